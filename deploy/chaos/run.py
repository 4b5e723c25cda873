"""One chaos run: start, hurt, let it settle, end, look."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from gnd.deploy.chaos.checks import Findings, look
from gnd.deploy.chaos.clients import ENOUGH, OPEN_SUFFIX
from gnd.deploy.chaos.cloud import ChaosCloud, running
from gnd.deploy.chaos.faults import Fault
from gnd.deploy.chaos.inflict import MESSENGER, End, Inflictor, retry
from gnd.deploy.chaos.service import SERVICES, Gaps, gaps, watched
from gnd.deploy.chaos.street import read_street
from gnd.deploy.errors import ChaosError
from gnd.ending import ORDERLY_S
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.tile_store.errors import StoreError

SETTLE_S: Final = 120.0
HURRIED_S: Final = 0.4 * ORDERLY_S
"""So long a run that was interrupted is let settle: the rest of the grace is for its end."""
READY_S: Final = 90.0
_LOOK_S: Final = 0.2
RETRY_S: Final = 2.0
CALM_S: Final = 3.0

OnStep = Callable[[str, int], None]
"""Called with what is done now, and how many faults there have been."""


@dataclass(frozen=True, slots=True)
class ChaosOutcome:
    """A run that has ended.

    Attributes:
        seed: of it.
        seconds: from its first fault to its last.
        settled_s: how long it took after the last one until nothing was left to do; None: it was not done in time.
        interrupted: by Ctrl-C: the faults are fewer than were wanted.
        findings: of the checks.
        gaps: without service.
        inflicted: the faults that there were: what was hit, and when they really began and ended, s.
        restarts: how often each process was started again, those that were killed on purpose included.
        deaths: how often one had died by itself.
        died: parts that would not live.
    """

    seed: int
    seconds: float
    settled_s: float | None
    interrupted: bool
    findings: Findings
    gaps: Gaps
    inflicted: tuple[dict[str, Any], ...]
    restarts: dict[str, int]
    deaths: dict[str, int]
    died: tuple[str, ...]

    @property
    def failures(self) -> list[str]:
        """What must not be, in words; empty: the cloud has kept its promises."""
        return self.findings.failures + list(self.died)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        told = self.findings.as_dict()
        head = ("acknowledged", "lost", "doubled", "torn_tiles", "stuck_tiles", "identical_map")
        return {
            **{name: told.pop(name) for name in head},
            "max_gap_s": {name: round(self.gaps.of_kills[name], 3) for name in SERVICES},
            "seed": self.seed,
            "faults": len(self.inflicted),
            "by_kind": dict(sorted(Counter(row["kind"] for row in self.inflicted).items())),
            "seconds": round(self.seconds, 1),
            "settled_s": None if self.settled_s is None else round(self.settled_s, 1),
            "interrupted": self.interrupted,
            "failures": self.failures,
            **told,
            "gap_s_by_kind": {
                kind: {name: round(value, 3) for name, value in values.items()}
                for kind, values in sorted(self.gaps.by_kind.items())
            },
            "restarts": self.restarts,
            "deaths": self.deaths,
            "list": list(self.inflicted),
        }


def run_chaos(
    seed: int,
    faults: Sequence[Fault],
    folder: Path,
    stop: threading.Event | None = None,
    on_step: OnStep = lambda _what, _n: None,
) -> ChaosOutcome:
    """Run a cloud, inflict the faults, let it settle, end it and look at what is left.

    Args:
        seed: of the reports.
        faults: in order of time.
        folder: empty; holds store, outboxes, receipts and logs afterwards.
        stop: ends the faults early; what was found until then is the outcome.
        on_step: progress.

    Raises:
        ChaosError: the cloud did not begin to work.
    """
    street, stop = read_street(), stop or threading.Event()
    on_step("starting", 0)
    with ExitStack() as stack:
        cloud = stack.enter_context(running(folder, street, seed))
        bus = stack.enter_context(open_bus(BusConfig(connect=(cloud.connect,)), name=MESSENGER))
        inflictor = Inflictor(cloud, street, seed, bus)
        stack.callback(inflictor.close)
        served = stack.enter_context(watched(cloud.connect, cloud.beacon, inflictor.probe()))
        _wait_for_merges(cloud, stop)
        timeline = Timeline(inflictor, on_step)
        timeline.run(faults, stop, lambda: bool(cloud.died))
        stop.wait(CALM_S)  # what the last one cost is still to be seen
        end_s = time.monotonic()
        found_gaps = gaps(served, timeline.faults, timeline.start_s, end_s)
        on_step("settling", len(timeline.rows))
        settled_s = _settle(cloud, inflictor, HURRIED_S if stop.is_set() else SETTLE_S)
        restarts, died = dict(cloud.supervisor.restarts), tuple(cloud.died)
        deaths = {name: n for name, n in cloud.supervisor.deaths.items() if n}
        on_step("ending", len(timeline.rows))
    on_step("checking", len(timeline.rows))
    findings = look(cloud.path, sorted(cloud.vehicles.glob("*.sqlite")), sorted(cloud.receipts.glob("*.jsonl")))
    return ChaosOutcome(
        seed=seed,
        seconds=end_s - timeline.start_s,
        settled_s=settled_s,
        interrupted=stop.is_set(),
        findings=findings,
        gaps=found_gaps,
        inflicted=tuple(timeline.rows),
        restarts=restarts,
        deaths=deaths,
        died=died,
    )


def _wait_for_merges(cloud: ChaosCloud, stop: threading.Event) -> None:
    """Until what vehicles report is merged: before that nothing can be lost."""
    deadline_s = time.monotonic() + READY_S
    while not any(head.version > 1 for head in cloud.store.heads() if head.tile != cloud.beacon.tile_id):
        if time.monotonic() > deadline_s or cloud.died:
            raise ChaosError(f"nothing was merged within {READY_S:g} s: read {cloud.folder / 'logs'}; {cloud.died}")
        if stop.wait(_LOOK_S):
            return


class Timeline:
    """Begins and ends faults in time; whatever happens, each one that was begun is ended."""

    def __init__(self, inflictor: Inflictor, on_step: OnStep) -> None:
        self.rows: list[dict[str, Any]] = []
        self.faults: list[Fault] = []
        self.start_s = time.monotonic()
        self._inflictor, self._on_step = inflictor, on_step
        self._held: dict[int, tuple[float, dict[str, Any], End]] = {}

    def run(self, faults: Sequence[Fault], stop: threading.Event, is_dead: Callable[[], bool]) -> None:
        """Inflict them all, or until `stop` is set or nothing lives any more."""
        todo = list(faults)
        try:
            while (todo or self._held) and not is_dead():
                number, end_s = min(
                    ((n, one[0]) for n, one in self._held.items()), key=lambda p: p[1], default=(-1, 1e9)
                )
                at_s = min(end_s, todo[0].at_s if todo else 1e9)
                if stop.wait(max(0.0, self.start_s + at_s - time.monotonic())):
                    break
                if end_s <= at_s:
                    self._end(number)
                else:
                    self._begin(todo.pop(0))
        finally:
            for number in list(self._held):
                self._end(number)

    def _begin(self, fault: Fault) -> None:
        began_s = time.monotonic() - self.start_s
        where, end = self._inflictor.begin(fault)
        row = fault.as_dict() | {"began_s": round(began_s, 3), "ended_s": None, "where": where}
        self.rows.append(row)
        self.faults.append(replace(fault, at_s=began_s))
        self._held[fault.number] = time.monotonic() - self.start_s + fault.held_s, row, end
        self._on_step(fault.kind, len(self.rows))

    def _end(self, number: int) -> None:
        _, row, end = self._held.pop(number)
        end()
        row["ended_s"] = round(time.monotonic() - self.start_s, 3)
        place = next(k for k, one in enumerate(self.faults) if one.number == number)
        self.faults[place] = replace(self.faults[place], held_s=row["ended_s"] - self.faults[place].at_s)


def _settle(cloud: ChaosCloud, inflictor: Inflictor, within_s: float) -> float | None:
    """Let the clients finish and the cloud work off what it has; how long it took, None: it came to no end."""
    begin_s = time.monotonic()
    (cloud.vehicles / ENOUGH).touch()
    cloud.is_shining = False
    retried_s = begin_s
    while time.monotonic() < begin_s + within_s and not cloud.died:
        time.sleep(_LOOK_S)
        with suppress(StoreError):
            if not _clients_open(cloud, inflictor) and _is_idle(cloud):
                return time.monotonic() - begin_s
            if time.monotonic() - retried_s > RETRY_S:
                retried_s = time.monotonic()
                retry(cloud.store)
    return None


def _clients_open(cloud: ChaosCloud, inflictor: Inflictor) -> int:
    told = [cloud.vehicles / f"{name}{OPEN_SUFFIX}" for name in cloud.names("vehicle")]
    if not all(path.exists() for path in told):
        return 1
    return sum(int(path.read_text(encoding="utf-8")) for path in told) + inflictor.still_open()


def _is_idle(cloud: ChaosCloud) -> bool:
    store, unread = cloud.store, ("waiting", "early")
    is_read = not set(unread) & set(store.upload_counts().by_state)
    return is_read and not store.dirty_count() and not store.tiles_set_aside() and not store.notices()
