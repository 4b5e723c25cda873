"""An exported map that is kept up to date tile by tile while clients ask for its cells."""

import logging
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gnd.deploy.map_export.autoware import (
    CLOUDS,
    ChangedCells,
    CloudCell,
    cells_of,
    corners_of,
    place_of,
    projection_of,
    read_cell,
    write_cells,
)
from gnd.deploy.map_export.differential import Area, cells_in
from gnd.deploy.map_export.sampling import PointsOf
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.export import ExportError

_log = logging.getLogger(__name__)
CELL_HEAD_BYTES: Final = 512
"""More than a cell's names, fields and bounds take in an answer."""


@dataclass(frozen=True, slots=True)
class CellsToLoad:
    """What a client gets.

    Attributes:
        new: cells of the area that it has not, by id, the nearest to the centre first.
        ids_to_remove: what it has and is not in the area, or no longer in the map and whose place is not among `left`.
        left: how many cells more would not have fitted into the answer: the farthest.
    """

    new: dict[str, CloudCell]
    ids_to_remove: tuple[str, ...]
    left: int


class ServedMap:
    """The map of a folder. One thread replaces tiles, any may ask.

    The folder is the map: what is served lies in its files, so that Autoware's own loaders and the next start find the
    same cells. Only the tiles are held in memory; a file that somebody else has removed is made of them again.

    Args:
        folder: of the export; it is made when missing, and brought up to date when it is there.
        tiles: all tiles of the map.
        projector: of `PROJECTORS`; None: that of the export before, else TransverseMercator.
        points: what stands for a Gaussian.

    Raises:
        ExportError: no tiles, the folder holds a map of another program, or it cannot be written.
        ProjectionError: the region is too large for the projection, or the one before differs.
    """

    def __init__(self, folder: Path, tiles: Sequence[Tile], projector: str | None, points: PointsOf) -> None:
        if not tiles:
            raise ExportError("no tiles: there is no map to serve")
        self.folder, self.points = folder, points
        self.projection = projection_of(list(tiles), folder, projector)
        self._tiles: dict[TileId, Tile] = {}
        self._touched: dict[TileId, frozenset[tuple[int, int]]] = {}
        self._corners: dict[str, tuple[int, int]] = {}
        self._swapping = threading.Lock()
        self.replace(tiles)

    @property
    def cells(self) -> int:
        """How many cells there are."""
        return len(self._corners)

    @property
    def tiles(self) -> int:
        """How many tiles there are."""
        return len(self._tiles)

    def replace(self, tiles: Iterable[Tile]) -> ChangedCells:
        """Take new versions of tiles into the map: the cells that they touch, or touched, are made anew.

        Raises:
            ExportError: the folder cannot be written; the map is as before.
            ProjectionError: a tile is outside of the projection; the map is as before.
        """
        changed = {tile.tile_id: tile for tile in tiles}
        touched = {key: corners_of(tile, self.projection, self.points) for key, tile in changed.items()}
        anew = frozenset().union(*touched.values(), *(self._touched.get(key, frozenset()) for key in changed))
        now, touching = self._tiles | changed, self._touched | touched
        near = [now[key] for key in sorted(now) if touching[key] & anew]
        made = {
            name: cell for name, cell in cells_of(near, self.projection, self.points).items() if cell.corner in anew
        }
        corners = {name: corner for name, corner in self._corners.items() if corner not in anew}
        corners |= {name: cell.corner for name, cell in made.items()}
        with self._swapping:  # an answer reads files that this removes
            done = write_cells(self.folder, self.projection, corners, made)
            self._tiles, self._touched, self._corners = now, touching, corners
        return done

    def cells_for(self, area: Area, cached_ids: Iterable[str], limit_bytes: int) -> CellsToLoad:
        """The cells of an area that a client lacks, as many as fit, and the ids that it is to drop.

        Args:
            area: where.
            cached_ids: what the client has.
            limit_bytes: of all new cells.
        """
        cached = set(cached_ids)
        with self._swapping:
            inside = cells_in(self._corners, area)
            wanted, new, size_bytes = [name for name in inside if name not in cached], dict[str, CloudCell](), 0
            for name in wanted:
                cell = self._cell(name)
                size_bytes += cell.cloud.nbytes + CELL_HEAD_BYTES
                if size_bytes > limit_bytes:
                    break
                new[name] = cell
        left = {place_of(name) for name in wanted[len(new) :]}  # there the client keeps what it has until then
        gone = tuple(sorted(name for name in cached.difference(inside) if place_of(name) not in left))
        return CellsToLoad(new, gone, len(wanted) - len(new))

    def _cell(self, name: str) -> CloudCell:
        corner = self._corners[name]
        try:
            return CloudCell(corner, read_cell(self.folder / CLOUDS / name))
        except ExportError as error:
            _log.warning("made again of its tiles: %s", error)
        near = [self._tiles[key] for key in sorted(self._tiles) if corner in self._touched[key]]
        return cells_of(near, self.projection, self.points)[name]
