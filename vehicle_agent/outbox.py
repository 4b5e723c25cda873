"""The durable outbox: a report is on the disk before it is sent and stays until somebody acknowledged it.

States of a report: `pending` -> `stored` | `duplicate` (acknowledged) or `quarantined` (refused by name, kept for
people to look at). A restarted agent makes the same report ids again; whatever is in the outbox already keeps its first
body, and what was acknowledged is not sent again (promise 1 of the design).

Beside the whole report lies its first half in short, and the base tiles without which the second half cannot be made:
they stay as long as a pending report needs them, whatever becomes of the cache.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from gnd_map.codec import CODEC_FLOAT32_ZSTD, CODEC_STANDARD_ZSTD, best_codec, codec_of
from gnd_map.errors import GndError
from gnd_map.gaussian import Gaussians
from gnd_map.tile import Tile, content_sha
from gnd_map.tile_id import TileId
from vehicle_agent.errors import OutboxError
from vehicle_agent.sqlite import Database

SCHEMA = """
CREATE TABLE IF NOT EXISTS report (
    report_id TEXT PRIMARY KEY,
    key       TEXT NOT NULL,
    body      BLOB NOT NULL,
    state     TEXT NOT NULL CHECK (state IN ('pending', 'stored', 'duplicate', 'quarantined')),
    reason    TEXT NOT NULL,
    attempts  INTEGER NOT NULL,
    next_ns   INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS report_pending ON report (next_ns) WHERE state = 'pending';
CREATE TABLE IF NOT EXISTS packed (
    report_id TEXT PRIMARY KEY,
    body      BLOB NOT NULL
) STRICT, WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS base (
    sha      BLOB PRIMARY KEY,
    morton   INTEGER NOT NULL,
    codec_id INTEGER NOT NULL,
    body     BLOB NOT NULL
) STRICT, WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS needs (
    report_id TEXT NOT NULL,
    sha       BLOB NOT NULL,
    PRIMARY KEY (report_id, sha)
) STRICT, WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS needs_sha ON needs (sha);
"""
# What a report in short needed goes with its answer; a base goes with the last report that needs it.
_FORGET = (
    "DELETE FROM packed WHERE report_id = ?",
    "DELETE FROM base WHERE sha IN (SELECT sha FROM needs WHERE report_id = ?1)"
    " AND NOT EXISTS (SELECT 1 FROM needs WHERE needs.sha = base.sha AND needs.report_id <> ?1)",
    "DELETE FROM needs WHERE report_id = ?",
)
_CODECS = (CODEC_STANDARD_ZSTD, CODEC_FLOAT32_ZSTD)  # quick, and the second can say anything
ANSWERS = ("stored", "duplicate", "quarantined")
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 15.0


@dataclass(frozen=True, slots=True)
class Letter:
    """One report on its way: the key it goes to, its encoded body, how often it was tried."""

    report_id: str
    key: str
    body: bytes
    attempts: int
    packed: bytes = b""
    """The report's first half in short; empty: it is sent whole."""


@dataclass(frozen=True, slots=True)
class OutboxCounts:
    """How many reports are in which state; `acknowledged` counts stored and duplicate."""

    pending: int
    acknowledged: int
    quarantined: int

    @property
    def total(self) -> int:
        """All reports that were ever put in."""
        return self.pending + self.acknowledged + self.quarantined


class Outbox:
    """Reports in SQLite (WAL, synchronous FULL: `put` returns when the report survives a power cut)."""

    def __init__(self, path: Path) -> None:
        self._db = Database(path, SCHEMA, synchronous="FULL", error=OutboxError)

    def put(self, report_id: str, key: str, body: bytes, packed: bytes = b"", bases: Iterable[Tile] = ()) -> bool:
        """Make a report durable; False when its id is known already (the first body stays).

        Args:
            report_id: ULID.
            key: where it goes.
            body: the whole report.
            packed: its first half in short; empty: it is only ever sent whole.
            bases: the tiles that its second half is coded against.
        """
        if self._db.run("SELECT 1 FROM report WHERE report_id = ?", (report_id,)):
            return False  # a restarted agent: no tile is encoded for nothing
        tiles = [_row(tile) for tile in bases]
        with self._db.transaction() as c:
            c.execute("INSERT OR IGNORE INTO report VALUES (?, ?, ?, 'pending', '', 0, 0)", (report_id, key, body))
            if not c.changes():
                return False
            if packed:
                c.execute("INSERT INTO packed VALUES (?, ?)", (report_id, packed))
            c.executemany("INSERT OR IGNORE INTO base VALUES (?, ?, ?, ?)", tiles)
            c.executemany("INSERT INTO needs VALUES (?, ?)", [(report_id, sha) for sha, *_ in tiles])
        return True

    def bases_of(self, report_id: str) -> dict[bytes, Gaussians]:
        """The base tiles of a pending report by content hash; one that is damaged on the disk is left out."""
        sql = "SELECT sha, morton, codec_id, body FROM base WHERE sha IN (SELECT sha FROM needs WHERE report_id = ?)"
        found = ((bytes(sha), _gaussians(*row)) for sha, *row in self._db.run(sql, (report_id,)))
        return {sha: g for sha, (tile, g) in found if g is not None and content_sha(tile, g) == sha}

    def due(self, now_ns: int, limit: int = 8) -> list[Letter]:
        """Pending reports whose waiting time is over, the oldest id first."""
        sql = (
            "SELECT report_id, key, report.body, attempts, coalesce(packed.body, x'') FROM report"
            " LEFT JOIN packed USING (report_id) WHERE state = 'pending' AND next_ns <= ? ORDER BY report_id LIMIT ?"
        )
        return [Letter(*row) for row in self._db.run(sql, (now_ns, limit))]

    def answered(self, report_id: str, status: str, reason: str = "") -> None:
        """Record an acknowledgement (`stored`, `duplicate`) or a refusal (`quarantined` with its reason)."""
        if status not in ANSWERS:
            raise OutboxError(f"report {report_id}: unknown answer {status!r}, expected one of {', '.join(ANSWERS)}")
        with self._db.transaction() as c:
            c.execute("UPDATE report SET state = ?, reason = ? WHERE report_id = ?", (status, reason, report_id))
            for sql in _FORGET:
                c.execute(sql, (report_id,))

    def failed(self, letter: Letter, now_ns: int, reason: str) -> int:
        """Record a failed attempt; returns when to try again (ns): 0.5 s doubled each time, at most 15 s."""
        wait_s = min(FIRST_WAIT_S * 2 ** min(letter.attempts, 8), LONGEST_WAIT_S)
        next_ns = now_ns + int(wait_s * 1e9)
        sql = "UPDATE report SET attempts = attempts + 1, next_ns = ?, reason = ? WHERE report_id = ?"
        self._db.run(sql, (next_ns, reason, letter.report_id))
        return next_ns

    def retry_now(self) -> None:
        """Forget all waiting times (the link is back, or the agent has restarted)."""
        self._db.run("UPDATE report SET next_ns = 0 WHERE state = 'pending'")

    def counts(self) -> OutboxCounts:
        """How many reports are pending, acknowledged and quarantined."""
        rows = self._db.run("SELECT state, count(*) FROM report GROUP BY state")
        n = {str(state): int(count) for state, count in rows}
        return OutboxCounts(n.get("pending", 0), n.get("stored", 0) + n.get("duplicate", 0), n.get("quarantined", 0))

    def states(self) -> dict[str, str]:
        """The state of every report by its id: pending, stored, duplicate or quarantined."""
        rows = self._db.run("SELECT report_id, state FROM report ORDER BY report_id")
        return {str(report_id): str(state) for report_id, state in rows}

    def body_of(self, report_id: str) -> bytes | None:
        """The whole report that is kept under an id, None where there is none."""
        rows = self._db.run("SELECT body FROM report WHERE report_id = ?", (report_id,))
        return bytes(rows[0][0]) if rows else None

    def refused(self) -> list[tuple[str, str]]:
        """(report id, reason) of the quarantined reports."""
        rows = self._db.run("SELECT report_id, reason FROM report WHERE state = 'quarantined' ORDER BY report_id")
        return [(str(report_id), str(reason)) for report_id, reason in rows]

    def close(self) -> None:
        """Close the file."""
        self._db.close()


def _row(tile: Tile) -> tuple[bytes, int, int, bytes]:
    codec_id = best_codec(tile.gaussians, _CODECS)
    return tile.sha, tile.tile_id.morton, codec_id, codec_of(codec_id).encode(tile.tile_id, tile.gaussians)


def _gaussians(morton: int, codec_id: int, body: bytes) -> tuple[TileId, Gaussians | None]:
    tile = TileId(morton)
    try:
        return tile, codec_of(codec_id).decode(tile, body)
    except GndError:
        return tile, None
