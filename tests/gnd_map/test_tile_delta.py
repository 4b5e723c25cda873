"""Versions of a tile and the deltas between them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.gnd_map.errors import DeltaError, ShapeError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, TileDelta, apply, diff
from gnd.gnd_map.tile_id import TileId

TILE = TileId(497353963154)


def world(rows: dict[int, int]) -> Gaussians:
    """Voxel id → a seed of its values, so that equal seeds are equal rows."""
    ids = np.array(sorted(rows), dtype=np.int32)
    seeds = np.array([rows[i] for i in sorted(rows)], dtype=np.float32)
    mean = np.stack([seeds * 0.01, seeds * 0.02, -seeds * 0.01], axis=1).reshape(-1, 3)
    cov = np.tile(np.array([0.04, 0.001, 0.0, 0.05, 0.0, 0.002], np.float32), (len(ids), 1))
    return Gaussians(
        ids, np.full(len(ids), 50, np.int32), np.full(len(ids), 30, np.int32), mean.astype(np.float32), cov
    )


worlds = st.dictionaries(st.integers(-50, 50), st.integers(0, 3), max_size=40).map(world)


@given(worlds, worlds)
def test_applying_a_difference_gives_the_new_state_bit_for_bit(old: Gaussians, new: Gaussians) -> None:
    delta = diff(old, new)
    assert apply(old, delta) == new
    assert Tile(TILE, 1, apply(old, delta)).sha == Tile(TILE, 2, new).sha


@given(worlds)
def test_nothing_changed_is_an_empty_delta(state: Gaussians) -> None:
    assert len(diff(state, state)) == 0


def test_a_delta_names_only_what_changed() -> None:
    delta = diff(world({1: 0, 2: 0, 3: 0}), world({2: 1, 3: 0, 4: 2}))
    assert delta.removed.tolist() == [1]
    assert delta.put.voxel_id.tolist() == [2, 4]
    assert delta == TileDelta(np.array([1], np.int32), world({2: 1, 4: 2}))
    assert len(delta) == 3


def test_a_changed_count_alone_is_a_change() -> None:
    old = world({1: 0})
    new = Gaussians(old.voxel_id, old.count + np.int32(1), old.cells, old.mean_m, old.cov_m2)
    assert diff(old, new).put == new


def test_negative_zero_is_no_change() -> None:
    old, new = world({1: 0}), world({1: 0})
    new.mean_m[0, 0] = -0.0
    assert len(diff(old, new)) == 0


def test_a_delta_that_does_not_fit_is_refused() -> None:
    delta = TileDelta(np.array([1, 5], np.int32), Gaussians.empty())
    with pytest.raises(DeltaError, match="1 of 2 voxels to remove are absent, first 5"):
        apply(world({1: 0, 2: 0}), delta)


def test_contradictory_deltas_are_refused() -> None:
    with pytest.raises(DeltaError, match="both removed and put"):
        TileDelta(np.array([1], np.int32), world({1: 0}))
    with pytest.raises(DeltaError, match="strictly increasing"):
        TileDelta(np.array([2, 1], np.int32), Gaussians.empty())
    with pytest.raises(DeltaError, match="count 0"):
        TileDelta(np.empty(0, np.int32), Gaussians.nothing_at([3]))


def test_a_tile_holds_only_voxels_that_exist() -> None:
    with pytest.raises(ShapeError, match="count 0"):
        Tile(TILE, 1, Gaussians.nothing_at([3]))
    with pytest.raises(ShapeError, match="version -1"):
        Tile(TILE, -1, world({}))
