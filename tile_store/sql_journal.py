"""The journal of a tile in SQL: numbers, windows and memories. Each function runs inside the caller's transaction.

The assignment of a report to a window is made once, with the write that makes the report durable, and stored: whatever
clocks, crashes and batches do afterwards, the map is a function of what stands here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, Final

from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.connection import SqlConnection, change, fetch, post
from gnd.tile_store.errors import StoreDamaged
from gnd.tile_store.values import Basis, ClosedWindow, ReportRow, StoreConfig, StoredMemory, WindowCounts

NO_WINDOWS: Final = 0
"""The window of reports that are older than the journal of their layer."""
WINDOW_VEHICLES: Final = 32
"""A window with votes of so many vehicles takes no report of another."""
_NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """Where a report goes in its tile's journal; `opens`: it is the first of its window."""

    seq: int
    window: int
    opened_ns: int | None
    opens: bool

    @property
    def columns(self) -> dict[str, Any]:
        """As the statements name them."""
        return {"seq": self.seq, "window": self.window, "opened_ns": self.opened_ns}


@dataclass(frozen=True, slots=True)
class _JournalPlace:
    """What stands where a report would go, as `place_in_journal` tells it. Nothing is said of vehicles in the window
    where this one is among them, or where they are few.
    """

    seq: int
    window: int
    opened_ns: int | None
    reports: int
    vehicles: int
    vehicle_of_key: str | None


NextEntries = Callable[[StoreConfig], list[JournalEntry | None]]


def ask_next(c: SqlConnection, rows: Sequence[ReportRow]) -> NextEntries:
    """Gives the places of reports, each of another tile: in the open window, or in a new one where it is old or full;
    None: it is there already. The journals are read as they are now, in one way with the next statement.
    """
    keys = [
        {"layer": row.layer, "tile": row.tile.morton}
        | {"report_id": row.report_id, "part": row.part, "vehicle": row.vehicle}
        for row in rows
    ]
    asked = c.ask_each("place_in_journal", keys, {"crowd": WINDOW_VEHICLES})

    def entries(config: StoreConfig) -> list[JournalEntry | None]:
        found = asked()
        missing = [key for key, places in zip(keys, found, strict=True) if not places]
        others = iter(c.fetch_each("place_without_journal", missing))
        places = [_JournalPlace(*some[0]) if some else _first_place(*next(others)[0]) for some in found]
        return [_next_entry(row, place, config) for row, place in zip(rows, places, strict=True)]

    return entries


def _first_place(seq: int, vehicle: str | None) -> _JournalPlace:
    """In a tile that nobody has reported about, or not since there is a journal."""
    return _JournalPlace(seq, NO_WINDOWS, None, 0, 0, vehicle)


def _next_entry(row: ReportRow, place: _JournalPlace, config: StoreConfig) -> JournalEntry | None:
    if place.vehicle_of_key is not None:
        return None
    if place.opened_ns is None:
        return JournalEntry(place.seq + 1, max(place.window, 1), row.received_ns, opens=True)
    if _is_over(row, place.opened_ns, config) or _is_full(place, config):
        return JournalEntry(place.seq + 1, place.window + 1, row.received_ns, opens=True)
    return JournalEntry(place.seq + 1, place.window, place.opened_ns, opens=False)


def _is_over(row: ReportRow, opened_ns: int, config: StoreConfig) -> bool:
    """Whether the time of a window has passed when a report comes."""
    length_ns = round(config.window_s * _NS_PER_S)
    if is_feature_layer(row.layer):  # cut alike in all tiles, see `StoreConfig.window_s`
        return row.received_ns // length_ns > opened_ns // length_ns
    return row.received_ns - opened_ns >= length_ns


def _is_full(place: _JournalPlace, config: StoreConfig) -> bool:
    """Whether the window takes no report of this vehicle any more. One that has a vote in it may say more, so none can
    close a window by talking; the bound on reports only limits the work of one merge.
    """
    return place.reports >= config.window_reports or place.vehicles >= WINDOW_VEHICLES


def mark(c: SqlConnection, layer: str, tile: TileId) -> int:
    """The number of an entry without a report: something else has changed what the tile's merge gives."""
    place = {"layer": layer, "tile": tile.morton}
    seq, window, opened_ns = _journal(c, place)
    post(c, "put_journal", place | {"seq": seq + 1, "window": window, "opened_ns": opened_ns})
    return seq + 1


def begin_epoch(c: SqlConnection, layer: str, tile: TileId, version: int) -> None:
    """A base or a rollback: what was merged counts no more, what was not goes into the new window."""
    place = {"layer": layer, "tile": tile.morton}
    if not fetch(c, "journal", place):
        return  # nobody has reported about it
    seq, window, _ = _journal(c, place)
    post(c, "forget_memory", place)
    moved = change(c, "move_waiting", place | {"window": window + 1})
    opened_ns = fetch(c, "oldest_of_window", place | {"window": window + 1})[0][0] if moved else None
    post(c, "put_journal", place | {"seq": seq, "window": window + 1, "opened_ns": opened_ns})
    put_basis(c, layer, tile, version, Basis(window + 1, seq))


