"""Scoring a point-cloud map as the paper does: converted to Gaussians, compared with the same indicator."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from gnd.fleet_sim.evaluate import Evaluation, evaluate_maps
from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.similarity import similarity
from gnd.gnd_map.tile_id import TileId
from studies.pcd.parameters import PcdMergeParameters

Tiles = Mapping[TileId, Gaussians]
SIMILAR: Final = PcdMergeParameters().similar


def settled(before: Tiles, after: Tiles, similar: float = SIMILAR) -> dict[TileId, Gaussians]:
    """`after` with the Gaussians of `before` where the two are at least `similar`.

    A few changed points alter a Gaussian by a hair; the paper compares normal distributions, and a voxel counts as
    modified there only when they differ. Points that nothing was said about stay to the bit, so the threshold can be
    higher than the GND framework's 0.5, which must allow for measurement noise in unchanged voxels; and it must be,
    because old points that a new surface hides stay in the cloud.
    """
    return {t: _settled(before.get(t, Gaussians.empty()), g, similar) for t, g in after.items()}


def _settled(old: Gaussians, new: Gaussians, similar: float) -> Gaussians:
    _, i, j = np.intersect1d(old.voxel_id, new.voxel_id, assume_unique=True, return_indices=True)
    a, b = old.take(i), new.take(j)
    alike = similarity(a.exists, a.mean_m, a.cov_m2, b.exists, b.mean_m, b.cov_m2) >= similar
    changed = np.ones(len(new), np.bool_)
    changed[j[alike]] = False
    return concat([new.take(changed), a.take(alike)])


def evaluate_gnd(truth: Truth, before: Tiles, after: Tiles, similar: float = SIMILAR) -> Evaluation:
    """F1 of the Gaussians `after` an update of the Gaussians `before`, both converted from point clouds."""
    return evaluate_maps(truth, before, settled(before, after, similar))
