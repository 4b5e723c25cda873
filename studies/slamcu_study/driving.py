"""One drive along the motorway through SLAMCU, in one of the variants, and what the truth says of it."""

from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.roads.drive import RoadDrive
from gnd.fleet_sim.roads.route import FEATURE_STATES, MAP_ERROR_M, Route
from gnd.fleet_sim.roads.sight import CameraView
from gnd.fleet_sim.trajectory import gauss_markov
from gnd.gnd_map.arrays import F64, I64
from gnd.schemas.drive import Detections
from gnd.vehicle_agent.features.look import Look, MapFeatures
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.replay import PoseAt
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu
from gnd.vehicle_agent.features.slamcu.tracked_feature import MAP_CONFIDENCE
from gnd.vehicle_agent.features.slamcu.verdicts import KnownState, NewFeature
from gnd.vehicle_agent.features.slamcu.watched import Lost, WatchedSlamcu
from gnd.vehicle_agent.features.view import Occlusion, SensorView
from studies.feature_study.truth import match_one_to_one, start_of
from studies.frame.pool import Tick
from studies.slamcu_study.signs import DELETED, NEW, SignTruth, Verdicts

LIDAR_SIGMA: Final = (0.04, 0.04, np.radians(0.08))
"""Errors of the LiDAR localiser's poses, m, m, rad: as `--poses noisy:4cm:0.08deg` of the other studies."""
_LIDAR_TAU_S: Final = 2.0
GIVEN_POSES: Final = ("no_rbpf", "lidar")
_TELL_EVERY: Final = 200


@dataclass(frozen=True, slots=True, eq=False)
class Driven:
    """What SLAMCU says after a drive, and its poses.

    Attributes:
        known: features of the map.
        new: features that it has not; those with too little evidence, too.
        step_ms: float64 (S,), time of each look with the motion since the one before.
        look: int64 (S,), indices of the looks taken.
        t_s: float64 (S,), time of the drive at each, since SLAMCU began.
        pose: float64 (S, 3), after each, as the vehicle believes at the end.
        pose_cov: float64 (S, 3, 3).
        lost: stretches on which it had believed something else.
        doubts: how often it asked.
        hidden: looks at features of the map that were left out as hidden.
    """

    known: tuple[KnownState, ...]
    new: tuple[NewFeature, ...]
    step_ms: F64
    look: I64
    t_s: F64
    pose: F64
    pose_cov: F64
    lost: tuple[Lost, ...]
    doubts: int
    hidden: int


def sign_truth(route: Route) -> SignTruth:
    """Return the signs of a route; its states are `TRUE_CLASSES`, in that order."""
    features = route.features
    codes = np.array([FEATURE_STATES.index(state) for state in features.states], np.uint8)
    return SignTruth(features.feature_id, features.xy_m, codes)


def map_features(route: Route) -> MapFeatures:
    """Return what the vehicle's map holds: normal and deleted signs where the survey put them."""
    mapped = route.features.mapped
    n = len(mapped)
    cov = np.broadcast_to(MAP_ERROR_M**2 * np.eye(2), (n, 2, 2)).copy()
    return MapFeatures(mapped.feature_id, mapped.kinds, mapped.mapped_xy_m, mapped.height_m, cov)


def look_of(detections: Detections) -> Look:
    """Return a look for SLAMCU."""
    return Look(
        detections.t_ns,
        np.asarray(detections.range_m, np.float64),
        np.asarray(detections.bearing_rad, np.float64),
        np.asarray(detections.sigma_range_m, np.float64),
        np.asarray(detections.sigma_bearing_rad, np.float64),
        detections.kinds,
    )


def sensor_view(view: CameraView) -> SensorView:
    """Return a simulated sensor's field of view as the vehicle knows it."""
    return SensorView(view.width_rad, view.range_m)


