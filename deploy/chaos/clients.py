"""The clients of a chaos run: vehicles that report, and followers that hold the map; each a process that may be killed.

What they hold is on their disks: a vehicle its outboxes, a follower a line for every tile that it ever received. That,
and the store, is all that the checks at the end believe.
"""

import json
import queue
import random
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gnd.deploy.chaos.street import LAYER, ChaosStreet, SentReport, read_street
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusClosed, BusError
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile import Tile, content_sha
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import tile_key, update_keys
from gnd.schemas.tiles import CodedDelta, TileBlob, TileReply, TileRequest, tile_after, tile_of
from gnd.schemas.updates import TileUpdate, updated
from gnd.vehicle_agent.errors import OutboxError
from gnd.vehicle_agent.link.outbox import FIRST_ASK_S, Outbox
from gnd.vehicle_agent.link.sending import SenderThread

REPORTS_OF_TRIP: Final = 6
ENOUGH: Final = "enough"
"""This file beside the outboxes: no new reports any more."""
OPEN_SUFFIX: Final = ".open"
_LOOK_S: Final = 0.2
_ASK_EVERY_S: Final = 0.1
_ASK_S: Final = 5.0
_NEW_SHARE: Final = 0.3
_QUICK: Final = RetryPolicy(longest_wait_s=0.2, attempt_timeout_s=2.0)


@dataclass(frozen=True, slots=True)
class ChaosVehicleTask:
    """A vehicle.

    Attributes:
        connect: endpoints of its routers.
        name: of the vehicle.
        folder: of its outboxes.
        seed: of its reports.
        every_s: how often it has one, on average, s.
        link: profile of its link.
        times: a line for each acknowledgement: when it came, s of the machine's monotonic clock; None: nowhere.
        reports_of_trip: after so many reports it takes another pseudonym, with an outbox of its own.
    """

    connect: tuple[str, ...]
    name: str
    folder: Path
    seed: int
    every_s: float
    link: str | LinkProfile = "none"
    times: Path | None = None
    reports_of_trip: int = REPORTS_OF_TRIP


class _TimedOutbox(Outbox):
    """An outbox that notes when its reports are acknowledged."""

    def __init__(self, path: Path, times: Path | None) -> None:
        super().__init__(path)
        self._times = times

    def answered(
        self,
        report_id: str,
        status: str,
        reason: str = "",
        now_ns: int = 0,
        wanted: bytes = b"",
        *,
        is_short: bool = False,
        ask_s: float = FIRST_ASK_S,
    ) -> None:
        """As `Outbox.answered`."""
        super().answered(report_id, status, reason, now_ns, wanted, is_short=is_short, ask_s=ask_s)
        if self._times is not None and status != "quarantined":
            with self._times.open("a", encoding="utf-8") as file:
                file.write(f"{time.monotonic():.4f}\n")


class _Trips:
    """The drives of one vehicle: each under a pseudonym of its own, with an outbox of its own."""

    def __init__(self, task: ChaosVehicleTask, street: ChaosStreet, bus: Bus) -> None:
        self._task, self._street, self._bus = task, street, bus
        self._open: dict[str, tuple[Outbox, SenderThread]] = {}
        known = sorted(task.folder.glob(f"{task.name}-*.sqlite"))
        for path in known:
            self._begin(path.stem)
        self._trip = max(len(known) - 1, 0)

    @property
    def _pseudonym(self) -> str:
        return _pseudonym(self._task.name, self._trip)

    def _begin(self, pseudonym: str) -> Outbox:
        outbox = _TimedOutbox(self._task.folder / f"{pseudonym}.sqlite", self._task.times)
        self._open[pseudonym] = outbox, SenderThread(self._bus, outbox, pseudonym)
        return outbox

    def report(self) -> None:
        """Put the next report into the outbox; raises OutboxError where it cannot be kept."""
        outbox = self._open[self._pseudonym][0] if self._pseudonym in self._open else self._begin(self._pseudonym)
        number = outbox.counts().total
        if number >= self._task.reports_of_trip:
            self._trip += 1
            return self.report()
        put(outbox, self._street.said(self._task.seed, self._pseudonym, number))
        return None

    def still_open(self) -> int:
        """How many reports are not released; trips of the past that are done with are closed."""
        total = 0
        for pseudonym, (outbox, sender) in list(self._open.items()):
            n = outbox.counts().open
            total += n
            if not n and pseudonym != self._pseudonym:
                del self._open[pseudonym]
                sender.close()
                outbox.close()
        return total

    def close(self) -> None:
        """End all senders."""
        for outbox, sender in self._open.values():
            sender.close()
            outbox.close()


def _pseudonym(vehicle: str, trip: int) -> str:
    return f"{vehicle}-{trip:03}"


def first_pseudonym(vehicle: str) -> str:
    """What a vehicle is called on its first trip."""
    return _pseudonym(vehicle, 0)


def put(outbox: Outbox, sent: SentReport) -> bool:
    """A report as an agent puts it into its outbox."""
    return outbox.put(sent.whole.report_id, sent.key, sent.whole.encode(), sent.packed.encode(), sent.bases)


