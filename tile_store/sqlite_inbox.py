"""The inbox and the queue in SQLite: each function runs inside the caller's transaction."""

import json
import secrets
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Final

import apsw

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import sqlite_journal as journal
from gnd.tile_store.regions import morton_range
from gnd.tile_store.rows_kept import RowsKept
from gnd.tile_store.sqlite_connection import Row, change, fetch
from gnd.tile_store.values import Claim, JournalMark, PutStatus, ReportRow, StoreConfig

NS_PER_S: Final = 1_000_000_000


ASIDE_S: Final = 60.0
"""A tile that is set aside is tried once more after so long, then after twice as long each time, ..."""
LONGEST_ASIDE_S: Final = 3600.0
"""... at most after so long: whoever was to blame for it may be gone by then."""
ATTEMPTS_IN_A_ROW: Final = 5
OVERDUE_S: Final = 2.0
"""A tile that has been ready for so long goes before all preferred ones: under load there are always some."""
LOOKED_AT: Final = 8
"""Times as many of the oldest tiles as can be claimed are looked at for preferred ones."""
HALVES_WAIT: Final = 4
"""Merge delays that a tile waits for the Gaussians that were asked for, if nothing else is said about it."""
CONTESTED_VOXELS: Final = 12
"""Where one vehicle alone claims so many changes of a tile, those are merged, too, who say that nothing has changed."""
NEVER_AT_ONCE: Final = 1 << 30


def timing_of(config: StoreConfig, now: int, steady: int) -> dict[str, Any]:
    """The statements' times: `now` (UTC), and when a dirty tile becomes ready: `steady` (the queue's clock), `delay`
    (all ns) and `merge_after` (reports).
    """
    delay = round(config.merge_delay_s * NS_PER_S)
    return {"now": now, "steady": steady, "delay": delay, "merge_after": config.merge_after_reports}


def put_reports(
    c: apsw.Connection, rows: Iterable[ReportRow], config: StoreConfig, timing: dict[str, Any]
) -> list[PutStatus]:
    """Insert the rows that are new, each with its place in the journal, and mark their tiles dirty."""
    return [_put_report(c, row, config, timing) for row in rows]


def _put_report(c: apsw.Connection, row: ReportRow, config: StoreConfig, timing: dict[str, Any]) -> PutStatus:
    place = {"layer": row.layer, "tile": row.tile.morton}
    entry = journal.next_entry(c, row, config)
    settled_in = None if entry.opens or not row.is_quiet else _version_that_it_confirms(c, row)
    told: dict[str, Any] = {name: getattr(row, name) for name in ("report_id", "part", "vehicle", "received_ns")}
    told |= {"base_sha": row.base_sha, "body": row.body, "merged_in": settled_in}
    if not change(c, "insert_report", place | told | {"seq": entry.seq, "window": entry.window}):
        return "duplicate"
    journal.put(c, row.layer, row.tile, entry)
    if settled_in is None:
        change(c, "mark_dirty", place | timing | _patience(row, timing) | {"seq": entry.seq})
    return "stored"


def _patience(row: ReportRow, timing: dict[str, Any]) -> dict[str, Any]:
    """The timing of a report that is half said: its other half saves a merge, where it comes in time."""
    return {"delay": HALVES_WAIT * timing["delay"], "merge_after": NEVER_AT_ONCE} if row.is_half else {}


def _version_that_it_confirms(c: apsw.Connection, row: ReportRow) -> int | None:
    """The newest version, where a report says that all is as there and nothing else waits: one more vote for what is
    published changes nothing. None: it has to be merged.
    """
    place = {"layer": row.layer, "tile": row.tile.morton}
    head = fetch(c, "head", place)
    if not head or head[0][2] != row.base_sha or fetch(c, "dirty_row", place):
        return None
    if fetch(c, "much_waits", place | {"least": CONTESTED_VOXELS}):
        return None  # it contradicts somebody, which the merge enters
    return int(head[0][0])


