"""The queues of a cloud as discrete events (SimPy): reports arrive, shards acknowledge, expand, merge and publish.

A host has cores; receiver and worker of a shard are processes that use one of them at a time (the interpreter's lock).
All work is cut into slices, so that what runs at the same time shares the cores. The rules are those of the shards: two
threads that expand, a tile that becomes ready some time after its first waiting report, sixteen tiles claimed at once,
four settled together. The database uses the same cores, or has some of its own, for which its clients wait.
"""

import heapq
import random
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

import simpy

from gnd.cloud_merger.expander import UPLOADS_AT_ONCE
from gnd.cloud_merger.merger import TILES_AT_ONCE
from gnd.cloud_merger.work import LEAST_IDLE_S, OTHERS_IDLE_S, SETTLED_TOGETHER
from gnd.tile_store.sql_inbox import HALVES_WAIT, HELP_AFTER_S, HELP_FACTOR
from gnd.tile_store.values import StoreConfig
from studies.frame.errors import OptionError

Step = Generator[simpy.Event, Any, None]
Said = Literal["quiet", "plain", "asked"]
"""Of a tile, a report says that nothing has changed, says all that it is to say, or is asked for Gaussians."""
STREET: Final = 1000
"""A street has so many numbers for its tiles."""
_ACK_FIRST: Final = 0
_LATER: Final = 1


@dataclass(frozen=True, slots=True)
class CpuCosts:
    """CPU seconds of one thing each, all processes of the host together.

    Attributes:
        receive_s: an upload, until it is acknowledged: router, receiver, database.
        flags_s: a tile of the first half of a report, until it is in the journal.
        half_s: a second half.
        merge_s: a tile, with its publication and notice.
        publish_s: of `merge_s`, for how long a publication has the database alone.
        notice_share: of a merge, what comes after the publication: notices, leases, looking for what is next.
        begin_s: what a worker takes once, when its first report comes.
        news: of reports about a tile of which n are known, 1 / (1 + n / news) change it: what is told often is no news.
        database_share: of each, what the database server does.
        answer_s: time (no CPU of the cloud) in which a vehicle answers with its second half.
    """

    receive_s: float
    flags_s: float
    half_s: float
    merge_s: float
    publish_s: float = 0.0
    notice_share: float = 0.0
    begin_s: float = 0.0
    news: float = 10.0
    database_share: float = 0.0
    answer_s: float = 0.02

    def __post_init__(self) -> None:
        values = (self.receive_s, self.flags_s, self.half_s, self.merge_s, self.begin_s, self.answer_s)
        if not all(0.0 <= one < 60.0 for one in values):
            raise OptionError(f"costs must be 0 to 60 s, got {', '.join(f'{one:g}' for one in values)}")
        if (1.0 - self.notice_share) * self.merge_s < self.publish_s:
            raise OptionError(f"a publication ({self.publish_s:g} s) is a part of a merge ({self.merge_s:g} s)")
        shares = (self.database_share, self.notice_share)
        if not (all(0.0 <= one <= 1.0 for one in shares) and self.news > 0.0):
            raise OptionError(f"shares lie in [0, 1], news above 0; got {shares}, {self.news:g}")

    def times(self, factor: float) -> "CpuCosts":
        """All CPU times by a factor: those of another core."""
        names = ("receive_s", "flags_s", "half_s", "merge_s", "publish_s", "begin_s")
        return replace(self, **{name: factor * getattr(self, name) for name in names})


@dataclass(frozen=True, slots=True)
class HostRules:
    """One host and the rules of its shards; defaults are those of the programs.

    Attributes:
        cores: of the host.
        shards: each a process that receives and one that works.
        database_cores: of a database host beside it; 0: the database uses the same cores.
        expanders: threads of a worker.
        merge_delay_s, merge_after: as `StoreConfig` has them.
        poll_s: as `ShardConfig` has it.
        slice_s: so long a thread keeps a core; nothing that is real, but others have their turns between.
    """

    cores: int = 1
    shards: int = 2
    database_cores: int = 0
    expanders: int = 2
    merge_delay_s: float = StoreConfig().merge_delay_s
    merge_after: int = StoreConfig().merge_after_reports
    poll_s: float = 0.2
    slice_s: float = 0.005

    def __post_init__(self) -> None:
        if min(self.cores, self.shards, self.expanders, self.merge_after) < 1 or min(self.poll_s, self.slice_s) <= 0:
            raise OptionError(f"a host needs cores, shards, threads and times above 0, got {self}")