def occlusion_of(drive: RoadDrive, look: int) -> Occlusion | None:
    """Return what was in the way at a look; None where nothing was."""
    free_m = drive.occluder_m[look]
    if np.isinf(free_m).all():
        return None
    width = drive.view.width_rad
    return Occlusion.of_ranges(free_m, -0.5 * width, width / len(free_m))


def run_slamcu(drive: RoadDrive, variant: str, parameters: SlamcuParameters, seed: int, tick: Tick) -> Driven:
    """Return what SLAMCU makes of a drive.

    Args:
        drive: along a motorway.
        variant: of `VARIANTS`.
        parameters: of SLAMCU.
        seed: of its particles.
        tick: told how many looks have been taken.
    """
    run, start_ns = _SlamcuRun(drive, variant, parameters, seed), start_of(drive).t_ns
    for t_ns, what, i in drive.events():
        if t_ns > start_ns and what != "lanes":
            run.take(t_ns, what, i)
            if what == "look" and len(run.taken) % _TELL_EVERY == 0:
                tick(i, len(drive.looks))
    return run.driven()


class _SlamcuRun:
    """SLAMCU on its way along a drive."""

    def __init__(self, drive: RoadDrive, variant: str, parameters: SlamcuParameters, seed: int) -> None:
        start = start_of(drive)
        self._drive, self._variant, self._view = drive, variant, sensor_view(drive.view)
        first = map_features(drive.route), start.pose, start.cov, seed, drive.gnss.sigma_m
        given = variant in GIVEN_POSES
        self._given = Slamcu(parameters, *first) if given else None
        self._watched = None if given else WatchedSlamcu(parameters, *first)
        self._poses = _Poses.of(drive, variant, parameters, seed)
        self._before_ns, self._spent_s = start.t_ns, 0.0
        self._step_ms: list[float] = []
        self._at: list[PoseAt] = []
        self.taken: list[int] = []

    def take(self, t_ns: int, what: str, i: int) -> None:
        """Take one event; only SLAMCU's own work is timed."""
        given = self._poses.at(t_ns, what, i) if self._poses is not None else None
        if what == "look":
            self._look(i, given)
            return
        begun_s = perf_counter()
        if what == "motion":
            self._slamcu.predict((t_ns - self._before_ns) * 1e-9, *motion_at(self._drive, i))
            self._before_ns = t_ns
        elif self._poses is None:
            self._slamcu.gnss(*fix_at(self._drive, i))
        self._spent_s += perf_counter() - begun_s

    @property
    def _slamcu(self) -> Slamcu | WatchedSlamcu:
        found = self._given or self._watched
        assert found is not None
        return found

    def _look(self, i: int, given: tuple[F64, F64] | None) -> None:
        look = look_of(self._drive.looks[i])
        occlusion = None if self._variant == "no_occlusion" else occlusion_of(self._drive, i)
        begun_s = perf_counter()
        if given is not None and self._given is not None:
            self._given.set_pose(*given)
        self._slamcu.look(look, self._view, occlusion)
        self._step_ms.append(1e3 * (self._spent_s + perf_counter() - begun_s))
        self._spent_s = 0.0
        self.taken.append(i)
        if self._given is not None:
            self._at.append(PoseAt(self._given.now_s, *self._given.pose()))

    def driven(self) -> Driven:
        """What SLAMCU says at the end."""
        watched = self._watched
        if watched is not None:
            watched.finish()
        path = self._at if watched is None else watched.path
        return Driven(
            self._slamcu.known_states(),
            self._slamcu.new_features(unclassified=True),
            np.array(self._step_ms),
            np.array(self.taken, np.int64),
            np.array([one.t_s for one in path]),
            np.array([one.pose for one in path]),
            np.array([one.cov for one in path]),
            () if watched is None else tuple(watched.lost),
            0 if watched is None else watched.doubts,
            self._slamcu.hidden,
        )


def motion_at(drive: RoadDrive, i: int) -> tuple[float, float]:
    """Return wheel speed [m/s] and yaw rate [rad/s] of a sample."""
    return float(drive.motion.speed_mps[i]), float(drive.motion.yaw_rate_radps[i])


