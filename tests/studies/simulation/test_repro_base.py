from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim.drives import simulate_drive
from gnd.fleet_sim.prepare import mapping_configs
from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from studies.frame.errors import FolderError
from studies.simulation import base_map
from studies.simulation.base_map import BaseMap, driven, read_base, surveyed, write_base


def some_tiles() -> dict[TileId, Gaussians]:
    world = street(3, StreetOptions(100.0, "wangsimni"))
    tile = TileId.from_geodetic(world.lat_rad, world.lon_rad)
    accumulator = VoxelAccumulator(GridFrame.around(world.frame, [tile, *tile.neighbours()]))
    accumulator.add(np.random.default_rng(1).uniform([-30, -30, 0], [30, 30, 4], (200_000, 3)))
    return accumulator.finish()


def test_a_base_map_is_read_as_written(tmp_path: Path) -> None:
    base = surveyed(some_tiles())
    write_base(base, tmp_path / "base.npz")
    again = read_base(tmp_path / "base.npz")
    assert again.sha == base.sha
    assert again.tiles == base.tiles


def test_tiles_without_gaussians_are_no_part_of_it() -> None:
    tiles = some_tiles()
    empty = TileId(min(tiles).morton + 4000)
    assert surveyed({**tiles, empty: Gaussians.empty()}).sha == surveyed(tiles).sha


def test_a_damaged_base_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "base.npz"
    write_base(surveyed(some_tiles()), path)
    body = bytearray(path.read_bytes())
    body[len(body) // 2] ^= 1
    path.write_bytes(body)
    with pytest.raises(FolderError, match=r"cannot read|base map"):
        read_base(path)
    with pytest.raises(FolderError, match="cannot read"):
        read_base(tmp_path / "missing.npz")


def test_a_driven_base_map_is_what_map_build_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = street(3, StreetOptions(100.0, "wangsimni"))
    configs = tuple(replace(config, scans=4) for config in mapping_configs(3))
    monkeypatch.setattr(base_map, "mapping_configs", lambda seed: configs)
    ours = driven(world)
    drives = [simulate_drive(world, config, tmp_path / f"{config.vehicle}.mcap") for config in configs]
    with SqliteStore(tmp_path / "map.sqlite") as store:
        build_map(drives, store, codec="float")
        built = {entry.tile: store.get("ndt", entry.tile, entry.version) for entry in store.heads("ndt")}
    theirs = BaseMap({tile: stored.decode().gaussians for tile, stored in built.items() if stored is not None})
    assert set(ours.tiles) == set(theirs.tiles)
    for tile, gaussians in ours.tiles.items():
        other = theirs.tiles[tile]
        same = np.intersect1d(gaussians.voxel_id, other.voxel_id)
        assert len(same) >= 0.99 * max(len(gaussians), len(other))
        assert np.abs(gaussians.select(same).mean_m - other.select(same).mean_m).max() < 0.01
