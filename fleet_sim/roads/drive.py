"""One drive along a route: what the vehicle's sensors give, and apart from it the truth for evaluation."""

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.drives import EPOCH_NS, SensorErrors
from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.curve import FloatArray
from gnd.fleet_sim.roads.hard_noise import HardNoise, erring_profile, hard_looks
from gnd.fleet_sim.roads.looks import DetectorNoise, detected, lane_looks
from gnd.fleet_sim.roads.motion import Cruise, RoadMotion
from gnd.fleet_sim.roads.route import IntArray, Route
from gnd.fleet_sim.roads.sight import CAMERA, LIDAR, BoolArray, CameraView, hidden, occluder_ranges, placed_boxes, polar
from gnd.fleet_sim.roads.traffic import EMPTY, Boxes, RoadTraffic, drawn_boxes, lanes_taken
from gnd.fleet_sim.trajectory import gauss_markov
from gnd.schemas.drive import Detections, LaneLook, MotionTrack

MOTION_HZ: Final = 50
LANES_HZ: Final = 15
_NS_PER_S: Final = 1_000_000_000
_CEP_PER_SIGMA: Final = 1.1774
"""Median of the length of a vector of two normal errors of standard deviation 1."""

GNSS_CEP_M: Final = 2.5
"""Median horizontal error: u-blox 6 data sheet, the papers' "2.5 m positioning errors"."""
GNSS_CORRELATION_S: Final = 13.4
GNSS_WHITE_SHARE: Final = 0.30
"""`python -m studies gnss-noise` at 9b4197d: of a car's single-point fixes against its reference."""


def road_errors(cep_m: float = GNSS_CEP_M) -> SensorErrors:
    """Return the errors of a drive whose GNSS has a median horizontal error of `cep_m`."""
    axis_m = cep_m / _CEP_PER_SIGMA
    slow_m, white_m = axis_m * sqrt(1.0 - GNSS_WHITE_SHARE), axis_m * sqrt(GNSS_WHITE_SHARE)
    return SensorErrors(gnss_m=slow_m * sqrt(2.0), gnss_correlation_s=GNSS_CORRELATION_S, gnss_white_m=white_m)


ROAD_ERRORS: Final = road_errors()


@dataclass(frozen=True, slots=True)
class RoadDriveOptions:
    """What a drive along a route is like.

    Attributes:
        errors: of wheel speed, yaw rate and GNSS.
        gnss_hz: rate of the GNSS.
        gnss_bias_m: standard deviation of a constant error of each axis of the GNSS, drawn for each drive, on top.
        points: noise of the detector of point features.
        lanes: noise of the lane camera.
        hard: what the detector of point features errs by besides; None: white noise of known sigma is all.
        view: what looks for point features; None: a camera for the layer "signs", else a LiDAR.
        lane_view: the lane camera's field of view.
        traffic: other vehicles; None: the usual ones on motorways, none on a closed track.
        start_m, length_m: which part of the route is driven; None: all of it, or one lap.
        start_ns: UTC of its start.
    """

    errors: SensorErrors = ROAD_ERRORS
    gnss_hz: int = 1
    gnss_bias_m: float = 0.0
    points: DetectorNoise = field(default_factory=DetectorNoise)
    lanes: DetectorNoise = field(default_factory=lambda: DetectorNoise(false_alarms=0.0))
    hard: HardNoise | None = None
    view: CameraView | None = None
    lane_view: CameraView = CAMERA
    traffic: RoadTraffic | None = None
    start_m: float = 0.0
    length_m: float | None = None
    start_ns: int = EPOCH_NS

    def __post_init__(self) -> None:
        if not 1 <= self.gnss_hz <= MOTION_HZ or self.gnss_bias_m < 0 or self.start_m < 0:
            raise RoadError(
                f"gnss_hz, gnss_bias_m or start_m cannot be: {self.gnss_hz}, {self.gnss_bias_m}, {self.start_m}"
            )
        if self.length_m is not None and self.length_m < 10.0:
            raise RoadError(f"a drive must be at least 10 m long, got {self.length_m}")


