"""The map that every vehicle starts with, and its file."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gnd.fleet_sim.drives import DriveSimulation
from gnd.fleet_sim.prepare import mapping_configs
from gnd.fleet_sim.world import State, World
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.vehicle_agent.local_map import LocalMap
from studies.frame.errors import FolderError
from studies.frame.kept import read_npz, write_npz
from studies.simulation.options import PoseSource
from studies.simulation.poses import FromReference

_COLUMNS = ("voxel_id", "count", "cells", "mean_m", "cov_m2")
_MAX_RANGE_M, _MIN_RANGE_M = 80.0, 2.0


@dataclass(frozen=True)
class BaseMap:
    """Tiles of the state before, of version 1 where `versions` says nothing else."""

    tiles: Mapping[TileId, Gaussians]
    versions: Mapping[TileId, int] = field(default_factory=dict)

    def version(self, tile_id: TileId) -> int:
        """Return which version of a tile this is."""
        return self.versions.get(tile_id, 1)

    def tile(self, tile_id: TileId) -> Tile | None:
        """Return a tile; None where the map has none, or nothing in it."""
        gaussians = self.tiles.get(tile_id)
        return Tile(tile_id, self.version(tile_id), gaussians) if gaussians is not None and len(gaussians) else None

    @cached_property
    def shas(self) -> dict[TileId, bytes]:
        """Content hash of each tile."""
        return {tile_id: Tile(tile_id, 1, gaussians).sha for tile_id, gaussians in self.tiles.items()}

    @cached_property
    def sha(self) -> str:
        """Content hash of the whole map, hexadecimal."""
        return hashlib.sha256(b"".join(self.shas[tile_id] for tile_id in sorted(self.shas))).hexdigest()


def surveyed(before: Mapping[TileId, Gaussians]) -> BaseMap:
    """Return the truth's own Gaussians of the state before as map, as in the paper (sections 6.1 and 6.3)."""
    return BaseMap({tile_id: before[tile_id] for tile_id in sorted(before) if len(before[tile_id])})


def driven(world: World, state: State = "before") -> BaseMap:
    """Return the map that the mapping vehicle makes: an HDL-32E up and down the empty street, poses exact."""
    accumulator = VoxelAccumulator(_mapping_grid(world))
    for points_m in mapping_points(world, state):
        accumulator.add(points_m)
    return surveyed(accumulator.finish())


def mapping_points(world: World, state: State = "before") -> Iterator[F64]:
    """The points (N, 3) of each scan of the mapping vehicle that go into the map, in the world's map frame."""
    grid_frame = _mapping_grid(world)
    for config in mapping_configs(world.seed):
        simulation = DriveSimulation(world, replace(config, state=state))
        poses = FromReference(simulation.header(), LocalMap(grid_frame), PoseSource("true", 0.0, 0.0), 0)
        for item in simulation.items():
            for scan in poses.push(item):
                range_m = np.linalg.norm(scan.points_map_m - scan.origins_map_m, axis=1)
                yield scan.points_map_m[(range_m >= _MIN_RANGE_M) & (range_m <= _MAX_RANGE_M)]


def _mapping_grid(world: World) -> GridFrame:
    radius_m = world.half_length_m + 2 * _MAX_RANGE_M
    return GridFrame.around(world.frame, covering_circle(world.lat_rad, world.lon_rad, radius_m))


def write_base(base: BaseMap, path: Path) -> None:
    """Write the map as .npz; the file appears complete or not at all."""
    ids = sorted(base.tiles)
    arrays: dict[str, Any] = {"head": np.array(json.dumps({"format": "gnd.base", "sha": base.sha}))}
    arrays["morton"] = np.array([i.morton for i in ids], np.int64)
    arrays["length"] = np.array([len(base.tiles[i]) for i in ids], np.int64)
    arrays["version"] = np.array([base.version(i) for i in ids], np.int64)
    for name in _COLUMNS:
        arrays[name] = np.concatenate([getattr(base.tiles[i], name) for i in ids])
    write_npz(path, arrays, compressed=False)


def read_base(path: Path) -> BaseMap:
    """Read a map.

    Raises:
        FolderError: it is missing or damaged.
    """
    data = read_npz(path)
    try:
        stops = np.cumsum(data["length"])
        tiles = {}
        for code, stop, n in zip(data["morton"].tolist(), stops.tolist(), data["length"].tolist(), strict=True):
            tiles[TileId(code)] = Gaussians(*(data[name][stop - n : stop] for name in _COLUMNS))
        base = BaseMap(tiles, dict(zip(tiles, data["version"].tolist(), strict=True)))
        sha = json.loads(str(data["head"]))["sha"]
    except (ValueError, KeyError) as error:
        raise FolderError(f"cannot read the base map {path}: {error}") from error
    if sha != base.sha:
        raise FolderError(f"the base map {path} is damaged: its content is not what was written")
    return base
