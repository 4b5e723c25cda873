import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.cloud_merger.cluster import dbscan, dbscan_sklearn
from gnd.gnd_map.similarity import pairs_within


@st.composite
def graphs(draw):
    sizes = draw(st.lists(st.integers(1, 7), min_size=1, max_size=6))
    group = np.repeat(np.arange(len(sizes)), sizes)
    i, j = pairs_within(group)
    keep = np.array(draw(st.lists(st.booleans(), min_size=len(i), max_size=len(i))), bool)
    i, j = i[keep], j[keep]
    distances = st.sampled_from([0.0, 0.1, 0.3, 0.4999999, 0.5, 0.5000001, 0.9, 1.0])
    distance = np.array(draw(st.lists(distances, min_size=len(i), max_size=len(i))), np.float64)
    weight = np.array(draw(st.lists(st.integers(1, 4), min_size=len(group), max_size=len(group))), np.int64)
    return weight, i, j, distance


@settings(max_examples=200, deadline=None)
@given(graphs(), st.integers(1, 6), st.sampled_from([0.3, 0.5, 0.7]))
def test_labels_are_those_of_scikit_learn(graph, min_samples, eps):
    fast = dbscan(*graph, eps=eps, min_samples=min_samples)
    np.testing.assert_array_equal(fast, dbscan_sklearn(*graph, eps=eps, min_samples=min_samples))


def test_a_chain_of_neighbours_is_one_cluster_and_groups_never_mix():
    i, j = np.array([0, 1, 3]), np.array([1, 2, 4])
    label = dbscan(np.ones(5, np.int64), i, j, np.array([0.4, 0.5, 0.0]), eps=0.5, min_samples=1)
    assert label.tolist() == [0, 0, 0, 1, 1]


def test_a_border_point_between_two_clusters_goes_to_the_first_and_a_lonely_point_is_noise():
    weight = np.array([3, 2, 1, 2, 3, 1])  # 1 and 3 have 6 around them, 0, 2 and 4 have 5, 5 is alone
    i, j = np.array([0, 1, 2, 3]), np.array([1, 2, 3, 4])
    label = dbscan(weight, i, j, np.full(4, 0.1), eps=0.5, min_samples=6)
    assert label.tolist() == [0, 0, 0, 1, 1, -1]


def test_nothing_has_no_clusters():
    none = np.zeros(0, np.int64)
    assert len(dbscan(none, none, none, np.zeros(0), eps=0.5, min_samples=1)) == 0
