"""The cloud merge of a tile as a pure function (GND section 5).

The merged tile depends on the epoch tile and on the set of all reports since the epoch, in the order of their ids, and
on nothing else: in whatever batches and retries they came, the same reports give the same tile, bit for bit.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import cast

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.cluster import Index, dbscan, dbscan_sklearn
from gnd.cloud_merger.decide_kernels import Found, decided
from gnd.cloud_merger.merge_kernels import clusters_of
from gnd.cloud_merger.parameters import (
    MERGE_D_DENIED,
    MERGE_D_RENEWED,
    MERGE_D_UPDATE,
    MERGE_NOISE_M,
    MERGE_XI_RESHAPED,
    MergeParameters,
)
from gnd.cloud_merger.statements import EPOCH, Kind, Rows, Statements, find, states_at
from gnd.gnd_map.arrays import are_in
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.similarity import pairs_within, similarity
from gnd.gnd_map.tile import TileDelta, apply

__all__ = ["MergeParameters", "MergedTile", "merge_tile"]

PAIRS_AT_ONCE = 200_000  # bounds the memory of the similarities


@dataclass(frozen=True, slots=True)
class MergedTile:
    """A merged tile.

    Attributes:
        epoch: what the statements were merged into.
        delta: the decided changes.
        provenance: for each changed voxel the ids of the reports in the cluster that won it.
        for_change: (M,) which statements are in the cluster that changes their voxel.
        for_epoch: (M,) which are in one that says it is as in the epoch.
    """

    epoch: Gaussians
    delta: TileDelta
    provenance: dict[int, tuple[str, ...]] = field(default_factory=dict)
    for_change: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    for_epoch: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))

    @property
    def changed(self) -> NDArray[np.int32]:
        """(C,) sorted ids of the voxels that differ from the epoch by decision."""
        return np.sort(np.concatenate([self.delta.removed, self.delta.put.voxel_id]))

    @property
    def gaussians(self) -> Gaussians:
        """The epoch's with the decided changes applied."""
        return apply(self.epoch, self.delta)

    def without(self, voxels: Collection[int]) -> "MergedTile":
        """The same with these voxels as they are in the epoch."""
        held = np.array(sorted(voxels), np.int32)
        gone, put = self.delta.removed, self.delta.put
        return replace(
            self,
            delta=TileDelta(gone[~are_in(gone, held)], put.take(~are_in(put.voxel_id, held))),
            provenance={voxel: ids for voxel, ids in self.provenance.items() if voxel not in voxels},
        )


def merge_tile(epoch: Gaussians, statements: Statements, parameters: MergeParameters | None = None) -> MergedTile:
    """Decide what the statements change in the epoch tile (GND 5.1 to 5.3).

    Args:
        epoch: the tile's Gaussians at its last base or rollback (empty for an unmapped tile).
        statements: of `statements_of` with the same epoch and mode.
        parameters: see `MergeParameters`.
    """
    parameters = parameters or MergeParameters()
    rows = statements.rows
    if len(rows) == 0:
        return MergedTile(epoch, TileDelta(np.zeros(0, np.int32), Gaussians.empty()))
    decide = decided if parameters.mode == "default" else plain_decisions
    for_change, for_epoch, voxel_id, count, cells, mean_m, cov_m2 = decide(rows, epoch, parameters)
    there = count > 0
    put = Gaussians(voxel_id[there], count[there], cells[there], mean_m[there], cov_m2[there])
    return MergedTile(
        epoch,
        TileDelta(voxel_id[~there], put),
        _said_by(voxel_id, statements, rows["voxel_id"][for_change], rows["report"][for_change]),
        for_change,
        for_epoch,
    )


def plain_decisions(rows: Rows, epoch: Gaussians, parameters: MergeParameters) -> Found:
    """What `decided` gives, over arrays of rows: for the paper's modes, and the twin of the kernel."""
    of_statement = _joined(rows, _clusters(rows, parameters))
    winner = _winners(rows, of_statement, parameters)
    members, cluster = _members(rows, of_statement, winner)
    candidate = _representatives(members, cluster, parameters)
    differs = _differs(epoch, candidate, _share(members["denies"], cluster), parameters)
    differs &= ~_confirmed(members, cluster)
    changes = candidate[differs]
    columns = (np.ascontiguousarray(changes[name]) for name in ("voxel_id", "count", "cells", "mean_m", "cov_m2"))
    for_change = np.isin(of_statement, winner[differs])
    return cast("Found", (for_change, _says_epoch(rows, of_statement, epoch), *columns))