def fix_at(drive: RoadDrive, i: int) -> tuple[float, float, float]:
    """Return x, y and sigma of a fix, m."""
    return float(drive.gnss.xy_m[i, 0]), float(drive.gnss.xy_m[i, 1]), drive.gnss.sigma_m


class _Poses:
    """Poses that are given to SLAMCU instead of being estimated by it."""

    def __init__(self, drive: RoadDrive, filtered: Slamcu | None, error: F64) -> None:
        self._drive, self._filtered, self._error = drive, filtered, error
        self._before_ns = start_of(drive).t_ns

    @classmethod
    def of(cls, drive: RoadDrive, variant: str, parameters: SlamcuParameters, seed: int) -> "_Poses | None":
        if variant == "no_rbpf":
            start = start_of(drive)
            first = MapFeatures.none(), start.pose, start.cov, seed, drive.gnss.sigma_m
            return cls(drive, Slamcu(parameters, *first), np.zeros((0, 3)))
        if variant == "lidar":
            rng = np.random.default_rng([seed, drive.seed, 61])
            n, step_s = len(drive.looks), 1.0 / drive.view.rate_hz
            error = [gauss_markov(rng, n, step_s, sigma, _LIDAR_TAU_S) for sigma in LIDAR_SIGMA]
            return cls(drive, None, np.stack(error, axis=1))
        return None

    def at(self, t_ns: int, what: str, i: int) -> tuple[F64, F64] | None:
        """Follow the drive; give pose and covariance at a look."""
        if self._filtered is None:
            if what != "look":
                return None
            return self._drive.truth.look_poses[i] + self._error[i], np.diag(np.square(LIDAR_SIGMA))
        drive, filtered = self._drive, self._filtered
        if what == "motion":
            filtered.predict((t_ns - self._before_ns) * 1e-9, *motion_at(drive, i))
            self._before_ns = t_ns
        elif what == "gnss":
            filtered.gnss(*fix_at(drive, i))
        return filtered.pose() if what == "look" else None


def verdicts_of(drive: RoadDrive, driven: Driven, map_confidence: float = MAP_CONFIDENCE) -> Verdicts:
    """Return what a drive says of its signs, with what the truth tells of how it came about."""
    truth = sign_truth(drive.route)
    sign, t_s, masses = _traces(drive, driven, truth, map_confidence)
    in_view, hidden = drive.truth.in_view[driven.look], drive.truth.hidden[driven.look]
    new = driven.new
    return Verdicts(
        known_id=np.array([one.feature_id for one in driven.known], np.int64),
        known_predicted=np.array([int(one.feature_class) for one in driven.known], np.uint8),
        known_conflict=np.array([one.existence.conflict for one in driven.known]),
        new_xy_m=np.array([one.position_m for one in new]).reshape(-1, 2),
        new_cov_m2=np.array([one.cov_m2 for one in new]).reshape(-1, 2, 2),
        new_exists=np.array([one.feature_class == NEW for one in new], np.bool_),
        new_conflict=np.array([one.existence.conflict for one in new]),
        step_ms=driven.step_ms,
        pose_error=pose_errors(driven.pose, drive.truth.look_poses[driven.look]),
        pose_chi2=pose_chi2(driven.pose, driven.pose_cov, drive.truth.look_poses[driven.look]),
        pose_said_lost=said_lost(driven),
        lost=np.array(
            [(one.from_s, one.until_s, one.off_m, one.value, one.taken_back, one.replayed) for one in driven.lost]
        ).reshape(-1, 6),
        pose_part_m=pose_parts(driven.pose, drive.truth.look_poses[driven.look], truth.xy_m, in_view & ~hidden),
        visible=(in_view & ~hidden).sum(axis=0).astype(np.int64),
        occluded=(in_view & hidden).sum(axis=0).astype(np.int64),
        no_evidence=driven.hidden,
        trace_sign=sign,
        trace_s=t_s,
        trace_masses=masses,
    )


