"""The clusters of a tile's statements (GND 5.1), voxel by voxel in one kernel: no array of pairs is made.

Similarity is the smooth one of `gnd.gnd_map.similarity` ("default"). The labels are those of its twin,
`cloud_merger.merge.plain_clusters`. What saves most: a statement whose cluster is known is found by nobody any more.
Where all agree that is one similarity each, not one a pair.
"""

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.parameters import MERGE_NOISE_M, MergeParameters
from gnd.cloud_merger.statements import Kind, Rows
from gnd.gnd_map.arrays import F32, F64, I32, I64
from gnd.gnd_map.jit import kernel
from gnd.gnd_map.similarity import alike, far_at

U8 = NDArray[np.uint8]
Said = tuple[U8, I64, I32, F64, F32, F32, float, float, float]
"""Kind, was, count, pose_m2, mean_m and cov_m2 of the statements, noise in m², eps, `far_at` it."""
NOISE = -1
_COLUMNS = ("voxel_id", "kind", "was", "count", "pose_m2", "mean_m", "cov_m2")
_NOTHING, _QUOTED, _MEASURED, _WITHHELD = (int(kind) for kind in Kind)


def clusters_of(rows: Rows, parameters: MergeParameters) -> I64:
    """(M,) the cluster of each statement, numbered by voxel, then by the cluster's first core; -1: noise and withheld.

    Args:
        rows: STATEMENT (M,), sorted by voxel.
        parameters: `eps`, `min_samples` and `noise_m` are used; the mode is taken to be "default".
    """
    label = np.full(len(rows), NOISE, np.int64)
    columns = {name: rows[name].copy() for name in _COLUMNS}  # aligned, as the fields of a record are not
    noise_m2, eps, min_samples = MERGE_NOISE_M**2, parameters.eps, parameters.min_samples
    label_voxels(**columns, noise_m2=noise_m2, eps=eps, min_samples=min_samples, label=label)
    return label


@kernel
def label_voxels(
    voxel_id: I32,
    kind: U8,
    was: I64,
    count: I32,
    pose_m2: F64,
    mean_m: F32,
    cov_m2: F32,
    noise_m2: float,
    eps: float,
    min_samples: int,
    label: I64,
) -> None:
    """Label the statements (M,) of one voxel after the other; scratch is as long as the voxel with most of them."""
    most = most_in_a_voxel(voxel_id)
    node, row, weight = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    found, queue, rest = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    begin, number, far = 0, 0, far_at(1.0 - eps)
    while begin < len(voxel_id):
        end = begin + 1
        while end < len(voxel_id) and voxel_id[end] == voxel_id[begin]:
            end += 1
        n = _nodes(begin, end, kind, was, node, row, weight)
        said = (kind, was, count, pose_m2, mean_m, cov_m2, noise_m2, eps, far)
        _add_neighbours(n, row, weight, min_samples, said)
        number = _cores(n, row, weight, min_samples, said, found, queue, rest, number)
        _borders(n, row, weight, min_samples, said, found)
        for k in range(begin, end):
            if kind[k] != _WITHHELD:
                label[k] = found[node[k - begin]]
        begin = end


@kernel
def most_in_a_voxel(voxel_id: I32) -> int:
    """The largest number of statements about one voxel; they are sorted by voxel."""
    most, n = 0, 0
    for k in range(len(voxel_id)):
        n = n + 1 if k > 0 and voxel_id[k] == voxel_id[k - 1] else 1
        most = max(most, n)
    return most


@kernel
def _nodes(begin: int, end: int, kind: U8, was: I64, node: I64, row: I64, weight: I64) -> int:
    """Statements that say the same are one node, each measured one is its own: how many there are.

    Fills the node of each statement, and of each node its first row and its number of statements.
    """
    n = 0
    for k in range(begin, end):
        if kind[k] == _WITHHELD:
            continue
        at = n
        if kind[k] != _MEASURED:
            said = was[k] if kind[k] == _QUOTED else 0
            for other in range(n):
                first = row[other]
                if kind[first] != _MEASURED and said == (was[first] if kind[first] == _QUOTED else 0):
                    at = other
                    break
        if at == n:
            row[n], weight[n] = k, 0
            n += 1
        node[k - begin] = at
        weight[at] += 1
    return n


@kernel
def _add_neighbours(n: int, row: I64, weight: I64, min_samples: int, said: Said) -> None:
    """Add to each node's weight that of its neighbours, until it is enough for a core."""
    if min_samples <= 1:
        return
    own = weight[:n].copy()
    for i in range(n):
        for j in range(i + 1, n):
            if (weight[i] < min_samples or weight[j] < min_samples) and _is_near(row[i], row[j], said):
                weight[i] += own[j]
                weight[j] += own[i]


@kernel
def _cores(
    n: int, row: I64, weight: I64, min_samples: int, said: Said, found: I64, queue: I64, rest: I64, number: int
) -> int:
    """Label the connected components of the cores from `number` on by their first core; the next number."""
    left = 0
    for i in range(n):
        found[i] = NOISE
        if weight[i] >= min_samples:
            rest[left] = i
            left += 1
    while left > 0:
        queue[0], length, done = rest[0], 1, 0
        found[rest[0]] = number
        left -= 1
        rest[:left] = rest[1 : left + 1]
        while done < length and left > 0:
            at, kept = queue[done], 0
            for k in range(left):
                other = rest[k]
                if _is_near(row[min(at, other)], row[max(at, other)], said):
                    found[other], queue[length] = number, other
                    length += 1
                else:
                    rest[kept] = other
                    kept += 1
            left = kept
            done += 1
        number += 1
    return number


@kernel
def _borders(n: int, row: I64, weight: I64, min_samples: int, said: Said, found: I64) -> None:
    """A node near a core joins the first cluster that reaches it."""
    for i in range(n):
        if weight[i] >= min_samples:
            continue
        for j in range(n):
            is_earlier = found[i] == NOISE or found[j] < found[i]
            if weight[j] >= min_samples and is_earlier and _is_near(row[min(i, j)], row[max(i, j)], said):
                found[i] = found[j]


@kernel
def _is_near(a: int, b: int, said: Said) -> bool:
    """Whether two statements of a voxel lie within `eps` of each other."""
    kind, was, count, pose_m2, mean_m, cov_m2, noise_m2, eps, far = said
    if kind[a] == _NOTHING or kind[b] == _NOTHING:  # Eq. 14
        return False
    if was[a] == was[b] and was[a] > 0 and kind[a] != kind[b]:  # one denies what the other quotes
        return False
    if count[a] <= 0 or count[b] <= 0:
        return bool((count[a] > 0) == (count[b] > 0))
    variance_m2 = noise_m2 + pose_m2[a] + pose_m2[b]
    return bool(1.0 - alike(mean_m[a], cov_m2[a], mean_m[b], cov_m2[b], variance_m2, far) <= eps)