def _says_epoch(rows: Rows, cluster: Index, epoch: Gaussians) -> NDArray[np.bool_]:
    """Which statements are in a cluster of which at least half say that the voxel is as in the epoch."""
    nothing = (rows["kind"] == Kind.NOTHING) & (find(epoch.voxel_id, rows["voxel_id"]) < 0)
    says = nothing | ((rows["kind"] == Kind.QUOTED) & (rows["was"] == EPOCH))
    inside = cluster >= 0
    n = int(cluster.max(initial=-1)) + 1
    share = np.bincount(cluster[inside], says[inside], n) / np.maximum(np.bincount(cluster[inside], minlength=n), 1)
    return np.asarray(inside & (np.append(share, 0.0)[cluster] >= 0.5))


def _clusters(rows: Rows, parameters: MergeParameters) -> Index:
    """GND 5.1: the cluster of each statement, numbered by voxel, then by the cluster's first report; -1 is noise, and
    what is withheld.
    """
    return clusters_of(rows, parameters) if parameters.mode == "default" else plain_clusters(rows, parameters)


def plain_clusters(rows: Rows, parameters: MergeParameters) -> Index:
    """The same over arrays of all pairs: for the paper's modes, and the twin of `clusters_of`."""
    shown = rows["kind"] != Kind.WITHHELD
    if parameters.mode == "paper-observers":
        shown &= rows["claim"]  # uploads alone are clustered; who observed no change is no more than counted
    cluster = np.full(len(rows), -1, np.int64)
    cluster[shown] = _clusters_shown(rows[shown], parameters)
    return cluster


def _clusters_shown(rows: Rows, parameters: MergeParameters) -> Index:
    first, node = _nodes(rows)
    nodes = rows[first]
    i, j = pairs_within(nodes["voxel_id"])
    there = (nodes["kind"][i] != Kind.NOTHING) & (nodes["kind"][j] != Kind.NOTHING)  # Eq. 14: else similarity 0
    i, j = i[there], j[there]
    clustered = dbscan_sklearn if parameters.has_paper_rules else dbscan  # the paper names DBSCAN (GND 5.1)
    label = clustered(
        np.bincount(node, minlength=len(first)).astype(np.int64),
        i,
        j,
        1.0 - np.where(_denied(nodes[i], nodes[j]), 0.0, _similarities(nodes, i, j, parameters)),
        eps=parameters.eps,
        min_samples=parameters.min_samples,
    )
    return label[node]


def _joined(rows: Rows, cluster: Index) -> Index:
    """The clusters, with each withheld statement in its voxel's largest cluster of measurements that is not the
    epoch's; -1 where there is none. It was not asked for because enough measurements agreed, or because it could not
    win: either way it counts where a change is most likely.
    """
    withheld = rows["kind"] == Kind.WITHHELD
    inside = np.flatnonzero(cluster >= 0)
    if not withheld.any() or not len(inside):
        return cluster
    number, first, member = np.unique(cluster[inside], return_index=True, return_inverse=True)
    part = rows[inside]
    measured = np.bincount(member, weights=part["kind"] == Kind.MEASURED) > 0
    change = measured & (_share((part["kind"] == Kind.QUOTED) & (part["was"] == EPOCH), member) < 0.5)
    number, voxel = number[change], part["voxel_id"][first][change]
    votes = np.bincount(member, weights=part["weight"])[change]
    order = np.lexsort((number, -votes, voxel))
    largest, at = np.unique(voxel[order], return_index=True)
    found = np.append(number[order][at], -1)[find(largest.astype(np.int32), rows["voxel_id"])]
    return np.where(withheld, found, cluster)


def _denied(a: Rows, b: Rows) -> NDArray[np.bool_]:
    """Pairs of which one quotes what the other was compared with and has found changed: the vehicle, which knows its
    evidence, has decided that they differ; similarity of two Gaussians knows less.
    """
    return np.asarray((a["was"] == b["was"]) & (a["was"] > 0) & (a["kind"] != b["kind"]))