def merge_again(c: apsw.Connection, layer: str, tile: TileId, timing: dict[str, Any]) -> None:
    """Mark a tile dirty although no report has come."""
    seq = journal.mark(c, layer, tile)
    change(c, "mark_dirty", {"layer": layer, "tile": tile.morton, "seq": seq} | timing)


def claim(c: apsw.Connection, owner: str, n: int, lease_s: float, prefer: Sequence[str], steady: int) -> list[Claim]:
    """Lease ready tiles: those that have waited for long, then those of the preferred regions, then any; each group
    oldest first. Preferred tiles are in the owner's memory.
    """
    ranges = [morton_range(prefix) for prefix in prefer]
    rows = fetch(c, "claimable", {"steady": steady, "n": LOOKED_AT * n if ranges else n})

    def turn(row: Row) -> int:
        _, tile, *_, ready_ns = row
        if steady - ready_ns >= OVERDUE_S * NS_PER_S:
            return 0
        return 1 if any(first <= tile < end for first, end in ranges) else 2

    return _take(c, sorted(rows, key=turn)[:n], owner, steady + round(lease_s * NS_PER_S))


def _take(c: apsw.Connection, rows: Iterable[Row], owner: str, lease_ns: int) -> list[Claim]:
    claims = [
        Claim(layer, TileId(tile), seq, owner, secrets.randbits(62), attempts + 1, bool(is_aside))
        for layer, tile, seq, attempts, is_aside, _ in rows
    ]
    for one in claims:
        change(c, "take_lease", _lease(one) | {"owner": owner, "lease_ns": lease_ns})
    return claims


def renew(c: apsw.Connection, claims: Iterable[Claim], lease_s: float, steady: int) -> list[bool]:
    """Prolong the leases that are still held by these claims."""
    lease_ns = steady + round(lease_s * NS_PER_S)
    return [change(c, "renew_lease", _lease(one) | {"lease_ns": lease_ns}) == 1 for one in claims]


def begin(c: apsw.Connection, claim: Claim, lease_s: float, steady: int) -> bool:
    """Count an attempt to merge a claimed tile, and prolong its lease; whether it is still held."""
    times = {"lease_ns": steady + round(lease_s * NS_PER_S), "again_ns": _again_ns(claim, steady)}
    return change(c, "begin_merge", _lease(claim) | times) == 1


def set_aside(c: apsw.Connection, claim: Claim, reason: str, now: int, steady: int) -> bool:
    """Free one lease; the tile is not ready for long, unless a report arrives or somebody takes it up again."""
    told = {"again_ns": _again_ns(claim, steady), "now": now, "reason": reason}
    return change(c, "set_aside", _lease(claim) | told) == 1


def _again_ns(claim: Claim, steady: int) -> int:
    pause_s = ASIDE_S * 2.0 ** min(max(claim.attempts - ATTEMPTS_IN_A_ROW, 0), 10)
    return steady + round(min(pause_s, LONGEST_ASIDE_S) * NS_PER_S)


def take_up_again(c: apsw.Connection, tiles: Iterable[tuple[str, TileId]], steady: int) -> int:
    """Make tiles that are set aside ready; how many of them were."""
    places = [{"layer": layer, "tile": tile.morton, "steady": steady} for layer, tile in tiles]
    return sum(change(c, "take_up_again", place) for place in places)


def enter_boot(c: apsw.Connection, boot: str, steady: int) -> None:
    """Free all leases when they are of another boot, whose clock was another one."""
    if fetch(c, "boot_of_queue") != [(boot,)]:
        change(c, "forget_leases", {"steady": steady})
        change(c, "put_boot", {"boot": boot})


def release(c: apsw.Connection, owner: str) -> int:
    """Free an owner's leases; how many they were."""
    return change(c, "release_owner", {"owner": owner})


def postpone(c: apsw.Connection, claim: Claim, ready_ns: int) -> None:
    """Free one lease; the tile is ready again at `ready_ns`."""
    change(c, "release_token", _lease(claim) | {"ready_ns": ready_ns})


def holds(c: apsw.Connection, claim: Claim) -> bool:
    """Whether this claim still holds its lease; an expired one that nobody else has taken is still held."""
    rows = fetch(c, "dirty_row", {"layer": claim.layer, "tile": claim.tile.morton})
    return any(token == claim.token for _, token in rows)


