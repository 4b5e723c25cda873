"""The inbox and the queue in SQL: each function runs inside the caller's transaction."""

import json
import secrets
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any, Final, Protocol

from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District, TileId
from gnd.tile_store import sql_journal as journal
from gnd.tile_store.connection import Lock, Row, SqlConnection, change, fetch, post
from gnd.tile_store.districts import is_owned
from gnd.tile_store.rows_kept import RowsKept
from gnd.tile_store.values import Claim, JournalMark, PutStatus, ReportRow, StoreConfig

NS_PER_S: Final = 1_000_000_000


ASIDE_S: Final = 60.0
"""A tile that is set aside is tried once more after so long, then after twice as long each time, ..."""
LONGEST_ASIDE_S: Final = 3600.0
"""... at most after so long: whoever was to blame for it may be gone by then."""
ATTEMPTS_IN_A_ROW: Final = 5
HELP_AFTER_S: Final = 1.0
"""So long a tile is left to the shard to which it belongs, which has what was said about it in memory ..."""
HELP_FACTOR: Final = 2.0
"""... and where others have some of their own to do, until it has waited so many times as long as those."""
LOOKED_AT: Final = 16
"""Times as many of the oldest tiles as can be claimed are looked at for own ones."""
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


CLAIMS: Final[Lock] = ("claims",)
"""Who takes leases passes over rows that others are about to change. One at a time: two could wait for each other, each
for a row that the other has leased.
"""


class OfTile(Protocol):
    """What is about one tile."""

    @property
    def layer(self) -> str:
        """Its layer."""

    @property
    def tile(self) -> TileId:
        """Its tile."""


def locks_of(things: Iterable[OfTile]) -> list[Lock]:
    """Of the journal and the queue of each of the tiles."""
    return [("tile", one.layer, one.tile.morton) for one in things]


Put = Callable[[StoreConfig, dict[str, Any]], list[PutStatus]]


def put_reports(
    c: SqlConnection, rows: Iterable[ReportRow], config: StoreConfig, timing: dict[str, Any]
) -> list[PutStatus]:
    """Insert the rows that are new, each with its place in the journal, and mark their tiles dirty."""
    return begin_to_put(c, rows)(config, timing)


def begin_to_put(c: SqlConnection, rows: Iterable[ReportRow]) -> Put:
    """Gives `put_reports`, and looks at once where the rows would go: with the next statement, which changes nothing
    there.
    """
    runs = _runs(rows)
    asked = journal.ask_next(c, runs[0]) if runs else None

    def put(config: StoreConfig, timing: dict[str, Any]) -> list[PutStatus]:
        statuses: list[PutStatus] = []
        for number, some in enumerate(runs):
            asked_of_run = asked if asked is not None and number == 0 else journal.ask_next(c, some)
            statuses += _put_run(c, some, asked_of_run(config), timing)
        return statuses

    return put


def _runs(rows: Iterable[ReportRow]) -> list[list[ReportRow]]:
    """The rows in order, in runs in which each tile is spoken of once: those know nothing of each other."""
    runs: list[list[ReportRow]] = []
    tiles: set[tuple[str, TileId]] = set()
    for row in rows:
        if not runs or (row.layer, row.tile) in tiles:
            runs.append([])
            tiles.clear()
        runs[-1].append(row)
        tiles.add((row.layer, row.tile))
    return runs


def _put_run(
    c: SqlConnection,
    rows: Sequence[ReportRow],
    entries: Sequence[journal.JournalEntry | None],
    timing: dict[str, Any],
) -> list[PutStatus]:
    new = [(row, entry) for row, entry in zip(rows, entries, strict=True) if entry is not None]
    settled_in = _versions_confirmed(c, [row for row, entry in new if row.is_quiet and not entry.opens])
    told = [_columns(row) | entry.columns | {"merged_in": settled_in.get(_place_of(row), 0)} for row, entry in new]
    for is_half in (False, True):
        some = [one for (row, _), one in zip(new, told, strict=True) if row.is_half == is_half]
        c.post_each("enter_report", some, timing | _patience(timing) if is_half else timing)
    return ["duplicate" if entry is None else "stored" for entry in entries]


def _place_of(row: ReportRow) -> tuple[str, int]:
    return row.layer, row.tile.morton


def _columns(row: ReportRow) -> dict[str, Any]:
    told = {name: getattr(row, name) for name in ("report_id", "part", "vehicle", "received_ns", "base_sha", "body")}
    return {"layer": row.layer, "tile": row.tile.morton} | told


def _patience(timing: dict[str, Any]) -> dict[str, Any]:
    """The timing of reports that are half said: their other half saves a merge, where it comes in time."""
    return {"delay": HALVES_WAIT * timing["delay"], "merge_after": NEVER_AT_ONCE}


