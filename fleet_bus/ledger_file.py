"""Reading ledgers back: JSON lines, of which a crash may have left any unfinished."""

from dataclasses import dataclass, field
from pathlib import Path

from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.ledger import Direction, LedgerLine
from gnd.fleet_bus.ledger_rows import Row, parse_rows
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.wire import WireBytes


@dataclass(frozen=True, slots=True)
class Booking:
    """One message of a ledger, or a share of one.

    Attributes:
        drive_s: when on the drive, s since its first booking.
        odometer_m: where on the drive, m.
        direction: "up" from the agent, "down" to it.
        kind: ledger kind.
        app_bytes: payload, bytes.
        tile: path of the tile, if it is about one.
        messages: 1, or 0 for a further share of a message that is about several things.
        head_bytes: key and envelope within the stream, bytes; None where the ledger does not say (version 1).
        took_s: for an answer, time since it was asked for, s of the clock.
        session: which session of the agent, restarts make new ones.
    """

    drive_s: float
    odometer_m: float
    direction: Direction
    kind: str
    app_bytes: int
    tile: str | None
    messages: int = 1
    head_bytes: int | None = None
    took_s: float | None = None
    session: str = ""


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
        ignored_lines: lines that a crash left unfinished, or that are damaged.
        wires: last reading of each session's connections.
        link: the link of the last session; None where the ledger does not say (version 1).
    """

    agent: str
    bookings: tuple[Booking, ...]
    drive_m: float
    drive_s: float
    wire_up: int
    wire_down: int
    ignored_lines: int
    wires: dict[str, WireBytes] = field(default_factory=dict)
    link: LinkProfile | None = None

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
        LedgerError: the file cannot be read, holds not one ledger line, or is of a version unknown here.
    """
    try:
        raw = [line for line in path.read_bytes().splitlines() if line.strip()]
    except OSError as error:
        raise LedgerError(f"cannot read the ledger {path}: {error.strerror}") from error
    rows = parse_rows(raw, path)
    if not rows:
        raise LedgerError(f"{path} holds no ledger lines ({len(raw)} lines read)")
    return _account(rows, path.stem, len(raw) - len(rows))


def _account(all_rows: list[Row], name: str, ignored_lines: int) -> AgentLedger:
    rows = [row for row in all_rows if not row.is_head]
    times_ns = _drive_times_ns(rows)
    start_ns = min(times_ns, default=0)
    wires = {row.session: row.wire for row in rows if row.wire is not None}
    total = sum(wires.values(), WireBytes())
    bookings = [_booking(row, time_ns - start_ns) for row, time_ns in zip(rows, times_ns, strict=True) if row.kind]
    links = [row.link for row in all_rows if row.link is not None]
    return AgentLedger(
        agent=all_rows[0].agent or name,
        bookings=tuple(sorted(bookings, key=lambda booking: booking.drive_s)),
        drive_m=max((row.odometer_m for row in rows), default=0.0),
        drive_s=(max(times_ns, default=0) - start_ns) / 1e9,
        wire_up=total.up,
        wire_down=total.down,
        ignored_lines=ignored_lines,
        wires=wires,
        link=links[-1] if links else None,
    )


def read_run(run: Path) -> tuple[AgentLedger, ...]:
    """The ledgers of all agents of a run, by name of the agent.

    Args:
        run: folder of the run, or its name below `runs/`.

    Raises:
        LedgerError: no such run, or no ledgers in it.
    """
    folder = run_folder(run)
    files = sorted((folder / "ledger").glob("*.jsonl"))
    if not files:
        raise LedgerError(f"no ledgers in {folder / 'ledger'}: has an agent of this run been started?")
    return tuple(sorted((read_ledger(file) for file in files), key=lambda ledger: ledger.agent))


def run_folder(run: Path) -> Path:
    """The folder of a run that is given by path, or by its name below `runs/`.

    Raises:
        LedgerError: there is none.
    """
    folder = run if run.is_dir() else Path("runs") / run
    if not folder.is_dir():
        raise LedgerError(f"no run at {run} nor at {folder}: `gnd fleet --out runs/NAME` makes one")
    return folder


def _drive_times_ns(rows: list[Row]) -> list[int]:
    """Time of each row: of the recording where it is known (a drive may be replayed faster than driven).

    What was sent before the drive began counts as its beginning; a ledger that knows no drive goes by the clock.
    """
    known = [row.drive_ns for row in rows if row.drive_ns is not None]
    if not known:
        return [row.t_ns for row in rows]
    return [known[0] if row.drive_ns is None else row.drive_ns for row in rows]


def _booking(row: Row, since_start_ns: int) -> Booking:
    return Booking(
        drive_s=since_start_ns / 1e9,
        odometer_m=row.odometer_m,
        direction=row.direction,
        kind=row.kind,
        app_bytes=row.app_bytes,
        tile=row.tile,
        messages=row.messages,
        head_bytes=row.head_bytes,
        took_s=row.took_s,
        session=row.session,
    )
