"""Crossings of two lines against a plain twin that asks on which side of each other the ends of segments lie."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.tile_store.feature_io.lane_crossing import crossing_of


def side(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> float:
    return float((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]))


def plain(a: np.ndarray, b: np.ndarray) -> set[tuple[int, int]]:
    """All pairs of segments whose ends lie on different sides of each other."""
    return {
        (i, j)
        for i in range(len(a) - 1)
        for j in range(len(b) - 1)
        if side(a[i], a[i + 1], b[j]) * side(a[i], a[i + 1], b[j + 1]) < 0
        and side(b[j], b[j + 1], a[i]) * side(b[j], b[j + 1], a[i + 1]) < 0
    }


lines = st.lists(st.tuples(st.integers(-20, 20), st.integers(-20, 20)), min_size=2, max_size=12)


@settings(max_examples=200, deadline=None)
@given(lines, lines)
def test_crossings_are_those_of_the_plain_twin(a: list[tuple[int, int]], b: list[tuple[int, int]]) -> None:
    first, second = np.array(a, np.float64), np.array(b, np.float64)
    found, expected = crossing_of(first, second), plain(first, second)
    assert (found is None) == (not expected)
    assert found is None or found in expected


def test_lines_that_share_an_end_do_not_cross() -> None:
    assert crossing_of(np.array([[0.0, 0], [10, 0]]), np.array([[0.0, 0], [10, 5]])) is None
    assert crossing_of(np.array([[0.0, 0], [10, 0]]), np.array([[10.0, 0], [10, 5]])) is None
