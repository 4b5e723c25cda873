"""Keeps a LiDAR map up to date with a fleet of vehicles, over Zenoh.

What a program needs that is no part of a fleet: `connect` to a router and read or follow the map; open a map's file as
a `Map`; read a recorded drive (`open_drive`) and `localise` it; feed a `Vehicle`. Each name is loaded when it is first
used, so that `import gnd` costs nothing. Everything raises subclasses of `GndError`. With examples: docs/api.md.
"""

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from gnd.client import Client, MapUpdate, ReportRefused, UpdateStream, connect
    from gnd.extras import MissingExtra
    from gnd.gnd_map.errors import GndError
    from gnd.gnd_map.features import Feature, FeatureTile
    from gnd.gnd_map.geodesy import LocalFrame
    from gnd.gnd_map.region import Region
    from gnd.gnd_map.tile import Tile
    from gnd.gnd_map.tile_id import TileId
    from gnd.live_vehicle import NoPosition, Vehicle
    from gnd.map_reader import GaussianColumns, Map, PlacedFeature
    from gnd.recorded import RecordedDrive, localise, open_drive, trajectory_of

__all__ = [
    "Client",
    "Feature",
    "FeatureTile",
    "GaussianColumns",
    "GndError",
    "LocalFrame",
    "Map",
    "MapUpdate",
    "MissingExtra",
    "NoPosition",
    "PlacedFeature",
    "RecordedDrive",
    "Region",
    "ReportRefused",
    "Tile",
    "TileId",
    "UpdateStream",
    "Vehicle",
    "connect",
    "localise",
    "open_drive",
    "trajectory_of",
]

_WHERE: Final = {
    "Client": "gnd.client",
    "Feature": "gnd.gnd_map.features",
    "FeatureTile": "gnd.gnd_map.features",
    "GaussianColumns": "gnd.map_reader",
    "GndError": "gnd.gnd_map.errors",
    "LocalFrame": "gnd.gnd_map.geodesy",
    "Map": "gnd.map_reader",
    "MapUpdate": "gnd.client",
    "MissingExtra": "gnd.extras",
    "NoPosition": "gnd.live_vehicle",
    "PlacedFeature": "gnd.map_reader",
    "RecordedDrive": "gnd.recorded",
    "Region": "gnd.gnd_map.region",
    "ReportRefused": "gnd.client",
    "Tile": "gnd.gnd_map.tile",
    "TileId": "gnd.gnd_map.tile_id",
    "UpdateStream": "gnd.client",
    "Vehicle": "gnd.live_vehicle",
    "connect": "gnd.client",
    "localise": "gnd.recorded",
    "open_drive": "gnd.recorded",
    "trajectory_of": "gnd.recorded",
}


def __getattr__(name: str) -> Any:
    """Load a name of the API when it is first used."""
    if name not in _WHERE:
        raise AttributeError(f"module 'gnd' has no attribute {name!r}")
    value = getattr(importlib.import_module(_WHERE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
