"""Reports in short about the small tiles of `merger_world`, as a vehicle sends them."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from merger_world import GROUND, TILE, WALL, State, change_of, gaussians_of, report_of

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import LATTICES, REPORT, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, content_sha
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import STEPS, Track, TrackPiece, TrackView
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.keys import change_key
from gnd.vehicle_agent.report.packing import pack

KEY = change_key("ndt", TILE.district)
BASE = snap(gaussians_of({0: GROUND, 1: WALL, 2: GROUND}), LATTICES["standard"])


def tile_at(tile: TileId = TILE, gaussians: Gaussians = BASE, version: int = 1) -> Tile:
    return Tile(tile, version, gaussians)


def flagged(
    new: Mapping[int, State] | None = None,
    modified: Mapping[int, State] | None = None,
    deleted: tuple[int, ...] = (),
    *,
    base: Gaussians = BASE,
    tile: TileId = TILE,
    observed: tuple[int, ...] = (0, 1, 2, 3, 4),
    version: int = 1,
) -> TileChange:
    """What a vehicle says about a tile, its Gaussians on the lattice on which they travel."""
    new, modified = new or {}, modified or {}
    states: dict[int, State | None] = {**new, **modified, **dict.fromkeys(deleted)}
    classes = dict.fromkeys(new, ChangeClass.NEW) | dict.fromkeys(modified, ChangeClass.MODIFIED)
    changed = snap(gaussians_of(states), REPORT)
    change = change_of(base, sorted({*observed, *states}), changed, tile=tile, version=version)
    kinds = [classes.get(int(voxel), ChangeClass.DELETED) for voxel in changed.voxel_id]
    return dataclasses.replace(change, change_class=np.array(kinds, np.uint8))


def track_by(tile: TileId = TILE) -> Track:
    """Past the middle of a tile, 2 m over the ellipsoid."""
    first = TileId(tile.district.first_morton)
    x, y = STEPS * (tile.lon_index - first.lon_index), STEPS * (tile.lat_index - first.lat_index) + STEPS // 2
    vertices = np.array([[x, y, 4], [x + STEPS, y, 4]], np.int32)
    return Track(tile.district, TrackView((-30, -24, -18, -12, -6, 0, 6, 12, 20)), (TrackPiece(vertices, 40),))


def bases_of(report: ChangeReport, base: Gaussians = BASE) -> dict[bytes, Gaussians]:
    return {content_sha(change.tile, base): base for change in report.tiles}


def packed_of(report: ChangeReport, base: Gaussians = BASE) -> bytes:
    return pack(report, bases_of(report, base), track_by(report.tiles[0].tile)).encode()


def drive_number(number: int, **said: Mapping[int, State]) -> ChangeReport:
    """One report about one tile."""
    return report_of(number, flagged(**said))  # type: ignore[arg-type]
