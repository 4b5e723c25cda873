"""How each fault is begun, and ended again: signals, lines, limits, bytes of the store's file, messages."""

import logging
import os
import random
import resource
import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Protocol

import apsw
import numpy as np
import psutil

from gnd.deploy.chaos import page
from gnd.deploy.chaos.clients import put
from gnd.deploy.chaos.faults import BY_NAME, Fault
from gnd.deploy.chaos.street import LAYER, ChaosStreet, SentReport
from gnd.deploy.processes import Supervisor
from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import BusError
from gnd.gnd_map.codec import encode_mask
from gnd.gnd_map.errors import GndError
from gnd.tile_store.errors import StoreError
from gnd.tile_store.sqlite_store import SqlStore
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.link.sending import SenderThread
from gnd.vehicle_agent.report.packing import askable, pack_measured

SMALL_BYTES: Final = 4_096
MESSENGER: Final = "messenger"
DAMAGED_BODIES: Final = 3
_SEND_S: Final = 8.0
_LOG: Final = logging.getLogger(__name__)

End = Callable[[], None]


class HurtLines(Protocol):
    """The lines of clients."""

    def cut(self, name: str) -> None:
        """End a client's connections, and let none be made."""

    def hold(self, name: str) -> None:
        """Carry nothing for a client."""

    def mend(self, name: str) -> None:
        """Carry all again."""


class HurtCloud(Protocol):
    """What is hurt: a cloud of one machine, or a laboratory of hosts."""

    @property
    def supervisor(self) -> Supervisor:
        """Starts again what dies."""

    @property
    def wires(self) -> HurtLines:
        """Lines of the clients."""

    @property
    def store(self) -> SqlStore:
        """The store, opened here."""

    @property
    def path(self) -> Path:
        """Its file, where it is one."""

    @property
    def folder(self) -> Path:
        """In which the run writes."""

    @property
    def vehicles(self) -> Path:
        """Folder of the outboxes."""

    def names(self, part: str) -> list[str]:
        """The processes of a part, in order; of "worker" the shards whose they are."""

    def step_clock(self, by_s: float) -> None:
        """Set the time of day wrong by so much; 0 = right."""


def pids_of(supervisor: Supervisor, part: str, name: str) -> list[int]:
    """The process of a name, or the worker of a shard; empty while it is being started again."""
    pid = supervisor.pids().get(name, 0)
    if part != "worker":
        return [pid] if pid and psutil.pid_exists(pid) else []
    try:
        return [child.pid for child in psutil.Process(pid).children()]
    except psutil.Error:
        return []


def retry(store: SqlStore) -> None:
    """What `gnd map retry` does: tiles that were set aside are merged again."""
    store.take_up_again((one.layer, one.tile) for one in store.tiles_set_aside())


