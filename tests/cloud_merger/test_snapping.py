"""Snapping with a memory against snapping anew: the same bits, whatever was merged before."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import TILE
from test_merge_kernels import covariances

from gnd.cloud_merger.merge import MergedTile
from gnd.cloud_merger.snapping import Snapping
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.tile import Tile, TileDelta

STANDARD, COMPACT = LATTICES["standard"], LATTICES["compact"]


def some(rng, ids):
    """Gaussians at these voxels; of every fourth one the mean is zero, with either sign."""
    n = len(ids)
    count = rng.choice([20, 41, 700], n).astype(np.int32)
    mean_m = rng.normal(0.0, 0.2, (n, 3)).astype(np.float32)
    mean_m[::4] = rng.choice([np.float32(0.0), np.float32(-0.0)], mean_m[::4].shape)
    return Gaussians(np.asarray(ids, np.int32), count, np.minimum(count, 20), mean_m, covariances(rng, n))


@st.composite
def merges(draw):
    """One tile merged again and again: changes that stay, move by a hair, come and go."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    epoch = some(rng, np.arange(0, 40, 2))
    if draw(st.booleans()):
        epoch = snap(epoch, STANDARD)
    pool = some(rng, np.arange(40))
    found = []
    for _ in range(draw(st.integers(1, 6))):
        chosen = np.flatnonzero(rng.random(40) < draw(st.sampled_from([0.0, 0.2, 0.6])))
        put = pool.take(chosen)
        if len(put) and draw(st.booleans()):
            moved = some(rng, put.voxel_id)
            is_moved = rng.random(len(put)) < 0.3
            put = concat([put.take(~is_moved), moved.take(is_moved)])
        gone = epoch.voxel_id[(rng.random(len(epoch)) < 0.2) & ~np.isin(epoch.voxel_id, put.voxel_id)]
        found.append(MergedTile(epoch, TileDelta(gone, put)))
    return found


@settings(max_examples=100, deadline=None)
@given(merges(), st.lists(st.booleans(), min_size=6, max_size=6))
def test_a_tile_snapped_with_a_memory_is_the_tile_snapped_anew(some_merges, coarse):
    snapping = Snapping()
    for merged, is_coarse in zip([*some_merges, some_merges[-1]], [*coarse, coarse[-1]], strict=False):
        lattice = COMPACT if is_coarse else STANDARD
        got, expected = snapping.of(TILE, merged, lattice), snap(merged.gaussians, lattice)
        assert Tile(TILE, 1, got).sha == Tile(TILE, 1, expected).sha


def test_what_is_decided_alike_is_the_very_tile():
    rng = np.random.default_rng(5)
    epoch = snap(some(rng, np.arange(0, 40, 2)), STANDARD)
    put = some(rng, np.arange(1, 40, 6))
    snapping = Snapping()
    first, again = (snapping.of(TILE, MergedTile(epoch, TileDelta(epoch.voxel_id[:1], put)), STANDARD) for _ in "ab")
    assert again is first
    zero = Gaussians(put.voxel_id, put.count, put.cells, np.where(put.mean_m == 0, -put.mean_m, put.mean_m), put.cov_m2)
    other = snapping.of(TILE, MergedTile(epoch, TileDelta(epoch.voxel_id[:1], zero)), STANDARD)
    assert other is not first  # -0.0 is not 0.0
