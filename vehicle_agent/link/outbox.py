"""The durable outbox: a report is on the disk before it is sent and stays until the cloud releases it.

States of a report: `pending` -> `stored` (acknowledged: durable in the cloud, which may yet ask for its Gaussians) ->
`released`, or `quarantined` (refused by name, kept for people to look at). Where the cloud cannot use the short form, a
stored report is pending again and goes whole. A restarted agent makes the same report ids again; whatever is in the
outbox already keeps its first body, and what was acknowledged is not sent again (promise 1 of the design).

Beside the whole report lies its first half in short, and the base tiles without which the second half cannot be made:
they stay until the report is released, whatever becomes of the cache.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import apsw

from gnd.gnd_map.codec import CODEC_FLOAT32_ZSTD, CODEC_STANDARD_ZSTD, best_codec, codec_of
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, content_sha
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.report_states import ReportState
from gnd.schemas.upload_head import head_of_upload
from gnd.vehicle_agent.errors import OutboxError
from gnd.vehicle_agent.link.sqlite import Database

_COLUMNS = """
    report_id TEXT PRIMARY KEY,
    key       TEXT NOT NULL,
    body      BLOB NOT NULL,
    state     TEXT NOT NULL CHECK (state IN ('pending', 'stored', 'released', 'quarantined')),
    reason    TEXT NOT NULL,
    attempts  INTEGER NOT NULL,
    next_ns   INTEGER NOT NULL,
    wanted    BLOB NOT NULL DEFAULT x'',
    answers   INTEGER NOT NULL DEFAULT 0
) STRICT, WITHOUT ROWID;
"""
SCHEMA = (
    "CREATE TABLE IF NOT EXISTS report ("
    + _COLUMNS
    + """
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
)
# An outbox of an older release: there, what was stored was done with.
_MIGRATION = (
    "ALTER TABLE report RENAME TO report_before",
    "DROP INDEX IF EXISTS report_pending",
    "CREATE TABLE report (" + _COLUMNS,
    "INSERT INTO report (report_id, key, body, state, reason, attempts, next_ns)"
    " SELECT report_id, key, body, CASE WHEN state IN ('stored', 'duplicate') THEN 'released' ELSE state END,"
    " reason, attempts, next_ns FROM report_before",
    "DROP TABLE report_before",
)
_INDEX = "CREATE INDEX IF NOT EXISTS report_open ON report (next_ns) WHERE state IN ('pending', 'stored')"
# What a second half needs goes with the release, a base with the last report that needs it. The first half, a hundredth
# of the report, stays beside it, so that a kept drive can be sent again as it was (`gnd load`).
_FORGET = (
    "DELETE FROM base WHERE sha IN (SELECT sha FROM needs WHERE report_id = ?1)"
    " AND NOT EXISTS (SELECT 1 FROM needs WHERE needs.sha = base.sha AND needs.report_id <> ?1)",
    "DELETE FROM needs WHERE report_id = ?",
)
_UNPACK = "DELETE FROM packed WHERE report_id = ?"
_CODECS = (CODEC_STANDARD_ZSTD, CODEC_FLOAT32_ZSTD)  # quick, and the second can say anything
ANSWERS = ("stored", "duplicate", "quarantined")
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 15.0
FIRST_ASK_S, LONGEST_ASK_S = 4.0, 60.0
PATIENT_ASK_S: Final = 120.0
"""Where word may wait for the ack of the next report: longer than a merger keeps it (`cloud_merger.patience`)."""
HURRY_S: Final = 2.0
MAX_ANSWERS: Final = 3  # so often the same Gaussians are asked for; then the report goes whole


@dataclass(frozen=True, slots=True)
class Letter:
    """One report on its way: the key it goes to, its encoded body, how often it was tried."""

    report_id: str
    key: str
    body: bytes
    attempts: int
    packed: bytes = b""
    """The report's first half in short; empty: it is sent whole."""
    wanted: bytes = b""
    """The mask of Gaussians that the cloud asks for; empty: it is not asked yet, or does not ask."""


