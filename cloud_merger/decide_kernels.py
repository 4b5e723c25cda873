"""What the statements of a tile decide, voxel by voxel in one kernel: GND 5.1 to 5.3 in "default" mode.

The plain twin is `cloud_merger.merge.plain_decisions`: the same sums in the same order, so the same bits. Arrays of a
few hundred rows cost numpy more in calls than in work; here a voxel costs what its statements do.
"""

from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.merge_kernels import label_voxels, most_in_a_voxel
from gnd.cloud_merger.parameters import (
    MERGE_D_DENIED,
    MERGE_D_RENEWED,
    MERGE_D_UPDATE,
    MERGE_NOISE_M,
    MERGE_XI_RESHAPED,
    MergeParameters,
)
from gnd.cloud_merger.statements import EPOCH, Kind, Rows, index_of
from gnd.gnd_map.arrays import F32, F64, I32, I64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.jit import kernel
from gnd.gnd_map.similarity import alike

U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Columns = tuple[I32, U8, I64, Mask, F64, F64, I32, I32, F32, F32]
"""Of the statements: voxel_id, kind, was, denies, weight, pose_m2, count, cells, mean_m, cov_m2."""
_COLUMNS: Final = ("voxel_id", "kind", "was", "denies", "weight", "pose_m2", "count", "cells", "mean_m", "cov_m2")
Epoch = tuple[I32, I32, F32, F32]
"""Of the epoch: voxel_id, count, mean_m, cov_m2."""
Found = tuple[Mask, Mask, I32, I32, I32, F32, F32]
"""Whether a statement is for a change, and for the epoch; of the decided voxels id, count, cells, mean_m, cov_m2."""
Rules = tuple[float, float, float, float, float, float]
"""noise_m2, xi, xi_reshaped, d_update, d_denied, d_renewed."""
_NOTHING, _QUOTED, _MEASURED, _WITHHELD = (int(kind) for kind in Kind)
_EPOCH: Final = EPOCH
_MOST: Final = int(np.iinfo(np.int32).max)


def decided(rows: Rows, epoch: Gaussians, parameters: MergeParameters) -> Found:
    """What the statements decide.

    Args:
        rows: STATEMENT (M,), sorted by voxel.
        epoch: the tile that they are merged into.
        parameters: the mode is taken to be "default".
    """
    columns = cast("Columns", tuple(rows[name].copy() for name in _COLUMNS))  # aligned, as fields of records are not
    rules = (
        MERGE_NOISE_M**2, parameters.xi, MERGE_XI_RESHAPED, MERGE_D_UPDATE, MERGE_D_DENIED, MERGE_D_RENEWED,
    )  # fmt: skip
    # of one kind, so that one kernel does for all
    ids, count = (np.require(one, requirements=["C", "W"]) for one in (epoch.voxel_id, epoch.count))
    mean_m, cov_m2 = (np.require(one, requirements=["C", "W"]) for one in (epoch.mean_m, epoch.cov_m2))
    return _decide(columns, (ids, count, mean_m, cov_m2), rules, parameters.eps, parameters.min_samples)


@kernel
def _decide(columns: Columns, epoch: Epoch, rules: Rules, eps: float, min_samples: int) -> Found:
    voxel_id, kind, was, _, _, pose_m2, count, _, mean_m, cov_m2 = columns
    rows = len(voxel_id)
    label = np.full(rows, -1, np.int64)
    label_voxels(voxel_id, kind, was, count, pose_m2, mean_m, cov_m2, rules[0], eps, min_samples, label)
    most = most_in_a_voxel(voxel_id)
    for_change, for_epoch = np.zeros(rows, np.bool_), np.zeros(rows, np.bool_)
    ids, counts, cells = np.empty(rows, np.int32), np.empty(rows, np.int32), np.empty(rows, np.int32)
    means, covs = np.empty((rows, 3), np.float32), np.empty((rows, 6), np.float32)
    votes, share = np.empty(most), np.empty((4, most))
    cell, mean, cov = np.empty(4, np.int64), np.empty((3, 3), np.float64), np.empty((3, 6), np.float64)
    n, begin = 0, 0
    while begin < rows:
        end = begin + 1
        while end < rows and voxel_id[end] == voxel_id[begin]:
            end += 1
        at = index_of(voxel_id[begin], epoch[0])
        winner = _winner(begin, end, columns, label, at >= 0, rules, votes, share, for_epoch)
        if winner >= 0 and _is_change(begin, end, winner, columns, label, at, epoch, rules, cell, mean, cov):
            for k in range(begin, end):
                for_change[k] = label[k] == winner
            ids[n], counts[n], cells[n] = voxel_id[begin], cell[0], cell[1]
            means[n], covs[n] = mean[0], cov[0]
            n += 1
        begin = end
    return for_change, for_epoch, ids[:n].copy(), counts[:n].copy(), cells[:n].copy(), means[:n].copy(), covs[:n].copy()


