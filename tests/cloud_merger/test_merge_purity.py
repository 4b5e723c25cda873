"""The merge against a plain twin, and its purity: the same reports in any order and batching give the same bits."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import (
    BALL,
    GROUND,
    GROUND_AGAIN,
    POLE,
    TILE,
    WALL,
    WALL_AGAIN,
    change_of,
    gaussians_of,
    report_of,
    sha_of,
)
from sklearn.cluster import DBSCAN

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.merge import MergeParameters, merge_tile
from gnd.cloud_merger.parameters import (
    MERGE_D_DENIED,
    MERGE_D_RENEWED,
    MERGE_D_UPDATE,
    MERGE_NOISE_M,
    MERGE_XI_RESHAPED,
)
from gnd.cloud_merger.statements import Report, statements_of
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians, Moments, concat
from gnd.gnd_map.similarity import similarity
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import split
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig

VOXELS = range(4)
EPOCH = gaussians_of({0: GROUND, 1: WALL})
OLDER = gaussians_of({0: GROUND, 2: POLE, 3: BALL})
LOST = gaussians_of({9: BALL})  # a version that the store has not
STATES = [None, GROUND, GROUND_AGAIN, WALL, WALL_AGAIN, POLE, BALL]


@st.composite
def changes(draw, bases=(EPOCH, OLDER, LOST, None)):
    observed = sorted(draw(st.sets(st.sampled_from(VOXELS))))
    changed = {v: draw(st.sampled_from(STATES)) for v in observed if draw(st.booleans())}
    gaussians = gaussians_of(changed, count=draw(st.integers(20, 1000)), cells=draw(st.sampled_from([20, 60, 10])))
    shift = draw(st.floats(-0.0625, 0.0625, width=32))
    moved = Gaussians(
        *gaussians.columns[:3], gaussians.mean_m + gaussians.exists[:, None] * np.float32(shift), gaussians.cov_m2
    )
    base = draw(st.sampled_from(bases))
    kind = draw(st.sampled_from([ChangeClass.MODIFIED, ChangeClass.MODIFIED, ChangeClass.UNMEASURED]))
    gone = [voxel for voxel, state in changed.items() if state is None]
    withheld = draw(st.sets(st.sampled_from(gone))) if gone and kind == ChangeClass.MODIFIED else ()
    return change_of(base, observed, moved, change_class=kind, withheld=sorted(withheld))


def plain_merge(epoch, reports, bases, parameters):
    """Voxel by voxel, as the paper tells it, with scikit-learn's DBSCAN on a full distance matrix."""
    parts, provenance = [], {}
    for voxel in sorted({*VOXELS, *epoch.voxel_id.tolist()}):
        was = epoch.select([voxel])
        votes = [
            ((r.report_id, r.weight, r.pose_m2), *vote)
            for r in sorted(reports, key=lambda r: r.report_id)
            if (vote := plain_vote(r, voxel, bases, parameters))
        ]
        now = plain_decision(was, votes, parameters)
        parts.append(was if now is None else now[0])
        if now is not None:
            provenance[voxel] = now[1]
    return concat(parts), provenance


def plain_vote(report, voxel, bases, parameters):
    """(state, is it measured, what stood there in its base), or nothing when it abstains; withheld: no state."""
    change = report.change
    if voxel not in change.observed:
        return None
    entry = change.changed.select([voxel])
    base = {**bases, b"": Gaussians.empty()}.get(change.base_sha)
    was = Gaussians.empty() if parameters.mode == "paper" or base is None else base.select([voxel])
    if len(entry):
        row = int(np.flatnonzero(change.changed.voxel_id == voxel)[0])
        if change.change_class[row] == ChangeClass.UNMEASURED or 0 < entry.cells[0] < 20:
            return None
        if change.change_class[row] == ChangeClass.MODIFIED and not entry.exists[0]:
            return None, False, was
        return entry.take(entry.exists), bool(entry.exists[0]), was
    if parameters.mode == "paper" or base is None:
        return None
    return was, False, was