@dataclass(frozen=True, slots=True)
class OutboxCounts:
    """How many reports are in which state; `acknowledged` counts all that are durable in the cloud, `held` those among
    them that it has not released yet.
    """

    pending: int
    acknowledged: int
    quarantined: int
    held: int = 0

    @property
    def total(self) -> int:
        """All reports that were ever put in."""
        return self.pending + self.acknowledged + self.quarantined

    @property
    def open(self) -> int:
        """Reports of which something is still to be sent or heard."""
        return self.pending + self.held


class Outbox:
    """Reports in SQLite (WAL, synchronous FULL: `put` returns when the report survives a power cut)."""

    def __init__(self, path: Path) -> None:
        self._db = Database(path, SCHEMA, synchronous="full", error=OutboxError)
        with self._db.transaction() as c:
            if "wanted" not in {row[0] for row in c.execute("SELECT name FROM pragma_table_info('report')")}:
                for step in _MIGRATION:
                    c.execute(step)
            c.execute(_INDEX)

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
        insert = (
            "INSERT OR IGNORE INTO report (report_id, key, body, state, reason, attempts, next_ns)"
            " VALUES (?, ?, ?, 'pending', '', 0, 0)"
        )
        with self._db.transaction() as c:
            c.execute(insert, (report_id, key, body))
            if not c.changes():
                return False
            if packed:
                c.execute("INSERT INTO packed VALUES (?, ?)", (report_id, packed))
            c.executemany("INSERT OR IGNORE INTO base VALUES (?, ?, ?, ?)", tiles)
            c.executemany("INSERT INTO needs VALUES (?, ?)", [(report_id, sha) for sha, *_ in tiles])
        return True

    def bases_of(self, report_id: str) -> dict[bytes, Gaussians]:
        """The base tiles of a report by content hash; one that is damaged on the disk is left out."""
        sql = "SELECT sha, morton, codec_id, body FROM base WHERE sha IN (SELECT sha FROM needs WHERE report_id = ?)"
        found = ((bytes(sha), _gaussians(*row)) for sha, *row in self._db.run(sql, (report_id,)))
        return {sha: g for sha, (tile, g) in found if g is not None and content_sha(tile, g) == sha}

    def due(self, now_ns: int, limit: int = 8) -> list[Letter]:
        """Reports of which something is to be sent and whose waiting time is over, the oldest id first."""
        sql = (
            "SELECT report_id, key, report.body, attempts, coalesce(packed.body, x''), wanted FROM report"
            " LEFT JOIN packed USING (report_id)"
            " WHERE (state = 'pending' OR (state = 'stored' AND wanted <> x'')) AND next_ns <= ?"
            " ORDER BY report_id LIMIT ?"
        )
        return [Letter(*row) for row in self._db.run(sql, (now_ns, limit))]

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
        """Record what came to a message: `stored` or `duplicate` (acknowledged), or `quarantined` with its reason.

        An acknowledged report is held: word of it is waited for, and `ask_s` after `now_ns` `unheard` names it.
        What is refused is done with.

        Args:
            report_id: of the message.
            status: of its answer.
            reason: of a refusal.
            now_ns: the time.
            wanted: the mask that the message has answered; empty: it held no Gaussians that were asked for.
            is_short: whether the message was a half: its ack says nothing once the report is to go whole.
            ask_s: when to ask after it, s.
        """
        if status not in ANSWERS:
            raise OutboxError(f"report {report_id}: unknown answer {status!r}, expected one of {', '.join(ANSWERS)}")
        with self._db.transaction() as c:
            if status == "quarantined":
                _end(c, report_id, "quarantined", reason)
                return
            sql = (  # what is wanted may have come before the ack of the flags
                "UPDATE report SET state = 'stored', reason = '', attempts = 0, answers = answers + (?1 <> x''),"
                " next_ns = CASE WHEN wanted = ?1 THEN ?2 ELSE 0 END,"
                " wanted = CASE WHEN wanted = ?1 THEN x'' ELSE wanted END"
                " WHERE report_id = ?3 AND state IN ('pending', 'stored')"
                " AND (NOT ?4 OR report_id IN (SELECT report_id FROM packed))"
            )
            c.execute(sql, (wanted, now_ns + int(ask_s * 1e9), report_id, is_short))

    def told(self, state: ReportState, now_ns: int) -> None:
        """Record how far the cloud says that a report has come; of one that is not here, or done with, nothing.

        The word may overtake the ack, or be all that is left of it.
        """
        with self._db.transaction() as c:
            sql = "SELECT state, answers, report_id IN (SELECT report_id FROM packed) FROM report WHERE report_id = ?"
            rows: list[tuple[str, int, int]] = c.execute(sql, (state.report_id,)).fetchall()  # type: ignore[assignment]
            for was, answers, is_short in rows:
                _hear(c, state, (was, bool(is_short), answers), now_ns)

    def unheard(self, now_ns: int, limit: int = 32) -> list[str]:
        """Acknowledged reports of which no word has come for some time, the oldest first."""
        sql = (
            "SELECT report_id FROM report WHERE state = 'stored' AND wanted = x'' AND next_ns <= ?"
            " ORDER BY report_id LIMIT ?"
        )
        return [str(report_id) for (report_id,) in self._db.run(sql, (now_ns, limit))]

    def asked(self, report_ids: Iterable[str], now_ns: int) -> None:
        """These reports were asked after: the next time is 4 s later, doubled each time, at most 60 s."""
        sql = (
            "UPDATE report SET attempts = attempts + 1, next_ns = ? + 1000000000 * min(?, ? << min(attempts, 8))"
            " WHERE report_id = ? AND state = 'stored'"
        )
        rows = [(now_ns, int(LONGEST_ASK_S), int(FIRST_ASK_S), report_id) for report_id in report_ids]
        self._db.run_many(sql, rows)

    def ask_soon(self, now_ns: int) -> None:
        """Ask after those within `HURRY_S` of which word was to come later: no report follows whose ack brings it."""
        sql = "UPDATE report SET next_ns = ? WHERE state = 'stored' AND wanted = x'' AND attempts = 0 AND next_ns > ?"
        self._db.run(sql, (now_ns + int(HURRY_S * 1e9), now_ns + int(FIRST_ASK_S * 1e9)))

    def send_whole(self, report_id: str, reason: str) -> None:
        """Give up the short form of a report: it goes whole, at once."""
        with self._db.transaction() as c:
            _whole(c, report_id, reason)

    def failed(self, letter: Letter, now_ns: int, reason: str, least_s: float = 0.0) -> int:
        """Record a failed attempt; returns when to try again (ns): 0.5 s doubled each time, at most 15 s, not before
        `least_s` are over.
        """
        wait_s = max(min(FIRST_WAIT_S * 2 ** min(letter.attempts, 8), LONGEST_WAIT_S), least_s)
        next_ns = now_ns + int(wait_s * 1e9)
        sql = "UPDATE report SET attempts = attempts + 1, next_ns = ?, reason = ? WHERE report_id = ?"
        self._db.run(sql, (next_ns, reason, letter.report_id))
        return next_ns

    def retry_now(self) -> None:
        """Forget all waiting times (the link is back, or the agent has restarted)."""
        self._db.run("UPDATE report SET next_ns = 0 WHERE state IN ('pending', 'stored')")

    def counts(self) -> OutboxCounts:
        """How many reports are pending, acknowledged, held and quarantined."""
        rows = self._db.run("SELECT state, count(*) FROM report GROUP BY state")
        n = {str(state): int(count) for state, count in rows}
        held = n.get("stored", 0)
        return OutboxCounts(n.get("pending", 0), held + n.get("released", 0), n.get("quarantined", 0), held)

    def states(self) -> dict[str, str]:
        """The state of every report by its id: pending, stored, released or quarantined."""
        rows = self._db.run("SELECT report_id, state FROM report ORDER BY report_id")
        return {str(report_id): str(state) for report_id, state in rows}

    def answers(self) -> dict[str, int]:
        """How often Gaussians of each report were acknowledged, by its id."""
        return {str(report_id): int(n) for report_id, n in self._db.run("SELECT report_id, answers FROM report")}

    def body_of(self, report_id: str) -> bytes | None:
        """The whole report that is kept under an id, None where there is none."""
        rows = self._db.run("SELECT body FROM report WHERE report_id = ?", (report_id,))
        return bytes(rows[0][0]) if rows else None

    def hides(self, _tile: TileId) -> bool:
        """Nothing is private."""
        return False

    def forget_others(self, vehicle: str) -> int:
        """Remove what was made under another name, which nobody is to learn; how many reports they were."""
        rows = self._db.run("SELECT report_id, body FROM report")
        others = [report_id for report_id, body in rows if head_of_upload(bytes(body)).vehicle != vehicle]
        with self._db.transaction() as c:
            for report_id in others:
                for sql in (_UNPACK, *_FORGET, "DELETE FROM report WHERE report_id = ?"):
                    c.execute(sql, (report_id,))
        return len(others)

    def refused(self) -> list[tuple[str, str]]:
        """(report id, reason) of the quarantined reports."""
        rows = self._db.run("SELECT report_id, reason FROM report WHERE state = 'quarantined' ORDER BY report_id")
        return [(str(report_id), str(reason)) for report_id, reason in rows]

    def close(self) -> None:
        """Close the file."""
        self._db.close()