@dataclass(frozen=True, slots=True, eq=False)
class RoadGnss:
    """GNSS fixes in the route's frame.

    Attributes:
        t_ns: int64 (G,).
        xy_m: float64 (G, 2).
        sigma_m: standard deviation along each axis, as the receiver knows it.
    """

    t_ns: IntArray
    xy_m: FloatArray
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class DriveTruth:
    """What only an evaluation may know.

    Attributes:
        t_ns: int64 (T,), at MOTION_HZ.
        poses: float64 (T, 3), x, y [m], heading [rad, not wrapped] in the route's frame.
        look_poses: float64 (L, 3), at the looks.
        of_detection: of each look int64 (K,): id of the feature that each detection is of, 0 for a false alarm.
        in_view: bool (L, N), which of the route's features (or the places of deleted ones) lay in the field of view.
        hidden: bool (L, N), which of those another vehicle hid.
    """

    t_ns: IntArray
    poses: FloatArray
    look_poses: FloatArray
    of_detection: tuple[IntArray, ...]
    in_view: BoolArray
    hidden: BoolArray

    @property
    def looks_at(self) -> IntArray:
        """How many looks each of the route's features was or would have been visible in, int64 (N,)."""
        return np.asarray((self.in_view & ~self.hidden).sum(axis=0), dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class RoadDrive:
    """One drive. All but `truth` is what the vehicle has.

    Attributes:
        route: where.
        seed: what it was drawn from, together with the route's.
        motion: wheel speed and yaw rate at MOTION_HZ.
        gnss: fixes.
        view: field of view of the looks.
        looks: L looks for point features, in time order.
        occluder_m: float32 (L, A), distance of what hides at the azimuths of `view.azimuths_rad()`, inf where nothing.
        lane_looks: looks at lane markings, in time order.
        truth: for evaluation only.
    """

    route: Route
    seed: int
    motion: MotionTrack
    gnss: RoadGnss
    view: CameraView
    looks: tuple[Detections, ...]
    occluder_m: NDArray[np.float32]
    lane_looks: tuple[LaneLook, ...]
    truth: DriveTruth

    def events(self) -> Iterator[tuple[int, str, int]]:
        """Yield (time [ns], "motion" | "gnss" | "look" | "lanes", index) of everything in time order."""
        columns = {"motion": self.motion.t_ns.tolist(), "gnss": self.gnss.t_ns.tolist()}
        columns["look"] = [look.t_ns for look in self.looks]
        columns["lanes"] = [look.t_ns for look in self.lane_looks]
        order = {name: rank for rank, name in enumerate(("motion", "gnss", "lanes", "look"))}
        merged = heapq.merge(
            *([(t, order[name], name, i) for i, t in enumerate(times)] for name, times in columns.items())
        )
        return ((t, name, i) for t, _, name, i in merged)


def drive_route(route: Route, seed: int, options: RoadDriveOptions | None = None) -> RoadDrive:
    """Drive along a route.

    Args:
        route: where.
        seed: of this drive, >= 0; each source of chance has its own stream, so that an option changes only its own.
        options: errors, noise, traffic, stretch.

    Raises:
        RoadError: the stretch does not lie on the route, or the seed is negative.
    """
    options = options or RoadDriveOptions()
    if seed < 0:
        raise RoadError(f"the seed of a drive must be >= 0, got {seed}")
    names = ("style", "traffic", "motion", "gnss", "points", "lanes", "hard", "profile")
    streams = {name: np.random.default_rng([seed, route.seed, k, 9]) for k, name in enumerate(names)}
    motion, boxes = _driven(route, options, streams)
    lane_ns, lane_s = _times(motion, LANES_HZ, options.start_ns)
    lanes = lane_looks(
        route, options.lane_view, options.lanes, lane_ns, motion.poses(lane_s), motion.way_m(lane_s), streams["lanes"]
    )
    looks, occluder_m, truth = _looked(route, options, motion, boxes, streams)
    return RoadDrive(
        route=route,
        seed=seed,
        motion=_motion_track(motion, options, streams["motion"]),
        gnss=_gnss(motion, options, streams["gnss"]),
        view=_view(route, options),
        looks=looks,
        occluder_m=occluder_m,
        lane_looks=lanes,
        truth=truth,
    )


def _view(route: Route, options: RoadDriveOptions) -> CameraView:
    return options.view or (CAMERA if route.layer == "signs" else LIDAR)


def _looked(
    route: Route, options: RoadDriveOptions, motion: RoadMotion, boxes: Boxes, streams: dict[str, np.random.Generator]
) -> tuple[tuple[Detections, ...], NDArray[np.float32], DriveTruth]:
    """The looks for point features, what was in the way at each, and the truth of the drive."""
    view, features = _view(route, options), route.features
    t_ns, t_s = _times(motion, view.rate_hz, options.start_ns)
    poses = motion.poses(t_s)
    placed, places = placed_boxes(route, boxes, t_s, poses), polar(poses, features.xy_m)
    in_view = view.holds(*places)
    out_of_sight = hidden(poses, features.xy_m, features.height_m, in_view, placed, view.eye_m)
    rows = features.rows("normal", "new")
    standing = (places[0][:, rows], places[1][:, rows])
    visible, hard = (in_view & ~out_of_sight)[:, rows], options.hard
    occluder_m = occluder_ranges(view, poses, placed)
    if hard is None:
        there = features.take(rows)
        looks, of = detected(view, options.points, there, route.layer, t_ns, standing, visible, streams["points"])
    else:
        signs = (rows, *standing, visible)
        looks, of = hard_looks(route, view, options.points, hard, t_ns, poses, placed, signs, streams["hard"])
        occluder_m = erring_profile(occluder_m, view, hard, streams["profile"])
    motion_ns, motion_s = _times(motion, MOTION_HZ, options.start_ns)
    truth = DriveTruth(motion_ns, motion.poses(motion_s), poses, of, in_view, out_of_sight)
    return looks, occluder_m, truth


def _driven(
    route: Route, options: RoadDriveOptions, streams: dict[str, np.random.Generator]
) -> tuple[RoadMotion, Boxes]:
    """The true motion, on lanes that depend on the traffic, and the traffic."""
    length_m = options.length_m if options.length_m is not None else route.length_m - options.start_m
    if (not route.line.closed and options.start_m + length_m > route.length_m + 1e-6) or length_m < 10.0:
        raise RoadError(f"{length_m:.0f} m from {options.start_m:.0f} m on do not lie on {route.length_m:.0f} m")
    motion = RoadMotion(route, Cruise.drawn(streams["style"], *route.cruise_mps), options.start_m, length_m)
    traffic = options.traffic or (EMPTY if route.line.closed else RoadTraffic())
    boxes = drawn_boxes(route, traffic, motion, streams["traffic"])
    motion.keep_to(lanes_taken(motion, boxes))
    return motion, boxes


def _times(motion: RoadMotion, rate_hz: int, start_ns: int) -> tuple[IntArray, FloatArray]:
    """Times of a sensor over the drive: UTC [ns], time of the drive [s]."""
    count = int(motion.duration_s * rate_hz) + 1
    offset_ns = (np.arange(count, dtype=np.int64) * _NS_PER_S) // rate_hz
    return start_ns + offset_ns, offset_ns / _NS_PER_S


def _motion_track(motion: RoadMotion, options: RoadDriveOptions, rng: np.random.Generator) -> MotionTrack:
    errors = options.errors
    t_ns, t_s = _times(motion, MOTION_HZ, options.start_ns)
    speed, yaw_rate = motion.speed_and_yaw_rate(t_s)
    scale, bias = 1.0 + errors.wheel_scale * rng.standard_normal(), errors.gyro_bias_radps * rng.standard_normal()
    speed = scale * speed + errors.wheel_mps * rng.standard_normal(len(t_s))
    return MotionTrack(t_ns, speed, yaw_rate + bias + errors.gyro_radps * rng.standard_normal(len(t_s)))


def _gnss(motion: RoadMotion, options: RoadDriveOptions, rng: np.random.Generator) -> RoadGnss:
    errors = options.errors
    t_ns, t_s = _times(motion, options.gnss_hz, options.start_ns)
    axis_m, step_s = errors.gnss_m / sqrt(2.0), 1.0 / options.gnss_hz
    slow = [gauss_markov(rng, len(t_s), step_s, axis_m, errors.gnss_correlation_s) for _ in range(2)]
    white = errors.gnss_white_m * rng.standard_normal((len(t_s), 2))
    bias = options.gnss_bias_m * rng.standard_normal(2)
    sigma_m = float(np.sqrt(axis_m**2 + errors.gnss_white_m**2 + options.gnss_bias_m**2))
    return RoadGnss(t_ns, motion.positions(t_s) + np.stack(slow, axis=1) + white + bias, max(sigma_m, 0.01))