def plain_distance(a, b, parameters):
    """1 - similarity; 1 where one quotes what the other was compared with and denies."""
    (by_one, one, one_measured, one_was), (by_two, two, two_measured, two_was) = a, b
    if one is two:
        return 0.0
    if one_measured != two_measured and len(one) and len(two) and len(one_was) and one_was == two_was:
        return 1.0
    pose_m2 = one_measured * by_one[2] + two_measured * by_two[2]
    return 1 - plain_similarity(one, two, parameters, pose_m2)


def plain_similarity(a, b, parameters, pose_m2=0.0):
    def one(g):
        return np.array([len(g) > 0]), *(g.columns[3:] if len(g) else (np.zeros((1, 3)), np.zeros((1, 6))))

    return float(similarity(*one(a), *one(b), parameters.mode, (MERGE_NOISE_M**2 + pose_m2) ** 0.5)[0])


def plain_decision(was, votes, parameters):
    shown = [k for k, vote in enumerate(votes) if vote[1] is not None]
    if not shown:
        return None
    distance = np.array([[plain_distance(votes[a], votes[b], parameters) for b in shown] for a in shown])
    label = np.full(len(votes), -1)
    label[shown] = (
        DBSCAN(eps=parameters.eps, min_samples=parameters.min_samples, metric="precomputed").fit(distance).labels_
    )
    weight = np.array([vote[0][1] for vote in votes])
    label = plain_joined(was, votes, weight, label)
    sizes = {cluster: weight[label == cluster].sum() for cluster in label if cluster >= 0}
    if not sizes:
        return None
    winner = min(sizes, key=lambda cluster: (-sizes[cluster], cluster))
    members = [vote for vote, cluster in zip(votes, label, strict=True) if cluster == winner]
    denying = sum((measured or state is None) and len(was) > 0 and base == was for _, state, measured, base in members)
    denied = 2 * denying > len(members)
    if not sizes[winner] > (MERGE_XI_RESHAPED if denied else parameters.xi) * weight.sum():
        return None
    now, pose_m2 = plain_representative(members, parameters)
    quotes = sum(quotes_epoch(was, vote) for vote in members)
    limit = MERGE_D_DENIED if denied else MERGE_D_UPDATE
    if plain_similarity(was, now, parameters, pose_m2) >= limit or 2 * quotes >= len(members):
        return None
    return now, tuple(report_id for (report_id, *_), *_ in members)


def quotes_epoch(was, vote):
    _, state, measured, _ = vote
    return not measured and state is not None and len(state) > 0 and state == was


def plain_joined(was, votes, weight, label):
    """Withheld votes go to the largest cluster of measurements of which less than half quotes the epoch."""
    open_to = {}
    for cluster in sorted(set(label) - {-1}):
        members = [vote for vote, of in zip(votes, label, strict=True) if of == cluster]
        if any(vote[2] for vote in members) and 2 * sum(quotes_epoch(was, vote) for vote in members) < len(members):
            open_to[cluster] = weight[label == cluster].sum()
    largest = min(open_to, key=lambda cluster: (-open_to[cluster], cluster), default=-1)
    return np.array([largest if vote[1] is None else of for vote, of in zip(votes, label, strict=True)])


def plain_representative(members, parameters):
    """The merged Gaussian and the variance of its mean by the poses."""
    measured = [(state, by[2]) for by, state, is_measured, _ in members if is_measured]
    if not measured:
        return members[0][1], 0.0
    best = min(pose_m2 for _, pose_m2 in measured)
    measured = [(state, pose_m2) for state, pose_m2 in measured if pose_m2 <= best + MERGE_NOISE_M**2]
    if parameters.mode == "paper":
        return plain_moments(measured)
    found = measured[0]
    for n in (2, 4, 8):
        if n <= len(measured):
            anew = plain_moments(measured[:n])
            if plain_similarity(found[0], anew[0], parameters, found[1] + anew[1]) < MERGE_D_RENEWED:
                found = anew
    return found


def plain_moments(measured):
    total = Moments.zeros(1)
    for state, _ in measured:
        total = total + Moments.of(state)
    return total.to_gaussians(measured[0][0].voxel_id), sum(pose_m2 for _, pose_m2 in measured) / len(measured) ** 2


