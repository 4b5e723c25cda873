"""What is aligned: a store of tiles, or a drive, of which a map is built first. Told apart by content."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Literal

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive_mcap import drive_counts
from gnd.tile_store.errors import StoreError
from gnd.tile_store.options import to_read
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.tile_store.values import DEFAULT_LAYER
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.map_build.build import build_recorded_map

_MAGIC: Final = {b"\x89MCAP0\r\n": "drive", b"SQLite format 3\x00": "map"}


class AlignError(VehicleError):
    """Two maps that cannot be compared, or a result that cannot be written."""


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """One of the two maps.

    Attributes:
        path: where it comes from.
        kind: a map (a store of tiles), or a drive of which the map was built.
        tiles: its newest tiles.
        surveyed_ns: when the oldest of them was measured; None: nobody knows.
    """

    path: Path
    kind: Literal["map", "drive"]
    tiles: tuple[Tile, ...]
    surveyed_ns: int | None


def open_side(path: Path, layer: str, progress: Callable[[str, int, int], None]) -> Side:
    """Read a map, or build that of a drive in passing.

    Raises:
        AlignError: no such file, neither of the two, no tiles, or a layer of features.
        BuildError, DriveError, StoreError: it cannot be read or built.
    """
    kind = _kind_of(path)
    if kind == "map":
        with to_read(path) as store:
            return _read(path, kind, store, layer)
    if drive_counts(path).reference < 2:
        raise AlignError(f"{path}: a drive without reference poses holds no map; `gnd import` computes them")
    with TemporaryDirectory(prefix="gnd-align-") as folder, SqliteStore(Path(folder) / "drive.sqlite") as store:
        build_recorded_map([path], store, layer=layer, refine="never", progress=progress)
        return _read(path, kind, store, layer)


def frame_of(side: Side) -> LocalFrame:
    """ENU in the tile that is nearest to the middle of all, by its indices."""
    tiles = [tile.tile_id for tile in side.tiles]
    east = sorted(tile.lon_index for tile in tiles)[len(tiles) // 2]
    north = sorted(tile.lat_index for tile in tiles)[len(tiles) // 2]
    return LocalFrame.of_tile(TileId.from_indices(east, north))


def _kind_of(path: Path) -> Literal["map", "drive"]:
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise AlignError(f"{path}: cannot be read: {error.strerror or error}") from None
    for magic, kind in _MAGIC.items():
        if head.startswith(magic):
            return "map" if kind == "map" else "drive"
    raise AlignError(
        f"{path} is neither a map (`gnd map build`), a drive (MCAP, `gnd import`) nor an HD map (.osm, .xodr, .geojson)"
    )


def _read(path: Path, kind: Literal["map", "drive"], store: SqlStore, layer: str = DEFAULT_LAYER) -> Side:
    tiles, surveyed = list[Tile](), list[int]()
    for entry in store.heads(layer):
        stored = store.get(layer, entry.tile)
        if stored is None:
            raise StoreError(f"{path}: tile {entry.tile} has gone while it was read")
        tile = stored.decode()
        if not isinstance(tile, Tile):
            raise AlignError(f"{path}: layer {layer!r} holds features; Gaussians can be aligned (ndt...)")
        tiles.append(tile)
        if stored.surveyed_ns is not None:
            surveyed.append(stored.surveyed_ns)
    if not tiles:
        raise AlignError(f"{path}: no tiles in layer {layer!r}; there are {', '.join(store.layers()) or 'none'}")
    return Side(path, kind, tuple(tiles), min(surveyed) if len(surveyed) == len(tiles) else None)
