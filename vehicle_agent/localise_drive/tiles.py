"""A store as the map of a drive."""

from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_corridor
from gnd.tile_store.store import Store
from gnd.tile_store.values import DEFAULT_LAYER
from gnd.vehicle_agent.errors import LocaliseError


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