def _versions_confirmed(c: SqlConnection, rows: Sequence[ReportRow]) -> dict[tuple[str, int], int]:
    """The newest versions of tiles of which a report says that all is as there, and where nothing else waits: one more
    vote for what is published changes nothing. Where it contradicts somebody it has to be merged, which enters that.
    """
    asked = [{"layer": row.layer, "tile": row.tile.morton, "base_sha": row.base_sha} for row in rows]
    found = c.fetch_each("confirmed_version", asked, {"least": CONTESTED_VOXELS})
    return {_place_of(row): int(version) for row, versions in zip(rows, found, strict=True) for (version,) in versions}


def merge_again(c: SqlConnection, layer: str, tile: TileId, timing: dict[str, Any]) -> None:
    """Mark a tile dirty although no report has come; not one of a district that another store has."""
    if not is_owned(c, tile.district):
        return
    seq = journal.mark(c, layer, tile)
    c.post_each("mark_dirty", [{"layer": layer, "tile": tile.morton, "seq": seq}], timing)


IsOwn = Callable[[District], bool]
"""Whether the tiles of a district belong to the shard that asks."""


def claim(c: SqlConnection, owner: str, n: int, lease_s: float, is_own: IsOwn | None, steady: int) -> list[Claim]:
    """Lease ready tiles, those first that have waited longest: the owner's own, and those of others that have waited
    for `HELP_AFTER_S` and `HELP_FACTOR` times as long. None: all are its own.
    """
    at_most = n if is_own is None else LOOKED_AT * n
    rows = fetch(c, "claimable", {"steady": steady, "n": at_most})
    mine = rows if is_own is None else _own_first(rows, is_own, steady)
    if not mine and len(rows) == at_most:  # its own may lie behind these
        mine = rows
    return _take(c, mine[:n], owner, steady + round(lease_s * NS_PER_S))


def _own_first(rows: Iterable[Row], is_own: IsOwn, steady: int) -> list[Row]:
    """Those that the owner may take, in the order of their turns."""
    found, known = [], dict[int, bool]()
    for row in rows:
        waited_s, district = (steady - row[-1]) / NS_PER_S, row[1] // TILES_OF_DISTRICT
        if district not in known:
            known[district] = is_own(TileId(row[1]).district)
        own = known[district]
        if own or waited_s >= HELP_AFTER_S:
            found.append((HELP_AFTER_S + HELP_FACTOR * waited_s if own else waited_s, row))
    return [row for _, row in sorted(found, key=itemgetter(0), reverse=True)]


def _take(c: SqlConnection, rows: Iterable[Row], owner: str, lease_ns: int) -> list[Claim]:
    claims = [
        Claim(layer, TileId(tile), seq, owner, secrets.randbits(62), attempts + 1, bool(is_aside))
        for layer, tile, seq, attempts, is_aside, _ in rows
    ]
    for one in claims:
        post(c, "take_lease", _lease(one) | {"owner": owner, "lease_ns": lease_ns})
    return claims


def renew(c: SqlConnection, claims: Iterable[Claim], lease_s: float, steady: int) -> list[bool]:
    """Prolong the leases that are still held by these claims."""
    lease_ns = steady + round(lease_s * NS_PER_S)
    return [change(c, "renew_lease", _lease(one) | {"lease_ns": lease_ns}) == 1 for one in claims]


def begin(c: SqlConnection, claim: Claim, lease_s: float, steady: int) -> bool:
    """Count an attempt to merge a claimed tile, and prolong its lease; whether it is still held."""
    times = {"lease_ns": steady + round(lease_s * NS_PER_S), "again_ns": _again_ns(claim, steady)}
    return change(c, "begin_merge", _lease(claim) | times) == 1


def set_aside(c: SqlConnection, claim: Claim, reason: str, now: int, steady: int) -> bool:
    """Free one lease; the tile is not ready for long, unless a report arrives or somebody takes it up again."""
    told = {"again_ns": _again_ns(claim, steady), "now": now, "reason": reason}
    return change(c, "set_aside", _lease(claim) | told) == 1


def _again_ns(claim: Claim, steady: int) -> int:
    pause_s = ASIDE_S * 2.0 ** min(max(claim.attempts - ATTEMPTS_IN_A_ROW, 0), 10)
    return steady + round(min(pause_s, LONGEST_ASIDE_S) * NS_PER_S)


def take_up_again(c: SqlConnection, tiles: Iterable[tuple[str, TileId]], steady: int) -> int:
    """Make tiles that are set aside ready; how many of them were."""
    places = [{"layer": layer, "tile": tile.morton, "steady": steady} for layer, tile in tiles]
    return sum(change(c, "take_up_again", place) for place in places)


def enter_boot(c: SqlConnection, boot: str, steady: int) -> None:
    """Free all leases when they are of another boot, whose clock was another one."""
    if fetch(c, "boot_of_queue") != [(boot,)]:
        post(c, "forget_leases", {"steady": steady})
        post(c, "put_boot", {"boot": boot})


