"""Polylines that cross themselves, beside a plain twin in whole numbers that compares each segment with each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.gnd_map.errors import FeatureError
from gnd.gnd_map.features import check_simple_polyline
from gnd.gnd_map.features.polylines import MAX_PAIRS

Vertex = tuple[int, int]


def side(a: Vertex, b: Vertex, c: Vertex) -> int:
    """1 where c lies to the left of a → b, -1 to the right, 0 on the line."""
    v = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return (v > 0) - (v < 0)


def in_box(a: Vertex, b: Vertex, c: Vertex) -> bool:
    return all(min(a[k], b[k]) <= c[k] <= max(a[k], b[k]) for k in (0, 1))


def meet(a: Vertex, b: Vertex, c: Vertex, d: Vertex) -> bool:
    sides = side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)
    if sides[0] != sides[1] and sides[2] != sides[3]:
        return True
    ends = (a, b, c), (a, b, d), (c, d, a), (c, d, b)
    return any(s == 0 and in_box(*end) for s, end in zip(sides, ends, strict=True))


def turns_back(a: Vertex, b: Vertex, c: Vertex) -> bool:
    return side(a, b, c) == 0 and (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1]) < 0


def plain_twin(line: list[Vertex]) -> tuple[int, int] | None:
    n = len(line) - 1
    for i in range(n):
        for j in range(i + 1, n):
            if j == i + 1:
                if turns_back(line[i], line[j], line[j + 1]):
                    return i, j
            elif not (line[0] == line[-1] and (i, j) == (0, n - 1)) and meet(*line[i : i + 2], *line[j : j + 2]):
                return i, j
    return None


small = st.integers(0, 8)


@given(st.lists(st.tuples(small, small), min_size=2, max_size=9), st.booleans(), st.sampled_from([0.125, 0.001, 7.3]))
@settings(max_examples=400, deadline=None)
def test_the_same_segments_meet_as_in_whole_numbers(line: list[Vertex], close: bool, scale: float) -> None:
    line = [*line, line[0]] if close else line
    once = [vertex for k, vertex in enumerate(line) if k == 0 or vertex != line[k - 1]]
    expected = plain_twin(once)
    points_m = np.column_stack([np.array(once) * scale, np.arange(len(once))])
    if expected is None:
        check_simple_polyline("line", points_m)
        check_simple_polyline("line", np.array(line) * scale)  # vertices that repeat count once
    else:
        with pytest.raises(FeatureError, match=f"segments {expected[0]} and {expected[1]} of {len(once) - 1} meet"):
            check_simple_polyline("line", points_m)


def test_many_vertices_in_one_tile_are_compared_too() -> None:
    n = 4096
    x_m = np.where(np.arange(n) // 2 % 2, 10.0, -10.0)
    zigzag = np.column_stack([x_m, (np.arange(n) + 1) // 2 * 0.005, np.zeros(n)])
    check_simple_polyline("a zigzag", zigzag)
    zigzag[-1, 1] = 5.0
    with pytest.raises(FeatureError, match="and 4094 of 4095 meet"):
        check_simple_polyline("a zigzag whose end runs back", zigzag)


def test_strokes_that_lie_over_each_other_are_refused_before_each_pair_is_looked_at():
    """4,096 points to and fro, slanted: nothing crosses, and every box meets every other one."""
    k = np.arange(4096)
    side = np.where(k % 2 == 0, 0.0, 30.0)
    points_m = np.stack([side + 0.003 * (k // 2), side - 0.003 * (k // 2), 0.0 * k], axis=1)
    with pytest.raises(FeatureError, match=f"more than {MAX_PAIRS} pairs"):
        check_simple_polyline("line", points_m)
    check_simple_polyline("line", points_m[:300])
