"""Mapping of a new feature layer in a vehicle (Kim, Cho, Sunwoo and Jo 2018, section 3).

While driving, motion, fixes, looks at features and looks at lanes are gathered. When the vehicle has stopped, a graph
of the whole drive gives the features and how certain they are, all in the map frame; then gathering begins anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.look import MapFeatures
from gnd.vehicle_agent.features.mapping.drive_nodes import DriveNodes
from gnd.vehicle_agent.features.mapping.feature_drive import FeatureDrive, Measurements
from gnd.vehicle_agent.features.mapping.graph import Solution, solve
from gnd.vehicle_agent.features.mapping.graph_edges import GraphAnchors, Problem, State
from gnd.vehicle_agent.features.mapping.landmarks import (
    LANDMARK_DRIFT_M,
    LANDMARK_MIN_HITS,
    LANDMARK_REVISIT_M,
    NONE,
    KnownPlaces,
    LandmarkPlaces,
    Sight,
    assigned,
    clustered,
    doubles,
    kept,
    spread,
    tied,
)
from gnd.vehicle_agent.features.mapping.lanes import LaneMap, LaneMatcher
from gnd.vehicle_agent.features.mapping.sensors import SERIES_CAR, DriveSensors
from gnd.vehicle_agent.features.mapping.smoothed_path import SmoothedPath
from gnd.vehicle_agent.features.mapping.strain import Strain, strains
from gnd.vehicle_agent.features.slamcu.sensor_model import SensorModel

ROUNDS: Final = 6
CONFIDENT: Final = 0.9
_SETTLED_M: Final = 0.01
"""Rounds end when no feature moves by more."""


@dataclass(frozen=True, slots=True, eq=False)
class MappedFeatures:
    """The features that a drive has measured, N of them, in the map frame.

    known_id: (N,) id of the known feature that it is, 0 = a new one. kinds: N.
    xy_m: (N, 2). cov_m2: (N, 2, 2), of the place in the map frame: the drive's own errors are in it.
    height_m: (N,) above the vehicle's origin, nan = unknown. hits: (N,) measurements.
    """

    known_id: I64
    kinds: tuple[str, ...]
    xy_m: F64
    cov_m2: F64
    height_m: F64
    hits: I64

    def __len__(self) -> int:
        return len(self.xy_m)


@dataclass(frozen=True, slots=True, eq=False)
class NewLayer:
    """What a drive gives. cost: J of Eq. (6), with lanes of Eq. (10). calibration: (2,) wheel scale, gyro bias.

    strains: edges that contradict the rest of the graph; when there are any, nothing of it is to be believed.
    """

    features: MappedFeatures
    path: SmoothedPath
    calibration: F64
    cost: float
    solution: Solution
    """For covariances of poses: `solution.pose_cov(keys)`."""
    strains: tuple[Strain, ...] = ()


def map_new_layer(
    drive: FeatureDrive,
    sensors: DriveSensors = SERIES_CAR,
    lanes: LaneMap | None = None,
    known: MapFeatures | None = None,
    *,
    trust_known: bool = True,
    rounds: int = ROUNDS,
) -> NewLayer:
    """Map the features of a drive.

    Args:
        drive: what was gathered.
        sensors: how exact the vehicle's own are.
        lanes: the HD map's; None = map without HD map (section 3.1).
        known: features of the layer that the map has already.
        trust_known: known features constrain the poses (with their covariances). False: they are only
            recognised, and where the drive has measured them does not depend on where the map has them.
        rounds: measurements are given to features anew, and the graph is solved, at most so often.

    Raises:
        NewLayerError: the drive's positions and motion do not go together.
    """
    return _Mapping(drive, sensors, lanes, known or MapFeatures.none(), trust_known).run(rounds)


class _Mapping:
    """One run of `map_new_layer`: landmarks are the known features first, then the new ones."""

    def __init__(
        self,
        drive: FeatureDrive,
        sensors: DriveSensors,
        lanes: LaneMap | None,
        known: MapFeatures,
        trust_known: bool,
        find_new: bool = True,
    ) -> None:
        drive = drive.within_motion()
        self.drive, self.sensors, self.known, self.trust_known = drive, sensors, known, trust_known
        self.find_new = find_new
        self.m = Measurements.of(drive.looks)
        self.nodes, self.state = DriveNodes.of(drive, sensors).first_state()
        self.lanes = None if lanes is None else LaneMatcher(lanes, drive.lanes, self.nodes)
        self.owner = np.full(len(self.m), NONE, np.int64)
        self.xy_m = known.xy_m
        self.kind = self._known_kinds()
        self.errors = np.zeros((len(known.xy_m), 2))  # of range (share) and bearing [rad], each feature's own
        self.detector = SensorModel(CONFIDENT)
        self.strains: tuple[Strain, ...] = ()

    def _known_kinds(self) -> I64:
        code = {name: n for n, name in enumerate(self.m.kinds)}
        return np.array([code.get(kind, NONE) for kind in self.known.kind], np.int64)

    @property
    def sight(self) -> Sight:
        return self.nodes.sight(self.m.t_ns)

    def run(self, rounds: int) -> NewLayer:
        """Rounds of association, matching and optimisation."""
        if self.lanes is not None:
            self._solve_without_features()
        slack_m = LANDMARK_REVISIT_M
        for turn in range(rounds):
            before = self.xy_m
            self._associate(slack_m)
            solution = self._solve()
            slack_m = LANDMARK_DRIFT_M
            if turn > 0 and self._merge(solution):
                continue
            if turn > 0 and before.shape == self.xy_m.shape and self._moved(before) < _SETTLED_M:
                break
        return self._result(self._solve(polish=True))

    def _moved(self, before: F64) -> float:
        return float(np.abs(before - self.xy_m).max(initial=0.0))

    def _solve_without_features(self) -> None:
        """Better first poses: lanes are matched before features are looked for."""
        for _ in range(2):
            problem = self._problem()
            self.state = solve(problem, self.state, self.sensors).state
            self.nodes = self.nodes.calibrated(self.state.calibration)

    def _problem(self, polish: bool = False) -> Problem:
        problem = self.nodes.problem(self.state.pose)
        if self.lanes is None:
            return problem
        return replace(problem, lanes=self.lanes.matched(self.nodes, self.state.pose, polish=polish))

    def _associate(self, slack_m: float) -> None:
        """Measurements to known and new features; those left over may make further new ones."""
        sight, pose = self.sight, self.state.pose
        slack = np.full(len(self.xy_m), LANDMARK_DRIFT_M)
        slack[: len(self.known.xy_m)] = slack_m if self.trust_known else LANDMARK_REVISIT_M
        self.owner = assigned(self.m, sight, pose, KnownPlaces(self.xy_m, self.kind, slack, self.errors))
        if self.find_new:
            self._find_new(sight, pose)
        self._drop_ghosts()

    def _find_new(self, sight: Sight, pose: F64) -> None:
        left = np.flatnonzero(self.owner == NONE)
        rest = replace(self.m, **{c: getattr(self.m, c)[left] for c in _COLUMNS})
        where = Sight(sight.key[left], sight.offset[left], sight.way_m[left])
        found, xy_m = clustered(rest, where, pose, self.detector.claimed)
        new = kept(found, LANDMARK_MIN_HITS)
        _, first = np.unique(found[new >= 0], return_index=True)
        rows = left[new >= 0]
        self.owner[rows] = len(self.xy_m) + new[new >= 0]
        self.xy_m = np.concatenate([self.xy_m, xy_m[np.unique(found[new >= 0])]])
        self.kind = np.append(self.kind, self.m.kind[rows[first]])
        self.errors = np.concatenate([self.errors, np.zeros((len(self.xy_m) - len(self.errors), 2))])

    def _drop_ghosts(self) -> None:
        """New features with too few measurements go; known ones stay, seen or not."""
        n_known, n = len(self.known.xy_m), len(self.xy_m)
        hits = np.bincount(self.owner[self.owner >= 0], minlength=n)
        stays = (hits >= LANDMARK_MIN_HITS) | (np.arange(n) < n_known)
        number = np.append(np.where(stays, np.cumsum(stays) - 1, NONE), NONE)
        self.owner = np.where(self.owner >= 0, number[self.owner], NONE)
        self.xy_m, self.kind, self.errors = self.xy_m[stays], self.kind[stays], self.errors[stays]

    def _solve(self, polish: bool = False) -> Solution:
        """Optimise with the features that are tied to the drive; the others are no nodes."""
        seen = np.unique(self.owner[self.owner >= 0])
        number = np.full(len(self.xy_m) + 1, NONE)
        number[seen] = np.arange(len(seen))
        ties = tied(self.m, self.sight, number[self.owner], self.state.pose, self.xy_m[seen])
        start = State(self.state.pose, self.xy_m[seen], self.state.calibration, self.errors[seen])
        held = self.detector.claimed if polish else self.detector.held
        problem = replace(self._problem(polish), ties=ties, anchors=self._anchors(seen, number), held=held)
        solution = solve(problem, start, self.sensors)
        self._learn(solution, held)
        self.strains = strains(problem, solution.state, self.nodes.t_ns, self.sensors)
        self.state = State(solution.state.pose, np.empty((0, 2)), solution.state.calibration)
        self.nodes = self.nodes.calibrated(solution.state.calibration)
        self.xy_m, self.errors = self.xy_m.copy(), self.errors.copy()
        self.xy_m[seen] = solution.state.xy_m
        if len(solution.state.errors):
            self.errors[seen] = solution.state.errors
        return solution

    def _learn(self, solution: Solution, held: F64) -> None:
        """How large the errors are that stay with features, by those of all features that were measured."""
        self.detector = SensorModel(CONFIDENT)
        for error, variance in zip(solution.state.errors, solution.error_variance(), strict=True):
            self.detector.settled(error, variance, held)

    def _anchors(self, seen: I64, number: I64) -> GraphAnchors:
        rows = seen[seen < len(self.known.xy_m)] if self.trust_known else np.empty(0, np.int64)
        return GraphAnchors(number[rows], self.known.xy_m[rows], self.known.cov[rows])

    def _merge(self, solution: Solution) -> bool:
        """Two new features that are one become one; the older number stays."""
        n_known = len(self.known.xy_m)
        seen = np.unique(self.owner[self.owner >= 0])
        new = seen[seen >= n_known]
        if len(new) < 2:
            return False
        cov = solution.landmark_cov()[np.searchsorted(seen, new)]
        number = np.full(len(self.xy_m) + 1, NONE)
        number[new] = np.arange(len(new))
        owner = number[self.owner]
        at = LandmarkPlaces(
            self.xy_m[new], cov, spread(self.m, self.sight, self.state.pose, owner, len(new)), self.kind[new]
        )
        same = doubles(self.m, owner, at)
        for first, second in same:
            self.owner[self.owner == new[second]] = new[first]
        self._drop_ghosts()
        return bool(same)

    def _result(self, solution: Solution) -> NewLayer:
        seen = np.unique(self.owner[self.owner >= 0])
        ids = np.concatenate([self.known.feature_id, np.zeros(len(self.xy_m) - len(self.known.xy_m), np.int64)])
        rows = [np.flatnonzero(self.owner == n) for n in seen]
        features = MappedFeatures(
            ids[seen],
            tuple(self.m.kinds[self.kind[n]] for n in seen),
            self.xy_m[seen],
            solution.landmark_cov(),
            np.array([_height(self.m.height_m[r]) for r in rows]),
            np.array([len(r) for r in rows], np.int64),
        )
        path = SmoothedPath(self.nodes.t_ns, solution.state.pose, self.nodes.reckoning)
        return NewLayer(features, path, solution.state.calibration, solution.cost, solution, self.strains)


_COLUMNS = ("look", "t_ns", "range_m", "bearing_rad", "sigma_range_m", "sigma_bearing_rad", "height_m", "kind")


def _height(height_m: F64) -> float:
    known = height_m[np.isfinite(height_m)]
    return float(known.mean()) if len(known) else float("nan")


def localise_with_features(
    drive: FeatureDrive,
    sensors: DriveSensors = SERIES_CAR,
    lanes: LaneMap | None = None,
    known: MapFeatures | None = None,
) -> NewLayer:
    """Where the vehicle was, by the same graph with the features known (section 6.3); none are added.

    Deleted features are not to be among `known`; features of a new layer are once they are published. Without `known`
    it is localisation by motion, GNSS and lanes alone. Arguments and errors as of `map_new_layer`.
    """
    return _Mapping(drive, sensors, lanes, known or MapFeatures.none(), True, find_new=False).run(ROUNDS)


def lane_map(lanes: Sequence[F64]) -> LaneMap:
    """The HD map's lanes, polylines (N, 2) in the map frame, made ready."""
    return LaneMap.of(lanes)