def forget_times(c: SqlConnection, steady: int) -> None:
    """Free all leases of tiles and of uploads, and make all tiles ready: the clock by which they wait was set back."""
    post(c, "forget_leases", {"steady": steady})
    post(c, "forget_upload_leases", {})


def release(c: SqlConnection, owner: str) -> int:
    """Free an owner's leases; how many they were."""
    return change(c, "release_owner", {"owner": owner})


def postpone(c: SqlConnection, claim: Claim, ready_ns: int, *, blameless: bool = False) -> None:
    """Free one lease; the tile is ready again at `ready_ns`. Blameless: the attempt that was begun does not count."""
    post(c, "release_token", _lease(claim) | {"ready_ns": ready_ns, "blameless": int(blameless)})


def holds(c: SqlConnection, claim: Claim) -> bool:
    """Whether this claim still holds its lease; an expired one that nobody else has taken is still held."""
    rows = fetch(c, "dirty_row", {"layer": claim.layer, "tile": claim.tile.morton})
    return any(token == claim.token for _, token in rows)


def consume(c: SqlConnection, claim: Claim, seq: int, version: int, timing: dict[str, Any]) -> bool:
    """The tile's reports up to number `seq` are merged in `version`; the tile is clean unless there are more. Whether
    any was merged for the first time.
    """
    place: dict[str, Any] = {"layer": claim.layer, "tile": claim.tile.morton}
    is_news = change(c, "consume_reports", place | {"version": version, "seq": seq}) > 0
    if not change(c, "clean", place | {"seq": seq}):
        post(c, "still_dirty", place | timing)
    return is_news


def unknown_reports(c: SqlConnection, claim: Claim, report_ids: Iterable[str]) -> list[str]:
    """Those of the report ids that the inbox does not hold for the claim's tile."""
    wanted = {"layer": claim.layer, "tile": claim.tile.morton, "ids": json.dumps(list(report_ids))}
    return [report_id for (report_id,) in fetch(c, "unknown_reports", wanted)]


def in_play(
    c: SqlConnection, kept: RowsKept, layer: str, tile: TileId, epoch: int, first: int, last: int
) -> tuple[ReportRow, ...]:
    """The reports of the windows `first` to `last` that count since the epoch, by report id and part."""
    wanted = {"layer": layer, "tile": tile.morton, "epoch": epoch, "folded": first - 1, "last": last}
    places = fetch(c, "places_in_play", wanted)
    return kept.ordered((layer, tile), places, lambda new: _rows_at(c, kept, layer, tile, new))


def since(c: SqlConnection, kept: RowsKept, layer: str, tile: TileId, mark: JournalMark) -> list[ReportRow]:
    """The reports in play with numbers beyond the mark, by number."""
    wanted = {"layer": layer, "tile": tile.morton, "epoch": mark.epoch, "folded": mark.folded, "seq": mark.seq}
    return _rows_at(c, kept, layer, tile, fetch(c, "places_since", wanted))


def _rows_at(c: SqlConnection, kept: RowsKept, layer: str, tile: TileId, places: Iterable[Row]) -> list[ReportRow]:
    """The rows at (arrival, window, seq): only those that are not in memory are read."""

    def read(arrival: int) -> ReportRow:
        return _row(*fetch(c, "report_at", {"arrival": arrival})[0])

    return [kept.row((layer, tile, arrival, seq), window, partial(read, arrival)) for arrival, window, seq in places]


def of_windows(c: SqlConnection, layer: str, tile: TileId, first: int, last: int, seq: int) -> tuple[ReportRow, ...]:
    """All reports of the windows `first` to `last` with numbers up to `seq`, by report id and part."""
    wanted = {"layer": layer, "tile": tile.morton, "first": first, "last": last, "seq": seq}
    return tuple(_row(*values) for values in fetch(c, "reports_of_windows", wanted))


def of_report(c: SqlConnection, layer: str, tile: TileId, report_id: str) -> list[ReportRow]:
    """The parts of a report about a tile, in order."""
    wanted = {"layer": layer, "tile": tile.morton, "report_id": report_id}
    return [_row(*values) for values in fetch(c, "rows_of_report", wanted)]


def page(c: SqlConnection, layer: str, vehicle: str | None, after: int, n: int) -> tuple[int, list[ReportRow]]:
    """Up to `n` reports that arrived after number `after`, and the last one's number."""
    rows = fetch(c, "reports_page", {"layer": layer, "vehicle": vehicle, "after": after, "n": n})
    return (rows[-1][0] if rows else after), [_row(*values[1:]) for values in rows]


def _row(report_id: str, layer: str, tile: int, *rest: Any) -> ReportRow:
    vehicle, received_ns, body, base_sha, part, window, seq = rest
    return ReportRow(report_id, layer, TileId(tile), vehicle, received_ns, body, base_sha, part, window=window, seq=seq)


def _lease(claim: Claim) -> dict[str, Any]:
    return {"layer": claim.layer, "tile": claim.tile.morton, "token": claim.token}
