"""Feature layers behind poses that are in doubt: nothing of what was concluded then is reported, and it is counted."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from test_feature_layer import FRAME, GONE, NEW, STANDS, look_from, mapped

from gnd.schemas.drive import Detections
from gnd.schemas.feature_layer import LAYERS
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.features.layer_parameters import FeatureParameters
from gnd.vehicle_agent.features.layers import FeatureLayers
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays
from gnd.vehicle_agent.segment.segmenter import SegmentedScan

STEP_NS = 66_000_000
Wrong = Literal["none", "poor", "disagrees", "taken back", "shifted", "a moment"]


class Said:
    """What would go into a report."""

    def __init__(self) -> None:
        self.changes: list = []
        self.counts: dict[str, int] = {}

    def add(self, change, t_ns, odometer_m) -> None:
        self.changes.append(change)

    def report(self, *_) -> None: ...

    def report_all(self, *_) -> None: ...


def scan_at(x_m: float, t_ns: int) -> SegmentedScan:
    T = np.eye(4)
    T[0, 3] = x_m
    rays = T[:3, 3] + np.array([[30.0, 0.0, -1.5], [0.0, 30.0, -1.5]])
    estimate = PoseEstimate(t_ns, T, 0.02, 0.001, 0.9, "good")
    scan = RefinedScan(t_ns, PlacedRays(rays, np.repeat(T[None, :3, 3], 2, axis=0)), estimate)
    return SegmentedScan(scan, np.zeros(2, bool))


def detections(x_m: float, rng: np.random.Generator, t_ns: int) -> Detections:
    look = look_from(x_m, rng, t_ns).look
    columns = (look.range_m, look.bearing_rad, look.height_m, look.sigma_range_m, look.sigma_bearing_rad)
    return Detections(t_ns, "camera", "signs", tuple(look.kinds), *(np.asarray(one, np.float32) for one in columns))


def driven(wrong: Wrong) -> tuple[list, dict[str, int]]:
    """A drive past a sign that stands, one that has gone and one that is new."""
    said, rng = Said(), np.random.default_rng(3)
    layers = FeatureLayers(FeatureParameters((LAYERS["signs"],)), ReportParameters(), FRAME, [said])  # type: ignore[list-item]
    for tile in mapped(STANDS, GONE):
        layers.hold("signs", tile)
    for step in range(160):
        x_m, t_ns = -20.0 + 0.6 * step, step * STEP_NS
        layers.wait(detections(x_m, rng, t_ns))
        segmented = scan_at(x_m, t_ns)
        if (wrong in ("poor", "disagrees") and 60 <= step < 90) or (wrong == "a moment" and step == 60):
            bad = {"disagrees": True} if wrong == "disagrees" else {"health": "degraded"}
            scan = replace(segmented.scan, estimate=replace(segmented.scan.estimate, **bad))
            segmented = replace(segmented, scan=scan)
        if step == 80 and wrong == "taken back":
            layers.take_back()
        layers.doubt(25 if step == 80 and wrong == "shifted" else 0)
        layers.take(segmented, 0.6 * step)
    layers.finish()
    return said.changes, dict(layers.counts)


@pytest.mark.parametrize("wrong", ["none", "a moment"])
def test_good_poses_report_all(wrong: Wrong) -> None:
    changes, counts = driven(wrong)
    assert sum(len(change.found) for change in changes) == 1
    assert {one.existence.state for change in changes for one in change.seen} == {"exist", "absent"}
    assert "tiles_held_back" not in counts
    assert NEW[0] == 80.0


@pytest.mark.parametrize("wrong", ["poor", "disagrees", "taken back", "shifted"])
def test_what_was_seen_from_poses_in_doubt_is_held_back_and_counted(wrong: Wrong) -> None:
    all_changes, _ = driven("none")
    changes, counts = driven(wrong)
    judged = sum(change.n_features for change in changes)
    assert counts["tiles_held_back"] > 0
    assert judged + counts["features_held_back"] >= 2
    assert judged < sum(change.n_features for change in all_changes)
    assert all(one.existence.state != "absent" for change in changes for one in change.seen)