class Inflictor:
    """Begins faults. `begin` tells what was hit and how it is ended; what has not been ended `end_all` ends.

    Args:
        cloud: that is hurt.
        street: of the reports.
        seed: of the run.
        bus: for messages.
    """

    def __init__(self, cloud: HurtCloud, street: ChaosStreet, seed: int, bus: Bus) -> None:
        self._cloud, self._street, self._seed, self._bus = cloud, street, seed, bus
        self._outbox = Outbox(cloud.vehicles / f"{MESSENGER}-000.sqlite")
        self._sender = SenderThread(bus, self._outbox, MESSENGER)
        self._threads: list[threading.Thread] = []
        self._damaged: set[int] = set()

    def begin(self, fault: Fault) -> tuple[str, End]:
        """Do it; what was hit, in words, and how to end it."""
        kind = BY_NAME[fault.kind]
        if kind.group == "clock":
            self._cloud.step_clock(fault.clock_s)
            return f"{fault.clock_s:+g} s", lambda: self._cloud.step_clock(0.0)
        if kind.group == "page":
            return self._damage(fault)
        if kind.group == "line":
            return self._hurt_line(fault)
        if kind.group == "message":
            return self._send(fault)
        names = self._cloud.names(kind.part)
        name = names[int(fault.draw * len(names))]
        pids = pids_of(self._cloud.supervisor, kind.part, name)
        if kind.group == "disk":
            pids += pids_of(self._cloud.supervisor, "worker", name) if kind.part == "shard" else []
            return name, self._fill(pids, fault)
        if kind.group == "kill":
            self._kill(kind.part, name, pids)
            return f"{name} {pids}", _nothing
        _signal(pids, signal.SIGSTOP)
        return f"{name} {pids}", lambda: _signal(pids, signal.SIGCONT)

    def _kill(self, part: str, name: str, pids: Sequence[int]) -> None:
        if part == "worker":
            _signal(pids, signal.SIGKILL)
        else:
            self._cloud.supervisor.kill(name)

    def _hurt_line(self, fault: Fault) -> tuple[str, End]:
        names = self._cloud.names("vehicle") + self._cloud.names("follower")
        name = names[int(fault.draw * len(names))]
        (self._cloud.wires.cut if fault.kind == "cut line" else self._cloud.wires.hold)(name)
        return name, lambda: self._cloud.wires.mend(name)

    def _fill(self, pids: Sequence[int], fault: Fault) -> End:
        """No file of these processes may grow beyond a few bytes, or beyond what the store's log takes now."""
        log = self._cloud.folder / "store.sqlite-wal"
        limit = SMALL_BYTES if fault.draw * 7 % 1 < 0.5 or not log.exists() else log.stat().st_size
        for pid in pids:
            _limit_files(pid, limit)

        def end() -> None:
            for pid in pids:
                _limit_files(pid, resource.RLIM_INFINITY)

        return end

    def _damage(self, fault: Fault) -> tuple[str, End]:
        """Other bytes into the bodies of some versions, as a failing disk would; then those that its mirror had.

        Who has read them before goes on with what it remembers; so a worker may be killed with it, whose next life
        remembers nothing.
        """
        rng, part = random.Random(fault.draw), BY_NAME[fault.kind].part
        found = _places_of_bodies(self._cloud, rng, self._damaged)
        self._damaged |= set(found)
        was = {at: page.write(self._cloud.path, at, b"\xff" * page.SAMPLE_BYTES) for at in found}
        names = rng.sample(self._cloud.names("worker"), 1) if part else []
        for name in names:
            self._kill(part, name, pids_of(self._cloud.supervisor, part, name))

        def end() -> None:
            for at, before in was.items():
                page.write(self._cloud.path, at, before)
            self._damaged -= set(was)
            with suppress(StoreError):
                retry(self._cloud.store)

        return ", ".join([*found.values(), *(f"worker of {name} killed" for name in names)]), end

    def _send(self, fault: Fault) -> tuple[str, End]:
        """Messages go from a thread of their own: the next fault does not wait for answers."""
        work = self._again if fault.kind == "twice" else self._out_of_order
        thread = threading.Thread(target=work, args=(random.Random(fault.draw), fault.number), daemon=True)
        thread.start()
        self._threads.append(thread)
        return "messages", _nothing

    def _again(self, rng: random.Random, _number: int) -> None:
        """Old uploads once more: flags, Gaussians, and the whole report, each twice."""
        sent = self._known(rng)
        if sent is None:
            return
        letters = [sent.packed.encode()]
        with suppress(GndError):
            halves = self._cloud.store.first_halves(sent.key, sent.whole.report_id)
            letters += [
                pack_measured(sent.whole, sent.bases_by_sha, half.wanted).encode() for half in halves if half.wanted
            ]
            if rng.random() < 0.5:
                letters.append(sent.whole.encode())
        rng.shuffle(letters)
        for letter in letters * 2:
            self._request(sent.key, letter)

    def _known(self, rng: random.Random) -> SentReport | None:
        """A report that some vehicle has acknowledged by its outbox."""
        paths = sorted(self._cloud.vehicles.glob("vehicle-*.sqlite"))
        if not paths:
            return None
        path = rng.choice(paths)
        with suppress(apsw.Error):
            connection = apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READONLY)
            try:
                count = len(connection.execute("SELECT 1 FROM report").fetchall())
            finally:
                connection.close()
            if count:
                return self._street.said(self._seed, path.stem, rng.randrange(count))
        return None

    def _out_of_order(self, _rng: random.Random, number: int) -> None:
        """All Gaussians of a report before its flags; then the report goes its way, as if nothing had been sent."""
        for attempt in range(20):
            sent = self._street.said(self._seed, MESSENGER, 20 * (number + 1) + attempt)
            n = askable(sent.whole)
            if n:
                half = pack_measured(sent.whole, sent.bases_by_sha, encode_mask(np.ones(n, np.bool_)))
                self._request(sent.key, half.encode())
                put(self._outbox, sent)
                return

    def _request(self, key: str, payload: bytes) -> None:
        try:
            self._bus.request(key, payload, kind="change", timeout_s=_SEND_S)
        except BusError as error:
            _LOG.info("a message came to nothing: %s", error)

    def probe(self) -> SentReport:
        """A report that is sent again and again by who watches for acknowledgements; the messenger answers for it."""
        sent = self._street.said(self._seed, MESSENGER, 0)
        put(self._outbox, sent)
        return sent

    def still_open(self) -> int:
        """How many of the messages' reports are not released."""
        for thread in self._threads:
            thread.join()
        return self._outbox.counts().open

    def close(self) -> None:
        """End the sender."""
        self._sender.close()
        self._outbox.close()


def _nothing() -> None:
    """It is over, or the supervisor ends it."""


def _signal(pids: Sequence[int], number: signal.Signals) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, number)


def _limit_files(pid: int, limit: int) -> None:
    """How large a file a process may write; Python and SQLite get an error beyond, no signal."""
    with suppress(ProcessLookupError):
        _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (limit, hard))


def _places_of_bodies(cloud: HurtCloud, rng: random.Random, damaged: set[int]) -> dict[int, str]:
    """Offsets in bodies of newest versions that are in the file, not only in its log, and whole; and whose they are."""
    heads, found = cloud.store.heads(LAYER), dict[int, str]()
    for head in rng.sample(heads, len(heads)):
        stored = cloud.store.get(LAYER, head.tile)
        if stored is None or len(stored.body) <= page.PAGE_BYTES:
            continue
        at = page.find(cloud.path, stored.body)
        if at is not None and at not in damaged:
            found[at] = f"{stored.tile.path} version {stored.version} at byte {at}"
        if len(found) == DAMAGED_BODIES:
            break
    return found
