"""The clusters of the kernel against those over arrays of all pairs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.cloud_merger import decide_kernels, merge
from gnd.cloud_merger.decide_kernels import decided
from gnd.cloud_merger.merge import plain_clusters, plain_decisions
from gnd.cloud_merger.merge_kernels import NOISE, clusters_of
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.statements import EPOCH, STATEMENT, Kind
from gnd.gnd_map.gaussian import Gaussians

KINDS = [Kind.NOTHING, Kind.QUOTED, Kind.MEASURED, Kind.MEASURED, Kind.MEASURED, Kind.WITHHELD]


def covariances(rng, n):
    """(N, 6) of balls, planes and lines in any attitude, the thinnest of no thickness."""
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    deviation_m = rng.choice([0.0, 0.01, 0.05, 0.28], (n, 3))
    full = (axes * deviation_m[:, None, :] ** 2) @ axes.transpose(0, 2, 1)
    six = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    six[:, [0, 3, 5]] = np.maximum(six[:, [0, 3, 5]], 0.0)
    return six.astype(np.float32)


@st.composite
def statements(draw):
    """Statements of a few voxels: some alike, some apart, some that deny others, some with poor poses."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    sizes = draw(st.lists(st.integers(1, 12), min_size=0, max_size=6))
    n = sum(sizes)
    rows = np.zeros(n, STATEMENT)
    rows["voxel_id"] = np.repeat(np.arange(len(sizes)) - 2, sizes)
    rows["kind"] = rng.choice(KINDS, n)
    rows["was"] = rng.integers(0, draw(st.sampled_from([1, 2, 4])), n)
    there = np.isin(rows["kind"], (Kind.QUOTED, Kind.MEASURED))
    rows["count"] = np.where(there, 40, 0)
    rows["pose_m2"] = np.where(rows["kind"] == Kind.MEASURED, rng.choice([0.0, 0.01, 0.3], n), 0.0)
    spread_m = draw(st.sampled_from([0.02, 0.1, 0.4]))
    rows["mean_m"] = np.where(there[:, None], rng.normal(0.0, spread_m, (n, 3)), 0.0)
    forms = covariances(rng, 3)
    rows["cov_m2"] = np.where(there[:, None], forms[rng.integers(0, draw(st.sampled_from([1, 3])), n)], 0.0)
    return rows


@settings(max_examples=200, deadline=None)
@given(statements(), st.sampled_from([0.05, 0.3, 0.7, 0.95]), st.integers(1, 5))
def test_labels_are_those_over_all_pairs(rows, eps, min_samples):
    parameters = MergeParameters(eps=eps, min_samples=min_samples)
    np.testing.assert_array_equal(clusters_of(rows, parameters), plain_clusters(rows, parameters))


def wall_at(offsets_m, voxel_id=0):
    """Measured walls of one voxel, so far along their normal."""
    rows = np.zeros(len(offsets_m), STATEMENT)
    rows["voxel_id"], rows["kind"], rows["count"] = voxel_id, Kind.MEASURED, 40
    rows["mean_m"][:, 0] = offsets_m
    rows["cov_m2"] = (0.0004, 0.0, 0.0, 0.08, 0.0, 0.08)
    return rows


def test_a_chain_is_one_cluster_and_the_number_goes_by_the_first_report():
    rows = np.concatenate([wall_at([0.24, 0.0, 0.08, 0.16]), wall_at([0.0, 0.4], 1)])
    assert clusters_of(rows, MergeParameters()).tolist() == [0, 0, 0, 0, 1, 2]
    assert clusters_of(rows, MergeParameters(eps=0.3)).tolist() == [0, 1, 2, 3, 4, 5]


def test_what_is_withheld_and_what_is_alone_is_no_cluster():
    rows = wall_at([0.0, 0.01, 0.5, 0.0])
    rows["kind"][3], rows["count"][3] = Kind.WITHHELD, 0
    rows[["mean_m", "cov_m2"]][3] = 0.0
    assert clusters_of(rows, MergeParameters(min_samples=2)).tolist() == [0, 0, NOISE, NOISE]
    assert clusters_of(rows, MergeParameters()).tolist() == [0, 0, 1, NOISE]


def test_a_measurement_that_denies_what_another_quotes_is_not_its_neighbour():
    rows = wall_at([0.0, 0.0])
    rows["kind"][0], rows["was"] = Kind.QUOTED, 1
    assert clusters_of(rows, MergeParameters()).tolist() == [0, 1]
    rows["was"][1] = 2
    assert clusters_of(rows, MergeParameters()).tolist() == [0, 0]


@st.composite
def votes(draw):
    """Statements with votes, counts of their own and denials, and an epoch that holds some of their voxels."""
    rows = draw(statements())
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = len(rows)
    rows["weight"] = rng.choice([1.0, 0.5, 0.3], n)
    rows["denies"] = (rows["was"] == EPOCH) & np.isin(rows["kind"], (Kind.MEASURED, Kind.WITHHELD))
    rows["report"] = rng.integers(-1, 5, n)
    there = rows["count"] > 0
    rows["count"] = np.where(there, rng.choice([20, 700, 2**31 - 1], n), 0)
    rows["cells"] = np.where(there, rng.integers(10, 60, n), 0)
    ids = np.unique(rows["voxel_id"])
    held = np.array([*ids[rng.random(len(ids)) < 0.6], 77], np.int32)
    m = len(held)
    mean_m = rng.normal(0.0, 0.1, (m, 3)).astype(np.float32)
    return rows, Gaussians(held, np.full(m, 40, np.int32), np.full(m, 20, np.int32), mean_m, covariances(rng, m))


@settings(max_examples=400, deadline=None)
@given(votes(), st.sampled_from([0.3, 0.7]), st.integers(1, 3), st.sampled_from([0.0, 0.5, 0.9]))
def test_decisions_are_those_over_arrays_of_rows_to_the_bit(given_, eps, min_samples, share):
    rows, epoch = given_
    parameters = MergeParameters(eps=eps, min_samples=min_samples, xi=share)
    with pytest.MonkeyPatch.context() as patch:
        for module in (merge, decide_kernels):
            patch.setattr(module, "MERGE_XI_RESHAPED", share / 2)
            patch.setattr(module, "MERGE_D_RENEWED", 0.99)
        for mine, plain in zip(decided(rows, epoch, parameters), plain_decisions(rows, epoch, parameters), strict=True):
            assert mine.dtype == plain.dtype
            np.testing.assert_array_equal(mine, plain)
