"""What is wanted is read off without making statements of all: here beside the statements, which are its oracle."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import TILE, change_of, gaussians_of

from gnd.cloud_merger.expanding import is_askable
from gnd.cloud_merger.memory import VOXEL, TileMemory
from gnd.cloud_merger.parameters import MERGE_XI_RESHAPED, MergeParameters
from gnd.cloud_merger.statements import Kind, Report, statements_of
from gnd.cloud_merger.votes import TileVotes
from gnd.cloud_merger.wants import WANT_SHARE, Known, WantParameters, _promised, _sample, _wanted_of_tile
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.day import day_of
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import content_sha

GROUND, WALL = (0.0, 0.0, -0.2, 0.28, 0.28, 0.02), (0.3, 0.0, 0.0, 0.02, 0.28, 0.28)


def by_statements(own, reports, known, merge, want):
    """The plain way: all statements of all reports, then those about the flagged voxels."""
    asked = is_askable(own.change)
    ids, modified = own.change.changed.voxel_id[asked], own.change.change_class[asked] == ChangeClass.MODIFIED
    others = [report for report in reports if report.report_id != own.report_id]
    statements = statements_of(known.epoch, [*others, own], known.bases, merge.mode, known.memory)
    rows = statements.rows[np.isin(statements.rows["voxel_id"], ids)]
    seat = np.searchsorted(ids, rows["voxel_id"])
    is_own = rows["report"] == statements.report_ids.index(own.report_id)
    was = np.zeros(len(ids), np.int64)
    was[seat[is_own]] = rows["was"][is_own]
    rows, seat = rows[~is_own], seat[~is_own]
    quotes = (rows["kind"] == Kind.QUOTED) & (rows["was"] == was[seat])
    may_agree = (rows["kind"] != Kind.NOTHING) & ~quotes
    votes = own.weight + np.bincount(seat, rows["weight"] * may_agree, len(ids))
    cast = own.weight + np.bincount(seat, rows["weight"], len(ids))
    measured = may_agree & (rows["kind"] == Kind.MEASURED) & (rows["was"] == was[seat])
    in_hand = np.bincount(seat, measured, len(ids)) + _promised(known.promised, ids)
    xi = np.where(modified & (merge.mode == "default"), MERGE_XI_RESHAPED, merge.xi)
    may_win = votes > WANT_SHARE * xi * cast
    anyway = _sample(~may_win, 0 if merge.mode == "paper" else want.sample)
    return (may_win & (in_hand < want.enough)) | anyway


def any_base(rng):
    ids = np.flatnonzero(rng.random(24) < 0.6)
    return gaussians_of({int(i): (GROUND, WALL)[rng.integers(2)] for i in ids}, cells=int(rng.choice([40, 60])))


def any_change(rng, base):
    ids = np.flatnonzero(rng.random(24) < 0.4)
    states = {int(i): (None, GROUND, WALL)[rng.integers(3)] for i in ids}
    observed = sorted({*states, *np.flatnonzero(rng.random(24) < 0.7).tolist()})
    change = change_of(base, observed, gaussians_of(states, cells=int(rng.choice([2, 60]))))
    n = len(states)
    kinds = rng.choice([ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED, ChangeClass.UNMEASURED], n)
    return replace(change, change_class=kinds.astype(np.uint8))


def any_memory(rng):
    """Of none, or of some voxels: confirmed by some, on the day of the reports."""
    ids = np.flatnonzero(rng.random(24) < rng.choice([0.0, 0.5]))
    voxels = np.zeros(len(ids), VOXEL)
    voxels["voxel_id"], voxels["observers"], voxels["day"] = ids, rng.integers(0, 9, len(ids)), day_of(0)
    return TileMemory(voxels)


def withheld(report):
    """As flags stand for it: without Gaussians."""
    ids = report.change.changed.voxel_id
    return replace(report, change=replace(report.change, changed=Gaussians.nothing_at(ids)))


@given(st.integers(0, 2**32 - 1), st.sampled_from(["default", "paper"]))
@settings(max_examples=200, deadline=None)
def test_what_is_wanted_is_what_all_statements_say(seed, mode):
    rng = np.random.default_rng(seed)
    bases = [any_base(rng) for _ in range(3)]
    told = [*bases, None]
    reports = [  # weights whose sums are exact: a tie is one in whatever order they are added
        Report(f"{n:02d}", any_change(rng, told[rng.integers(4)]), weight=float(rng.choice([1.0, 0.5, 0.25])))
        for n in rng.permutation(rng.integers(1, 9))
    ]
    reports.insert(0, replace(reports[0], change=any_change(rng, bases[0])))  # it comes again
    own, split = withheld(reports.pop()), int(rng.integers(0, 9))
    known = Known(
        epoch=bases[0],
        votes=TileVotes.of(reports[:split]).with_reports(reports[split:]),
        bases={content_sha(TILE, base): base for base in bases[: rng.integers(1, 4)]},  # one may have gone
        promised=rng.integers(0, 24, rng.integers(0, 9)).astype(np.int32),
        memory=any_memory(rng) if mode == "default" else TileMemory(),
    )
    merge = MergeParameters(mode=mode)
    want = WantParameters(enough=int(rng.integers(0, 4)), sample=int(rng.choice([0, 2])))
    _, found = _wanted_of_tile(own, known, merge, want)
    assert found.tolist() == by_statements(own, reports, known, merge, want).tolist()
