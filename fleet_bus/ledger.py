"""The traffic account of one agent: every message in and out, by kind, tile and place along the drive."""

import json
import logging
import os
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from fleet_bus.errors import LedgerError
from fleet_bus.wire import WireBytes
from gnd_map.tile_id import TileId

Direction = Literal["up", "down"]
KINDS: Final = ("tile", "delta", "catalog", "change", "ack", "update", "control")
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

    def record(
        self,
        direction: Direction,
        kind: str,
        app_bytes: int,
        tile: TileId | str | None = None,
        *,
        messages: int = 1,
    ) -> None:
        """Accounts for one message.

        Args:
            direction: "up" from this agent, "down" to it.
            kind: one of `KINDS`.
            app_bytes: length of the payload, bytes.
            tile: the tile it is about, if it is about one.
            messages: 0 for a further share of a message that is booked already.

        Raises:
            LedgerError: unknown kind or direction.
        """
        if kind not in KINDS or direction not in ("up", "down"):
            raise LedgerError(f"no such ledger line: {direction} {kind}; kinds are {', '.join(KINDS)}")
        path = tile.path if isinstance(tile, TileId) else tile
        with self._lock:
            _count(self._totals[kind, direction], app_bytes, messages)
            if path is not None:
                _count(self._by_tile[path], app_bytes, messages)
            several = {} if messages == 1 else {"messages": messages}
            self._note({"direction": direction, "kind": kind, "app_bytes": app_bytes, "tile": path} | several)

    def record_shares(self, direction: Direction, shares: Sequence[Share]) -> None:
        """Accounts for one message that is about several things; the first share counts as the message."""
        for place, share in enumerate(shares):
            self.record(direction, share.kind, share.app_bytes, share.tile, messages=int(place == 0))

    def record_wire(self, wire: WireBytes) -> None:
        """Notes the wire bytes of the agent's session so far, and with them the present place."""
        with self._lock:
            self._wire = wire
            self._note({"wire_up": wire.up, "wire_down": wire.down})

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

    def _note(self, line: dict[str, Any]) -> None:
        head = {"agent": self.agent, "session": self._session, "t_ns": self._now_ns(), **self._place}
        self._waiting.append(head | line)
        if self.path is not None:
            self._try_append(self.path)

    def _try_append(self, path: Path) -> None:
        """Writes at once, so that a kill loses no line; a full disk must not stop the vehicle."""
        try:
            self._append(path)
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
