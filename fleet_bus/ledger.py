"""The traffic account of one agent: every message in and out, by kind, tile and place along the drive."""

import json
import logging
import math
import os
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.wire import WireBytes
from gnd.gnd_map.tile_id import TileId

Direction = Literal["up", "down"]
KINDS: Final = ("tile", "delta", "catalog", "change", "ack", "update", "telemetry", "control")
LEDGER_VERSION: Final = 3
"""Written at the head of every session. Version 1 had no heads, neither of ledgers nor of messages; version 2 booked
telemetry as control, and did not tell opening and keep-alives apart from the rest of a session."""
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Share:
    """A part of one message that is booked by itself: a message may carry many tiles."""

    kind: str
    app_bytes: int
    tile: TileId | str | None = None


SharesOf = Callable[[bytes], Sequence[Share]]
"""How a message's payload is booked; the shares add up to its length."""


@dataclass(frozen=True, slots=True)
class LedgerLine:
    """Total of one kind in one direction; `app_bytes` are payload bytes."""

    kind: str
    direction: Direction
    messages: int
    app_bytes: int


class Ledger:
    """Adds up messages and, with a path, keeps each as a line of JSON. Thread-safe.

    Args:
        agent: who is accounted for.
        path: JSON-lines file to which each message is appended at once; None keeps the lines until `write_jsonl`.
        now_ns: clock, ns UTC.
    """

    def __init__(self, agent: str = "", path: Path | None = None, now_ns: Callable[[], int] = time.time_ns) -> None:
        self.agent, self.path, self._now_ns = agent, path, now_ns
        self._session = f"{now_ns():x}-{os.getpid():x}"
        self._lock = threading.Lock()
        self._totals: dict[tuple[str, Direction], list[int]] = defaultdict(lambda: [0, 0])
        self._by_tile: dict[str, list[int]] = defaultdict(lambda: [0, 0])
        self._waiting: list[dict[str, Any]] = []
        self._place: dict[str, Any] = {"odometer_m": 0.0, "drive_ns": None}
        self._wire = WireBytes()
        self._head: dict[str, Any] = {"ledger": LEDGER_VERSION, "agent": agent, "session": self._session, "link": None}
        self._is_begun = False

    def begin(self, link: LinkProfile) -> None:
        """Notes the link that the messages from now on travel by."""
        with self._lock:
            self._head = self._head | {"link": _plain(link)}
            self._waiting.append(self._head)
            self._is_begun = True

    def record(
        self,
        direction: Direction,
        kind: str,
        app_bytes: int,
        tile: TileId | str | None = None,
        *,
        head_bytes: int = 0,
        took_s: float | None = None,
    ) -> None:
        """Accounts for one message.

        Args:
            direction: "up" from this agent, "down" to it.
            kind: one of `KINDS`.
            app_bytes: length of the payload, bytes.
            tile: the tile it is about, if it is about one.
            head_bytes: its key and envelope, bytes.
            took_s: for an answer, time since it was asked for, s.

        Raises:
            LedgerError: unknown kind or direction.
        """
        self.record_shares(direction, (Share(kind, app_bytes, tile),), head_bytes=head_bytes, took_s=took_s)

    def record_shares(
        self, direction: Direction, shares: Sequence[Share], *, head_bytes: int = 0, took_s: float | None = None
    ) -> None:
        """Accounts for one message that is about several things; the first share counts as the message.

        Raises:
            LedgerError: unknown kind or direction; then nothing is booked.
        """
        for share in shares:
            if share.kind not in KINDS or direction not in ("up", "down"):
                raise LedgerError(f"no such ledger line: {direction} {share.kind}; kinds are {', '.join(KINDS)}")
        took = {} if took_s is None else {"took_s": round(took_s, 4)}
        with self._lock:
            for place, share in enumerate(shares):
                first = {"head_bytes": head_bytes} if place == 0 else {"messages": 0}
                self._book(direction, share, int(place == 0), first | took)
            self._write_at_once()

    def record_wire(self, wire: WireBytes) -> None:
        """Notes the wire bytes of the agent's session so far, and with them the present place."""
        with self._lock:
            self._wire = wire
            self._note({f"wire_{name}": value for name, value in asdict(wire).items()})
            self._write_at_once()

    def set_position(self, odometer_m: float, drive_ns: int | None = None) -> None:
        """Says where on the drive the agent is: the messages that follow are booked there.

        Args:
            odometer_m: way driven, m.
            drive_ns: time of the recording, ns UTC (the drive may be replayed faster than it was driven).
        """
        with self._lock:
            self._place = {"odometer_m": round(float(odometer_m), 3), "drive_ns": drive_ns}

    def totals(self) -> tuple[LedgerLine, ...]:
        """One line a kind and direction, sorted."""
        with self._lock:
            return tuple(LedgerLine(kind, way, *self._totals[kind, way]) for kind, way in sorted(self._totals))

    def total_bytes(self, direction: Direction) -> int:
        """Payload bytes of all kinds in one direction."""
        return sum(line.app_bytes for line in self.totals() if line.direction == direction)

    def by_tile(self) -> dict[str, tuple[int, int]]:
        """Messages and payload bytes of each tile, by its path."""
        with self._lock:
            return {tile: (count[0], count[1]) for tile, count in sorted(self._by_tile.items())}

    @property
    def wire(self) -> WireBytes:
        """The wire bytes noted last."""
        return self._wire

    @property
    def odometer_m(self) -> float:
        """Way driven at the last `set_position`, m."""
        return float(self._place["odometer_m"])

    def write_jsonl(self, path: Path) -> None:
        """Appends what has not been written yet to a JSON-lines file."""
        with self._lock:
            self._append(path)

    def flush(self) -> None:
        """Writes what waits to the ledger's own path, if it has one."""
        if self.path is not None:
            self.write_jsonl(self.path)

    def _book(self, direction: Direction, share: Share, messages: int, more: dict[str, Any]) -> None:
        path = share.tile.path if isinstance(share.tile, TileId) else share.tile
        _count(self._totals[share.kind, direction], share.app_bytes, messages)
        if path is not None:
            _count(self._by_tile[path], share.app_bytes, messages)
        self._note({"direction": direction, "kind": share.kind, "app_bytes": share.app_bytes, "tile": path} | more)

    def _note(self, line: dict[str, Any]) -> None:
        if not self._is_begun:
            self._waiting.append(self._head)
            self._is_begun = True
        head = {"agent": self.agent, "session": self._session, "t_ns": self._now_ns(), **self._place}
        self._waiting.append(head | line)

    def _write_at_once(self) -> None:
        """Writes now, so that a kill loses no line; a full disk must not stop the vehicle."""
        try:
            if self.path is not None:
                self._append(self.path)
        except LedgerError as error:
            if len(self._waiting) & (len(self._waiting) - 1) == 0:  # 1, 2, 4, 8 …: one warning a doubling
                _LOG.warning("%d ledger lines wait: %s", len(self._waiting), error)

    def _append(self, path: Path) -> None:
        if not self._waiting:
            return
        text = "".join(json.dumps(line, separators=(",", ":")) + "\n" for line in self._waiting)
        append_lines(path, text)
        self._waiting.clear()


def append_lines(path: Path, text: str) -> None:
    """Appends whole lines; a line that a crash left unfinished is closed first, so that only it is lost.

    Raises:
        LedgerError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+") as file:
            if file.tell() > 0:
                file.seek(-1, os.SEEK_END)
                text = text if file.read(1) == b"\n" else "\n" + text
            file.write(text.encode())
    except OSError as error:
        raise LedgerError(f"cannot write the ledger {path}: {error.strerror}") from error


def _count(counter: list[int], app_bytes: int, messages: int) -> None:
    counter[0] += messages
    counter[1] += app_bytes


def _plain(link: LinkProfile) -> dict[str, Any]:
    """The profile as values of JSON, which has no infinite rate."""
    return {name: value for name, value in asdict(link).items() if value != math.inf}
