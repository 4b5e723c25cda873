"""SLAMCU that knows when it is lost, and takes back what it concluded since it was last where it believed to be.

A particle filter that is sure of a wrong place finds what it expects, or calls the map wrong: it never notices by
itself. So its place is watched (`watch.py`). On an alarm the stretch is told anew, from states kept along the way, by
particles drawn around where wheels, gyro and GNSS had the vehicle: of all accounts the one with the fewest changes of
the map that the fixes do not speak against is kept. When none will do, the vehicle is lost: everything since the last
state that was good is undone, and the place is looked for anew where the vehicle is now.
"""

from collections.abc import Collection, Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from math import radians
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.look import Look, MapFeatures
from gnd.vehicle_agent.features.slamcu.blind import BlindBelief
from gnd.vehicle_agent.features.slamcu.existence_book import FeatureClass
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
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu
from gnd.vehicle_agent.features.slamcu.verdicts import KnownState, NewFeature
from gnd.vehicle_agent.features.slamcu.watch import DELETED_COST, NEW_COST, Alarm, Watch
from gnd.vehicle_agent.features.view import Occlusion, SensorView

KEEP_EVERY_M: Final = 300.0
"""A state is kept so often, when nothing is in view."""
KEEP_AT_LEAST_M: Final = 1000.0
"""And even when something is."""
KEPT: Final = 14
"""So many states: 4 km."""
CLEAR_S: Final = 1.0
BACK_M: Final = (400.0, 1500.0, 4000.0)
"""From states so far back the way is told anew."""
ASK_EVERY_S: Final = 1.0
BETTER: Final = 3.0
"""Another account must be so much better (natural logarithm)."""
ALIKE: Final = 1.0
"""Accounts that differ by less are as good as each other."""
PATIENCE_S: Final = 20.0
"""After a doubt has been looked into, so long no other one is; twice as long each time that it changed nothing."""
MOST_PATIENCE_S: Final = 160.0
WIDE_M: Final = 2.5
WIDE_RAD: Final = radians(0.5)
"""What a place is made less certain by that fixes speak against, when no account is better: most of a lane."""
CONTRADICTS: Final = 15.0
"""Where the account that GNSS, wheels and gyro allow is so much worse (natural logarithm; five signs gone) than one
that they deny, map and GNSS contradict, and nobody can tell which is right."""
FOUND_AGAIN: Final = 2
"""A vehicle that has given up knows its place again when so many signs of the map are there, and more than are not."""
LOST_M: Final = 10.0
"""Sigma of each axis of the place until then."""
LOOK_BACK_EVERY_S: Final = 10.0
LOOK_BACK_S: Final = 240.0
"""Hindsight is asked so often, of so much: fixes from farther back say nothing of the place."""
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
        told_anew: whether the stretch has another account; else nothing is said of it.
    """

    from_s: float
    until_s: float
    off_m: float
    test: str
    value: float
    taken_back: int
    told_anew: bool

    def covers(self, from_s: float, until_s: float) -> bool:
        """Whether a stretch lies within one that was given up."""
        return not self.told_anew and self.from_s <= from_s and until_s <= self.until_s


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
class _Moved:
    dt_s: float
    speed_mps: float
    yaw_rate_radps: float


@dataclass(frozen=True, slots=True)
class _Fixed:
    x_m: float
    y_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Looked:
    look: Look
    view: SensorView
    occlusion: Occlusion | None


_Event = _Moved | _Fixed | _Looked


class _Account:
    """One telling of the drive: SLAMCU, its watch, its path."""

    def __init__(self, slamcu: Slamcu, watch: Watch) -> None:
        self.slamcu, self.watch = slamcu, watch
        self.path: list[PoseAt] = []
        self._fix_s: float | None = None
        self._seen_s = slamcu.now_s

    def fork(self, seed: int) -> "_Account":
        """A copy that goes its own way, its path empty."""
        copied = _Account(self.slamcu.fork(seed), deepcopy(self.watch))
        copied._fix_s, copied._seen_s = self._fix_s, self._seen_s
        return copied

    def take(self, event: _Event) -> None:
        """One more event."""
        slamcu = self.slamcu
        if isinstance(event, _Moved):
            slamcu.predict(event.dt_s, event.speed_mps, event.yaw_rate_radps)
        elif isinstance(event, _Looked):
            slamcu.look(event.look, event.view, event.occlusion)
            self.path.append(PoseAt(slamcu.now_s, *slamcu.pose()))
            if slamcu.now_s - CLEAR_S - self._seen_s >= ASK_EVERY_S:
                self._passed()
        else:
            self._fixed(event)

    def _fixed(self, event: _Fixed) -> None:
        slamcu = self.slamcu
        before = slamcu.pose()[0][:2]
        if not slamcu.gnss(event.x_m, event.y_m, event.sigma_m):
            return
        dt_s = 0.0 if self._fix_s is None else slamcu.now_s - self._fix_s
        self._fix_s = slamcu.now_s
        off_m = np.array([event.x_m, event.y_m]) - before
        self.watch.fix(off_m, event.sigma_m, dt_s, slamcu.pose(), slamcu.blind)

    def _passed(self) -> None:
        slamcu = self.slamcu
        for told in slamcu.told():
            self.watch.sign(told)
        until_s = slamcu.now_s - CLEAR_S
        if seen := slamcu.last_seen(self._seen_s, until_s):
            self.watch.passed(seen, slamcu.last_seen(self._seen_s - 2.0 * PATIENCE_S, slamcu.now_s))
        self._seen_s = until_s

    @property
    def cost(self) -> float:
        """What speaks against this account, natural logarithm: changes of the map, and the GNSS."""
        deleted, new = self.slamcu.changes()
        return DELETED_COST * deleted + NEW_COST * new + self.watch.cost


@dataclass(frozen=True, slots=True, eq=False)
class _KeptState:
    """A state on the way: what had been told, and how many events and poses there were."""

    account: _Account
    events: int
    poses: int

    @property
    def t_s(self) -> float:
        return self.account.slamcu.now_s

    @property
    def odometer_m(self) -> float:
        return self.account.slamcu.odometer_m


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
        path: where the vehicle was at each look, as it believes now.
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
    ) -> None:
        slamcu = Slamcu(parameters, known, pose0, cov0, seed, gnss_sigma_m)
        self._now, self._seed = _Account(slamcu, Watch(parameters.gnss)), seed
        self.path: list[PoseAt] = []
        self.lost: list[Lost] = []
        self.doubts = 0
        self._events: list[_Event] = []
        self._kept: list[_KeptState] = [self._state()]
        self._asked_s, self._patience_s = 0.0, PATIENCE_S
        self._hindsight = Hindsight(parameters, BlindBelief.first(pose0, cov0, parameters, gnss_sigma_m))
        self._back_s = self._known_s = 0.0  # when hindsight was asked last, and until when its answer has been heard
        self._clock_ns = 0
        self._lost_since: _KeptState | None = None
        self._extra = np.zeros((0, 2, 2))  # of each pose of the path, once the drive has ended

    def predict(self, dt_s: float, speed_mps: float, yaw_rate_radps: float) -> None:
        """As of `Slamcu`."""
        self._take(_Moved(dt_s, speed_mps, yaw_rate_radps))

    def gnss(self, x_m: float, y_m: float, sigma_m: float) -> None:
        """As of `Slamcu`; on an alarm the way is told anew."""
        self._take(_Fixed(x_m, y_m, sigma_m))
        self._ask()

    def look(self, look: Look, view: SensorView, occlusion: Occlusion | None = None) -> None:
        """As of `Slamcu`; on an alarm the way is told anew."""
        self._take(_Looked(look, view, occlusion))
        self._ask()

    def hold(self, known: MapFeatures) -> None:
        """As of `Slamcu`, and for every state from which the way may be told anew."""
        for slamcu in self._all:
            slamcu.hold(known)

    def forget(self, feature_ids: Collection[int]) -> None:
        """As of `Slamcu`, and for every state from which the way may be told anew."""
        for slamcu in self._all:
            slamcu.forget(feature_ids)

    @property
    def _all(self) -> Iterator[Slamcu]:
        yield self._slamcu
        yield from (one.account.slamcu for one in self._kept)
        since = self._lost_since
        if since is not None and all(since is not one for one in self._kept):
            yield since.account.slamcu

    @property
    def settled_m(self) -> float:
        """Way up to which nothing will be told anew: that of the oldest state kept."""
        return self._kept[0].odometer_m

    @property
    def odometer_m(self) -> float:
        """Way driven."""
        return self._slamcu.odometer_m

    def finish(self) -> None:
        """The drive has ended: look into what is in doubt before anything is said."""
        alarm = self._now.watch.alarm(AT_THE_END)
        if alarm is not None:
            self._look_into(alarm)
        self._look_back()
        if self._lost_since is not None:
            self._stay_lost(self._lost_since)
        self._slamcu.decide()
        if self.path:
            covs = self._claim(0, 0.0)
            self.path = [replace(one, cov=cov) for one, cov in zip(self.path, covs, strict=True)]

    def claim(self) -> None:
        """Let what is said of features be as uncertain as hindsight has the places that they were seen from: those on
        the way that may still be told anew.
        """
        oldest = self._kept[0]
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
        return self._now.slamcu

    def _take(self, event: _Event) -> None:
        self._now.take(event)  # raises before anything is remembered
        if isinstance(event, _Moved):
            self._hindsight.predict(event.dt_s, event.speed_mps, event.yaw_rate_radps)
        elif isinstance(event, _Fixed):
            self._hindsight.fix(np.array([event.x_m, event.y_m]), event.sigma_m)
        else:
            self._clock_ns = event.look.t_ns - round(self._slamcu.now_s * 1e9)
        self._events.append(event)
        if self._now.path:
            self.path += self._now.path
            self._now.path.clear()

    def _ask(self) -> None:
        """Whether there is an alarm, and a state to keep."""
        alarm = self._now.watch.alarm()
        if alarm is not None and self._slamcu.now_s - self._asked_s > self._patience_s:
            self._look_into(alarm)
        elif self._slamcu.now_s - self._back_s >= LOOK_BACK_EVERY_S:
            self._look_back()
        self._found_again()
        self._keep()

    # States on the way

    def _state(self) -> _KeptState:
        self._seed += 1
        return _KeptState(self._now.fork(self._seed), len(self._events), len(self.path))

    def _keep(self) -> None:
        way_m = self._slamcu.odometer_m - self._kept[-1].odometer_m
        clear = way_m > KEEP_EVERY_M and not self._slamcu.in_view(CLEAR_S)
        if clear or way_m > KEEP_AT_LEAST_M:
            self._kept.append(self._state())
        if len(self._kept) > KEPT:
            del self._kept[0]
            self._forget_events(self._kept[0].events)

    def _forget_events(self, count: int) -> None:
        del self._events[:count]
        self._kept = [_KeptState(one.account, one.events - count, one.poses) for one in self._kept]

    def _back(self) -> Iterator[_KeptState]:
        """States so far back, each once; the oldest when the drive has just begun."""
        told: set[int] = set()
        for back_m in BACK_M:
            old = [one for one in self._kept if self._slamcu.odometer_m - one.odometer_m >= back_m]
            one = old[-1] if old else self._kept[0]
            if one.events not in told:
                told.add(one.events)
                yield one

    # A doubt

    def _look_into(self, alarm: Alarm) -> None:
        """Tell the way anew, and keep the best account of it."""
        self.doubts += 1
        tried: list[tuple[_KeptState, _Account]] = []
        for one in self._back():
            tried += [(one, account) for account in self._tellings(one)]
            if any(self._will_do(account) for _, account in tried):
                break
        smoothed = self._smoothed()
        against = [_against(account) + self._denied(one, account.path, smoothed) for one, account in tried]
        first = min(kept.poses for kept in self._kept)
        now = _against(self._now) + speaks_against(*_columns(self.path[first:]), smoothed)
        which = next(i for i, one in enumerate(against) if one <= min(against) + ALIKE)  # the shortest way back
        (one, best), better = tried[which], against[which] < now - BETTER
        self._patience_s = PATIENCE_S if better else min(2.0 * self._patience_s, MOST_PATIENCE_S)
        if better:
            self._adopt(one, best, alarm)
        elif alarm.test in ("offset", "blind"):
            self._slamcu.widen(WIDE_M, WIDE_RAD)
        easiest = min(account.cost for account in (self._now, *(each for _, each in tried)))
        if not self._now.watch.agrees or self._now.cost > easiest + CONTRADICTS:
            self._give_up(alarm)
        else:
            self._cut_out(smoothed)
        self._now.watch.settled()
        self._asked_s = self._slamcu.now_s

    def _smoothed(self) -> Smoothed:
        return self._hindsight.smoothed(self._slamcu.now_s - LOOK_BACK_S)

    def _denied(self, kept: _KeptState, path: list[PoseAt], smoothed: Smoothed) -> float:
        """What hindsight says against the way since the first state that is kept, with another path from one on."""
        first = min(one.poses for one in self._kept)
        return speaks_against(*_columns([*self.path[first : kept.poses], *path]), smoothed)

    def _look_back(self) -> None:
        """Whether what came since denies a place that was believed in."""
        self._back_s = self._slamcu.now_s
        found = self._contradictions(self._smoothed())
        if found:
            self._known_s = found[-1].until_s
            most = max(found, key=lambda one: one.squared)
            self._look_into(Alarm("hindsight", most.squared, GATE))

    def _contradictions(self, smoothed: Smoothed, gate: float = GATE) -> list[Contradiction]:
        """Stretches that hindsight denies, of those that can be told anew and have not been cut out."""
        path = self.path[self._kept[0].poses :]
        found = contradictions(*_columns(path), smoothed, gate) if path else []
        return [one for one in found if not any(lost.covers(one.from_s, one.until_s) for lost in self.lost)]

    def _cut_out(self, smoothed: Smoothed) -> None:
        """Stretches that are still denied are not told: as if nobody had looked, and the place is looked for anew."""
        for denied in self._contradictions(smoothed, GATE_SURE):
            self._tell_without(denied)

    def _tell_without(self, denied: Contradiction) -> None:
        kept = next((one for one in reversed(self._kept) if one.t_s < denied.from_s), self._kept[0])
        self._seed += 1
        account, at = kept.account.fork(self._seed), kept.poses
        is_in = False
        for event in self._events[kept.events :]:
            was_in, is_in = is_in, denied.from_s - CLEAR_S <= account.slamcu.now_s <= denied.until_s
            if was_in != is_in:
                account.slamcu.look_anew()
            if is_in and isinstance(event, _Looked):
                account.path.append(self.path[at])
            else:
                account.take(event)
            at += isinstance(event, _Looked)
        taken = _differences(self._slamcu, account.slamcu)
        self.lost.append(
            Lost(denied.from_s - CLEAR_S, denied.until_s, denied.off_m, "hindsight", denied.squared, taken, False)
        )
        self._replace(kept, account)

    def _replace(self, kept: _KeptState, account: _Account) -> None:
        self.path[kept.poses :] = account.path
        account.path.clear()
        self._now = account
        self._kept = [one for one in self._kept if one.events <= kept.events]

    def _will_do(self, account: _Account) -> bool:
        """Whether an account is so much better, and so free of doubt, that none from farther back is needed."""
        return account.watch.alarm() is None and _against(account) < _against(self._now) - 2.0 * BETTER

    def _tellings(self, kept: _KeptState) -> Iterator[_Account]:
        """From a state by particles around the blind pose, and by those that were there, which doubt the map."""
        for anew in (True, False):
            self._seed += 1
            account = kept.account.fork(self._seed)
            if anew:
                account.slamcu.look_anew()
            else:
                account.slamcu.doubt_the_map()
            for event in self._events[kept.events :]:
                account.take(event)
            yield account

    def _adopt(self, kept: _KeptState, account: _Account, alarm: Alarm) -> None:
        """The account of the way since a state was wrong; here is another."""
        old = self.path[kept.poses :]
        off_m = max(
            (float(np.hypot(*(a.pose - b.pose)[:2])) for a, b in zip(old, account.path, strict=True)), default=0.0
        )
        taken = _differences(self._slamcu, account.slamcu)
        self.lost.append(Lost(kept.t_s, self._slamcu.now_s, off_m, alarm.test, alarm.value, taken, True))
        account.slamcu.doubt_the_map(doubted=False)
        self._replace(kept, account)

    def _give_up(self, alarm: Alarm) -> None:
        """No account will do: nothing is said of the way since the last good state."""
        kept = next((one for one in reversed(self._kept) if one.account.watch.agrees), self._kept[0])
        lost_s, believed = self._slamcu.now_s, self._slamcu
        self._seed += 1
        account = kept.account.fork(self._seed)
        account.slamcu.look_anew()
        for event in self._events[kept.events :]:
            if not isinstance(event, _Looked):
                account.take(event)
        account.slamcu.look_anew()
        account.watch = Watch(believed.parameters.gnss)
        off_m = float(np.hypot(*(believed.pose()[0] - account.slamcu.blind.mean[:3])[:2]))
        taken = _differences(believed, account.slamcu)
        self.lost.append(Lost(kept.t_s, lost_s, off_m, alarm.test, alarm.value, taken, False))
        self._now = account
        self._kept = [*(one for one in self._kept if one.events <= kept.events), self._state()]
        self._lost_since = self._kept[-1]

    def _found_again(self) -> None:
        """After giving up: whether signs of the map are where the place that was found since has them."""
        since = self._lost_since
        if since is None or self._slamcu.now_s - since.t_s < CLEAR_S:
            return
        seen = [one for one in self._slamcu.last_seen(since.t_s, self._slamcu.now_s - CLEAR_S) if one.known]
        there = sum(one.feature_class == FeatureClass.NORMAL for one in seen)
        if there >= FOUND_AGAIN and there > sum(one.feature_class == FeatureClass.DELETED for one in seen):
            self._lost_since = None

    def _stay_lost(self, since: _KeptState) -> None:
        """The place was not found again: nothing of what was concluded since is told."""
        off_m = float(np.hypot(*(self._slamcu.pose()[0] - self._slamcu.blind.mean[:3])[:2]))
        taken = _differences(self._slamcu, since.account.slamcu)
        self.lost.append(Lost(since.t_s, self._slamcu.now_s, off_m, "not found again", 0.0, taken, False))
        self._now = since.account.fork(self._seed)


def _columns(path: list[PoseAt]) -> tuple[F64, F64, F64]:
    """Times (S,), poses (S, 3) and covariances (S, 3, 3)."""
    return (
        np.array([one.t_s for one in path]),
        np.array([one.pose for one in path]),
        np.array([one.cov for one in path]),
    )


def _against(account: _Account) -> float:
    """What speaks against an account; one whose place GNSS, wheels and gyro deny is out unless all are."""
    return account.cost + (0.0 if account.watch.agrees else 1e3)


def _differences(one: Slamcu, other: Slamcu) -> int:
    """How many verdicts of one drive the other does not share."""
    classes = [{state.feature_id: state.feature_class for state in each.known_states()} for each in (one, other)]
    known = sum(classes[0][number] != classes[1].get(number) for number in classes[0])
    found = [np.array([new.position_m for new in each.new_features()]).reshape(-1, 2) for each in (one, other)]
    apart = np.linalg.norm(found[0][:, None] - found[1][None], axis=2)
    return known + (int((apart.min(axis=1) > 1.0).sum()) if apart.size else len(found[0]))
