"""Parts of surveys between bus and store: what cannot be true is refused by name, with numbers."""

from typing import Final

import numpy as np

from gnd.cloud_merger.errors import BadReport
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.keys import parse_change_key
from gnd.schemas.survey import SurveyReport
from gnd.tile_store.errors import IdTaken
from gnd.tile_store.roads import RoadPart
from gnd.tile_store.store import Store

FAR_M: Final = 20_000.0
"""A part of a survey does not reach farther from its district."""
SPEED_MPS: Final = 70.0
ANCHOR_OFF_M: Final = 100.0
"""An anchor may lie so far from the fixes of its submap, beside five of their sigmas."""
_MAX_MEAN_M: Final = 200.0
_MAX_COVARIANCE_M2: Final = 0.25
"""Points within half a metre vary by no more along any axis."""


class SurveyInbox:
    """What becomes of a part of a survey. Safe in several threads.

    Args:
        store: of the map.
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    def keep(self, key: str, report: SurveyReport, received_ns: int) -> None:
        """Check a part and keep it; one that is known changes nothing.

        Raises:
            BadReport: it cannot be true; with numbers.
            SchemaError: what it holds cannot be decoded.
        """
        check_survey(key, report)
        part = RoadPart(
            report.survey_id, report.part, report.report_id, report.layer, report.vehicle, received_ns, report.encode()
        )
        try:
            self._store.put_road_part(part)
        except IdTaken as error:
            raise BadReport(str(error)) from error


def check_survey(key: str, report: SurveyReport) -> None:
    """Refuse a part that no vehicle can have driven.

    Raises:
        BadReport: with numbers.
        SchemaError: no key of reports, or Gaussians that cannot be decoded.
    """
    layer, district = parse_change_key(key)
    what = f"part {report.part} of survey {report.survey_id}"
    if (report.layer, report.district) != (layer, district):
        raise BadReport(f"{what} for {report.layer} {report.district} came on the key of {layer} {district}")
    _check_times(what, report)
    frame = LocalFrame(*district.centre_rad)
    fixes = {
        fix.submap: (frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m), fix.sigma_m)
        for fix in report.fixes
    }
    for number, (place_m, _) in fixes.items():
        _check_far(f"{what}: the fix of submap {number}", float(np.hypot(*place_m[:2])))
    for anchor in report.anchors:
        T = frame.T_self_other(LocalFrame.of_tile(anchor.tile)) @ anchor.pose.T
        _check_far(f"{what}: the anchor of submap {anchor.submap}", float(np.hypot(*T[:2, 3])))
        if anchor.submap in fixes:
            place_m, sigma_m = fixes[anchor.submap]
            off_m, limit_m = float(np.hypot(*(place_m - T[:3, 3])[:2])), ANCHOR_OFF_M + 5.0 * sigma_m
            if off_m > limit_m:
                raise BadReport(f"{what}: the anchor of submap {anchor.submap} lies {off_m:.0f} m from its fix, the "
                                f"limit is {limit_m:.0f} m")  # fmt: skip
    for submap in report.submaps:
        gaussians = submap.gaussians()
        if len(gaussians) and float(np.abs(gaussians.mean_m).max()) > _MAX_MEAN_M:
            raise BadReport(f"{what}: submap {submap.number} reaches {np.abs(gaussians.mean_m).max():.0f} m")
        variance = float(np.einsum("nii->ni", gaussians.cov_m2).max(initial=0.0))
        if variance > _MAX_COVARIANCE_M2:
            raise BadReport(
                f"{what}: variance {variance:.3g} m² in submap {submap.number}, the limit is {_MAX_COVARIANCE_M2:g} m²"
            )


def _check_times(what: str, report: SurveyReport) -> None:
    for before, now in zip(report.submaps, report.submaps[1:], strict=False):
        step = now.step
        assert step is not None
        s, m = (now.t_ns - before.t_ns) * 1e-9, float(np.linalg.norm(step.T[:3, 3]))
        if s <= 0 or m > SPEED_MPS * s:
            raise BadReport(f"{what}: from submap {before.number} to {now.number} {m:.1f} m in {s:.2f} s")


def _check_far(what: str, far_m: float) -> None:
    if not far_m <= FAR_M:
        raise BadReport(f"{what} lies {far_m / 1000:.0f} km from the district, the limit is {FAR_M / 1000:g} km")