def consume(c: apsw.Connection, claim: Claim, seq: int, version: int, timing: dict[str, Any]) -> bool:
    """The tile's reports up to number `seq` are merged in `version`; the tile is clean unless there are more. Whether
    any was merged for the first time.
    """
    place: dict[str, Any] = {"layer": claim.layer, "tile": claim.tile.morton}
    is_news = change(c, "consume_reports", place | {"version": version, "seq": seq}) > 0
    if not change(c, "clean", place | {"seq": seq}):
        change(c, "still_dirty", place | timing)
    return is_news


def unknown_reports(c: apsw.Connection, claim: Claim, report_ids: Iterable[str]) -> list[str]:
    """Those of the report ids that the inbox does not hold for the claim's tile."""
    wanted = {"layer": claim.layer, "tile": claim.tile.morton, "ids": json.dumps(list(report_ids))}
    return [report_id for (report_id,) in fetch(c, "unknown_reports", wanted)]


def in_play(
    c: apsw.Connection, kept: RowsKept, layer: str, tile: TileId, epoch: int, first: int, last: int
) -> tuple[ReportRow, ...]:
    """The reports of the windows `first` to `last` that count since the epoch, by report id and part."""
    wanted = {"layer": layer, "tile": tile.morton, "epoch": epoch, "folded": first - 1, "last": last}
    places = fetch(c, "places_in_play", wanted)
    return kept.ordered((layer, tile), places, lambda new: _rows_at(c, kept, layer, tile, new))


def since(c: apsw.Connection, kept: RowsKept, layer: str, tile: TileId, mark: JournalMark) -> list[ReportRow]:
    """The reports in play with numbers beyond the mark, by number."""
    wanted = {"layer": layer, "tile": tile.morton, "epoch": mark.epoch, "folded": mark.folded, "seq": mark.seq}
    return _rows_at(c, kept, layer, tile, fetch(c, "places_since", wanted))


def _rows_at(c: apsw.Connection, kept: RowsKept, layer: str, tile: TileId, places: Iterable[Row]) -> list[ReportRow]:
    """The rows at (arrival, window, seq): only those that are not in memory are read."""

    def read(arrival: int) -> ReportRow:
        return _row(*fetch(c, "report_at", {"arrival": arrival})[0])

    return [kept.row((layer, tile, arrival, seq), window, partial(read, arrival)) for arrival, window, seq in places]


def of_windows(c: apsw.Connection, layer: str, tile: TileId, first: int, last: int, seq: int) -> tuple[ReportRow, ...]:
    """All reports of the windows `first` to `last` with numbers up to `seq`, by report id and part."""
    wanted = {"layer": layer, "tile": tile.morton, "first": first, "last": last, "seq": seq}
    return tuple(_row(*values) for values in fetch(c, "reports_of_windows", wanted))


def of_report(c: apsw.Connection, layer: str, tile: TileId, report_id: str) -> list[ReportRow]:
    """The parts of a report about a tile, in order."""
    wanted = {"layer": layer, "tile": tile.morton, "report_id": report_id}
    return [_row(*values) for values in fetch(c, "rows_of_report", wanted)]


def page(c: apsw.Connection, layer: str, vehicle: str | None, after: int, n: int) -> tuple[int, list[ReportRow]]:
    """Up to `n` reports that arrived after number `after`, and the last one's number."""
    rows = fetch(c, "reports_page", {"layer": layer, "vehicle": vehicle, "after": after, "n": n})
    return (rows[-1][0] if rows else after), [_row(*values[1:]) for values in rows]


def _row(report_id: str, layer: str, tile: int, *rest: Any) -> ReportRow:
    vehicle, received_ns, body, base_sha, part, window, seq = rest
    return ReportRow(report_id, layer, TileId(tile), vehicle, received_ns, body, base_sha, part, window=window, seq=seq)


def _lease(claim: Claim) -> dict[str, Any]:
    return {"layer": claim.layer, "tile": claim.tile.morton, "token": claim.token}
