"""A truth drawn at random and written as an export: what the scorer's tests run on, without a simulation."""

import json
from pathlib import Path

import numpy as np

from gnd.fleet_sim.dense_rays import ScanPlan
from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId, covering_circle
from studies.benchmark.export import write_map, write_voxels
from studies.benchmark.files import write_json
from studies.benchmark.frames import IndexFrame

VEHICLES = ("vehicle-00", "vehicle-01")
FRAME = LocalFrame(0.65553, 2.21719, 30.0)


def gaussians_at(voxel_id: np.ndarray, rng: np.random.Generator) -> Gaussians:
    n = len(voxel_id)
    cov = np.tile(np.array([0.05, 0.0, 0.0, 0.06, 0.0, 0.01], np.float32), (n, 1))
    mean = rng.uniform(-0.4, 0.4, (n, 3)).astype(np.float32)
    return Gaussians(voxel_id, np.full(n, 90, np.int32), np.full(n, 50, np.int32), mean, cov)


def made_truth(seed: int) -> Truth:
    """Some hundred voxels of a few tiles, every class among them."""
    rng = np.random.default_rng(seed)
    tiles = sorted(covering_circle(FRAME.lat_rad, FRAME.lon_rad, 40.0))
    parts, before, after = [], {}, {}
    for tile in tiles:
        grid = VoxelGrid.of(tile)
        known = rng.integers(0, [grid.nx, grid.ny, 6], (150, 3)).T + np.array([[0], [0], [28]])
        voxel_id = np.unique(grid.voxel_id(*known))
        change_class = rng.integers(0, 5, len(voxel_id)).astype(np.uint8)
        parts.append((np.full(len(voxel_id), tile.morton), voxel_id, change_class))
        held = {state: np.isin(change_class, (ChangeClass.NORMAL, ChangeClass.MODIFIED, one))
                for state, one in (("before", ChangeClass.DELETED), ("after", ChangeClass.NEW))}  # fmt: skip
        before[tile] = gaussians_at(voxel_id[held["before"]], rng)
        after[tile] = gaussians_at(voxel_id[held["after"]], rng)
    morton, voxel_id, change_class = (np.concatenate(column) for column in zip(*parts, strict=True))
    clear, observable, seasonal = rng.random((3, len(morton))) < np.array([[0.8], [0.6], [0.1]])
    return Truth("0" * 64, ScanPlan(), FRAME, morton.astype(np.int64), voxel_id.astype(np.int32), change_class, clear,
                 observable, seasonal, before, after)  # fmt: skip


def changed_map(truth: Truth, seed: int) -> dict[TileId, Gaussians]:
    """The map before with Gaussians taken out, replaced and added at random, some where the truth knows nothing."""
    rng, found = np.random.default_rng(seed), {}
    for tile, old in truth.before.items():
        kept = old.take(np.flatnonzero(rng.random(len(old)) < 0.7))
        ids = truth.voxel_id[truth.morton == tile.morton]
        put = np.unique(np.concatenate([rng.choice(ids, 30), rng.choice(ids, 5) + VoxelGrid.of(tile).nx]))
        put = put.astype(np.int32)
        rest = kept.take(~np.isin(kept.voxel_id, put))
        columns = [np.concatenate(pair) for pair in zip(rest.columns, gaussians_at(put, rng).columns, strict=True)]
        order = np.argsort(columns[0])
        found[tile] = Gaussians(*(column[order] for column in columns))
    return found


def write_export(folder: Path, truths: dict[str, Truth]) -> Path:
    """An export without drives."""
    for name, truth in truths.items():
        home, frame = folder / "worlds" / name, IndexFrame.around(truth)
        (home / "map_before").mkdir(parents=True)
        (folder / "truth" / name).mkdir(parents=True)
        write_json(home / "frame.json", frame.plain())
        write_map(home / "map_before", truth, frame)
        write_voxels(folder / "truth" / name / "voxels.npz", truth, frame)
    worlds = [{"name": name, "vehicles": list(VEHICLES)} for name in truths]
    mark = {"format": "gnd.benchmark", "version": 1, "finished": True, "worlds": worlds}
    (folder / "benchmark.json").write_text(json.dumps(mark))
    return folder
