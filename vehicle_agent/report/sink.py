"""Where reports go: the durable outbox of an agent, or a list in memory."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId


@dataclass(frozen=True, slots=True)
class OutgoingReport:
    """One report as it leaves the vehicle.

    Attributes:
        report_id: ULID.
        key: where it goes.
        body: the whole report, encoded (`schemas.changes`, `schemas.features`).
        packed: its first half in short (`schemas.packed`); empty: it is only ever sent whole.
        bases: the tiles that its second half is coded against.
    """

    report_id: str
    key: str
    body: bytes
    packed: bytes = b""
    bases: tuple[Tile, ...] = ()


class ReportSink(Protocol):
    """Takes reports; `outbox.Outbox` and `ReportList` are such."""

    def put(self, report_id: str, key: str, body: bytes, packed: bytes = b"", bases: Iterable[Tile] = ()) -> bool:
        """Take a report; False when its id is known already, and the first body stays."""

    def body_of(self, report_id: str) -> bytes | None:
        """The body that is kept under an id, None without one."""

    def hides(self, tile: TileId) -> bool:
        """Whether nothing is to be told of a tile: a report that names it would not be passed on."""


class ReportList:
    """Keeps reports in memory, in the order in which they came."""

    def __init__(self) -> None:
        self._kept: dict[str, OutgoingReport] = {}

    def put(self, report_id: str, key: str, body: bytes, packed: bytes = b"", bases: Iterable[Tile] = ()) -> bool:
        """Take a report; False when its id is known already, and the first body stays."""
        if report_id in self._kept:
            return False
        self._kept[report_id] = OutgoingReport(report_id, key, body, packed, tuple(bases))
        return True

    def body_of(self, report_id: str) -> bytes | None:
        """The body that is kept under an id, None without one."""
        known = self._kept.get(report_id)
        return None if known is None else known.body

    def hides(self, _tile: TileId) -> bool:
        """Nothing is private."""
        return False

    @property
    def reports(self) -> tuple[OutgoingReport, ...]:
        """All that were put in."""
        return tuple(self._kept.values())


class NewReports:
    """Passes reports on to a sink, and notes those that it did not know."""

    def __init__(self, sink: ReportSink) -> None:
        self._sink = sink
        self._new: list[OutgoingReport] = []

    def put(self, report_id: str, key: str, body: bytes, packed: bytes = b"", bases: Iterable[Tile] = ()) -> bool:
        """Pass a report on; False when the sink knows its id already."""
        report = OutgoingReport(report_id, key, body, packed, tuple(bases))
        if not self._sink.put(report_id, key, body, packed, report.bases):
            return False
        self._new.append(report)
        return True

    def body_of(self, report_id: str) -> bytes | None:
        """The body that the sink keeps under an id, None without one."""
        return self._sink.body_of(report_id)

    def hides(self, tile: TileId) -> bool:
        """Whether the sink will tell nothing of a tile."""
        return self._sink.hides(tile)

    def take(self) -> tuple[OutgoingReport, ...]:
        """What was put in since this was called last."""
        new, self._new = tuple(self._new), []
        return new