@kernel
def _winner(
    begin: int, end: int, columns: Columns, label: I64, is_mapped: bool, rules: Rules, votes: F64, share: F64,
    for_epoch: Mask,
) -> int:  # fmt: skip
    """The cluster that wins a voxel, -1: none. Withheld statements join theirs, and those for the epoch are marked."""
    _, kind, was, denies, weight, _, _, _, _, _ = columns
    first, last = _MOST, -1
    for k in range(begin, end):
        if label[k] >= 0:
            first, last = min(first, label[k]), max(last, label[k])
    if last < 0:
        return -1
    n = last - first + 1
    _join(begin, end, first, n, columns, label, votes, share)
    votes[:n], share[:, :n], cast = 0.0, 0.0, 0.0
    for k in range(begin, end):
        cast += weight[k]
        if label[k] >= 0:
            c = label[k] - first
            is_same = (kind[k] == _NOTHING and not is_mapped) or (kind[k] == _QUOTED and was[k] == _EPOCH)
            votes[c] += weight[k]
            share[0, c] += 1.0
            share[1, c] += 1.0 if denies[k] else 0.0
            share[2, c] += 1.0 if is_same else 0.0
    for k in range(begin, end):
        for_epoch[k] = label[k] >= 0 and share[2, label[k] - first] / share[0, label[k] - first] >= 0.5
    best = 0
    for c in range(1, n):
        if votes[c] > votes[best]:
            best = c
    xi = rules[2] if share[1, best] / share[0, best] > 0.5 else rules[1]
    return first + best if votes[best] > xi * cast else -1


@kernel
def _join(begin: int, end: int, first: int, n: int, columns: Columns, label: I64, votes: F64, share: F64) -> None:
    """Each withheld statement joins its voxel's largest cluster of measurements that is not the epoch's."""
    _, kind, was, _, weight, _, _, _, _, _ = columns
    votes[:n], share[:, :n] = 0.0, 0.0
    some = False
    for k in range(begin, end):
        some = some or kind[k] == _WITHHELD
        if label[k] >= 0:
            c = label[k] - first
            votes[c] += weight[k]
            share[0, c] += 1.0
            share[1, c] += 1.0 if kind[k] == _QUOTED and was[k] == _EPOCH else 0.0
            share[2, c] += 1.0 if kind[k] == _MEASURED else 0.0
    if not some:
        return
    best = -1
    for c in range(n):
        is_change = share[2, c] > 0.0 and share[1, c] / share[0, c] < 0.5
        if is_change and (best < 0 or votes[c] > votes[best]):
            best = c
    for k in range(begin, end):
        if kind[k] == _WITHHELD:
            label[k] = first + best if best >= 0 else -1


@kernel
def _is_change(
    begin: int, end: int, winner: int, columns: Columns, label: I64, at: int, epoch: Epoch, rules: Rules, cell: I64,
    mean: F64, cov: F64,
) -> bool:  # fmt: skip
    """Whether the winner differs from the epoch's voxel; its representative lies in the first rows of `cell` (count,
    cells), `mean` and `cov`, as float32 has it.
    """
    _, kind, was, denies, _, _, _, _, _, _ = columns
    size, confirming, denying = 0.0, 0.0, 0.0
    for k in range(begin, end):
        if label[k] == winner:
            size += 1.0
            confirming += 1.0 if kind[k] == _QUOTED and was[k] == _EPOCH else 0.0
            denying += 1.0 if denies[k] else 0.0
    if confirming / size >= 0.5:
        return False
    pose_m2 = _represent(begin, end, winner, columns, label, rules, cell, mean, cov)
    is_mapped = at >= 0 and epoch[1][at] > 0
    if is_mapped and cell[0] > 0:
        _put(epoch[2][at], epoch[3][at], mean[2], cov[2])
        noise_m = np.sqrt(rules[0] + 0.0 + pose_m2)
        like = alike(mean[2], cov[2], mean[0], cov[0], noise_m * noise_m, np.inf)
    else:
        like = 1.0 if is_mapped == (cell[0] > 0) else 0.0
    return bool(like < (rules[4] if denying / size > 0.5 else rules[3]))


