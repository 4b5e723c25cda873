"""A map with its changes and the vehicles that made them, in one metric frame: what Foxglove and Rerun are shown."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from gnd.deploy.run_folder import RunFolder
from gnd.gnd_map.arrays import F32
from gnd.gnd_map.classes import CLASS_COLOURS, ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.export import region_frame, region_tiles
from gnd.tile_store.location import StoreLocation
from gnd.tile_store.store import Store

if TYPE_CHECKING:
    from gnd.vehicle_agent.way import Milestone

RGB: Final = {kind: tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5)) for kind, colour in CLASS_COLOURS.items()}
"""The colours of the classes of changes, 0 ... 255."""


@dataclass(frozen=True, slots=True)
class Update:
    """A version of a tile: what it changed against the one before.

    Attributes:
        t_ns: when it was published, UTC.
        tile: which tile.
        version: its version.
        points_m: (N, 3) means of what is new, modified or deleted, in the frame of the scene.
        change: (N,) `ChangeClass` of each.
    """

    t_ns: int
    tile: TileId
    version: int
    points_m: F32
    change: "np.ndarray[tuple[int], np.dtype[np.uint8]]"


@dataclass(frozen=True, slots=True)
class ExportScene:
    """What is shown.

    Attributes:
        frame: ENU at the middle of the map on the ellipsoid.
        points_m: (N, 3) means of the newest map.
        count: (N,) raw points of each.
        updates: the merged versions that the store still has, oldest first.
        ways: the milestones of each vehicle of a run, by its name.
    """

    frame: LocalFrame
    points_m: F32
    count: "np.ndarray[tuple[int], np.dtype[np.int32]]"
    updates: tuple[Update, ...]
    ways: "dict[str, list[Milestone]]"

    @property
    def start_ns(self) -> int:
        """When the first thing happened; 1 where nothing did."""
        times = [update.t_ns for update in self.updates[:1]] + [way[0].wall_ns for way in self.ways.values() if way]
        return min(times, default=1)


def store_of(path: StoreLocation) -> StoreLocation:
    """The store: itself, or that of a run's folder."""
    return RunFolder(path).store if isinstance(path, Path) and path.is_dir() else path


def read_scene(store: Store, layer: str, prefix: str, run: Path | None = None) -> ExportScene:
    """The map of a region, its changes, and the ways of the vehicles where `run` is the folder of a run.

    Raises:
        ExportError: no tiles there, or a layer of features.
        VehicleError: a way is damaged.
    """
    tiles = region_tiles(store, layer, prefix)
    frame = region_frame(tiles)
    updates = [update for tile in tiles for update in _updates(store, layer, tile.tile_id, frame)]
    return ExportScene(
        frame=frame,
        points_m=np.concatenate([_means(tile.tile_id, tile.gaussians, frame) for tile in tiles]),
        count=np.concatenate([tile.gaussians.count for tile in tiles]),
        updates=tuple(sorted(updates, key=lambda one: (one.t_ns, one.tile))),
        ways=_ways(run) if run is not None else {},
    )


def _ways(run: Path) -> "dict[str, list[Milestone]]":
    from gnd.vehicle_agent.way import read_way  # it loads what only the extra `vehicle` brings

    folder = RunFolder(run)
    names = sorted(path.name for path in folder.agents.iterdir()) if folder.agents.is_dir() else []
    found = {name: list(read_way(folder.way(name))) for name in names}
    return {name: way for name, way in found.items() if way}


def _updates(store: Store, layer: str, tile: TileId, frame: LocalFrame) -> Iterator[Update]:
    before: Tile | None = None
    for line in store.history(layer, tile):
        stored = store.get(layer, tile, line.version)
        if stored is None:
            continue
        after = stored.decode_gaussians()
        if before is not None and line.kind != "base":
            yield _update(line.created_ns, before, after, frame)
        before = after


def _update(t_ns: int, before: Tile, after: Tile, frame: LocalFrame) -> Update:
    delta = diff(before.gaussians, after.gaussians)
    is_new = ~np.isin(delta.put.voxel_id, before.gaussians.voxel_id)
    gone = before.gaussians.select(delta.removed)
    points = [_means(after.tile_id, one, frame) for one in (delta.put, gone)]
    change = np.where(is_new, ChangeClass.NEW, ChangeClass.MODIFIED)
    return Update(
        t_ns,
        after.tile_id,
        after.version,
        np.concatenate(points),
        np.concatenate([change, np.full(len(gone), ChangeClass.DELETED)]).astype(np.uint8),
    )


def _means(tile: TileId, gaussians: Gaussians, frame: LocalFrame) -> F32:
    mean_m = VoxelGrid.of(tile).centre_m(gaussians.voxel_id) + gaussians.mean_m
    T = frame.T_self_other(LocalFrame.of_tile(tile))
    return (mean_m @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
