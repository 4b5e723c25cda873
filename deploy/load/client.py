"""A process that is many vehicles: it sends their reports when they are due and answers for each of them."""

import itertools
import json
import logging
import queue
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gnd.deploy.load.drives import KeptRuns
from gnd.deploy.load.plan import Due, LoadOptions, Timetable
from gnd.deploy.load.sending import Open, Sender, SenderAccount, SendingMeasured, opened
from gnd.deploy.load.shift import DistrictShift
from gnd.deploy.load.streets import Streets
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.gnd_map.errors import GndError
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import ROOT
from gnd.schemas.limits import MAX_REPORTS_OF_QUESTION
from gnd.schemas.report_states import ReportState, ReportStates

POLL_S: Final = 0.05
LOOK_S: Final = 0.5
"""Period at which reports without an answer are looked for."""
DONE: Final = ("released", "quarantined")
_LOG = logging.getLogger(__name__)
Work = Callable[[Sender], None]


@dataclass(frozen=True, slots=True)
class ClientConfig:
    """One client process.

    Attributes:
        number: of the client.
        vehicles: whose reports it sends.
        options: of the load.
        runs: the kept drives.
        connect: endpoints of its routers, in order.
        folder: where it tells that it is ready, reads when to begin, and writes its accounts.
        identities: of its vehicles, each under its name; None: there are no certificates.
    """

    number: int
    vehicles: range
    options: LoadOptions
    runs: KeptRuns
    connect: tuple[str, ...]
    folder: Path
    identities: Path | None

    @property
    def name(self) -> str:
        """Of the process."""
        return f"client-{self.number}"

    @property
    def ready(self) -> Path:
        """Is there when the client waits for the start; holds how many reports it is going to send."""
        return self.folder / f"client-{self.number}.ready"

    @property
    def offered(self) -> Path:
        """Is there when it has sent its last report."""
        return self.folder / f"client-{self.number}.offered"

    @property
    def cpu(self) -> Path:
        """CPU that it has used from the start to its end, s."""
        return self.folder / f"client-{self.number}.cpu"

    @property
    def accounts(self) -> Path:
        """What became of its reports: a JSON object a line."""
        return self.folder / f"client-{self.number}.jsonl"

    @property
    def all_vehicles(self) -> str:
        """A name that is each of theirs, as subscriptions say it."""
        return f"load-{self.number}-$*"

    def name_of(self, vehicle: int) -> str:
        """Name of a vehicle."""
        return vehicle_name(self.number, vehicle)


def vehicle_name(client: int, vehicle: int) -> str:
    """Name of a vehicle; all of a client begin alike, so that one subscription hears of all."""
    return f"load-{client}-{vehicle}"


def start_file(folder: Path) -> Path:
    """Holds when all begin, s of the machine's monotonic clock."""
    return folder / "start"


def client(config: ClientConfig, *, stop: threading.Event) -> None:
    """Send all reports of the client's vehicles, then wait until all are released, at most `drain_s`."""
    streets = Streets.of(config.runs, config.options)
    table = streets.timetable()
    with _sessions(config) as buses:
        herd = _Herd(config, streets, buses)
        config.ready.write_text(str(table.count(config.vehicles)), encoding="utf-8")
        start_s = _started(config.folder, stop)
        if start_s is None:
            return
        before_s = time.process_time()
        try:
            herd.drive(table, start_s, stop)
            config.offered.touch()
            herd.drain(time.monotonic() + config.options.drain_s, stop)
        finally:
            herd.close()
            _write(config.accounts, herd.accounts)
            config.cpu.write_text(repr(time.process_time() - before_s), encoding="utf-8")


@contextmanager
def _sessions(config: ClientConfig) -> Iterator[dict[str, Bus]]:
    """By name one session for all vehicles; with certificates one each: who seals a report must be who it is of."""
    folder, names = config.identities, [config.all_vehicles]
    if folder is not None:
        names = [config.name_of(vehicle) for vehicle in config.vehicles]
    with ExitStack() as stack:
        buses = {}
        for name in names:
            own = BusConfig(connect=config.connect, identity=None if folder is None else folder / name)
            buses[name] = stack.enter_context(open_bus(own, name=name))
        yield buses