def basis_of(c: SqlConnection, layer: str, tile: TileId, version: int) -> Basis | None:
    """What a version was made of; None: it is older than the journal, or the tile's first base."""
    rows = fetch(c, "basis", {"layer": layer, "tile": tile.morton, "version": version})
    if not rows:
        return None
    window, seq, named, number = rows[0]
    return Basis(window, seq, _names(named), _parameters(c, number))


def first_window(c: SqlConnection, layer: str, tile: TileId, epoch: int) -> int:
    """The window with which the epoch begins."""
    rows = fetch(c, "basis", {"layer": layer, "tile": tile.morton, "version": epoch})
    return int(rows[0][0]) if rows else NO_WINDOWS


def memory_of(c: SqlConnection, layer: str, tile: TileId, epoch: int) -> StoredMemory | None:
    """What the closed windows since the epoch have come to; None: none has been folded."""
    rows = fetch(c, "memory", {"layer": layer, "tile": tile.morton, "epoch": epoch})
    return StoredMemory(*rows[0]) if rows else None


def folded(c: SqlConnection, layer: str, tile: TileId, epoch: int) -> int:
    """The newest folded window; the one before the epoch's first where none is."""
    rows = fetch(c, "folded_window", {"layer": layer, "tile": tile.morton, "epoch": epoch})
    return int(rows[0][0]) if rows else first_window(c, layer, tile, epoch) - 1


def reopen(c: SqlConnection, layer: str, tile: TileId, epoch: int) -> bool:
    """Forget what the closed windows of a tile have come to, so that the next merge folds all of them anew; False: it
    stays, for retention has removed reports of theirs.
    """
    place = {"layer": layer, "tile": tile.morton}
    began = basis_of(c, layer, tile, epoch)
    wanted = place | {"first": NO_WINDOWS if began is None else began.window}
    oldest = fetch(c, "oldest_since_epoch", wanted)[0][0]
    if oldest is None or oldest > (0 if began is None else began.seq) + 1:  # the oldest are removed first
        return False
    post(c, "forget_memory", place)
    return True


def keep(
    c: SqlConnection,
    layer: str,
    tile: TileId,
    epoch: int,
    memory: StoredMemory,
    closed: Mapping[int, ClosedWindow],
) -> None:
    """The result of folding windows, and how that was done."""
    place = {"layer": layer, "tile": tile.morton}
    columns = {name: getattr(memory, name) for name in StoredMemory.__slots__}
    post(c, "put_memory", place | columns | {"epoch": epoch})
    for window, how in closed.items():
        told = {"window": window, "named": _text(how.named), "parameters": _number(c, how.parameters)}
        post(c, "put_closed_window", place | told)


def put_basis(c: SqlConnection, layer: str, tile: TileId, version: int, basis: Basis) -> None:
    """What a merged version was made of."""
    place = {"layer": layer, "tile": tile.morton, "version": version}
    told = {"window": basis.window, "seq": basis.seq, "named": _text(basis.named)}
    post(c, "put_basis", place | told | {"parameters": _number(c, basis.parameters)})


def closed_windows(c: SqlConnection, layer: str, tile: TileId) -> dict[int, ClosedWindow]:
    """How each folded window was folded."""
    rows = fetch(c, "closed_windows", {"layer": layer, "tile": tile.morton})
    return {window: ClosedWindow(_names(named), _parameters(c, number)) for window, named, number in rows}


def _number(c: SqlConnection, parameters: str) -> int | None:
    """The number under which a text of parameters stands in the store, which keeps each once; None of "not known"."""
    if not parameters:
        return None
    digest = sha256(parameters.encode()).digest()
    post(c, "put_parameters", {"digest": digest, "body": parameters})
    return int(fetch(c, "number_of_parameters", {"digest": digest})[0][0])


def _parameters(c: SqlConnection, number: int | None) -> str:
    """The text of that number."""
    if number is None:
        return ""
    rows = fetch(c, "parameters", {"number": number})
    if not rows:
        raise StoreDamaged(f"merge parameters {number} are named and not in the store")
    told, body = rows[0]
    digest = sha256(body.encode()).digest()
    if digest != told:
        raise StoreDamaged(
            f"merge parameters {number} are not what they were: their digest is {digest.hex()[:16]}…, that written down"
            f" {told.hex()[:16]}…"
        )
    return str(body)


def windows(c: SqlConnection) -> list[WindowCounts]:
    """The open window of each tile that anybody has reported about."""
    return [WindowCounts(layer, TileId(tile), *rest) for layer, tile, *rest in fetch(c, "windows")]


def newest(c: SqlConnection, layer: str, tile: TileId) -> JournalEntry:
    """The newest entry."""
    return JournalEntry(*_journal(c, {"layer": layer, "tile": tile.morton}), opens=False)


def _journal(c: SqlConnection, place: dict[str, Any]) -> tuple[int, int, int | None]:
    """(newest number, open window, since when) of a tile; nobody has reported about it: (0, 0, None)."""
    rows = fetch(c, "journal", place)
    if rows:
        return rows[0][0], rows[0][1], rows[0][2]
    return fetch(c, "newest_entry", place)[0][0] or 0, NO_WINDOWS, None  # of before there was a journal


def _text(names: frozenset[str]) -> str:
    return " ".join(sorted(names))  # pseudonyms hold no space


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())
