"""What turns one set of Gaussians into another."""

from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import I32, I64, are_in, check_array
from gnd.gnd_map.errors import DeltaError
from gnd.gnd_map.gaussian import Gaussians, concat


@dataclass(frozen=True, slots=True)
class TileDelta:
    """What turns one set of Gaussians into another."""

    removed: I32
    """(K,) voxel ids that go, strictly increasing."""
    put: Gaussians
    """Voxels that come or are replaced, every count > 0."""

    def __post_init__(self) -> None:
        check_array("removed", self.removed, np.int32, (None,))
        if (self.removed[1:] <= self.removed[:-1]).any():
            raise DeltaError(f"delta: the {len(self.removed)} removed voxel ids are not strictly increasing")
        both = are_in(self.removed, self.put.voxel_id)
        if both.any():
            raise DeltaError(f"delta: {int(both.sum())} voxels are both removed and put")
        if not self.put.exists.all():
            raise DeltaError(f"delta: {int((~self.put.exists).sum())} voxels are put with count 0")

    def __len__(self) -> int:
        return len(self.removed) + len(self.put)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TileDelta):
            return NotImplemented
        return np.array_equal(self.removed, other.removed) and self.put == other.put

    __hash__ = None  # type: ignore[assignment]


def diff(old: Gaussians, new: Gaussians) -> TileDelta:
    """The smallest delta with apply(old, delta) == new, bit for bit."""
    removed = old.voxel_id[~are_in(old.voxel_id, new.voxel_id)]
    return TileDelta(removed, new.take(~_same_rows(old, new)))


def apply(old: Gaussians, delta: TileDelta) -> Gaussians:
    """The Gaussians after the delta.

    Raises:
        DeltaError: a voxel to remove is not there.
    """
    absent = delta.removed[~are_in(delta.removed, old.voxel_id)]
    if len(absent):
        raise DeltaError(f"delta: {len(absent)} of {len(delta.removed)} voxels to remove are absent, first {absent[0]}")
    gone = are_in(old.voxel_id, delta.removed) | are_in(old.voxel_id, delta.put.voxel_id)
    return concat([old.take(~gone), delta.put])


def _same_rows(old: Gaussians, new: Gaussians) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    """(len(new),) whether `old` holds the voxel with the same bits."""
    same = np.asarray(are_in(new.voxel_id, old.voxel_id))
    at_new = np.flatnonzero(same)
    at_old = np.searchsorted(old.voxel_id, new.voxel_id[at_new])
    same[at_new] = _are_equal(old, at_old, new, at_new)
    return same


def _are_equal(
    old: Gaussians, at_old: I64, new: Gaussians, at_new: I64
) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    """(K,) whether pairs of rows hold the same values but for the ids; -0.0 and 0.0 are one value, and NaN is none."""
    same = (old.count[at_old] == new.count[at_new]) & (old.cells[at_old] == new.cells[at_new])
    same &= (old.mean_m[at_old] == new.mean_m[at_new]).all(axis=1)
    return np.asarray(same & (old.cov_m2[at_old] == new.cov_m2[at_new]).all(axis=1))