@dataclass(frozen=True, slots=True)
class SimulatedReport:
    """One report.

    Attributes:
        at_s: when it is sent.
        shard: that receives it.
        says: of each tile, by its number.
    """

    at_s: float
    shard: int
    says: tuple[tuple[int, Said], ...]

    @property
    def asked(self) -> tuple[int, ...]:
        """The tiles of which Gaussians are wanted."""
        return tuple(tile for tile, said in self.says if said == "asked")


@dataclass(slots=True)
class _Dirty:
    """A tile that waits to be merged, and the shard to which it belongs: it receives all that is said about it."""

    ready_s: float
    shard: int
    waiting: list[float] = field(default_factory=list)
    is_leased: bool = False


@dataclass(slots=True)
class SimulatedRun:
    """What came of a run.

    Attributes:
        acks_s: time to each acknowledgement.
        lags_s: of each report part that a version was made of, from its receipt to the publication.
        merges: how many tiles were merged.
        versions: how many of these changed the map.
        busy_s: CPU time.
        ended_s: when nothing waited any more, or the run was over.
        is_drained: whether nothing waited.
    """

    acks_s: list[float] = field(default_factory=list)
    lags_s: list[float] = field(default_factory=list)
    merges: int = 0
    versions: int = 0
    busy_s: float = 0.0
    ended_s: float = 0.0
    is_drained: bool = False


class _WaitingTiles:
    """Tiles that wait and that nobody has leased, by the time at which they are ready.

    Every poll of every shard asks it. What a tile's later times have overtaken is thrown away when it comes to the top.
    """

    def __init__(self, dirty: dict[int, _Dirty]) -> None:
        self._dirty = dirty
        self._heap: list[tuple[float, int]] = []

    def note(self, tile: int, one: _Dirty) -> None:
        """A tile's time is new, or its lease is over."""
        heapq.heappush(self._heap, (one.ready_s, tile))

    def first(self, most: int) -> list[int]:
        """The tiles that are ready first, in the order of their times and numbers."""
        found: dict[int, tuple[float, int]] = {}
        while self._heap and len(found) < most:
            ready_s, tile = entry = heapq.heappop(self._heap)
            one = self._dirty.get(tile)
            if one is not None and not one.is_leased and one.ready_s == ready_s:
                found[tile] = entry
        for entry in found.values():
            heapq.heappush(self._heap, entry)
        return list(found)


