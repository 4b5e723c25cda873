"""What a vehicle that comes back downloads: as many voxels changed as asked for, through the server's own code."""

from pathlib import Path

import numpy as np
import pytest

from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.tile import diff
from gnd.gnd_map.tile_id import TileId
from studies.frame.options import of_arguments
from studies.return_download import ReturnDownloadOptions, partly_changed, run
from studies.simulation.base_map import BaseMap, write_base

TILES = [TileId(497353963154 + k) for k in range(4)]


def ground(seed: int, n: int = 400) -> Gaussians:
    rng = np.random.default_rng(seed)
    ids = np.sort(rng.choice(1500, n, replace=False)).astype(np.int32)
    mean_m = np.column_stack([rng.uniform(-0.1, 0.1, (n, 2)), np.full(n, -0.2)]).astype(np.float32)
    cov_m2 = np.tile(np.array([0.07, 0, 0, 0.07, 0, 0.0004], np.float32), (n, 1))
    return Gaussians(ids, np.full(n, 90, np.int32), np.full(n, 40, np.int32), mean_m, cov_m2)


def changed(before: Gaussians, n: int) -> Gaussians:
    """The first `n` voxels: one in three is gone, the others lie higher."""
    then = before.take(np.arange(n)[np.arange(n) % 3 > 0])
    higher = Gaussians(then.voxel_id, then.count, then.cells, then.mean_m + np.float32(0.3), then.cov_m2)
    return concat([higher, before.take(np.arange(n, len(before)))])


BEFORE = {tile: ground(k) for k, tile in enumerate(TILES)}
# In the last tile nothing changes, in the one before it less than is asked for.
AFTER = {tile: changed(g, n) for (tile, g), n in zip(BEFORE.items(), (200, 200, 5, 0), strict=True)}


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_as_many_voxels_are_changed_as_asked_for_where_there_are_as_many(share: float) -> None:
    new = partly_changed(BEFORE, AFTER, share, np.random.default_rng(0))
    counts = [len(diff(BEFORE[tile], new[tile])) for tile in TILES]
    assert abs(sum(counts) - share * 1600) <= 2
    assert counts[2:] == [5, 0]
    assert new[TILES[3]] == BEFORE[TILES[3]]
    for tile in TILES:
        edits = diff(BEFORE[tile], new[tile])
        assert edits.put == AFTER[tile].select(edits.put.voxel_id)
        assert not np.isin(edits.removed, AFTER[tile].voxel_id).any()


def test_more_than_has_changed_cannot_be_asked_for() -> None:
    new = partly_changed(BEFORE, AFTER, 0.9, np.random.default_rng(0))
    assert new == AFTER


def test_a_return_costs_less_than_the_first_time_and_nothing_almost_nothing(tmp_path: Path) -> None:
    for name, tiles in (("before", BEFORE), ("after", AFTER)):
        write_base(BaseMap(tiles), tmp_path / f"{name}.npz")
    arguments = ["--before", str(tmp_path / "before.npz"), "--after", str(tmp_path / "after.npz"), "--changed", "0.05"]
    chosen = of_arguments(ReturnDownloadOptions, arguments)
    assert chosen == ReturnDownloadOptions(before=tmp_path / "before.npz", after=tmp_path / "after.npz", changed=0.05)
    figures = {figure.name: figure for figure in run(chosen)}
    down = [figures[f"{name}: download"].value for name in ("first", "return", "nothing changed")]
    assert down[0] > 2 * down[1] > 4 * down[2] > 0
    assert figures["return: download"].detail.endswith("4 tiles of 400 voxels, standard, 20.2 changed voxels a tile")
    assert all(figures[f"{name}: question"].value < 60 / 4 + 10 for name in ("first", "return"))
