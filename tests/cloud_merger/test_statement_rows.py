"""The statements of a window, laid out in a kernel, against those made report by report."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import TILE, change_of, gaussians_of

from gnd.cloud_merger.statements import EPOCH, STATEMENT, Kind, Report, changed_of, find, statements_of, states_at
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import content_sha, diff

GROUND, WALL = (0.0, 0.0, -0.2, 0.28, 0.28, 0.02), (0.3, 0.0, 0.0, 0.02, 0.28, 0.28)
VOXELS = 24


def some_gaussians(rng):
    ids = np.flatnonzero(rng.random(VOXELS) < 0.6)
    return gaussians_of({int(i): (GROUND, WALL)[rng.integers(2)] for i in ids}, cells=int(rng.choice([40, 60])))


def some_change(rng, base):
    states = {int(i): (None, GROUND, WALL)[rng.integers(3)] for i in np.flatnonzero(rng.random(VOXELS) < 0.4)}
    observed = sorted({*states, *np.flatnonzero(rng.random(VOXELS) < 0.7).tolist()})
    change = change_of(base, observed, gaussians_of(states, cells=int(rng.choice([2, 60]))))
    kinds = [ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED, ChangeClass.UNMEASURED]
    return replace(change, change_class=rng.choice(kinds, len(states)).astype(np.uint8))


def plain_rows(epoch, reports, bases):
    """Of each voxel that a report changes or whose base is not the epoch: what each report that observed it says."""
    known = {b"": Gaussians.empty(), **bases}
    used = {one.change.base_sha for one in reports} & set(known)
    deltas = [diff(epoch, known[sha]) for sha in used]
    differs = {int(voxel) for delta in deltas for voxel in (*delta.removed, *delta.put.voxel_id)}
    voxels = sorted({*differs, *(int(v) for one in reports for v in one.change.changed.voxel_id)})
    rows = []
    for voxel in voxels:
        numbers = numbered(voxel, epoch, known)
        for k, report in enumerate(sorted(reports, key=lambda one: one.report_id)):
            row = said_of(voxel, report, numbers.get(report.change.base_sha), known)
            if row is not None:
                row["report"], row["weight"] = k, report.weight
                row["pose_m2"] = report.pose_m2 if row["kind"] == Kind.MEASURED else 0.0
                rows.append(row)
    return np.concatenate([np.zeros(0, STATEMENT), *rows])


def state(gaussians, voxel):
    at = find(gaussians.voxel_id, np.array([voxel], np.int32))[0]
    if at < 0 or gaussians.count[at] == 0:
        return None
    return gaussians.count[at].item(), gaussians.mean_m[at].tobytes(), gaussians.cov_m2[at].tobytes()


def numbered(voxel, epoch, known):
    """0: nothing, 1: as the epoch, else one number for equal states."""
    seen = {None: 0, state(epoch, voxel) or "nothing": EPOCH}
    found = {}
    for number, (sha, base) in enumerate(sorted(known.items()), start=2):
        found[sha] = seen.setdefault(state(base, voxel), number)
    return found


def said_of(voxel, report, was, known):
    change, voxels = report.change, np.array([voxel], np.int32)
    if voxel not in change.observed:
        return None
    changed = changed_of(change)
    at = find(changed.rows["voxel_id"], voxels)[0]
    if at < 0:
        if was is None:
            return None
        row = states_at(known[change.base_sha], voxels, Kind.QUOTED)
        row["was"] = was
        return row
    if not changed.speaks[at]:
        return None
    row = changed.rows[at : at + 1].copy()
    row["was"], row["claim"] = was or 0, True
    row["denies"] = was == EPOCH and changed.denies[at]
    return row


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=150, deadline=None)
def test_the_kernel_lays_out_what_each_report_says(seed):
    rng = np.random.default_rng(seed)
    bases = [some_gaussians(rng) for _ in range(3)]
    told = [*bases, None]
    reports = [
        Report(f"{n:02d}", some_change(rng, told[rng.integers(4)]), float(rng.choice([1.0, 0.5])), float(rng.random()))
        for n in rng.permutation(rng.integers(0, 7))
    ]
    known = {content_sha(TILE, base): base for base in bases[: rng.integers(1, 4)]}  # one may have gone
    found = statements_of(bases[0], reports, known).rows
    expected = plain_rows(bases[0], reports, known)
    for name in STATEMENT.names:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
