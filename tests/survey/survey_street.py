"""A street made of points, and drives over it as a vehicle would report them: quick, and known to the millimetre."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, transform
from gnd.gnd_map.submap import SubmapPoints
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_corridor
from gnd.schemas.keys import change_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.survey import SurveyAnchor, SurveyFix, SurveyMotion, SurveyReport, SurveySubmap

START_NS: Final = 1_700_000_000_000_000_000
TILE: Final = TileId.from_geodetic(np.radians(48.5), np.radians(9.2))
FRAME: Final = LocalFrame.of_tile(TILE)
HEIGHT_M: Final = 300.0
STEP_M: Final = 20.0
_SEEN_M: Final = 25.0


def street_points(low_m: float, high_m: float, seed: int = 1, period_m: float | None = None) -> F64:
    """(N, 3) points of a street along east: road, walls with bays, posts; with a period it repeats itself."""
    rng = np.random.default_rng([seed, 7])
    bays = rng.uniform(0.0, 3.0, (4096, 2))
    x = np.arange(low_m, high_m, 0.12)
    bay = np.floor((x if period_m is None else np.mod(x, period_m)) / 4.0).astype(int) % 4096
    parts = [np.stack(np.meshgrid(x, np.arange(-8.0, 8.0, 0.12), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)]
    z = np.arange(0.05, 5.0, 0.12)
    for side, column in ((-1.0, 0), (1.0, 1)):
        y = side * (8.0 + bays[bay, column])
        parts.append(np.column_stack([np.repeat(x, len(z)), np.repeat(y, len(z)), np.tile(z, len(x))]))
        for k in np.flatnonzero(np.diff(bay)):  # where a bay ends, its side wall
            across = np.arange(min(y[k], y[k + 1]), max(y[k], y[k + 1]), 0.12)
            parts.append(np.column_stack([np.full(len(across) * len(z), x[k]), np.repeat(across, len(z)),
                                          np.tile(z, len(across))]))  # fmt: skip
    return np.asarray(np.concatenate(parts) + np.array([0.0, 0.0, HEIGHT_M]))


@dataclass(frozen=True, slots=True)
class Driven:
    """How a vehicle drives: from east `first_m`, so many submaps, ahead or back; what its sensors are off by.

    gnss_off_m: error of all its fixes. anchored: submaps that the map still holds. odometry: one sigma of a step, m and
    rad. bent_m: its LiDAR sees walls so far aside. start_off_m: error of where it is believed to begin, by its fixes.
    """

    vehicle: str
    first_m: float = -10.0
    submaps: int = 6
    direction: int = 1
    gnss_off_m: tuple[float, float, float] = (0.5, -0.4, 0.8)
    anchored: Sequence[int] = (0,)
    odometry: tuple[float, float] = (0.02, 4e-4)
    bent_m: float = 0.0
    seed: int = 5
    period_m: float | None = None
    start_ns: int = START_NS
    layer: str = "ndt"
    parts: Sequence[Sequence[int]] = field(default=())

    def true_poses(self) -> F64:
        """(N, 4, 4) in FRAME."""
        rng = np.random.default_rng([self.seed, 1])
        T = []
        for n in range(self.submaps):
            yaw = (0.0 if self.direction > 0 else np.pi) + rng.normal(0, 0.01)
            p = np.array([self.first_m + self.direction * n * STEP_M, -1.8 * self.direction, HEIGHT_M])
            T.append(T_from_R_t(exp_so3([0.0, 0.0, yaw]), p))
        return np.stack(T)


def survey_of_drive(drive: Driven) -> list[SurveyReport]:
    """The parts of a survey that a vehicle sends of a drive."""
    rng, T = np.random.default_rng([drive.seed, 2]), drive.true_poses()
    m, rad = drive.odometry
    covariance = np.diag([rad**2] * 3 + [m**2] * 3)
    submaps, fixes, anchors = [], [], []
    for n in range(drive.submaps):
        points = SubmapPoints()
        seen = street_points(T[n, 0, 3] - _SEEN_M, T[n, 0, 3] + STEP_M + _SEEN_M, period_m=drive.period_m)
        seen = seen + rng.normal(0.0, 0.015, seen.shape) + [0.0, drive.bent_m * n / drive.submaps, 0.0]
        points.add(transform(T_inverse(T[n]), seen))
        step = None
        if n:
            off = T_from_R_t(exp_so3(rng.normal(0, rad, 3)), rng.normal(0, m, 3))
            step = SurveyMotion(T_inverse(T[n - 1]) @ T[n] @ off, covariance)
        t_ns = drive.start_ns + n * 2_000_000_000
        submaps.append(SurveySubmap(n, t_ns, step, points.encoded()))
        fix_m = T[n, :3, 3] + drive.gnss_off_m + rng.normal(0.0, 0.3, 3)
        lat, lon, height = FRAME.geodetic_from_enu(fix_m[None])
        fixes.append(SurveyFix(n, np.zeros(3), float(lat[0]), float(lon[0]), float(height[0]), 2.5))
        if n in drive.anchored:
            off = T_from_R_t(exp_so3(rng.normal(0, 1e-3, 3)), rng.normal(0, 0.02, 3))
            anchors.append(SurveyAnchor(n, TILE, SurveyMotion(T[n] @ off, np.diag([2e-3**2] * 3 + [0.04**2] * 3))))
    return _parts(drive, submaps, fixes, anchors)


def _parts(
    drive: Driven, submaps: list[SurveySubmap], fixes: list[SurveyFix], anchors: list[SurveyAnchor]
) -> list[SurveyReport]:
    numbers, made, survey_id = drive.parts or (range(drive.submaps),), [], ""
    lat, lon = FRAME.lat_rad, FRAME.lon_rad
    for part, some in enumerate(numbers):
        names = drive.vehicle, str(drive.seed), str(drive.start_ns), str(part)
        report_id = deterministic_report_id(drive.start_ns // 1_000_000, *names)
        survey_id = survey_id or report_id
        made.append(
            SurveyReport(
                report_id, survey_id, part, part == len(numbers) - 1, drive.vehicle, "VLP-16", "test", drive.layer,
                TileId.from_geodetic(lat, lon).district, submaps[some[0]].t_ns, submaps[some[-1]].t_ns + 1_000_000_000,
                tuple(submaps[n] for n in some), tuple(fix for fix in fixes if fix.submap in some),
                tuple(one for one in anchors if one.submap in some),
            )
        )  # fmt: skip
    return made


def key_of_part(report: SurveyReport) -> str:
    """The key on which a part is sent."""
    return change_key(report.layer, report.district)


def published_map(low_m: float, high_m: float, period_m: float | None = None) -> list[Tile]:
    """The tiles of the street between two places."""
    x = np.arange(low_m, high_m, 5.0)
    lat, lon, _ = FRAME.geodetic_from_enu(np.column_stack([x, np.zeros_like(x), np.full_like(x, HEIGHT_M)]))
    accumulator = VoxelAccumulator(GridFrame.around(FRAME, covering_corridor(lat, lon, 60.0)))
    points = street_points(low_m, high_m, period_m=period_m)
    accumulator.add(points + np.random.default_rng(3).normal(0.0, 0.015, points.shape))
    return [Tile(tile, 1, gaussians) for tile, gaussians in sorted(accumulator.finish().items())]


def with_part(report: SurveyReport, **changes: object) -> SurveyReport:
    """The part with some values changed."""
    return replace(report, **changes)  # type: ignore[arg-type]
