"""What one vehicle alone claims is published while it is little; more waits for a second witness."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import GROUND, POLE, TILE, WALL, change_of, gaussians_of, report_of, seen_by, sha_of
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.confirmation import ConfirmationParameters, changes_together, gate
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.merge import MergeParameters, merge_tile
from gnd.cloud_merger.statements import Report, statements_of
from gnd.cloud_merger.stored import report_of as stored_report
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import split
from gnd.schemas.doubt import Doubt, DoubtReason
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig

VOXELS = range(300)
EPOCH = gaussians_of(dict.fromkeys(VOXELS, GROUND))
THIRD = dict.fromkeys(range(0, 300, 3), WALL)
FEW = dict.fromkeys(range(300, 308), POLE)  # new, side by side
HOUR_NS = 3_600_000_000_000


def said(number, changed, vehicle="", *, base=EPOCH, at_h=0, doubtful=False, pose_m2=0.0):
    """A report of a vehicle that has seen the whole tile."""
    change = change_of(base, sorted({*VOXELS, *changed}), changed)
    begin = at_h * HOUR_NS
    return Report(
        f"{number:026d}", change, 1.0, pose_m2, vehicle or f"car-{number}", begin, begin + 60_000_000_000, doubtful
    )


def gated(reports, epoch=EPOCH, named=frozenset(), **changed):
    bases = {sha_of(EPOCH): EPOCH}
    merged = merge_tile(epoch, statements_of(epoch, reports, bases))
    return gate(epoch, merged, reports, ConfirmationParameters(**changed), named)


def published(reports, **options):
    return gated(reports, **options).merged.changed.tolist()


def test_a_third_of_a_tile_that_one_vehicle_rewrites_waits():
    result = gated([said(1, THIRD)])
    assert result.merged.gaussians == EPOCH
    assert result.merged.provenance == {}
    (waiting,) = result.waiting
    assert (waiting.vehicle, waiting.voxels, waiting.seen, waiting.reason) == ("car-1", 100, 300, "share")
    assert waiting.report_ids == (f"{1:026d}",)


def test_confirmed_by_a_second_vehicle_it_is_published():
    result = gated([said(1, THIRD), said(2, THIRD)])
    assert result.merged.changed.tolist() == sorted(THIRD)
    assert result.waiting == ()


def test_contradicted_by_others_it_goes():
    result = gated([said(1, THIRD), said(2, {})])
    assert result.merged.gaussians == EPOCH
    assert result.waiting == ()


def test_in_one_window_no_drive_of_the_same_vehicle_confirms_another():
    assert published([said(1, THIRD, "car"), said(2, THIRD, "car", at_h=1)]) == []  # `test_windows`: in two it does
    assert published([said(1, THIRD, "car"), said(2, THIRD, "car")]) == []
    # A chain of passes in a row is one drive, however long it takes.
    chain = [said(n, THIRD, "car", at_h=n / 3) for n in range(9)]
    assert published(chain) == []


def test_a_named_vehicle_never_confirms_itself_and_its_lonely_claims_wait_all():
    both = [said(1, THIRD, "car"), said(2, THIRD, "car", at_h=1)]
    assert published(both, named=frozenset({"car"})) == []
    few = gated([said(1, FEW, "car")], named=frozenset({"car"}))
    assert [one.reason for one in few.waiting] == ["named"]
    assert published([said(1, FEW, "car"), said(2, FEW)], named=frozenset({"car"})) == sorted(FEW)
    assert published([said(1, FEW, "car"), said(2, FEW, "other")], named=frozenset({"car", "other"})) == []


def test_few_well_supported_claims_are_published_at_once():
    assert published([said(1, FEW)]) == sorted(FEW)
    assert published([said(1, FEW)], few_voxels=7, few_share=0.0) == []
    assert published([said(1, FEW)], few_voxels=0, few_share=0.03) == sorted(FEW)


def waiting_for(changed, epoch=EPOCH):
    """Voxels that wait, by reason, of what one vehicle claims."""
    return {one.reason: one.voxels for one in gated([said(1, changed)], epoch=epoch).waiting}


@pytest.mark.parametrize(
    ("changed", "waits"),
    [
        ({400: POLE}, {"isolated": 1}),
        ({400: POLE, 401: POLE}, {"isolated": 2}),
        ({400: POLE, 401: POLE, 402: POLE}, {}),
        ({400: POLE, 410: POLE, 420: POLE}, {"isolated": 3}),  # far from each other
        (dict.fromkeys(range(8), WALL), {"isolated": 8}),  # of another shape, no more
        ({0: WALL, 1: None, 2: None, 3: None, 9: None}, {"isolated": 1}),  # a shape goes with what has gone beside it
    ],
)
def test_what_a_lonely_vehicle_claims_of_single_voxels_waits(changed, waits):
    assert waiting_for(changed) == waits
    assert published([said(1, changed), said(2, changed)]) == sorted(changed), "a second vehicle confirms it"


def test_a_voxel_that_is_as_in_an_older_version_is_a_claim_that_was_seen():
    older = gaussians_of({400: POLE})
    report = Report("1" * 26, change_of(older, [400], {}), vehicle="car")
    merged = merge_tile(EPOCH, statements_of(EPOCH, [report], {sha_of(older): older}))
    (waiting,) = gate(EPOCH, merged, [report]).waiting
    assert (waiting.voxels, waiting.seen, waiting.reason) == (1, 1, "isolated")


def test_on_new_ground_single_voxels_do_not_wait():
    assert published([said(1, {400: POLE}, base=None)], epoch=Gaussians.empty()) == [400]


def test_few_claims_from_poor_poses_wait():
    (waiting,) = gated([said(1, FEW, pose_m2=0.2**2)]).waiting
    assert (waiting.voxels, waiting.reason) == (8, "poses")
    assert published([said(1, FEW, pose_m2=0.2**2), said(2, FEW, pose_m2=0.2**2)]) == sorted(FEW)


def test_doubtful_claims_wait_however_few_and_two_doubts_confirm_each_other():
    (waiting,) = gated([said(1, FEW, doubtful=True)]).waiting
    assert waiting.reason == "doubtful"
    assert published([said(1, FEW, doubtful=True), said(2, FEW)]) == sorted(FEW)
    assert published([said(1, THIRD, doubtful=True), said(2, THIRD, doubtful=True)]) == sorted(THIRD)


def test_what_one_sees_more_of_a_site_that_others_confirm_is_published_with_it():
    site, more = dict.fromkeys(range(100), WALL), dict.fromkeys(range(150), WALL)
    from_afar = Report("2" * 26, change_of(EPOCH, list(range(100)), site), vehicle="other")
    assert published([said(1, more), from_afar]) == sorted(more)
    unsure = said(1, more, doubtful=True, pose_m2=0.2**2)
    assert published([unsure, from_afar]) == sorted(more), "others have confirmed its poses"
    assert published([unsure, from_afar], named=frozenset({"car-1"})) == sorted(site)
    little = dict.fromkeys(range(10), WALL)
    from_afar = Report("2" * 26, change_of(EPOCH, list(range(10)), little), vehicle="other")
    assert published([said(1, more), from_afar]) == sorted(little)


def test_new_ground_is_mapped_by_one_vehicle_unless_it_doubts_itself():
    empty = Gaussians.empty()
    assert published([said(1, THIRD, base=None)], epoch=empty) == sorted(THIRD)
    assert published([said(1, THIRD, base=None, doubtful=True)], epoch=empty) == []
    assert published([said(1, THIRD, base=None)], epoch=empty, named=frozenset({"car-1"})) == []


@pytest.mark.parametrize(
    ("reasons", "on_the_map", "on_new_ground"),
    [
        (DoubtReason.IMPLAUSIBLE_SHARE, True, False),
        (DoubtReason.POSE_NOT_CHECKED, True, False),
        (DoubtReason.HEALTH_NOT_GOOD, True, True),
        (DoubtReason.POSE_NOT_CHECKED | DoubtReason.ESTIMATES_DISAGREE, True, True),
        (DoubtReason(1 << 20), True, True),  # of a newer vehicle
    ],
)
def test_on_new_ground_only_doubts_about_the_poses_count(reasons, on_the_map, on_new_ground):
    for base, expected in ((EPOCH, on_the_map), (None, on_new_ground)):
        change = replace(change_of(base, [*VOXELS, *FEW], FEW), doubt=Doubt(reasons))
        body = report_of(1, change).encode()
        assert stored_report(body, MergeParameters()).is_doubtful == expected


@pytest.mark.parametrize(
    "bad",
    [{"few_voxels": -1}, {"together_voxels": 0}, {"few_share": 1.5}],
)
def test_parameters_out_of_range_are_refused(bad):
    with pytest.raises(MergerError, match=next(iter(bad))):
        ConfirmationParameters(**bad)


def plain_waits(epoch, merged, reports, few):
    """Voxels that wait by share, told voxel by voxel; every vehicle drives once and is sure."""
    by_id = {report.report_id: report for report in reports}
    witnesses = {voxel: {by_id[one].vehicle for one in ids} for voxel, ids in merged.provenance.items()}
    waits = set()
    for vehicle in {report.vehicle for report in reports}:
        alone = {voxel for voxel, who in witnesses.items() if who == {vehicle}}
        together = {voxel for voxel, who in witnesses.items() if vehicle in who} - alone
        if len(together) < max(12, 0.5 * (len(together) + len(alone))):
            waits |= alone if len(alone) > few else alone & plain_isolated(epoch, merged)
    return waits


def plain_isolated(epoch, merged):
    """Voxels in whose group of neighbours fewer than three appear or vanish, found by walking from each of them."""
    grid, there = VoxelGrid.of(TILE), set(merged.gaussians.voxel_id.tolist())
    at = {voxel: np.array([int(axis[0]) for axis in grid.unravel(np.int32([voxel]))]) for voxel in merged.provenance}
    isolated = set()
    for voxel in at:
        group = {voxel}
        while more := {a for a in at for b in group if np.abs(at[a] - at[b]).max() <= 1} - group:
            group |= more
        if sum((one in there) != (one in set(epoch.voxel_id.tolist())) for one in group) < 3:
            isolated.add(voxel)
    return isolated


@settings(max_examples=60, deadline=None)
@given(
    claims=st.lists(
        st.tuples(
            st.sampled_from("abc"),
            st.dictionaries(st.integers(0, 39), st.sampled_from([WALL, POLE, None]), max_size=12),
        ),
        max_size=6,
    ),
    random=st.randoms(use_true_random=False),
)
def test_the_gate_is_that_of_the_plain_twin_in_any_order(claims, random):
    reports = [
        Report(f"{n:026d}", change_of(EPOCH, sorted({*range(n, 30), *changed}), changed), vehicle=vehicle)
        for n, (vehicle, changed) in enumerate(claims)
    ]
    merged = merge_tile(EPOCH, statements_of(EPOCH, reports, {sha_of(EPOCH): EPOCH}))
    parameters = ConfirmationParameters(few_voxels=4, few_share=0.0)
    one = gate(EPOCH, merged, reports, parameters)
    waits = plain_waits(EPOCH, merged, reports, 4)
    assert sorted(set(merged.changed.tolist()) - waits) == one.merged.changed.tolist()
    assert sum(told.voxels for told in one.waiting) == len(waits)
    held = np.array(sorted(waits), np.int32)
    assert one.merged.gaussians.select(held) == EPOCH.select(held)
    random.shuffle(reports)
    other = gate(EPOCH, merged, reports, parameters)
    assert (other.waiting, other.merged.gaussians) == (one.waiting, one.merged.gaussians)


def put(store, *reports):
    for report in reports:
        ((tile, body),) = split(report)
        sha = report.tiles[0].base_sha
        store.put_reports(
            [ReportRow(report.report_id, "ndt", tile, report.vehicle, report.last_ns, body, base_sha=sha)]
        )


def merge_all(store):
    worker = Worker(store, ShardConfig(store_path=store.path))
    while claims := store.claim("one", 4, 30.0):
        store.publish(worker.merge(claims))


def whole(number, changed, vehicle=""):
    told = seen_by(vehicle or f"car-{number}", changed)
    return report_of(number, change_of(EPOCH, sorted({*VOXELS, *changed}), told), vehicle=vehicle)


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([Tile(TILE, 1, EPOCH)])
        yield store


def test_the_store_tells_what_waits_until_it_is_confirmed(store):
    one = whole(1, THIRD)
    put(store, one)
    merge_all(store)
    assert store.get("ndt", TILE).version == 1
    (waiting,) = store.waiting_changes()
    assert (waiting.tile, waiting.vehicle, waiting.voxels, waiting.since_ns) == (TILE, "car-1", 100, one.last_ns)
    put(store, whole(2, THIRD))
    merge_all(store)
    assert store.waiting_changes() == []
    assert store.get("ndt", TILE).version == 2


def test_nothing_waits_after_a_rollback_or_a_new_base(store):
    for begin_anew in (
        lambda: store.rollback("ndt", TILE, 1),
        lambda: store.put_tiles([Tile(TILE, 9, EPOCH.take([0]))]),
    ):
        put(store, whole(len(store.history("ndt", TILE)), THIRD))
        merge_all(store)
        assert len(store.waiting_changes()) == 1
        begin_anew()
        assert store.waiting_changes() == []


@settings(max_examples=10, deadline=None)
@given(random=st.randoms(use_true_random=False), cuts=st.sets(st.integers(0, 4)))
def test_any_batching_ends_in_the_same_tile_and_the_same_waiting(tmp_path_factory, random, cuts):
    more = dict.fromkeys(range(1, 300, 5), POLE)
    reports = [whole(1, THIRD, "a"), whole(2, more, "a"), whole(3, more, "b"), whole(4, FEW, "c")]
    ends = []
    for order, ends_of_batches in ((reports, {4}), (random.sample(reports, 4), cuts | {4})):
        folder = tmp_path_factory.mktemp("batches")
        with SqliteStore(folder / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
            store.put_tiles([Tile(TILE, 1, EPOCH)])
            first = 0
            for end in sorted(ends_of_batches):
                put(store, *order[first:end])
                merge_all(store)
                first = end
            ends.append((store.get("ndt", TILE).sha, store.waiting_changes()))
    assert ends[0] == ends[1]


@settings(max_examples=100, deadline=None)
@given(st.sets(st.tuples(*[st.integers(0, 5)] * 3), max_size=60), st.integers(0, 2**32 - 1))
def test_groups_of_changes_are_those_of_the_graph(cells, seed):
    at = np.array(sorted(cells, key=lambda cell: cell[::-1]), np.int64).reshape(-1, 3)
    counts = np.random.default_rng(seed).random(len(at)) < 0.5
    beside = np.abs(at[:, None] - at[None]).max(axis=2, initial=0) <= 1
    _, group = connected_components(csr_array(beside), directed=False)
    expected = np.bincount(group, counts, max(len(at), 1))[group]
    np.testing.assert_array_equal(changes_together(*np.ascontiguousarray(at.T), counts), expected)