def _nodes(rows: Rows) -> tuple[Index, Index]:
    """Statements of a voxel that say the same are one node: (first row of each node, node of each row).

    Equal statements have similarity 1, so this changes no cluster; it saves most of the pairs.
    """
    said = np.where(rows["kind"] == Kind.QUOTED, rows["was"], 0)
    measured = rows["kind"] == Kind.MEASURED  # each its own node
    said[measured] = 1 + said.max(initial=0) + np.flatnonzero(measured)
    key = rows["voxel_id"].astype(np.int64) * (1 << 32) + said
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    return np.sort(first), np.argsort(np.argsort(first))[inverse]


def _similarities(nodes: Rows, i: Index, j: Index, parameters: MergeParameters) -> NDArray[np.float64]:
    """Eq. 13 for each pair."""
    parts = [np.zeros(0)]
    for start in range(0, len(i), PAIRS_AT_ONCE):
        a, b = nodes[i[start : start + PAIRS_AT_ONCE]], nodes[j[start : start + PAIRS_AT_ONCE]]
        parts.append(_similarity(a, b, parameters))
    return np.concatenate(parts)


def _similarity(a: Rows, b: Rows, parameters: MergeParameters) -> NDArray[np.float64]:
    return similarity(
        a["count"] > 0,
        a["mean_m"],
        a["cov_m2"],
        b["count"] > 0,
        b["mean_m"],
        b["cov_m2"],
        "paper" if parameters.has_paper_rules else "default",
        noise_m=np.sqrt(MERGE_NOISE_M**2 + a["pose_m2"] + b["pose_m2"]),
    )


def _winners(rows: Rows, cluster: Index, parameters: MergeParameters) -> Index:
    """GND 5.3: of each voxel the cluster with most statements, if it holds more than ξ of all. Sorted cluster numbers.

    Of equally large clusters the one with the earliest report wins. "All" are the uploads as the paper prints it, else
    all who observed the voxel: `rows` hold the ones or the others.
    """
    in_cluster = cluster >= 0
    number, first, member = np.unique(cluster[in_cluster], return_index=True, return_inverse=True)
    voxel = rows["voxel_id"][in_cluster][first]
    votes = np.bincount(member, weights=rows["weight"][in_cluster])
    order = np.lexsort((number, -votes, voxel))
    best = order[np.unique(voxel[order], return_index=True)[1]]
    observed, seat = np.unique(rows["voxel_id"], return_inverse=True)
    cast = np.bincount(seat, weights=rows["weight"])[np.searchsorted(observed, voxel[best])]
    denying = _share(rows["denies"][in_cluster], member)[best] if len(best) else np.zeros(0)
    xi = np.where((denying > 0.5) & (parameters.mode == "default"), MERGE_XI_RESHAPED, parameters.xi)
    return np.sort(number[best[votes[best] > xi * cast]])


def _members(rows: Rows, cluster: Index, winner: Index) -> tuple[Rows, Index]:
    """The statements of the winning clusters, renumbered 0 … C-1, together and by report within each."""
    inside = np.flatnonzero(np.isin(cluster, winner))
    number = np.searchsorted(winner, cluster[inside])
    order = np.argsort(number, kind="stable")
    return rows[inside[order]], number[order]


def _representatives(rows: Rows, cluster: Index, parameters: MergeParameters) -> Rows:
    """GND 5.2: one row a cluster, by the recursive update of sample mean and covariance over its measured statements.

    A quoted Gaussian is no new measurement: it represents its cluster only where nobody measured, and then once.
    Measurements with much worse poses than the best of the cluster are left out.

    In default mode a representative is looked at anew when the number of its measurements has doubled (the first 1, 2,
    4, 8 … of them), and renewed only where the new one is less than `d_renewed` like it. Else every report would move
    every changed voxel by a hair, and each move is sent to all vehicles.
    """
    first = np.unique(cluster, return_index=True)[1]
    measured = _measured_well(rows, cluster)
    before: Index = np.cumsum(measured) - measured
    turn: Index = before - before[first][cluster]
    n = np.bincount(cluster, weights=measured).astype(np.int64)
    if parameters.has_paper_rules:
        use = measured.copy()
        use[first[n == 0]] = True
        return _recursive_moments(rows[use], cluster[use])
    use = measured & (turn == 0)
    use[first[n == 0]] = True
    found: Rows = rows[use]
    of = 2
    while of <= n.max(initial=0):
        many = np.flatnonzero(n >= of)
        use = measured & (turn < of) & (n >= of)[cluster]
        anew = _recursive_moments(rows[use], np.searchsorted(many, cluster[use]))
        renewed = _similarity(found[many], anew, parameters) < MERGE_D_RENEWED
        found[many[renewed]] = anew[renewed]
        of *= 2
    return found