def read_accounts(path: Path) -> list[SenderAccount]:
    """What a client has written; nothing where it was killed before."""
    if not path.exists():
        return []
    return [SenderAccount(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def _write(path: Path, accounts: list[SenderAccount]) -> None:
    lines = "".join(json.dumps(one.as_json()) + "\n" for one in accounts)
    path.write_text(lines, encoding="utf-8")


def _started(folder: Path, stop: threading.Event) -> float | None:
    while not stop.is_set():
        with_text = start_file(folder)
        if with_text.exists():
            return float(with_text.read_text(encoding="utf-8"))
        stop.wait(POLL_S)
    return None


class _Herd:
    """The vehicles of one client: who is on the way with what, and the threads that send."""

    def __init__(self, config: ClientConfig, streets: Streets, buses: Mapping[str, Bus]) -> None:
        self.accounts: list[SenderAccount] = []
        self._config, self._streets, self._options = config, streets, config.options
        self._shifts: dict[int, DistrictShift] = {}
        self._open: dict[str, Open] = {}
        self._lock = threading.Lock()
        # Urgent first: a second half before new flags, as a vehicle has it in its outbox longer.
        self._work: queue.PriorityQueue[tuple[int, int, Callable[[], None] | None]] = queue.PriorityQueue()
        self._number = itertools.count()
        self._room = threading.Semaphore(2 * self._options.in_flight)
        measured = SendingMeasured(streets.bases)
        self._senders = {name: Sender(bus, measured) for name, bus in buses.items()}
        for name, bus in buses.items():
            bus.subscribe(f"{ROOT}/want/{name}", self._on_notice, kind="ack")
        self._threads = [threading.Thread(target=self._run, daemon=True) for _ in range(self._options.in_flight)]
        for thread in self._threads:
            thread.start()

    def drive(self, table: Timetable, start_s: float, stop: threading.Event) -> None:
        """Hand every report to the threads when it is due (pace "max": when there is room)."""
        is_real = self._options.pace == "real"
        for due in table.due(self._config.vehicles):
            due_s = start_s + due.at_s
            while is_real and not stop.is_set() and (wait_s := due_s - time.monotonic()) > 0:
                self._ask_after()
                stop.wait(min(wait_s, LOOK_S))
            if not is_real:
                self._wait_for_room(stop)
                due_s = time.monotonic()
                if due_s - start_s > self._options.seconds:
                    return
            if stop.is_set():
                return
            self._begin(due, due_s)

    def drain(self, until_s: float, stop: threading.Event) -> None:
        """Wait until every report is released or refused."""
        while self._open and time.monotonic() < until_s and not stop.is_set():
            self._ask_after()
            stop.wait(POLL_S)

    def close(self) -> None:
        """End the threads after their current messages."""
        for _ in self._threads:
            self._work.put((9, next(self._number), None))
        for thread in self._threads:
            thread.join()

    def _wait_for_room(self, stop: threading.Event) -> None:
        while not stop.is_set() and not self._room.acquire(timeout=POLL_S):
            self._ask_after()

    def _begin(self, due: Due, due_s: float) -> None:
        edition = self._streets.edition(due.street)
        shift = self._shifts.get(due.street)
        if shift is None:
            shift = self._shifts[due.street] = self._streets.shift(due.street)
        kept = edition.drives[due.drive].reports[due.report]
        one = opened(due, kept, shift, self._options.seed, self._config.name_of(due.vehicle), due_s)
        with self._lock:
            self._open[one.account.report_id] = one
        self.accounts.append(one.account)
        self._put(1, one, lambda sender: self._first(sender, one))

    def _first(self, sender: Sender, one: Open) -> None:
        sender.first(one)
        if self._options.pace == "max":
            self._room.release()

    def _put(self, rank: int, one: Open, work: Work) -> None:
        sender = self._senders.get(one.account.vehicle) or self._senders[self._config.all_vehicles]
        self._work.put((rank, next(self._number), lambda: work(sender)))

    def _run(self) -> None:
        while (work := self._work.get()[2]) is not None:
            try:
                work()
            except GndError:
                _LOG.exception("a message was not sent")

    def _on_notice(self, _key: str, payload: bytes) -> None:
        try:
            states = ReportStates.decode(payload).states
        except SchemaError:
            _LOG.exception("a message with the states of reports cannot be read")
            return
        for state in states:
            self._hear(state)

    def _hear(self, state: ReportState) -> None:
        """Process the state of a report; it may arrive before the acknowledgement."""
        with self._lock:
            one = self._open.get(state.report_id)
            if one is None or state.status in ("waiting", "unknown"):
                return
            now_s = time.monotonic()
            one.account.word_s = one.account.word_s or now_s
            one.account.status = state.status
            if state.status in DONE:
                one.account.released_s = now_s
                del self._open[state.report_id]
                return
            if state.status == "wanted" and not one.account.halves:
                one.wanted = state.wanted
                self._put(0, one, lambda sender: sender.half(one))
            elif state.status == "resend" and not one.account.whole:
                self._put(0, one, lambda sender: sender.whole(one))

    def _ask_after(self) -> None:
        """Ask for the states of acknowledged reports that had no answer for some time, all of a vehicle at once."""
        now_s = time.monotonic()
        silent = defaultdict(list)
        with self._lock:
            for one in self._open.values():
                if one.next_ask_s and one.next_ask_s <= now_s:
                    one.next_ask_s = now_s + self._options.drain_s  # until it has been asked
                    silent[one.account.vehicle].append(one)
        for vehicle, reports in silent.items():
            for some in _batches(reports):
                self._put(0, some[0], lambda sender, vehicle=vehicle, some=some: self._ask(sender, vehicle, some))  # type: ignore[misc]

    def _ask(self, sender: Sender, vehicle: str, reports: list[Open]) -> None:
        for state in sender.ask(vehicle, reports):
            self._hear(state)


def _batches(reports: list[Open]) -> Iterator[list[Open]]:
    for first in range(0, len(reports), MAX_REPORTS_OF_QUESTION):
        yield reports[first : first + MAX_REPORTS_OF_QUESTION]
