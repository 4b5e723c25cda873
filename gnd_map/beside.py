"""Voxels that lie side by side, also across an edge or a corner, as groups."""

import numpy as np

from gnd.gnd_map.arrays import I64
from gnd.gnd_map.jit import bare, kernel


def groups_of(index: I64, members: I64) -> list[I64]:
    """Put voxels that lie side by side into groups.

    Args:
        index: (N, 3) column, row and floor of each voxel.
        members: (K,) numbers of those that count.

    Returns:
        Their numbers, ascending in each group, the group with the lowest voxel first.
    """
    if not len(members):
        return []
    upwards = np.sort(members)[np.argsort(index[np.sort(members), 2], kind="stable")]
    label = group_numbers(*np.ascontiguousarray(index[upwards].T))
    order = np.argsort(label, kind="stable")
    parts = np.split(upwards[order], np.flatnonzero(np.diff(label[order])) + 1)
    return [np.sort(part) for part in parts]


@kernel
def group_numbers(x: I64, y: I64, floor: I64) -> I64:
    """(N,) the number of the first voxel of each voxel's group; `floor` ascends."""
    n = len(x)
    group = np.arange(n)
    for i in range(n):
        for j in range(i + 1, n):
            if floor[j] - floor[i] > 1:
                break
            if abs(x[i] - x[j]) <= 1 and abs(y[i] - y[j]) <= 1:
                a, b = _root(group, i), _root(group, j)
                group[max(a, b)] = min(a, b)
    return np.array([_root(group, i) for i in range(n)])


@bare
def _root(group: I64, i: int) -> int:
    while group[i] != i:
        group[i] = group[group[i]]
        i = group[i]
    return i


@kernel
def count_beside(index: I64, others: I64) -> I64:
    """(N,) how many of other voxels lie beside each voxel (N, 3), across an edge or a corner too, or are it."""
    found = np.zeros(len(index), np.int64)
    for i in range(len(index)):
        for j in range(len(others)):
            if (
                abs(index[i, 0] - others[j, 0]) <= 1
                and abs(index[i, 1] - others[j, 1]) <= 1
                and abs(index[i, 2] - others[j, 2]) <= 1
            ):
                found[i] += 1
    return found