def _measured_well(rows: Rows, cluster: Index) -> NDArray[np.bool_]:
    """Measured statements whose pose variance exceeds the least of their cluster by no more than `noise_m`²."""
    measured = rows["kind"] == Kind.MEASURED
    least = np.full(int(cluster.max(initial=-1)) + 1, np.inf)
    np.minimum.at(least, cluster[measured], rows["pose_m2"][measured])
    return np.asarray(measured & (rows["pose_m2"] <= least[cluster] + MERGE_NOISE_M**2))


def _recursive_moments(rows: Rows, cluster: Index) -> Rows:
    """Merge sample means and covariances (population form) of each cluster's rows, one member of all at a time."""
    first = np.unique(cluster, return_index=True)[1]
    turn = np.arange(len(rows)) - first[cluster]
    merged = rows[first]
    n = merged["count"].astype(np.int64)
    mean, cov = merged["mean_m"].astype(np.float64), merged["cov_m2"].astype(np.float64)
    for k in range(1, int(turn.max(initial=0)) + 1):
        new, c = rows[turn == k], cluster[turn == k]
        n[c] += new["count"]
        share = (new["count"] / n[c])[:, None]
        step = new["mean_m"] - mean[c]
        mean[c] += share * step
        cov[c] += share * (new["cov_m2"] - cov[c]) + share * (1 - share) * _outer(step)
    merged["pose_m2"] = np.bincount(cluster, weights=rows["pose_m2"]) / np.bincount(cluster) ** 2  # of their mean
    merged["count"] = np.minimum(n, np.iinfo(np.int32).max)
    np.maximum.at(merged["cells"], cluster, rows["cells"])
    merged["mean_m"], merged["cov_m2"] = mean, cov
    return merged


def _outer(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """V v^T of (N, 3) as (N, 6) xx, xy, xz, yy, yz, zz."""
    x, y, z = v.T
    return np.stack([x * x, x * y, x * z, y * y, y * z, z * z], axis=1)


def _differs(
    epoch: Gaussians, candidate: Rows, denying: NDArray[np.float64], parameters: MergeParameters
) -> NDArray[np.bool_]:
    """GND 5.3: a candidate is a change when its similarity to the base voxel is SMALLER than d_update.

    Where most of its statements were compared with that very voxel and deny it, anything less than equal will do.
    """
    was = states_at(epoch, candidate["voxel_id"], Kind.QUOTED)
    limit = np.where((denying > 0.5) & (parameters.mode == "default"), MERGE_D_DENIED, MERGE_D_UPDATE)
    return np.asarray(_similarity(was, candidate, parameters) < limit)


def _confirmed(rows: Rows, cluster: Index) -> NDArray[np.bool_]:
    """Clusters in which at least half of the statements quote the epoch's own voxel.

    Neighbours of neighbours share a cluster, so without this two changed measurements could carry a majority that says
    "as it was".
    """
    return np.asarray(_share((rows["kind"] == Kind.QUOTED) & (rows["was"] == EPOCH), cluster) >= 0.5)


def _share(mark: NDArray[np.bool_], cluster: Index) -> NDArray[np.float64]:
    """Share of marked statements in each cluster."""
    return np.asarray(np.bincount(cluster, weights=mark) / np.bincount(cluster))


def _said_by(
    voxel_id: NDArray[np.int32], statements: Statements, voxel: NDArray[np.int32], report: NDArray[np.int32]
) -> dict[int, tuple[str, ...]]:
    """Of each changed voxel the ids of the reports in the cluster that won; voxel and report of its statements."""
    ids = statements.report_ids
    spoken = report >= 0  # the support of what was published is nobody's report
    voxel, report = voxel[spoken], report[spoken]
    first = np.append(np.flatnonzero(np.append(True, voxel[1:] != voxel[:-1])[: len(voxel)]), len(voxel)).tolist()
    told: dict[bytes, tuple[str, ...]] = {}  # most voxels were told by the same reports
    found: dict[int, tuple[str, ...]] = dict.fromkeys(voxel_id.tolist(), ())
    for begin, end in pairwise(first):
        key = report[begin:end].tobytes()
        if key not in told:
            told[key] = tuple(dict.fromkeys(ids[k] for k in report[begin:end].tolist()))
        found[int(voxel[begin])] = told[key]
    return found