@kernel
def _represent(
    begin: int, end: int, winner: int, columns: Columns, label: I64, rules: Rules, cell: I64, mean: F64, cov: F64
) -> float:
    """GND 5.2, `cloud_merger.merge._representatives` of one cluster: the variance by poses of what it finds. The second
    rows hold the moments of all measurements so far, the third ones are scratch.
    """
    _, kind, _, _, _, pose_m2, count, cells, mean_m, cov_m2 = columns
    least, lead = np.inf, -1
    for k in range(begin, end):
        if label[k] == winner:
            lead = k if lead < 0 else lead
            least = min(least, pose_m2[k]) if kind[k] == _MEASURED else least
    cell[0], cell[1] = count[lead], cells[lead]  # where nobody measured
    _put(mean_m[lead], cov_m2[lead], mean[0], cov[0])
    found_m2 = pose_m2[lead]
    n, looks, total, total_m2 = 0, 1, 0, 0.0
    for k in range(begin, end):
        if label[k] != winner or kind[k] != _MEASURED or not pose_m2[k] <= least + rules[0]:
            continue
        n, total, total_m2 = n + 1, total + count[k], total_m2 + pose_m2[k]
        cell[2] = max(cell[2], cells[k]) if n > 1 else cells[k]
        if n == 1:
            _put(mean_m[k], cov_m2[k], mean[1], cov[1])
            _take(cell, mean, cov, total)
            found_m2 = pose_m2[k]
            continue
        _add(count[k] / total, mean_m[k], cov_m2[k], mean[1], cov[1])
        if n == 2 * looks:
            looks, anew_m2 = n, total_m2 / (n * n)
            if _is_renewed(mean, cov, rules[0] + found_m2 + anew_m2, rules[5]):
                _take(cell, mean, cov, min(total, _MOST))
                found_m2 = anew_m2
    return float(found_m2)


@kernel
def _is_renewed(mean: F64, cov: F64, noise_m2: float, least: float) -> bool:
    """Whether the moments in the second rows, as float32 has them, are less like those found than this."""
    for i in range(3):
        mean[2, i] = np.float32(mean[1, i])
    for i in range(6):
        cov[2, i] = np.float32(cov[1, i])
    noise_m = np.sqrt(noise_m2)
    return bool(alike(mean[0], cov[0], mean[2], cov[2], noise_m * noise_m, np.inf) < least)


@kernel
def _put(from_mean: F32, from_cov: F32, mean: F64, cov: F64) -> None:
    for i in range(3):
        mean[i] = from_mean[i]
    for i in range(6):
        cov[i] = from_cov[i]


@kernel
def _take(cell: I64, mean: F64, cov: F64, count: int) -> None:
    """What is found now are the moments in the second rows, as float32 has them."""
    cell[0], cell[1] = count, cell[2]
    for i in range(3):
        mean[0, i] = np.float32(mean[1, i])
    for i in range(6):
        cov[0, i] = np.float32(cov[1, i])


@kernel
def _add(share: float, new_mean: F32, new_cov: F32, mean: F64, cov: F64) -> None:
    """The moments with those of one more member, which makes up this share of all."""
    x, y, z = new_mean[0] - mean[0], new_mean[1] - mean[1], new_mean[2] - mean[2]
    mean[0] += share * x
    mean[1] += share * y
    mean[2] += share * z
    both = share * (1 - share)
    cov[0] += share * (new_cov[0] - cov[0]) + both * (x * x)
    cov[1] += share * (new_cov[1] - cov[1]) + both * (x * y)
    cov[2] += share * (new_cov[2] - cov[2]) + both * (x * z)
    cov[3] += share * (new_cov[3] - cov[3]) + both * (y * y)
    cov[4] += share * (new_cov[4] - cov[4]) + both * (y * z)
    cov[5] += share * (new_cov[5] - cov[5]) + both * (z * z)