@settings(max_examples=150, deadline=None)
@given(
    st.lists(changes(), max_size=7),
    st.sampled_from(["default", "paper"]),
    st.sampled_from([0.3, 0.5, 0.6]),
    st.integers(1, 3),
    st.lists(st.sampled_from([1.0, 0.5, 0.25]), min_size=7, max_size=7),
    st.lists(st.sampled_from([0.0, 0.0, 0.001, 0.01]), min_size=7, max_size=7),
)
def test_the_merge_is_that_of_the_plain_twin(some, mode, xi, min_samples, weights, poses):
    parameters = MergeParameters(mode=mode, xi=xi, min_samples=min_samples)
    poses = poses if mode == "default" else [0.0] * 7
    by = zip(some, weights, poses, strict=False)
    reports = [Report(f"{n:026d}", change, weight, pose_m2) for n, (change, weight, pose_m2) in enumerate(by)]
    bases = {sha_of(EPOCH): EPOCH, sha_of(OLDER): OLDER}
    got = merge_tile(EPOCH, statements_of(EPOCH, reports, bases, mode), parameters)
    expected, provenance = plain_merge(EPOCH, reports, bases, parameters)
    assert got.provenance == provenance
    assert got.changed.tolist() == sorted(provenance)
    for mine, plain in zip(got.gaussians.columns, expected.columns, strict=True):
        np.testing.assert_allclose(mine, plain, rtol=1e-5, atol=1e-7)


@settings(max_examples=100, deadline=None)
@given(st.lists(changes(), max_size=7), st.randoms(use_true_random=False))
def test_order_and_repetition_do_not_matter(some, random):
    reports = [Report(f"{n:026d}", change) for n, change in enumerate(some)]
    shuffled = reports + reports[: len(reports) // 2]
    random.shuffle(shuffled)
    bases = {sha_of(EPOCH): EPOCH, sha_of(OLDER): OLDER}
    one, two = (merge_tile(EPOCH, statements_of(EPOCH, r, bases)) for r in (reports, shuffled))
    assert Tile(TILE, 1, one.gaussians).sha == Tile(TILE, 1, two.gaussians).sha
    assert one.provenance == two.provenance


def rows_of(reports):
    return [
        ReportRow(r.report_id, r.layer, tile, r.vehicle, 0, body, base_sha=change.base_sha)
        for r in reports
        for change, (tile, body) in zip(r.tiles, split(r), strict=True)
    ]


def head_after(path, reports, cuts):
    """The head's hash when the reports come in these batches, each merged and published before the next."""
    config = ShardConfig(store_path=path)
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([Tile(TILE, 1, OLDER)])
        store.put_tiles([Tile(TILE, 2, EPOCH)])
        worker = Worker(store, config)
        for first, end in itertools.pairwise([0, *cuts, len(reports)]):
            store.put_reports(rows_of(reports[first:end]))
            while claims := store.claim("one", 4, 30.0):
                store.publish(worker.merge(claims))
        assert store.dirty_count() == 0
        head = store.get("ndt", TILE)
        return head.sha, store.voxel_provenance("ndt", TILE, head.version)


@settings(max_examples=15, deadline=None)
@given(some=st.lists(changes(bases=(EPOCH, OLDER, None)), min_size=1, max_size=6), data=st.data())
def test_any_batching_ends_in_the_same_tile_bit_for_bit(tmp_path_factory, some, data):
    folder = tmp_path_factory.mktemp("batching")
    reports = [report_of(n, change) for n, change in enumerate(some)]
    shuffled = data.draw(st.permutations(reports))
    cuts = sorted(data.draw(st.sets(st.integers(0, len(reports)))))
    assert head_after(folder / "one.sqlite", reports, [])[0] == head_after(folder / "many.sqlite", shuffled, cuts)[0]


@pytest.mark.parametrize("mode", ["default", "paper", "paper-observers"])
def test_a_batch_after_publication_ends_as_if_it_had_come_at_once(tmp_path, mode):
    reports = [
        report_of(n, change_of(EPOCH, [0, 1, 2], {1: WALL_AGAIN, 2: state}))
        for n, state in enumerate((POLE, BALL, POLE))
    ]
    apart, provenance = head_after(tmp_path / "a.sqlite", reports, [1, 2])
    together, _ = head_after(tmp_path / "b.sqlite", reports[::-1], [])
    assert apart == together
    assert provenance == {2: (reports[0].report_id, reports[2].report_id)}
