"""Maps made ready for registration: what several of them share, and that nobody keeps the window of before."""

import gc
import weakref

import numpy as np
from yard import local_map_of, yard

from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.match_map import LINEAR_M, MatchMap, MatchMapCache

HERE = np.zeros(3)
FAR = np.array([LINEAR_M, 0.0, 0.0])


def test_caches_of_one_map_share_all_but_where_its_grid_is_taken_as_affine():
    local_map = local_map_of(yard(np.random.default_rng(1)))
    one, other = MatchMapCache(local_map, 0.04), MatchMapCache(local_map, 0.04)
    here, there = one.near(HERE), other.near(FAR)
    assert here.information is there.information
    assert here.index is there.index is local_map.index
    assert not np.array_equal(here.b, there.b)
    assert one.near(HERE + 1.0) is here, "made once"
    assert one.near(FAR) is not here
    np.testing.assert_array_equal(one.near(FAR).A, there.A)


def test_another_noise_gives_another_map():
    local_map = local_map_of(yard(np.random.default_rng(1)))
    fine, coarse = MatchMapCache(local_map, 0.01).near(HERE), MatchMapCache(local_map, 0.1).near(HERE)
    assert (np.abs(fine.information).sum(axis=1) >= np.abs(coarse.information).sum(axis=1)).all()
    assert fine.information.sum() != coarse.information.sum()


def test_the_information_is_that_of_all_gaussians_and_made_once_a_tile():
    local_map = local_map_of(yard(np.random.default_rng(1)))
    first = MatchMapCache(local_map, 0.04).near(HERE)
    held = [local_map.tile(tile_id) for tile_id in local_map.tiles]
    assert len(held) > 1
    local_map.remove_tile(local_map.tiles[0])
    made = []
    kept = local_map.of_gaussians(("match map", 0.04), lambda cov_m2: made.append(cov_m2) or cov_m2)
    assert not made
    np.testing.assert_array_equal(kept, first.information[-len(kept) :])
    local_map.set_tile(held[0])
    found = MatchMapCache(local_map, 0.04).near(HERE)
    whole = MatchMap.of(found.index, found.A, found.b, local_map.mean_map_m, local_map.cov_m2, 0.04)
    np.testing.assert_array_equal(found.information, whole.information)
    assert MatchMapCache(LocalMap(local_map.grid_frame), 0.04).near(HERE).information.shape == (0, 6)


def test_a_changed_map_is_seen_and_the_window_of_before_is_let_go():
    local_map = local_map_of(yard(np.random.default_rng(1)))
    caches = [MatchMapCache(local_map, 0.04) for _ in range(3)]
    before = [cache.near(HERE) for cache in caches]
    window, rows = weakref.ref(before[0].index), len(before[0])
    del before
    local_map.remove_tile(local_map.tiles[0])
    after = caches[0].near(HERE)  # the others have not asked yet
    gc.collect()
    assert window() is None
    assert len(after) < rows
    assert len(caches[1].near(HERE)) == len(after)
