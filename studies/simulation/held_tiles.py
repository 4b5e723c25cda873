"""The tiles around a vehicle: those of the base map that are near are held, those left behind are let go."""

from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import TileError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.surroundings import FLOORS_ABOVE, FLOORS_BELOW, STEP_M, left_behind, tiles_along
from studies.simulation.base_map import BaseMap


class HeldTiles:
    """Keeps a local map in step with the place, from a base map at hand: `vehicle_agent.surroundings` without a bus."""

    def __init__(self, base: BaseMap, local_map: LocalMap, detector: ChangeDetector | None) -> None:
        self._base, self._map, self._detector = base, local_map, detector
        self._parameters: Final = DownloadParameters()
        self._looked_at: F64 | None = None
        self.other_zone: set[TileId] = set()

    def follow(self, place: Place) -> None:
        """Hold what is near, let go what is far and without evidence; every few metres of way."""
        here, p = place.position_map_m, self._parameters
        if self._looked_at is not None and np.linalg.norm(here - self._looked_at) <= STEP_M:
            return
        self._looked_at = here.copy()
        frame = self._map.grid_frame.frame
        floor = int(np.floor(place.height_m / FLOORS_BELOW)) * FLOORS_BELOW
        self._map.cover_floors(floor - FLOORS_BELOW, floor + FLOORS_ABOVE)
        for tile_id in sorted(set(tiles_along(frame, here[None], p.near_m)) - set(self._map.tiles) - self.other_zone):
            self._hold(tile_id)
        for tile_id in left_behind(frame, self._map.tiles, here, p.forget_m):
            if self._detector is None or not self._detector.touched(tile_id):
                self._map.remove_tile(tile_id)

    def _hold(self, tile_id: TileId) -> None:
        gaussians = self._base.tiles.get(tile_id, Gaussians.empty())
        try:
            if len(gaussians):
                self._map.set_tile(Tile(tile_id, self._base.version(tile_id), gaussians))
            else:
                self._map.set_absent(tile_id)
        except TileError:  # of another latitude zone: this grid frame cannot hold its voxels
            self.other_zone.add(tile_id)
