"""SLAMCU that knows when it is lost, and takes back what it concluded since it was last where it believed to be.

A particle filter that is sure of a wrong place finds what it expects, or calls the map wrong: it never notices by
itself. So its place is watched (`watch.py`). On an alarm the measurements since a checkpoint (`replay.py`) are run
again by particles drawn around where wheels, gyro and GNSS had the vehicle: of all runs the one with the fewest changes
of the map that the fixes do not speak against is adopted. When none will do, the vehicle is lost: everything since the
last state that was good is undone, and the place is searched for anew where the vehicle is now.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from math import radians
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.look import Look, MapFeatures
from gnd.vehicle_agent.features.slamcu.blind import BlindBelief
from gnd.vehicle_agent.features.slamcu.hindsight import (
    GATE,
    GATE_SURE,
    Contradiction,
    Hindsight,
    Smoothed,
    claimed,
    claimed_now,
    contradictions,
    held,
    speaks_against,
)
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.replay import (
    CLEAR_S,
    Checkpoint,
    DriveLog,
    FixEvent,
    LookEvent,
    MotionEvent,
    PoseAt,
    SlamcuEvent,
    WatchedRun,
)
from gnd.vehicle_agent.features.slamcu.sensor_model import SensorModel
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass
from gnd.vehicle_agent.features.slamcu.verdicts import KnownState, NewFeature
from gnd.vehicle_agent.features.slamcu.watch import Alarm, Watch
from gnd.vehicle_agent.features.view import Occlusion, SensorView

BETTER: Final = 3.0
"""Another run must be so much better (natural logarithm)."""
ALIKE: Final = 1.0
"""Runs that differ by less are as good as each other."""
PATIENCE_S: Final = 20.0
"""After a doubt has been looked into, so long no other one is; twice as long each time that it changed nothing."""
MOST_PATIENCE_S: Final = 160.0
WIDE_M: Final = 2.5
WIDE_RAD: Final = radians(0.5)
"""What a place is made less certain by that fixes speak against, when no run is better: most of a lane."""
CONTRADICTS: Final = 15.0
"""Where the run that GNSS, wheels and gyro allow is so much worse (natural logarithm; five signs gone) than one that
they deny, map and GNSS contradict, and it is open which is right."""
FOUND_AGAIN: Final = 2
"""A vehicle that has given up knows its place again when so many signs of the map are there, and more than are not."""
LOST_M: Final = 10.0
"""Sigma of each axis of the place until then."""
LOOK_BACK_EVERY_S: Final = 10.0
LOOK_BACK_S: Final = 240.0
"""Hindsight is asked so often, of so much: fixes from farther back do not constrain the place."""
AT_THE_END: Final = 0.5
"""When the drive ends a doubt need be only so large: nothing more will come."""


@dataclass(frozen=True, slots=True)
class Lost:
    """A stretch on which the vehicle was not where it believed to be.

    Attributes:
        from_s: the last good state, time of the drive.
        until_s: when it noticed.
        off_m: the farthest that what it believed was from what it believes now; for a stretch that was given up, from
            where wheels, gyro and GNSS have it at its end.
        test: which of the watch's tests failed.
        value: of its statistic.
        taken_back: verdicts on features that hold no longer.
        replayed: whether another run took the stretch's place; else it was given up, and nothing is concluded from it.
    """

    from_s: float
    until_s: float
    off_m: float
    test: str
    value: float
    taken_back: int
    replayed: bool

    def gives_up(self, from_s: float, until_s: float) -> bool:
        """Whether a stretch lies within one that was given up."""
        return not self.replayed and self.from_s <= from_s and until_s <= self.until_s


class WatchedSlamcu:
    """One drive whose poses the particles find, watched.

    Args:
        parameters: of existence, association and filter.
        known: the map's features; a 2D frame (ENU), metres.
        pose0: (3,) x, y, heading at the start.
        cov0: (3, 3) its covariance.
        seed: of the particles.
        gnss_sigma_m: of the GNSS fixes that the first pose was made of, whose slow error it shares; 0: made otherwise.

    Attributes:
        lost: stretches on which it believed something else.
        doubts: alarms that were looked into.

    Raises:
        BadPose: the pose is not finite, or the covariance is none.
    """

    def __init__(
        self,
        parameters: SlamcuParameters,
        known: MapFeatures,
        pose0: F64,
        cov0: F64,
        seed: int = 0,
        gnss_sigma_m: float = 0.0,
        sensor: SensorModel | None = None,
    ) -> None:
        self._run = WatchedRun(Slamcu(parameters, known, pose0, cov0, seed, gnss_sigma_m, sensor), Watch())
        self._log = DriveLog(self._run, seed)
        self.lost: list[Lost] = []
        self.doubts = 0
        self._asked_s, self._patience_s = 0.0, PATIENCE_S
        self._hindsight = Hindsight(BlindBelief.first(pose0, cov0, gnss_sigma_m))
        self._back_s = 0.0  # when hindsight was asked last
        self._clock_ns = 0
        self._lost_since: Checkpoint | None = None
        self._extra = np.zeros((0, 2, 2))  # of each pose of the path, once the drive has ended

    @property
    def path(self) -> list[PoseAt]:
        """Where the vehicle was at each look, as it believes now."""
        return self._log.path

    def predict(self, dt_s: float, speed_mps: float, yaw_rate_radps: float) -> None:
        """As of `Slamcu`."""
        self._take(MotionEvent(dt_s, speed_mps, yaw_rate_radps))
        self._hindsight.predict(dt_s, speed_mps, yaw_rate_radps)

    def gnss(self, x_m: float, y_m: float, sigma_m: float) -> None:
        """As of `Slamcu`; on an alarm the way is run again."""
        self._take(FixEvent(x_m, y_m, sigma_m))
        self._hindsight.fix(np.array([x_m, y_m]), sigma_m)
        self._ask()

    def look(self, look: Look, view: SensorView, occlusion: Occlusion | None = None) -> None:
        """As of `Slamcu`; on an alarm the way is run again."""
        self._take(LookEvent(look, view, occlusion))
        self._clock_ns = look.t_ns - round(self._slamcu.now_s * 1e9)
        self._ask()

    def hold(self, known: MapFeatures) -> None:
        """As of `Slamcu`, and for every state from which the way may be run again."""
        for slamcu in self._all:
            slamcu.hold(known)

    def weigh_as_printed(self) -> None:
        """As of `Slamcu`, and for every state from which the way may be run again."""
        for slamcu in self._all:
            slamcu.weigh_as_printed()

    def forget(self, feature_ids: Collection[int]) -> None:
        """As of `Slamcu`, and for every state from which the way may be run again."""
        for slamcu in self._all:
            slamcu.forget(feature_ids)

    @property
    def _all(self) -> Iterator[Slamcu]:
        yield self._slamcu
        yield from (one.run.slamcu for one in self._log.checkpoints)
        since = self._lost_since
        if since is not None and all(since is not one for one in self._log.checkpoints):
            yield since.run.slamcu

    @property
    def settled_m(self) -> float:
        """Way up to which nothing will change: that of the oldest checkpoint."""
        return self._log.checkpoints[0].odometer_m

    @property
    def odometer_m(self) -> float:
        """Way driven."""
        return self._slamcu.odometer_m

    def finish(self) -> None:
        """The drive has ended: look into what is in doubt before anything is concluded."""
        alarm = self._run.watch.alarm(AT_THE_END)
        if alarm is not None:
            self._look_into(alarm)
        self._look_back()
        if self._lost_since is not None:
            self._stay_lost(self._lost_since)
        self._slamcu.decide()
        if self.path:
            covs = self._claim(0, 0.0)
            self._log.path = [replace(one, cov=cov) for one, cov in zip(self.path, covs, strict=True)]

    def claim(self) -> None:
        """Let features be as uncertain as hindsight has the places that they were seen from: those on the way that may
        still change.
        """
        oldest = self._log.checkpoints[0]
        if len(self.path) > oldest.poses:
            self._claim(oldest.poses, max(oldest.t_s - LOOK_BACK_S, 0.0))

    def _claim(self, first: int, since_s: float) -> F64:
        """(S, 3, 3) covariances of the path from one pose on, as hindsight has them by the fixes since a time."""
        columns = _columns(self.path[first:])
        covs = claimed(*columns, self._hindsight.smoothed(since_s))
        self._extra = np.zeros((len(self.path), 2, 2))
        self._extra[first:] = (covs - columns[2])[:, :2, :2]
        return covs

    def pose(self) -> tuple[F64, F64]:
        """Pose (3,) x, y [m], heading [rad], and covariance (3, 3)."""
        pose, cov = self._slamcu.pose()
        wide = claimed_now(pose, cov, self._slamcu.blind) if self._slamcu.has_fixes else held(cov[None])[0]
        return pose, wide + np.diag([LOST_M**2, LOST_M**2, 0.0]) if self.is_lost else wide

    @property
    def camera(self) -> tuple[F64, F64]:
        """As of `Slamcu`."""
        return self._slamcu.camera

    @property
    def camera_is_wrong(self) -> bool:
        """As of `Slamcu`."""
        return self._slamcu.camera_is_wrong

    @property
    def is_lost(self) -> bool:
        """Whether the vehicle has given up and not found its place again."""
        return self._lost_since is not None

    def known_states(self) -> tuple[KnownState, ...]:
        """All features of the map, in its order."""
        states = self._slamcu.known_states()
        return tuple(one if one.cov_m2 is None else replace(one, cov_m2=one.cov_m2 + self._more(one)) for one in states)

    def new_features(self, *, unclassified: bool = False) -> tuple[NewFeature, ...]:
        """Features that the map has not and that exist; `unclassified`: those with too little evidence as well."""
        found = self._slamcu.new_features(unclassified=unclassified)
        return tuple(replace(one, cov_m2=one.cov_m2 + self._more(one)) for one in found)

    def _more(self, one: KnownState | NewFeature) -> F64:
        """(2, 2) by how much less certain than the particles have it a feature is: as the places it was seen from."""
        if not len(self._extra) or not one.history:
            return np.zeros((2, 2))
        at_s = np.array([pose.t_s for pose in self.path[: len(self._extra)]])  # as of the last claim
        seen_s = (one.history[-1].t_ns - self._clock_ns) * 1e-9
        return np.asarray(self._extra[min(int(np.searchsorted(at_s, seen_s)), len(at_s) - 1)])

    @property
    def hidden(self) -> int:
        """As of `Slamcu`."""
        return self._slamcu.hidden

    @property
    def fixes_refused(self) -> int:
        """As of `Slamcu`."""
        return self._slamcu.fixes_refused

    @property
    def _slamcu(self) -> Slamcu:
        return self._run.slamcu

    def _take(self, event: SlamcuEvent) -> None:
        self._run.take(event)  # raises before anything is remembered
        self._log.append(event, self._run)

    def _ask(self) -> None:
        """Whether there is an alarm, and a checkpoint to make."""
        alarm = self._run.watch.alarm()
        if alarm is not None and self._slamcu.now_s - self._asked_s > self._patience_s:
            self._look_into(alarm)
        elif self._slamcu.now_s - self._back_s >= LOOK_BACK_EVERY_S:
            self._look_back()
        self._find_again()
        self._log.keep(self._run)

    # The way is run again

    def _look_into(self, alarm: Alarm) -> None:
        """Run the way again, and keep the best run."""
        self.doubts += 1
        tried: list[tuple[Checkpoint, WatchedRun]] = []
        for one in self._log.back_from(self._slamcu.odometer_m):
            tried += [(one, run) for run in self._runs_from(one)]
            if any(self._will_do(run) for _, run in tried):
                break
        smoothed = self._smoothed()
        against = [run.cost_if_denied + self._denied(one, run.path, smoothed) for one, run in tried]
        now = self._run.cost_if_denied + speaks_against(*_columns(self._log.recent_path), smoothed)
        which = next(i for i, one in enumerate(against) if one <= min(against) + ALIKE)  # the shortest way back
        (one, best), better = tried[which], against[which] < now - BETTER
        self._patience_s = PATIENCE_S if better else min(2.0 * self._patience_s, MOST_PATIENCE_S)
        if better:
            self._adopt(one, best, alarm)
        elif alarm.test in ("offset", "blind"):
            self._slamcu.widen(WIDE_M, WIDE_RAD)
        easiest = min(run.cost for run in (self._run, *(each for _, each in tried)))
        if not self._run.watch.agrees or self._run.cost > easiest + CONTRADICTS:
            self._give_up(alarm)
        else:
            self._cut_out(smoothed)
        self._run.watch.settled()
        self._asked_s = self._slamcu.now_s

    def _runs_from(self, checkpoint: Checkpoint) -> Iterator[WatchedRun]:
        """From a checkpoint by particles around the blind pose, and by those that were there, which doubt the map."""
        for anew in (True, False):
            run = self._log.forked(checkpoint.run)
            if anew:
                run.slamcu.look_anew()
            else:
                run.slamcu.doubt_the_map()
            for event in self._log.since(checkpoint):
                run.take(event)
            yield run

    def _will_do(self, run: WatchedRun) -> bool:
        """Whether a run is so much better, and so free of doubt, that none from farther back is needed."""
        return run.watch.alarm() is None and run.cost_if_denied < self._run.cost_if_denied - 2.0 * BETTER

    def _adopt(self, checkpoint: Checkpoint, run: WatchedRun, alarm: Alarm) -> None:
        """What was believed since a checkpoint was wrong; here is another run."""
        old = self.path[checkpoint.poses :]
        off_m = max((float(np.hypot(*(a.pose - b.pose)[:2])) for a, b in zip(old, run.path, strict=True)), default=0.0)
        self._note_lost(checkpoint.t_s, self._slamcu.now_s, off_m, alarm, run, replayed=True)
        run.slamcu.doubt_the_map(doubted=False)
        self._replace(checkpoint, run)

    def _replace(self, checkpoint: Checkpoint, run: WatchedRun) -> None:
        self._log.adopt(checkpoint, run)
        self._run = run

    def _note_lost(
        self, from_s: float, until_s: float, off_m: float, alarm: Alarm, instead: WatchedRun, *, replayed: bool
    ) -> None:
        taken_back = _differences(self._slamcu, instead.slamcu)
        self.lost.append(Lost(from_s, until_s, off_m, alarm.test, alarm.value, taken_back, replayed))

    # What hindsight denies

    def _smoothed(self) -> Smoothed:
        return self._hindsight.smoothed(self._slamcu.now_s - LOOK_BACK_S)

    def _denied(self, checkpoint: Checkpoint, path: list[PoseAt], smoothed: Smoothed) -> float:
        """Cost by hindsight of the way since the oldest checkpoint, with another path from one on."""
        first = self._log.checkpoints[0].poses
        return speaks_against(*_columns([*self.path[first : checkpoint.poses], *path]), smoothed)

    def _look_back(self) -> None:
        """Whether what came since denies a place that was believed in."""
        self._back_s = self._slamcu.now_s
        found = self._contradictions(self._smoothed())
        if found:
            self._look_into(Alarm("hindsight", max(one.squared for one in found), GATE))

    def _contradictions(self, smoothed: Smoothed, gate: float = GATE) -> list[Contradiction]:
        """Stretches that hindsight denies, of those that may change and have not been given up."""
        path = self._log.recent_path
        found = contradictions(*_columns(path), smoothed, gate) if path else []
        return [one for one in found if not any(lost.gives_up(one.from_s, one.until_s) for lost in self.lost)]

    def _cut_out(self, smoothed: Smoothed) -> None:
        """Stretches that are still denied count as if nobody had looked, and the place is searched for anew."""
        for denied in self._contradictions(smoothed, GATE_SURE):
            self._run_without(denied)

    def _run_without(self, denied: Contradiction) -> None:
        checkpoints = self._log.checkpoints
        checkpoint = next((one for one in reversed(checkpoints) if one.t_s < denied.from_s), checkpoints[0])
        run, at = self._log.forked(checkpoint.run), checkpoint.poses
        is_in = False
        for event in self._log.since(checkpoint):
            was_in, is_in = is_in, denied.from_s - CLEAR_S <= run.slamcu.now_s <= denied.until_s
            if was_in != is_in:
                run.slamcu.look_anew()
            if is_in and isinstance(event, LookEvent):
                run.path.append(self.path[at])
            else:
                run.take(event)
            at += isinstance(event, LookEvent)
        alarm = Alarm("hindsight", denied.squared, GATE_SURE)
        self._note_lost(denied.from_s - CLEAR_S, denied.until_s, denied.off_m, alarm, run, replayed=False)
        self._replace(checkpoint, run)

    # The vehicle is lost

    def _give_up(self, alarm: Alarm) -> None:
        """No run will do: nothing is concluded from the way since the last good state."""
        checkpoints = self._log.checkpoints
        good = next((one for one in reversed(checkpoints) if one.run.watch.agrees), checkpoints[0])
        run = self._log.forked(good.run)
        run.slamcu.look_anew()
        for event in self._log.since(good):
            if not isinstance(event, LookEvent):
                run.take(event)
        run.slamcu.look_anew()
        run.watch = Watch()
        off_m = float(np.hypot(*(self._slamcu.pose()[0] - run.slamcu.blind.mean[:3])[:2]))
        self._note_lost(good.t_s, self._slamcu.now_s, off_m, alarm, run, replayed=False)
        self._run = run
        self._log.drop_after(good)
        self._lost_since = self._log.checkpoint(run)
        self._log.checkpoints.append(self._lost_since)

    def _find_again(self) -> None:
        """After giving up: whether signs of the map are where the place that was found since has them."""
        since = self._lost_since
        if since is None or self._slamcu.now_s - since.t_s < CLEAR_S:
            return
        seen = [one for one in self._slamcu.last_seen(since.t_s, self._slamcu.now_s - CLEAR_S) if one.known]
        there = sum(one.feature_class == FeatureClass.NORMAL for one in seen)
        if there >= FOUND_AGAIN and there > sum(one.feature_class == FeatureClass.DELETED for one in seen):
            self._lost_since = None

    def _stay_lost(self, since: Checkpoint) -> None:
        """The place was not found again: nothing that was concluded since is kept."""
        off_m = float(np.hypot(*(self._slamcu.pose()[0] - self._slamcu.blind.mean[:3])[:2]))
        alarm = Alarm("not found again", 0.0, 0.0)
        self._note_lost(since.t_s, self._slamcu.now_s, off_m, alarm, since.run, replayed=False)
        self._run = since.run.fork(self._log.seed)


def _columns(path: list[PoseAt]) -> tuple[F64, F64, F64]:
    """Times (S,), poses (S, 3) and covariances (S, 3, 3)."""
    return (
        np.array([one.t_s for one in path]),
        np.array([one.pose for one in path]),
        np.array([one.cov for one in path]),
    )


def _differences(one: Slamcu, other: Slamcu) -> int:
    """How many verdicts of one drive the other does not share."""
    classes = [{state.feature_id: state.feature_class for state in each.known_states()} for each in (one, other)]
    known = sum(classes[0][number] != classes[1].get(number) for number in classes[0])
    found = [np.array([new.position_m for new in each.new_features()]).reshape(-1, 2) for each in (one, other)]
    apart = np.linalg.norm(found[0][:, None] - found[1][None], axis=2)
    return known + (int((apart.min(axis=1) > 1.0).sum()) if apart.size else len(found[0]))
