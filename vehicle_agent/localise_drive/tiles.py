"""The map around the vehicle, from tiles at hand: `vehicle_agent.surroundings` without a bus and without evidence."""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import TileError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_corridor
from gnd.tile_store.store import Store
from gnd.tile_store.values import DEFAULT_LAYER
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.surroundings import FLOORS_ABOVE, FLOORS_BELOW, STEP_M, left_behind, tiles_along


class TileSource(Protocol):
    """Where tiles come from."""

    def tile(self, tile_id: TileId) -> Tile | None:
        """The tile of that id, or None where the map has none."""


@dataclass(frozen=True, slots=True)
class StoreMap:
    """One layer of a store, as it is now or was at a time: a `TileSource`."""

    store: Store
    layer: str = DEFAULT_LAYER
    at_ns: int | None = None

    def tile(self, tile_id: TileId) -> Tile | None:
        """The tile with its hash checked; None where there is (or was) none. `StoreError`, `SchemaError`."""
        stored = self.store.get(self.layer, tile_id, at_ns=self.at_ns)
        return None if stored is None else stored.decode_gaussians()

    def check_covers(self, lat_rad: F64, lon_rad: F64, half_width_m: float) -> None:
        """Refuse a map that has nothing within `half_width_m` of the line through the positions (N,).

        Raises:
            LocaliseError: says where the drive is, where the map is, and how far apart they are.
        """
        known = [entry.tile for entry in self.store.heads(self.layer)]
        if not known:
            layers = ", ".join(self.store.layers()) or "none"
            raise LocaliseError(f"the map has no tiles in layer {self.layer}; its layers: {layers}")
        wanted = set(covering_corridor(lat_rad, lon_rad, half_width_m))
        here = [tile_id for tile_id in known if tile_id in wanted]
        if not here:
            raise LocaliseError(_elsewhere(float(lat_rad.mean()), float(lon_rad.mean()), known))
        if self.at_ns is not None and not any(self.store.get(self.layer, t, at_ns=self.at_ns) for t in here):
            then = np.datetime64(self.at_ns, "ns").astype("datetime64[s]")
            raise LocaliseError(f"none of the {len(here)} tiles around the drive existed at {then} UTC")


class MapAround:
    """Keeps a local map in step with the place: what is near is held, what is left behind is let go."""

    def __init__(self, source: TileSource, local_map: LocalMap, parameters: DownloadParameters | None = None) -> None:
        self.used: dict[TileId, int] = {}
        """Tiles that were held at some time, and their versions."""
        self.absent: set[TileId] = set()
        """Tiles that were needed, and the map has not."""
        self._source, self._map = source, local_map
        self._parameters: Final = parameters or DownloadParameters()
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
            self._map.remove_tile(tile_id)
        for tile_id in sorted(set(tiles_along(frame, here[None], p.near_m)) - set(self._map.tiles)):
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


def _elsewhere(lat_rad: float, lon_rad: float, known: list[TileId]) -> str:
    """Where the drive is, where the nearest of the map's tiles is, and how far that is, in one sentence."""
    centres = np.array([tile_id.centre_rad for tile_id in known])
    here = LocalFrame(lat_rad, lon_rad)
    away_m = np.linalg.norm(here.enu_from_geodetic(centres[:, 0], centres[:, 1], np.zeros(len(known))), axis=1)
    nearest = int(np.argmin(away_m))
    near_lat, near_lon = np.degrees(centres[nearest])
    return (
        f"no tiles here: the drive is at {np.degrees(lat_rad):.5f}°, {np.degrees(lon_rad):.5f}°, the nearest of the"
        f" map's {len(known)} tiles at {near_lat:.5f}°, {near_lon:.5f}°, {away_m[nearest] / 1000:.1f} km away"
    )