def _hear(c: apsw.Connection, state: ReportState, here: tuple[str, bool, int], now_ns: int) -> None:
    was, is_short, answers = here
    if was not in ("pending", "stored"):
        return
    if state.status == "released":
        _end(c, state.report_id, "released", "")
    elif state.status == "wanted" and is_short:  # of a report that goes whole nothing is wanted any more
        _want(c, state, answers, now_ns)
    elif state.status in ("resend", "quarantined") and is_short:  # the word may overtake the ack
        _whole(c, state.report_id, f"{state.status} {state.reason}")
    elif was == "stored":  # else it is the word on what was sent before: what is to be sent now nobody has looked at
        _hear_of_held(c, state, now_ns)


def _want(c: apsw.Connection, state: ReportState, answers: int, now_ns: int) -> None:
    if answers >= MAX_ANSWERS:
        _whole(c, state.report_id, f"its Gaussians were sent {answers} times and are asked for again")
        return
    sql = "UPDATE report SET state = 'stored', wanted = ?, attempts = 0, next_ns = ? WHERE report_id = ?"
    c.execute(sql, (state.wanted, now_ns, state.report_id))


def _hear_of_held(c: apsw.Connection, state: ReportState, now_ns: int) -> None:
    if state.status == "unknown":  # a store of before the ack: as if it had never been sent
        sql = "UPDATE report SET state = 'pending', wanted = x'', attempts = 0, next_ns = ? WHERE report_id = ?"
        c.execute(sql, (now_ns, state.report_id))
    elif state.status == "quarantined":
        _end(c, state.report_id, "quarantined", state.reason)
    elif state.status == "resend":
        _whole(c, state.report_id, f"{state.status} {state.reason}")


def _whole(c: apsw.Connection, report_id: str, reason: str) -> None:
    for sql in (_UNPACK, *_FORGET):
        c.execute(sql, (report_id,))
    sql = "UPDATE report SET state = 'pending', wanted = x'', attempts = 0, next_ns = 0, reason = ? WHERE report_id = ?"
    c.execute(sql, (reason, report_id))


def _end(c: apsw.Connection, report_id: str, state: str, reason: str) -> None:
    c.execute("UPDATE report SET state = ?, reason = ?, wanted = x'' WHERE report_id = ?", (state, reason, report_id))
    for sql in _FORGET:
        c.execute(sql, (report_id,))


def _row(tile: Tile) -> tuple[bytes, int, int, bytes]:
    codec_id = best_codec(tile.gaussians, _CODECS)
    return tile.sha, tile.tile_id.morton, codec_id, codec_of(codec_id).encode(tile.tile_id, tile.gaussians)


def _gaussians(morton: int, codec_id: int, body: bytes) -> tuple[TileId, Gaussians | None]:
    tile = TileId(morton)
    try:
        return tile, codec_of(codec_id).decode(tile, body)
    except GndError:
        return tile, None