def pose_errors(pose: F64, true: F64) -> F64:
    """Return errors (S, 3) of poses (S, 3): along and to the left of the true heading [m], heading [rad]."""
    dx, dy = (pose - true)[:, :2].T
    c, s = np.cos(true[:, 2]), np.sin(true[:, 2])
    turn = (pose[:, 2] - true[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([c * dx + s * dy, c * dy - s * dx, turn])


def pose_chi2(pose: F64, cov: F64, true: F64) -> F64:
    """Return (S,) squared Mahalanobis distances of poses' places from the true ones; (S, 3), (S, 3, 3), (S, 3)."""
    off = (pose - true)[:, :2]
    return np.asarray(np.einsum("si,si->s", off, np.linalg.solve(cov[:, :2, :2], off[..., None])[..., 0]))


def said_lost(driven: Driven) -> NDArray[np.bool_]:
    """Return bool (S,), the looks of stretches of which the vehicle says nothing."""
    lost = np.zeros(len(driven.look), np.bool_)
    for one in driven.lost:
        lost |= (driven.t_s >= one.from_s) & (driven.t_s <= one.until_s) & (not one.replayed)
    return lost


def pose_parts(pose: F64, true: F64, xy_m: F64, visible: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> F64:
    """Return (N, 2) what errors of the poses moved each place by, mean over the looks at it; nan where there are none.

    A look from near tells more of a place than one from afar, and so counts with the inverse of its squared range.

    Args:
        pose: (S, 3) as estimated.
        true: (S, 3).
        xy_m: (N, 2) places.
        visible: (S, N) which looks could see which place.
    """
    found = np.full((len(xy_m), 2), np.nan)
    for n, place in enumerate(xy_m):
        rows = np.flatnonzero(visible[:, n])
        if len(rows):
            moved = _seen_from(pose[rows], true[rows], place) - place
            weight = 1.0 / np.maximum(np.linalg.norm(place - true[rows, :2], axis=1), 10.0) ** 2
            found[n] = weight @ moved / weight.sum()
    return found


def _seen_from(pose: F64, true: F64, place: F64) -> F64:
    """Where a place (2,) seen rightly from true poses (S, 3) lies for one who believes to be at other poses."""
    turn = pose[:, 2] - true[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    x, y = (place - true[:, :2]).T
    return np.asarray(pose[:, :2] + np.column_stack([c * x - s * y, s * x + c * y]))


def _traces(drive: RoadDrive, driven: Driven, truth: SignTruth, map_confidence: float) -> tuple[I64, F64, F64]:
    """Masses over time of deleted and new signs, those of the map from λ_HD on: sign, seconds, masses (Q, 3)."""
    begin_ns, rows = int(drive.motion.t_ns[0]), []
    for sign, one in _told(driven, truth):
        if isinstance(one, KnownState) and one.history:
            rows.append((sign, (one.history[0].t_ns - begin_ns) * 1e-9, map_confidence, 0.0, 1.0 - map_confidence))
        for step in one.history:
            masses = step.existence
            rows.append((sign, (step.t_ns - begin_ns) * 1e-9, masses.exist, masses.absent, masses.unknown))
    columns = np.array(rows, np.float64).reshape(-1, 5)
    return columns[:, 0].astype(np.int64), columns[:, 1], columns[:, 2:]


def _told(driven: Driven, truth: SignTruth) -> Iterator[tuple[int, KnownState | NewFeature]]:
    """Deleted and new signs with what SLAMCU says of them."""
    states = {one.feature_id: one for one in driven.known}
    for sign in truth.of(DELETED).tolist():
        yield sign, states[int(truth.feature_id[sign])]
    signs = truth.of(NEW)
    new = [one for one in driven.new if one.feature_class == NEW]
    matching = match_one_to_one(np.array([one.position_m for one in new]).reshape(-1, 2), truth.xy_m[signs])
    for sign, estimate in zip(signs[matching.true].tolist(), matching.estimate.tolist(), strict=True):
        yield sign, new[estimate]
