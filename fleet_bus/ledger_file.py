"""Reading ledgers back: JSON lines, of which a crash may have left any unfinished."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fleet_bus.errors import LedgerError
from fleet_bus.ledger import KINDS, Direction, LedgerLine


@dataclass(frozen=True, slots=True)
class Booking:
    """One message of a ledger.

    Attributes:
        drive_s: when on the drive, s since its first booking.
        odometer_m: where on the drive, m.
        direction: "up" from the agent, "down" to it.
        kind: ledger kind.
        app_bytes: payload, bytes.
        tile: path of the tile, if it is about one.
        messages: 1, or 0 for a further share of a message that is about several things.
    """

    drive_s: float
    odometer_m: float
    direction: Direction
    kind: str
    app_bytes: int
    tile: str | None
    messages: int = 1


@dataclass(frozen=True, slots=True)
class AgentLedger:
    """Everything that the ledger file of one agent says.

    Attributes:
        agent: who.
        bookings: messages in the order of the drive.
        drive_m: way driven, m.
        drive_s: time driven, s.
        wire_up: bytes on the wire from the agent, over all its sessions (restarts included).
        wire_down: bytes on the wire to the agent.
        ignored_lines: lines that a crash left unfinished.
    """

    agent: str
    bookings: tuple[Booking, ...]
    drive_m: float
    drive_s: float
    wire_up: int
    wire_down: int
    ignored_lines: int

    def lines(self) -> tuple[LedgerLine, ...]:
        """Totals by kind and direction, sorted."""
        keys = sorted({(booking.kind, booking.direction) for booking in self.bookings})
        return tuple(self._line(kind, direction) for kind, direction in keys)

    def total_bytes(self, direction: Direction) -> int:
        """Payload bytes of one direction."""
        return sum(booking.app_bytes for booking in self.bookings if booking.direction == direction)

    def _line(self, kind: str, direction: Direction) -> LedgerLine:
        booked = [b for b in self.bookings if (b.kind, b.direction) == (kind, direction)]
        return LedgerLine(kind, direction, sum(b.messages for b in booked), sum(b.app_bytes for b in booked))


def read_ledger(path: Path) -> AgentLedger:
    """Reads one ledger file; unfinished lines are counted and left out.

    Raises:
        LedgerError: the file cannot be read, or holds not one ledger line.
    """
    try:
        raw = path.read_bytes().splitlines()
    except OSError as error:
        raise LedgerError(f"cannot read the ledger {path}: {error.strerror}") from error
    rows = list(_rows(raw))
    if not rows:
        raise LedgerError(f"{path} holds no ledger lines ({len(raw)} lines read)")
    times_ns = [_time_ns(row) for row in rows]
    start_ns = min(times_ns)
    bookings = [_booking(row, _time_ns(row) - start_ns) for row in rows if "kind" in row]
    wire = {row["session"]: (row["wire_up"], row["wire_down"]) for row in rows if "wire_up" in row}
    return AgentLedger(
        agent=str(rows[0]["agent"] or path.stem),
        bookings=tuple(sorted(bookings, key=lambda booking: booking.drive_s)),
        drive_m=max(float(row["odometer_m"]) for row in rows),
        drive_s=(max(times_ns) - start_ns) / 1e9,
        wire_up=sum(up for up, _ in wire.values()),
        wire_down=sum(down for _, down in wire.values()),
        ignored_lines=sum(1 for line in raw if line.strip()) - len(rows),
    )


def read_run(run: Path) -> tuple[AgentLedger, ...]:
    """The ledgers of all agents of a run, by name of the agent.

    Args:
        run: folder of the run, or its name below `runs/`.

    Raises:
        LedgerError: no such run, or no ledgers in it.
    """
    folder = run if run.is_dir() else Path("runs") / run
    if not folder.is_dir():
        raise LedgerError(f"no run at {run} nor at {folder}: `gnd fleet --out runs/NAME` makes one")
    files = sorted((folder / "ledger").glob("*.jsonl"))
    if not files:
        raise LedgerError(f"no ledgers in {folder / 'ledger'}: has an agent of this run been started?")
    return tuple(sorted((read_ledger(file) for file in files), key=lambda ledger: ledger.agent))


def _rows(raw: list[bytes]) -> Iterator[dict[str, Any]]:
    for line in raw:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and _is_whole(row):
            yield row


def _is_whole(row: dict[str, Any]) -> bool:
    if not {"agent", "session", "t_ns", "odometer_m", "drive_ns"} <= row.keys():
        return False
    if "wire_up" in row:
        return "wire_down" in row
    return {"direction", "app_bytes", "tile"} <= row.keys() and row.get("kind") in KINDS


def _time_ns(row: dict[str, Any]) -> int:
    """Time of the recording where it is known (a drive may be replayed faster than driven), else of the clock."""
    return int(row["t_ns"] if row["drive_ns"] is None else row["drive_ns"])


def _booking(row: dict[str, Any], since_start_ns: int) -> Booking:
    return Booking(
        drive_s=since_start_ns / 1e9,
        odometer_m=float(row["odometer_m"]),
        direction=row["direction"],
        kind=row["kind"],
        app_bytes=int(row["app_bytes"]),
        tile=row["tile"],
        messages=int(row.get("messages", 1)),
    )