class CloudModel:
    """One host with its shards.

    Args:
        costs: of each thing.
        rules: of host and shards.
        seed: of which merges change the map.
        again: of a street, how many merges of what is known follow a merge of what has come: what was said of a vehicle
            has changed, and tiles about which it reported are merged once more.
    """

    def __init__(
        self, costs: CpuCosts, rules: HostRules, seed: int = 1, again: Callable[[int], float] = lambda _: 0.0
    ) -> None:
        self._costs, self._rules, self._rng, self._again = costs, rules, random.Random(seed), again
        self._env = simpy.Environment()
        self._cores = simpy.PriorityResource(self._env, rules.cores)
        self._database = simpy.PriorityResource(self._env, rules.database_cores) if rules.database_cores else None
        self._alone = simpy.Resource(self._env)  # who publishes
        self._receivers = [simpy.Resource(self._env) for _ in range(rules.shards)]
        self._workers = [simpy.Resource(self._env) for _ in range(rules.shards)]
        self._uploads: list[deque[tuple[SimulatedReport, float, bool]]] = [deque() for _ in range(rules.shards)]
        self._woken = [self._env.event() for _ in range(rules.shards)]
        self._dirty: dict[int, _Dirty] = {}
        self._waiting = _WaitingTiles(self._dirty)
        self._own_waiting = [_WaitingTiles(self._dirty) for _ in range(rules.shards)]
        self._window: Counter[int] = Counter()  # reports of each tile's open window
        self._known: dict[int, list[int]] = {}  # of each street, the tiles about which reports have come
        self._open = 0  # reports that are not through
        self._begun = [False] * rules.shards
        self.run_ = SimulatedRun()

    def run(self, reports: Iterable[SimulatedReport], until_s: float) -> SimulatedRun:
        """Simulate these reports, in the order of their times, until all is merged or the time is over."""
        reports = list(reports)
        self._open = len(reports)
        self._env.process(self._arrivals(reports))
        for shard in range(self._rules.shards):
            for _ in range(self._rules.expanders):
                self._env.process(self._expander(shard))
            self._env.process(self._merger(shard))
        end = self._env.process(self._end(until_s))
        self._env.run(until=end)
        self.run_.ended_s = self._env.now
        return self.run_

    def _end(self, until_s: float) -> Step:
        while self._env.now < until_s:
            if not self._open and not self._dirty:
                self.run_.is_drained = True
                return
            yield self._env.timeout(min(0.1, until_s - self._env.now))

    def _use(self, process: simpy.Resource, cpu_s: float, priority: int) -> Step:
        """So much CPU in one thread of a process, in slices: others have their turns between them."""
        own = 1.0 if self._database is None else 1.0 - self._costs.database_share
        left_s = cpu_s
        while left_s > 0.0:
            slice_s = min(self._rules.slice_s, left_s)
            with process.request() as mine:
                yield mine
                with self._cores.request(priority) as core:
                    yield core
                    yield self._env.timeout(own * slice_s)
                if self._database is not None:
                    with self._database.request(priority) as core:
                        yield core
                        yield self._env.timeout((1.0 - own) * slice_s)
            left_s -= slice_s
        self.run_.busy_s += cpu_s

    def _arrivals(self, reports: list[SimulatedReport]) -> Step:
        for one in reports:
            yield self._env.timeout(max(0.0, one.at_s - self._env.now))
            self._env.process(self._received(one, is_half=False))

    def _received(self, one: SimulatedReport, *, is_half: bool) -> Step:
        came_s = self._env.now
        yield from self._use(self._receivers[one.shard], self._costs.receive_s, _ACK_FIRST)
        if not is_half:
            self.run_.acks_s.append(self._env.now - came_s)
        self._uploads[one.shard].append((one, came_s, is_half))
        self._wake(one.shard)

    def _wake(self, shard: int) -> None:
        event, self._woken[shard] = self._woken[shard], self._env.event()
        event.succeed()

    def _expander(self, shard: int) -> Step:
        uploads = self._uploads[shard]
        while True:
            claimed = [uploads.popleft() for _ in range(min(UPLOADS_AT_ONCE, len(uploads)))]
            for one, came_s, is_half in claimed:
                if not self._begun[shard]:
                    self._begun[shard] = True
                    yield from self._use(self._workers[shard], self._costs.begin_s, _LATER)
                cost_s = self._costs.half_s if is_half else self._costs.flags_s * len(one.says)
                yield from self._use(self._workers[shard], cost_s, _LATER)
                self._journaled(one, came_s, is_half=is_half)
            if not claimed:
                yield self._woken[shard] | self._env.timeout(self._rules.poll_s)

    def _journaled(self, one: SimulatedReport, came_s: float, *, is_half: bool) -> None:
        delay_s = self._rules.merge_delay_s
        if is_half:
            for tile in one.asked:
                self._mark(tile, one.shard, came_s, delay_s, self._rules.merge_after)
            self._open -= 1
            return
        for tile, said in one.says:
            if tile not in self._window:
                self._known.setdefault(tile // STREET, []).append(tile)
            self._window[tile] = self._window[tile] % StoreConfig().window_reports + 1
            if said == "asked":
                self._mark(tile, one.shard, came_s, HALVES_WAIT * delay_s, 1 << 30)
            elif said == "plain" or tile in self._dirty:  # nothing changes and nothing waits: no merge
                self._mark(tile, one.shard, came_s, delay_s, self._rules.merge_after)
        if one.asked:
            self._env.process(self._answer(one))
        else:
            self._open -= 1

    def _mark(self, tile: int, shard: int, came_s: float, delay_s: float, merge_after: int) -> None:
        dirty = self._dirty.setdefault(tile, _Dirty(self._env.now + delay_s, shard))
        dirty.waiting.append(came_s)
        self._wait(tile, dirty, delay_s, merge_after)

    def _wait(self, tile: int, dirty: _Dirty, delay_s: float, merge_after: int) -> None:
        is_full = len(dirty.waiting) >= merge_after
        dirty.ready_s = min(dirty.ready_s, self._env.now + (0.0 if is_full else delay_s))
        self._note(tile, dirty)

    def _merge_again(self, tile: int, shard: int) -> None:
        if tile not in self._dirty:
            delay_s = self._rules.merge_delay_s
            self._wait(tile, self._dirty.setdefault(tile, _Dirty(self._env.now + delay_s, shard)), delay_s, 1 << 30)

    def _note(self, tile: int, dirty: _Dirty) -> None:
        if not dirty.is_leased:
            self._waiting.note(tile, dirty)
            self._own_waiting[dirty.shard].note(tile, dirty)

    def _answer(self, one: SimulatedReport) -> Step:
        yield self._env.timeout(self._costs.answer_s)
        yield from self._received(one, is_half=True)

    def _merger(self, shard: int) -> Step:
        while True:
            claims = self._claimed(shard)
            for first in range(0, len(claims), SETTLED_TOGETHER):
                some = claims[first : first + SETTLED_TOGETHER]
                taken, after_s = [], 0.0
                for tile in some:
                    dirty = self._dirty[tile]
                    read = self._window[tile]
                    taken.append((tile, len(dirty.waiting), read))
                    after_s += self._costs.notice_share * self._costs.merge_s
                    own_s = (1.0 - self._costs.notice_share) * self._costs.merge_s - self._costs.publish_s
                    yield from self._use(self._workers[shard], own_s, _LATER)
                if self._costs.publish_s:
                    with self._alone.request() as turn:
                        yield turn
                        yield from self._use(self._workers[shard], len(some) * self._costs.publish_s, _LATER)
                for tile, count, read in taken:
                    self._published(tile, count, read)
                yield from self._use(self._workers[shard], after_s, _LATER)
            if not claims:
                yield self._env.timeout(self._idle_s())

    def _claimed(self, shard: int) -> list[int]:
        """Ready tiles, those first that have waited longest: the shard's own, and those of others that lag."""
        now_s, turns = self._env.now, list[tuple[float, int]]()
        for tile in self._own_waiting[shard].first(TILES_AT_ONCE):
            if (waited_s := now_s - self._dirty[tile].ready_s) >= 0.0:
                turns.append((HELP_AFTER_S + HELP_FACTOR * waited_s, tile))
        # the shard's own among the first of all have more weight than what comes after them
        for tile in self._waiting.first(TILES_AT_ONCE):
            waited_s = now_s - self._dirty[tile].ready_s
            if self._dirty[tile].shard != shard and waited_s >= HELP_AFTER_S:
                turns.append((waited_s, tile))
        claims = [tile for _, tile in sorted(turns, key=lambda turn: (-turn[0], turn[1]))[:TILES_AT_ONCE]]
        for tile in claims:
            self._dirty[tile].is_leased = True
        return claims

    def _idle_s(self) -> float:
        soonest_s = min((self._dirty[tile].ready_s for tile in self._waiting.first(1)), default=float("inf"))
        wait_s = soonest_s - self._env.now
        return min(OTHERS_IDLE_S if wait_s <= 0.0 else max(wait_s, LEAST_IDLE_S), self._rules.poll_s)

    def _published(self, tile: int, count: int, read: int) -> None:
        dirty = self._dirty[tile]
        self.run_.merges += 1
        if self._rng.random() < 1.0 - (1.0 - 1.0 / (1.0 + read / self._costs.news)) ** count:
            self.run_.versions += 1
            self.run_.lags_s += [self._env.now - came_s for came_s in dirty.waiting[:count]]
        del dirty.waiting[:count]
        if dirty.waiting:
            dirty.is_leased = False
            is_full = len(dirty.waiting) >= self._rules.merge_after
            dirty.ready_s = self._env.now + (0.0 if is_full else self._rules.merge_delay_s)
            self._note(tile, dirty)
        else:
            del self._dirty[tile]
        if count and self._rng.random() < self._again(tile // STREET):
            self._merge_again(self._rng.choice(self._known[tile // STREET]), dirty.shard)
