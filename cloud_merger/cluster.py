"""DBSCAN of all voxels of a tile at once (GND 5.1 clusters the uploads of one voxel; here all voxels are one graph).

Points of different voxels have no pair, so the distance matrix is block-diagonal: a missing pair means "far".
`dbscan` is exact and costs one pass over the pairs; `dbscan_sklearn` is the same clustering by the library: that of
"paper" mode, and the oracle of the other. The library is loaded where it is first called.
"""

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]
NOISE = -1


def dbscan(
    weight: Index, i: Index, j: Index, distance: NDArray[np.float64], *, eps: float, min_samples: int
) -> NDArray[np.int64]:
    """Labels as of sklearn's DBSCAN with sample weights: clusters in the order of their first core point, noise -1.

    Args:
        weight: (N,) how many equal points each row stands for.
        i: (P,) first row of each pair; no pair twice.
        j: (P,) second row of each pair.
        distance: (P,) of each pair; what is not listed is far.
        eps: neighbours are at most this far apart.
        min_samples: weight in the neighbourhood (the point included) that makes a core point.
    """
    near = distance <= eps
    i, j = i[near], j[near]
    core = _neighbourhood_weight(weight, i, j) >= min_samples
    label = _core_labels(core, i, j)
    return _with_borders(label, core, np.concatenate([i, j]), np.concatenate([j, i]))


def _neighbourhood_weight(weight: Index, i: Index, j: Index) -> Index:
    total = weight.copy()
    np.add.at(total, i, weight[j])
    np.add.at(total, j, weight[i])
    return total


def _core_labels(core: NDArray[np.bool_], i: Index, j: Index) -> Index:
    """Connected components of the core points, numbered by their first point; NOISE elsewhere."""
    from scipy.sparse import csr_array  # here because the import is dear, and kernels cluster in the default mode
    from scipy.sparse.csgraph import connected_components

    n = len(core)
    both = core[i] & core[j]
    graph = csr_array((np.ones(int(both.sum()), bool), (i[both], j[both])), shape=(n, n))
    component = connected_components(graph, directed=False)[1] if n else np.zeros(0, np.int32)
    _, first, inverse = np.unique(component[core], return_index=True, return_inverse=True)
    label = np.full(n, NOISE, np.int64)
    label[core] = np.argsort(np.argsort(first))[inverse]
    return label


def _with_borders(label: Index, core: NDArray[np.bool_], a: Index, b: Index) -> Index:
    """A point near a core point joins the first cluster that reaches it."""
    reach = core[a] & ~core[b]
    first = np.full(len(label), np.iinfo(np.int64).max)
    np.minimum.at(first, b[reach], label[a[reach]])
    reached = ~core & (first < np.iinfo(np.int64).max)
    return np.where(reached, first, label)


def dbscan_sklearn(
    weight: Index, i: Index, j: Index, distance: NDArray[np.float64], *, eps: float, min_samples: int
) -> NDArray[np.int64]:
    """The same labels by scikit-learn: one sparse distance matrix, explicit zeros kept. Arguments as `dbscan`."""
    from scipy.sparse import csr_array
    from sklearn.cluster import DBSCAN  # here because the import is dear and only "paper" mode needs it

    n = len(weight)
    if n == 0:
        return np.zeros(0, np.int64)
    diagonal = np.arange(n)
    row, column = np.concatenate([diagonal, i, j]), np.concatenate([diagonal, j, i])
    value = np.concatenate([np.zeros(n), distance, distance])
    order = np.lexsort((value, row))  # sorted by distance within a row: what the library asks of a sparse graph
    start = np.searchsorted(row[order], np.arange(n + 1))
    matrix = csr_array((value[order], column[order].astype(np.int32), start.astype(np.int32)), shape=(n, n))
    model = DBSCAN(eps=eps, min_samples=min_samples, metric="precomputed")
    return np.asarray(model.fit(matrix, sample_weight=weight).labels_, np.int64)
