"""Rows of reports that were read lately: a tile of a busy street is merged with every report and all that came before.

A row never changes but for its window, and the number in a tile's journal is given once; so a row is read again only
where the place that it has now is another one.
"""

from bisect import insort
from collections import OrderedDict
from collections.abc import Callable
from operator import itemgetter
from threading import Lock
from typing import Any, Final

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.values import ReportRow

REMEMBERED_BYTES: Final = 128 << 20
REMEMBERED_TILES: Final = 512

Key = tuple[str, TileId, int, int]
"""Layer, tile, number of the row in the file, number in the journal."""


Place = tuple[Any, ...]
"""Number of the row in the file, window, number in the journal."""
_Ordered = tuple[tuple[str, int], ReportRow]


class RowsKept:
    """Rows of one file by their place, those used last. Safe in several threads."""

    def __init__(self, most_bytes: int = REMEMBERED_BYTES) -> None:
        self._most_bytes = most_bytes
        self._lock = Lock()
        self._held: OrderedDict[Key, ReportRow] = OrderedDict()
        self._bytes = 0
        self._tiles: OrderedDict[tuple[str, TileId], tuple[list[Place], list[_Ordered]]] = OrderedDict()

    def ordered(
        self, tile: tuple[str, TileId], places: list[Place], rows_at: Callable[[list[Place]], list[ReportRow]]
    ) -> tuple[ReportRow, ...]:
        """The rows at these places by report id and part; `rows_at` gives those that have come since the last time."""
        with self._lock:
            before, rows = self._tiles.pop(tile, ([], []))
        if places[: len(before)] != before:
            before, rows = [], []
        found = list(rows)
        for row in rows_at(places[len(before) :]):
            insort(found, ((row.report_id, row.part), row), key=itemgetter(0))
        with self._lock:
            self._tiles[tile] = places, found
            if len(self._tiles) > REMEMBERED_TILES:
                self._tiles.popitem(last=False)
        return tuple(row for _, row in found)

    def row(self, key: Key, window: int, read: Callable[[], ReportRow]) -> ReportRow:
        """The row at a place in a window; `read` reads it."""
        with self._lock:
            held = self._held.get(key)
            if held is not None and held.window == window:
                self._held.move_to_end(key)
                return held
        found = read()
        with self._lock:
            before = self._held.pop(key, None)
            self._held[key] = found
            self._bytes += len(found.body) - (0 if before is None else len(before.body))
            while self._bytes > self._most_bytes and len(self._held) > 1:
                self._bytes -= len(self._held.popitem(last=False)[1].body)
        return found
