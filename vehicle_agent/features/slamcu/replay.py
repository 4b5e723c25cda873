"""A drive that can be run again: its measurements, SLAMCU's states on the way, and the path that came of it.

A checkpoint is a copy of SLAMCU some way back. From it the measurements since are run again, with other particles or
without some of the looks, and what comes of it can take the place of what was believed.
"""

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.look import Look
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu
from gnd.vehicle_agent.features.slamcu.watch import DELETED_COST, NEW_COST, PASSED_AROUND_S, Watch
from gnd.vehicle_agent.features.view import Occlusion, SensorView

KEEP_EVERY_M: Final = 300.0
"""A checkpoint is made so often, when nothing is in view."""
KEEP_AT_LEAST_M: Final = 1000.0
"""And even when something is."""
CHECKPOINTS: Final = 14
"""So many are kept: 4 km."""
CLEAR_S: Final = 1.0
"""What was not in view for this time has been passed."""
ASK_EVERY_S: Final = 1.0
"""The watch is asked about features passed so often."""
BACK_M: Final = (400.0, 1500.0, 4000.0)
"""From checkpoints so far back the way is run again."""
DENIED_COST: Final = 1e3
"""A run whose place GNSS, wheels and gyro deny is out unless all are."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseAt:
    """Where the vehicle was at a look, as it believes now.

    Attributes:
        t_s: time of the drive.
        pose: (3,) x, y [m], heading [rad].
        cov: (3, 3).
    """

    t_s: float
    pose: F64
    cov: F64


@dataclass(frozen=True, slots=True)
class MotionEvent:
    """As of `Slamcu.predict`."""

    dt_s: float
    speed_mps: float
    yaw_rate_radps: float


@dataclass(frozen=True, slots=True)
class FixEvent:
    """As of `Slamcu.gnss`."""

    x_m: float
    y_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class LookEvent:
    """As of `Slamcu.look`."""

    look: Look
    view: SensorView
    occlusion: Occlusion | None


SlamcuEvent = MotionEvent | FixEvent | LookEvent


class WatchedRun:
    """SLAMCU over a drive, or a part of it, with its watch.

    Args:
        slamcu: at the start of the run.
        watch: of it.

    Attributes:
        slamcu, watch: as given.
        path: a pose for each look of the run, until somebody takes them.
    """

    def __init__(self, slamcu: Slamcu, watch: Watch) -> None:
        self.slamcu, self.watch = slamcu, watch
        self.path: list[PoseAt] = []
        self._fix_s: float | None = None
        self._seen_s = slamcu.now_s

    def fork(self, seed: int) -> "WatchedRun":
        """A copy that goes its own way, its path empty."""
        copied = WatchedRun(self.slamcu.fork(seed), deepcopy(self.watch))
        copied._fix_s, copied._seen_s = self._fix_s, self._seen_s
        return copied

    def take(self, event: SlamcuEvent) -> None:
        """One more measurement."""
        slamcu = self.slamcu
        if isinstance(event, MotionEvent):
            slamcu.predict(event.dt_s, event.speed_mps, event.yaw_rate_radps)
        elif isinstance(event, LookEvent):
            slamcu.look(event.look, event.view, event.occlusion)
            self.path.append(PoseAt(slamcu.now_s, *slamcu.pose()))
            if slamcu.now_s - CLEAR_S - self._seen_s >= ASK_EVERY_S:
                self._show_passed()
        else:
            self._take_fix(event)

    def _take_fix(self, event: FixEvent) -> None:
        slamcu = self.slamcu
        before = slamcu.pose()[0][:2]
        if not slamcu.gnss(event.x_m, event.y_m, event.sigma_m):
            return
        dt_s = 0.0 if self._fix_s is None else slamcu.now_s - self._fix_s
        self._fix_s = slamcu.now_s
        off_m = np.array([event.x_m, event.y_m]) - before
        self.watch.fix(off_m, event.sigma_m, dt_s, slamcu.pose(), slamcu.blind)

    def _show_passed(self) -> None:
        """Show the watch the features that have left the view."""
        slamcu = self.slamcu
        for innovation in slamcu.take_innovations():
            self.watch.sign(innovation)
        until_s = slamcu.now_s - CLEAR_S
        if seen := slamcu.last_seen(self._seen_s, until_s):
            self.watch.passed(seen, slamcu.last_seen(self._seen_s - PASSED_AROUND_S, slamcu.now_s))
        self._seen_s = until_s

    @property
    def cost(self) -> float:
        """What speaks against this run, natural logarithm: changes of the map, and the GNSS."""
        deleted, new = self.slamcu.changes()
        return DELETED_COST * deleted + NEW_COST * new + self.watch.cost

    @property
    def cost_if_denied(self) -> float:
        """The same, with `DENIED_COST` where the watch's gates are exceeded."""
        return self.cost + (0.0 if self.watch.agrees else DENIED_COST)


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A state on the way.

    Attributes:
        run: as it was then.
        events: how many measurements of the log come before it.
        poses: how many poses of the path.
    """

    run: WatchedRun
    events: int
    poses: int

    @property
    def t_s(self) -> float:
        """Time of the drive."""
        return self.run.slamcu.now_s

    @property
    def odometer_m(self) -> float:
        """Way driven."""
        return self.run.slamcu.odometer_m


class DriveLog:
    """The measurements since the oldest checkpoint, the checkpoints, and the whole path.

    Args:
        run: at the start of the drive.
        seed: of the particles; copies get the next ones.

    Attributes:
        seed: that of the newest copy.
        path: where the vehicle was at each look, as it believes now.
        checkpoints: the oldest first; never empty.
    """

    def __init__(self, run: WatchedRun, seed: int) -> None:
        self.path: list[PoseAt] = []
        self._events: list[SlamcuEvent] = []
        self.seed = seed
        self.checkpoints = [self.checkpoint(run)]

    @property
    def recent_path(self) -> list[PoseAt]:
        """The path since the oldest checkpoint: what may change."""
        return self.path[self.checkpoints[0].poses :]

    def append(self, event: SlamcuEvent, run: WatchedRun) -> None:
        """Remember a measurement that a run has taken."""
        self._events.append(event)
        if run.path:
            self.path += run.path
            run.path.clear()

    def checkpoint(self, run: WatchedRun) -> Checkpoint:
        """The state of a run now."""
        return Checkpoint(self.forked(run), len(self._events), len(self.path))

    def forked(self, run: WatchedRun) -> WatchedRun:
        """A copy of a run with chance of its own."""
        self.seed += 1
        return run.fork(self.seed)

    def keep(self, run: WatchedRun) -> None:
        """Make a checkpoint where one is due, and forget the oldest."""
        way_m = run.slamcu.odometer_m - self.checkpoints[-1].odometer_m
        clear = way_m > KEEP_EVERY_M and not run.slamcu.in_view(CLEAR_S)
        if clear or way_m > KEEP_AT_LEAST_M:
            self.checkpoints.append(self.checkpoint(run))
        if len(self.checkpoints) > CHECKPOINTS:
            del self.checkpoints[0]
            first = self.checkpoints[0].events
            del self._events[:first]
            self.checkpoints = [replace(one, events=one.events - first) for one in self.checkpoints]

    def back_from(self, odometer_m: float) -> Iterator[Checkpoint]:
        """Checkpoints `BACK_M` before a place, each once; the oldest when the drive has just begun."""
        given: set[int] = set()
        for back_m in BACK_M:
            old = [one for one in self.checkpoints if odometer_m - one.odometer_m >= back_m]
            one = old[-1] if old else self.checkpoints[0]
            if one.events not in given:
                given.add(one.events)
                yield one

    def since(self, checkpoint: Checkpoint) -> list[SlamcuEvent]:
        """The measurements since a checkpoint."""
        return self._events[checkpoint.events :]

    def adopt(self, checkpoint: Checkpoint, run: WatchedRun) -> None:
        """Believe in a run from a checkpoint on: its path, and nothing that was kept since."""
        self.path[checkpoint.poses :] = run.path
        run.path.clear()
        self.drop_after(checkpoint)

    def drop_after(self, checkpoint: Checkpoint) -> None:
        """Forget the checkpoints after one."""
        self.checkpoints = [one for one in self.checkpoints if one.events <= checkpoint.events]
