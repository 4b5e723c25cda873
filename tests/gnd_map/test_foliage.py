"""Which changes are leaves, and which are not."""

import re

import numpy as np
import pytest
from things_testing import GRID, GROUND_M, box, gaussians, street
from tree_testing import FRONT, LEAVES, TWIGS, X, Y, trunk

from gnd.gnd_map import foliage
from gnd.gnd_map.foliage import follows_season
from gnd.gnd_map.tile import diff


def shares(before, after):
    """How many voxels hold something only before or only after, and the share of them that are said to be leaves."""
    before, after = gaussians(street(), *before), gaussians(street(), *after)
    change = diff(before, after)
    put = change.put.take(np.flatnonzero(~np.isin(change.put.voxel_id, before.voxel_id)))
    held = follows_season(GRID, before, change.removed, put)
    changed = np.concatenate([change.removed, put.voxel_id])
    assert np.isin(held, changed).all()
    assert (np.diff(held) > 0).all()
    return len(changed), len(held) / len(changed)


@pytest.mark.parametrize(("before", "after"), [((LEAVES[0],), ()), ((), (LEAVES[0],)), ((LEAVES[0],), (LEAVES[1],))])
def test_leaves_that_fall_come_or_grow_anew_are_leaves(before, after):
    number, share = shares([trunk(), TWIGS, FRONT, *before], [trunk(), TWIGS, FRONT, *after])
    assert number > 10
    assert share > 0.6


def test_a_tree_that_is_felled_or_planted_is_a_change():
    tree = [trunk(), TWIGS, LEAVES[0]]
    assert shares([FRONT, *tree], [FRONT])[1] == 0.0
    assert shares([FRONT], [FRONT, *tree])[1] == 0.0


def test_what_is_built_or_taken_down_beside_a_tree_is_a_change():
    tree = [trunk(), TWIGS, LEAVES[0]]
    assert shares(tree, [*tree, FRONT])[1] < 0.05
    assert shares([*tree, FRONT], tree)[1] < 0.05
    board = box(X + 3.2, Y, 0.1, 1.6, GROUND_M + 2.4, GROUND_M + 4.4)
    assert shares(tree, [*tree, board])[1] < 0.2


def test_leaves_without_a_trunk_in_sight_are_not_known():
    """The trunk stands in another tile, or a hedge hides it: then nobody says that it is the season."""
    assert shares([TWIGS, LEAVES[0]], [TWIGS])[1] == 0.0


def test_nothing_changed_and_no_ground():
    tree = gaussians(trunk(), TWIGS, LEAVES[0])
    nothing = np.zeros(0, np.int32)
    assert len(follows_season(GRID, gaussians(street()), nothing, tree.take(nothing))) == 0
    without_ground = follows_season(GRID, tree, tree.voxel_id[-30:], tree.take(nothing))
    assert len(without_ground) == 0


def test_every_constant_travels_with_the_map():
    values = [
        value for name, value in vars(foliage).items() if re.fullmatch(r"[A-Z][A-Z_]*", name) and name != "BOUNDS"
    ]
    numbers = [one for value in values for one in (value if isinstance(value, tuple) else (value,))]
    assert sorted(numbers) == sorted(foliage.BOUNDS.values())
