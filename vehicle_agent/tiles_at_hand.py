"""The tiles around the vehicle, from a map at hand: a store, a file, a world in memory; without a bus."""

from collections.abc import Mapping, Sequence
from typing import Final, Protocol, runtime_checkable

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import TileError
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import DriveHeader, GnssFix
from gnd.vehicle_agent.config import DownloadParameters, PipelineParameters
from gnd.vehicle_agent.local_map import LocalMap, Touched
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.pipeline import Parts, Pipeline
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.surroundings import FLOORS_ABOVE, FLOORS_BELOW, STEP_M, left_behind, tiles_along


class TileSource(Protocol):
    """Where tiles come from."""

    def tile(self, tile_id: TileId) -> Tile | None:
        """The tile of that id, or None where the map has none."""


@runtime_checkable
class DistantTileSource(TileSource, Protocol):
    """A source that is asked for many tiles at once."""

    def tiles_of(self, wanted: Sequence[TileId]) -> Mapping[TileId, Tile]:
        """Those of the wanted tiles that the map has."""


class TilesAtHand:
    """Keeps a local map in step with the place: what is near is held, what is left behind is let go.

    Args:
        source: where tiles come from.
        local_map: to be filled.
        touched: whether there is evidence about a tile, which keeps it.

    Attributes:
        used: tiles that were held at some time, and their versions.
        absent: tiles that were needed, and the map has not.
    """

    def __init__(self, source: TileSource, local_map: LocalMap, touched: Touched) -> None:
        self.used: dict[TileId, int] = {}
        self.absent: set[TileId] = set()
        self._source, self._map, self._touched = source, local_map, touched
        self._parameters: Final = DownloadParameters()
        self._looked_at: F64 | None = None

    def follow(self, place: Place) -> None:
        """Look again after every few metres of way."""
        here, p = place.position_map_m, self._parameters
        if self._looked_at is not None and np.linalg.norm(here - self._looked_at) <= STEP_M:
            return
        self._looked_at = here.copy()
        frame = self._map.grid_frame.frame
        floor = int(np.floor(place.height_m / FLOORS_BELOW)) * FLOORS_BELOW
        self._map.cover_floors(floor - FLOORS_BELOW, floor + FLOORS_ABOVE)
        for tile_id in left_behind(frame, self._map.tiles, here, p.forget_m):
            if not self._touched(tile_id):
                self._map.remove_tile(tile_id)
        needed = sorted(set(tiles_along(frame, here[None], p.near_m)) - set(self._map.tiles))
        if isinstance(self._source, DistantTileSource):
            found = self._source.tiles_of(needed)
            for tile_id in needed:
                self._hold(tile_id, found.get(tile_id))
        else:
            for tile_id in needed:
                self._hold(tile_id, self._source.tile(tile_id))

    def _hold(self, tile_id: TileId, tile: Tile | None) -> None:
        try:
            if tile is None:
                self._map.set_absent(tile_id)
                self.absent.add(tile_id)
            else:
                self._map.set_tile(tile)
                self.used[tile_id] = tile.version
        except TileError:  # of another latitude zone: this grid frame cannot hold its voxels
            self.absent.add(tile_id)


class AllTilesHeld:
    """A local map that was filled beforehand: a place small enough for that."""

    def follow(self, place: Place) -> None:
        """All tiles are held already."""


def localising_on(
    local_map: LocalMap,
    header: DriveHeader,
    fix: GnssFix,
    parameters: LocaliserParameters | None = None,
    parts: Parts | None = None,
) -> Pipeline[AllTilesHeld]:
    """A vehicle that only localises, on a local map that was filled beforehand.

    Args:
        local_map: holds all tiles that are needed.
        header: sensor and mount.
        fix: where the drive begins, roughly.
        parameters: of the localiser.
        parts: what a study replaces.
    """
    of_all = PipelineParameters(localise=parameters or LocaliserParameters())
    return Pipeline(header, fix, lambda _map, _touched: AllTilesHeld(), of_all, local_map=local_map, parts=parts)
