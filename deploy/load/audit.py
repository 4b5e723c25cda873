"""What the store says of a load: read from its tables, not from what any program believes."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

import apsw

from gnd.tile_store.location import StoreLocation, conninfo_of, file_of

NS_PER_S: Final = 1_000_000_000
_BACKLOG: Final = (
    "SELECT (SELECT COUNT(*) FROM upload WHERE state IN ('waiting', 'early')),"
    " (SELECT COUNT(*) FROM dirty WHERE aside_ns IS NULL), (SELECT MAX(upload) FROM upload)"
)
_JOURNALED: Final = "SELECT DISTINCT report_id, part FROM report"
_KEPT: Final = "SELECT report_id, state FROM upload WHERE form = 'packed'"
_MERGED: Final = (  # versions that came after the report: an older one was there already, the report changed nothing
    "SELECT r.tile, r.merged_in, r.received_ns, v.created_ns FROM report AS r JOIN tile_version AS v"
    " ON v.layer = r.layer AND v.tile = r.tile AND v.version = r.merged_in WHERE v.created_ns >= r.received_ns"
)
_WAITING: Final = "SELECT COUNT(*) FROM report WHERE merged_in IS NULL"
_ASIDE: Final = "SELECT COUNT(*) FROM dirty WHERE aside_ns IS NOT NULL"
_REFUSED: Final = "SELECT COUNT(*) FROM quarantine"


@dataclass(frozen=True, slots=True)
class Backlog:
    """What waits at one time.

    Attributes:
        at_s: of the machine's monotonic clock.
        uploads: acknowledged and not looked at.
        tiles: to be merged.
        received: uploads so far, settled or not.
    """

    at_s: float
    uploads: int
    tiles: int
    received: int

    @property
    def items(self) -> int:
        """All that waits."""
        return self.uploads + self.tiles


@dataclass(frozen=True, slots=True)
class MergedTiles:
    """One part of a report and the version of a tile that it was merged into.

    Attributes:
        tile, version: which.
        received_s: when the part was received, s UTC.
        lag_s: from then to the version's publication.
    """

    tile: int
    version: int
    received_s: float
    lag_s: float


@dataclass(frozen=True, slots=True)
class LoadLedger:
    """What the store holds when all is over.

    Attributes:
        journaled: report ids of the journal.
        with_gaussians: those of which the journal holds a second part.
        kept: state of each first half that came, by report id.
        merged: report parts that a version was made of.
        unmerged: report parts that are in no version yet.
        aside: tiles that are set aside.
        quarantined: refused messages.
    """

    journaled: frozenset[str]
    with_gaussians: frozenset[str]
    kept: Mapping[str, str] = field(repr=False)
    merged: tuple[MergedTiles, ...] = field(repr=False)
    unmerged: int
    aside: int
    quarantined: int

    def lost(self, acknowledged: frozenset[str]) -> frozenset[str]:
        """Acknowledged reports that are neither in the journal nor kept to be looked at."""
        waiting = {report_id for report_id, state in self.kept.items() if state == "waiting"}
        return acknowledged - self.journaled - waiting


class AuditConnection(Protocol):
    """What is needed of a connection of either database."""

    def execute(self, sql: str) -> Iterable[Any]:
        """Its rows."""

    def close(self) -> None:
        """Close it."""


class Auditor:
    """Reads a store beside the programs that use it.

    Args:
        location: of the store.
    """

    def __init__(self, location: StoreLocation) -> None:
        file = file_of(location)
        if file is not None:
            self._connection, self._snapshot = _of_file(file), "BEGIN"
        else:
            self._connection = _of_database(conninfo_of(location))
            self._snapshot = "BEGIN ISOLATION LEVEL REPEATABLE READ, READ ONLY"

    def backlog(self, at_s: float) -> Backlog:
        """What waits now."""
        uploads, tiles, received = self._row(_BACKLOG)
        return Backlog(at_s, uploads, tiles, received)

    def ledger(self) -> LoadLedger:
        """All that the load has left behind, as it is at one moment: workers may still be busy."""
        self._connection.execute(self._snapshot)  # an upload that is settled meanwhile would be seen nowhere
        try:
            return self._ledger()
        finally:
            self._connection.execute("ROLLBACK")

    def _ledger(self) -> LoadLedger:
        parts = [(str(report_id), int(part)) for report_id, part in self._connection.execute(_JOURNALED)]
        merged = tuple(
            MergedTiles(int(tile), int(version), received_ns / NS_PER_S, (created_ns - received_ns) / NS_PER_S)
            for tile, version, received_ns, created_ns in self._connection.execute(_MERGED)
        )
        return LoadLedger(
            journaled=frozenset(report_id for report_id, _ in parts),
            with_gaussians=frozenset(report_id for report_id, part in parts if part == 1),
            kept={str(report_id): str(state) for report_id, state in self._connection.execute(_KEPT)},
            merged=merged,
            unmerged=self._row(_WAITING)[0],
            aside=self._row(_ASIDE)[0],
            quarantined=self._row(_REFUSED)[0],
        )

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _row(self, sql: str) -> list[int]:
        """One row of counts; there is none of an empty table: 0."""
        (row,) = self._connection.execute(sql)
        return [int(value or 0) for value in row]


def _of_file(path: Path) -> AuditConnection:
    connection = apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READONLY)
    connection.set_busy_timeout(10_000)
    return connection


def _of_database(conninfo: str) -> AuditConnection:
    import psycopg

    return psycopg.connect(conninfo, autocommit=True)