def vehicle(task: ChaosVehicleTask, *, stop: threading.Event) -> None:
    """Send reports until the run ends them, then continue until all are released."""
    street = read_street()
    rng = random.Random(time.time_ns())
    config = BusConfig(connect=task.connect, link=task.link, patient=True)
    look_s = min(_LOOK_S, task.every_s / 4)
    with open_bus(config, name=task.name) as bus:
        trips, next_s = _Trips(task, street, bus), time.monotonic()
        while not stop.wait(look_s):
            is_enough = (task.folder / ENOUGH).exists()
            try:
                if not is_enough and time.monotonic() >= next_s:
                    next_s = time.monotonic() + task.every_s * rng.uniform(0.5, 1.5)
                    trips.report()
                if is_enough:
                    _tell(task.folder / f"{task.name}{OPEN_SUFFIX}", trips.still_open())
                else:
                    trips.still_open()
            except (OutboxError, OSError):  # the disk is full: the next report comes later
                continue
        bus.close()
        trips.close()


def _tell(path: Path, count: int) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(str(count), encoding="utf-8")
    partial.replace(path)


@dataclass(frozen=True, slots=True)
class Receipt:
    """A tile as a client received it.

    Attributes:
        tile, version, sha: as the message says.
        found_sha: of the content that came out; b"": nothing did.
        how: "blob", "delta" or "notice".
    """

    tile: TileId
    version: int
    sha: bytes
    found_sha: bytes
    how: str

    def line(self) -> str:
        """As one line of a log."""
        return json.dumps([self.tile.morton, self.version, self.sha.hex(), self.found_sha.hex(), self.how]) + "\n"

    @classmethod
    def of_line(cls, line: str) -> "Receipt":
        """From a line of a log."""
        morton, version, sha, found_sha, how = json.loads(line)
        return cls(TileId(morton), version, bytes.fromhex(sha), bytes.fromhex(found_sha), how)


def read_receipts(path: Path) -> Iterator[Receipt]:
    """The lines of a log; a kill may have cut one off."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.endswith("]"):
            yield Receipt.of_line(line)


class _Follower:
    """Holds every tile that it hears of, and writes down each one that it receives."""

    def __init__(self, bus: Bus, log: Path) -> None:
        self._bus, self._log = bus, log.open("a", encoding="utf-8")
        self._held: dict[int, Tile] = {}
        self._log.write("\n")  # a line that a kill has cut off ends here

    def hear(self, payload: bytes) -> None:
        """Follow a notice: by its delta where that fits what is held, else by asking."""
        update = TileUpdate.decode(payload)
        held = self._held.get(update.tile.morton)
        if held is not None and held.version >= update.version:
            return
        if held is not None and held.sha == update.previous_sha and update.has_delta:
            self._take("notice", update, lambda: updated(update, held))
        else:
            self.ask(update.tile)

    def ask(self, tile: TileId, *, as_if_new: bool = False) -> None:
        """Ask for a tile, saying what is held; or nothing of it, as one that has just come."""
        held = None if as_if_new else self._held.get(tile.morton)
        wanted = TileRequest() if held is None else TileRequest(held.version, held.sha)
        payload = self._bus.request(tile_key(LAYER, tile), wanted.encode(), kind="tile", retry=_QUICK, timeout_s=_ASK_S)
        reply, kept = TileReply.decode(payload), held
        if reply.blob is not None:
            blob = reply.blob
            self._take("blob", blob, lambda: tile_of(blob))
        elif reply.delta is not None and kept is not None:
            delta = reply.delta
            self._take("delta", delta, lambda: tile_after(delta, kept))

    def _take(self, how: str, part: TileBlob | CodedDelta | TileUpdate, decode: Callable[[], Tile]) -> None:
        """Write down what came, whether anything can be made of it or not."""
        try:
            tile = decode()
        except SchemaError:
            self._note(Receipt(part.tile, part.version, part.sha, b"", how))
        else:
            self._received(how, part.version, part.sha, tile)

    def _received(self, how: str, version: int, sha: bytes, tile: Tile) -> None:
        self._note(Receipt(tile.tile_id, version, sha, content_sha(tile.tile_id, tile.gaussians), how))
        held = self._held.get(tile.tile_id.morton)
        if held is None or held.version < version:
            self._held[tile.tile_id.morton] = tile

    def _note(self, receipt: Receipt) -> None:
        self._log.write(receipt.line())
        self._log.flush()


def follower(connect: str, name: str, log: Path, *, stop: threading.Event) -> None:
    """Subscribe to all tiles, and request one after the other, until `stop` is set."""
    street, rng = read_street(), random.Random(name)
    notices: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with open_bus(BusConfig(connect=(connect,), patient=True), name=name) as bus:
        follows = _Follower(bus, log)
        bus.subscribe(update_keys(LAYER, ""), lambda _key, payload: notices.put(payload))
        asked_s = 0.0
        while not stop.is_set():
            try:
                if time.monotonic() - asked_s >= _ASK_EVERY_S:
                    asked_s = time.monotonic()
                    follows.ask(rng.choice(street.tiles).tile_id, as_if_new=rng.random() < _NEW_SHARE)
                follows.hear(notices.get(timeout=_ASK_EVERY_S))
            except queue.Empty:
                continue
            except BusClosed:
                return
            except (BusError, GndError, OSError):  # no answer while something is down: the next one
                continue


def held_by(states: Mapping[str, str]) -> set[str]:
    """The reports of an outbox that are acknowledged."""
    return {report_id for report_id, state in states.items() if state in ("stored", "released")}
