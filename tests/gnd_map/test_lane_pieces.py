"""Lines in pieces of the grid: the same for every vehicle, whole, in their tiles; and pieces beside each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.gnd_map.errors import FeatureError
from gnd.gnd_map.features.lane_pieces import beside, lane_pieces, left_of
from gnd.gnd_map.geodesy import LocalFrame

FRAME = LocalFrame(np.radians(37.56), np.radians(127.035), 50.0)


def _line(heading, length=120.0, left=0.0, start=0.0, step=3.0):
    s = np.arange(start, start + length, step)
    t = np.array([np.cos(heading), np.sin(heading)])
    xy = s[:, None] * t + left * np.array([-t[1], t[0]])
    return FRAME.geodetic_from_enu(np.column_stack([xy, np.zeros(len(s))]))


@settings(max_examples=40, deadline=None)
@given(heading=st.floats(-3.1, 3.1), start=st.floats(0.0, 7.0), step=st.floats(0.5, 9.0))
def test_however_a_line_is_sampled_its_pieces_are_the_same(heading, start, step):
    if abs(abs(np.tan(heading)) - 1.0) < 0.02:
        return
    one = {piece.cell: piece for piece in lane_pieces(*_line(heading))}
    other = {piece.cell: piece for piece in lane_pieces(*_line(heading, 100.0, 0.0, start, step))}
    assert len(other) >= 10
    assert set(other) <= set(one)
    for cell, piece in other.items():
        assert piece.tile == one[cell].tile
        assert piece.points_m == pytest.approx(one[cell].points_m, abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(heading=st.floats(-3.1, 3.1), left=st.floats(-0.3, 0.3))
def test_drives_that_err_across_have_pieces_beside_each_other(heading, left):
    if abs(abs(np.tan(heading)) - 1.0) < 0.02:
        return
    one = {piece.cell: piece for piece in lane_pieces(*_line(heading))}
    matched = 0
    for piece in lane_pieces(*_line(heading, left=left)):
        same = one.get(piece.cell)
        if same is None or same.tile != piece.tile or np.hypot(*(same.points_m[1] - same.points_m[0])[:2]) < 1.5:
            continue
        overlap, lateral = beside(same.points_m, piece.points_m)
        matched += 1
        assert overlap > 0.5
        assert abs(lateral) == pytest.approx(abs(left), abs=1e-4)
    assert matched >= 12


def test_a_line_backwards_has_the_same_pieces():
    lat, lon, height = _line(0.5)
    there, back = lane_pieces(lat, lon, height), lane_pieces(lat[::-1].copy(), lon[::-1].copy(), height[::-1].copy())
    assert [one.cell for one in there] == [one.cell for one in back][::-1]
    assert all(a.points_m == pytest.approx(b.points_m, abs=1e-5) for a, b in zip(there, back[::-1], strict=True))


def test_pieces_lie_in_their_tiles_and_are_some_metres_long():
    for heading in np.linspace(-3.0, 3.0, 23):
        for piece in lane_pieces(*_line(heading, 200.0)):
            assert np.abs(piece.points_m[:, :2]).max() < 19.2 + 1.0
            assert np.hypot(*(piece.points_m[1] - piece.points_m[0])[:2]) < 7.0


def test_bad_lines_are_refused():
    with pytest.raises(FeatureError, match="1 vertices"):
        lane_pieces(np.zeros(1), np.zeros(1), np.zeros(1))
    with pytest.raises(Exception, match=r"finite|nan"):
        lane_pieces(np.array([0.0, np.nan]), np.zeros(2), np.zeros(2))
    with pytest.raises(FeatureError, match="at most"):
        lane_pieces(np.zeros(2), np.array([0.0, 3.0]), np.zeros(2))


def test_what_lies_ahead_is_not_beside():
    piece = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    assert beside(piece, piece + np.array([5.0, 0.0, 0.0])) == (0.0, np.inf)
    assert beside(piece, piece + np.array([2.5, 0.3, 0.0])) == pytest.approx((0.5, 0.3))
    assert beside(np.zeros((2, 3)), piece) == (0.0, np.inf)
    assert left_of(piece) == pytest.approx([0.0, 1.0, 0.0])
