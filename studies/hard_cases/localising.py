"""One run of the localiser over a hard case, every pose kept with its covariance."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.schemas.drive import DriveHeader, DriveItem, ReferencePose, Scan
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.localise.localiser import Localiser
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.pipeline import Pipeline
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand
from studies.hard_cases.cases import Kidnap
from studies.simulation.base_map import BaseMap

HEALTHS: Final = ("lost", "degraded", "good")
_HEADING, _X, _Y = 2, 3, 4
"""Entries of a pose's covariance: rotation before position."""


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """N poses of a run against the truth.

    Attributes:
        t_ns: int64 (N,).
        error: float64 (N, 3), along and across the true heading [m], heading [rad].
        covariance: float64 (N, 3, 3) of the same three in the same order, as the vehicle claims it; NaN where it
            claims none.
        health: uint8 (N,), index of `HEALTHS`.
    """

    t_ns: I64
    error: F64
    covariance: F64
    health: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def of(cls, estimates: Iterable[PoseEstimate], true: Trajectory) -> "Poses":
        """Return the errors of the estimates that lie within the truth's time; frames must be the same."""
        within = [e for e in estimates if true.t_ns[0] <= e.t_ns <= true.t_ns[-1]]
        t_ns = np.array([e.t_ns for e in within], np.int64)
        health = np.array([HEALTHS.index(e.health) for e in within], np.uint8)
        if not within:
            return cls(t_ns, np.empty((0, 3)), np.empty((0, 3, 3)), health)
        error = T_inverse(true.at(t_ns)) @ np.stack([e.T_map_vehicle for e in within])
        off = np.column_stack([error[:, 0, 3], error[:, 1, 3], log_so3(error[:, :3, :3])[:, 2]])
        return cls(t_ns, off, np.stack([_claimed(e) for e in within]), health)


def _claimed(estimate: PoseEstimate) -> F64:
    """Covariance (3, 3) of place and heading."""
    if estimate.covariance is None:
        return np.full((3, 3), np.nan)
    rows = [_X, _Y, _HEADING]
    return estimate.covariance[np.ix_(rows, rows)]


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The localiser's estimate of the time between its clocks [s]: samples stamped so much too late; one sigma."""

    offset_s: float
    sigma_s: float


@dataclass(frozen=True, slots=True, eq=False)
class CaseRun:
    """What a run gave: refined and online poses, scans that arrived, and the clock offset where it was estimated."""

    refined: Poses
    online: Poses
    scans: int
    clock: ClockOffset | None


def clock_offset_of(localiser: Localiser) -> ClockOffset | None:
    """Return the clock offset that a localiser has found."""
    known = localiser.calibration
    return ClockOffset(known.time_offset_s, known.time_offset_sigma_s)


def run_case(
    header: DriveHeader,
    items: Iterable[DriveItem],
    base: BaseMap,
    parameters: LocaliserParameters,
    kidnap: Kidnap | None,
    seed: int,
) -> CaseRun:
    """Run the localiser over a drive, the map's tiles held around the vehicle as the agent does.

    Args:
        header: of the drive.
        items: in time order, with reference poses, which the vehicle never sees.
        base: the map.
        parameters: of the localiser.
        kidnap: a wrong pose that it gets at the first scan, None for none.
        seed: of where that pose is.

    Raises:
        VehicleError: the drive has no GNSS fix.
    """
    fix, stream = first_fix(items, header.drive_id)
    pipeline = Pipeline(
        header,
        fix,
        lambda local_map, touched: TilesAtHand(base, local_map, touched),
        PipelineParameters(localise=parameters),
    )
    all_items = list(stream)
    true = _true(all_items, pipeline.place.frame.T_self_other(header.anchor))
    if kidnap is not None:
        first_ns = next(item.t_ns for item in all_items if isinstance(item, Scan))
        pipeline.start_at(first_ns, _displaced(true.at(first_ns), kidnap, seed), trusted=True)
    refined: list[PoseEstimate] = []
    online: list[PoseEstimate] = []  # one pose a scan, those called lost too
    for item in all_items:
        output = pipeline.push(item)
        refined += output.poses
        if output.online is not None and (not online or output.online.t_ns > online[-1].t_ns):
            online.append(output.online)
    refined += pipeline.finish().poses
    clock = clock_offset_of(pipeline.localiser)
    return CaseRun(Poses.of(refined, true), Poses.of(online, true), pipeline.scans, clock)


def _true(items: Iterable[DriveItem], T_map_anchor: F64) -> Trajectory:
    poses = [item for item in items if isinstance(item, ReferencePose)]
    T_anchor_vehicle = np.stack([pose.T_map_vehicle for pose in poses])
    return Trajectory(np.array([pose.t_ns for pose in poses], np.int64), T_map_anchor @ T_anchor_vehicle)


def _displaced(T_map_vehicle: F64, kidnap: Kidnap, seed: int) -> F64:
    """Return a pose so far off, in a direction of its own."""
    rng = np.random.default_rng([seed, 0x41D])
    way_m, turn = rng.uniform(kidnap.nearest_m, kidnap.farthest_m), rng.uniform(-pi, pi)
    T = T_map_vehicle.copy()
    T[:3, 3] += way_m * np.array([np.cos(turn), np.sin(turn), 0.0])
    return T
