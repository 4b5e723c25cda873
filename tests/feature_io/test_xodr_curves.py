"""The curves of OpenDRIVE against closed forms and against integrals that know no Fresnel function."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from gnd.tile_store.feature_io.xodr_curves import (
    CurvePiece,
    HeightProfile,
    ReferenceLine,
    arc,
    line,
    param_poly3,
    poly3,
    simplified,
    spiral,
)

RNG = np.random.default_rng(3)


def integrated(start: float, end: float, length: float, s: float) -> tuple[float, float]:
    """Where a clothoid is after a way s, from its heading alone."""
    heading = lambda p: start * p + (end - start) / length * p**2 / 2.0  # noqa: E731
    places = [quad(lambda p, f=f: f(heading(p)), 0.0, s, epsabs=1e-12, limit=500)[0] for f in (np.cos, np.sin)]
    return places[0], places[1]


def test_a_straight_line_is_straight() -> None:
    x, y, heading = line()(np.array([0.0, 12.5]))
    assert (x.tolist(), y.tolist(), heading.tolist()) == ([0.0, 12.5], [0.0, 0.0], [0.0, 0.0])


@pytest.mark.parametrize("curvature", [0.02, -0.05])
def test_an_arc_lies_on_its_circle(curvature: float) -> None:
    s = np.linspace(0.0, 100.0, 50)
    x, y, heading = arc(curvature, 100.0)(s)
    np.testing.assert_allclose(np.hypot(x, y - 1.0 / curvature), abs(1.0 / curvature), atol=1e-12)
    np.testing.assert_allclose(heading, curvature * s)
    quarter = np.pi / 2 / abs(curvature)
    x, y, _ = arc(curvature, 100.0)(np.array([quarter]))
    assert (x[0], y[0]) == pytest.approx((1 / abs(curvature), 1 / curvature))


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(1.0, 150.0))
def test_a_clothoid_is_the_integral_of_its_heading(start: float, end: float, length: float) -> None:
    s = np.linspace(0.0, length, 4)
    x, y, heading = spiral(start, end, length)(s)
    expected = np.array([integrated(start, end, length, one) for one in s])
    np.testing.assert_allclose(np.column_stack([x, y]), expected, atol=1e-7)
    assert heading[-1] == pytest.approx((start + end) / 2.0 * length, abs=1e-9)


def test_a_clothoid_that_hardly_bends_is_an_arc() -> None:
    s = np.linspace(0.0, 100.0, 11)
    for end in (0.01, 0.01 + 1e-14, 0.01 + 1e-12, 0.01 + 1e-9):
        np.testing.assert_allclose(spiral(0.01, end, 100.0)(s), arc(0.01, 100.0)(s), atol=1e-5)


def test_cubics_by_their_parameters() -> None:
    u, v = np.array([0.0, 10.0, 1.0, -0.5]), np.array([0.0, 0.0, 2.0, 1.0])
    x, y, heading = param_poly3(u, v, 20.0)(np.array([0.0, 10.0, 20.0]))
    assert (x.tolist(), y.tolist()) == ([0.0, 5.1875, 10.5], [0.0, 0.625, 3.0])
    assert heading[2] == pytest.approx(np.arctan2(7.0, 10.5))
    flat = param_poly3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(4), 1.0)(np.array([7.0]))
    assert (flat[0][0], flat[1][0]) == (7.0, 0.0)


def test_a_cubic_by_its_arc_length() -> None:
    k = np.array([0.0, 0.1, 0.01, -1e-4])
    x, y, heading = poly3(k, 40.0)(np.array([30.0]))
    way = quad(lambda u: np.hypot(1.0, k[1] + 2 * k[2] * u + 3 * k[3] * u**2), 0.0, x[0])[0]
    assert way == pytest.approx(30.0, abs=1e-5)
    assert y[0] == pytest.approx(np.polyval(k[::-1], x[0]))
    assert np.tan(heading[0]) == pytest.approx(np.polyval(np.polyder(k[::-1]), x[0]))


def test_pieces_follow_each_other() -> None:
    x, y, heading = (float(v[0]) for v in spiral(0.0, 0.02, 50.0)(np.array([50.0])))
    start = np.pi / 3
    c, n = np.cos(start), np.sin(start)
    pieces = (
        CurvePiece(0.0, 100.0, 200.0, start, 50.0, spiral(0.0, 0.02, 50.0)),
        CurvePiece(50.0, 100.0 + c * x - n * y, 200.0 + n * x + c * y, start + heading, 30.0, arc(0.02, 30.0)),
    )
    s = np.linspace(0.0, 80.0, 801)
    px, py, ph = ReferenceLine(pieces).at(s)
    steps = np.hypot(np.diff(px), np.diff(py))
    np.testing.assert_allclose(steps, 0.1, atol=1e-6)
    np.testing.assert_allclose(np.arctan2(np.diff(py), np.diff(px)), (ph[1:] + ph[:-1]) / 2, atol=1e-4)


def test_profiles_begin_where_they_say() -> None:
    profile = HeightProfile(np.array([5.0, 10.0]), np.array([[1.0, 0.5, 0.0, 0.0], [4.0, 0.0, 0.0, 1.0]]))
    assert profile.at(np.array([0.0, 5.0, 7.0, 10.0, 12.0])).tolist() == [0.0, 1.0, 2.0, 4.0, 12.0]
    assert HeightProfile(np.zeros(0), np.zeros((0, 4))).at(np.array([1.0])).tolist() == [0.0]


def test_a_thinned_line_stays_within_its_tolerance() -> None:
    s = np.linspace(0.0, 200.0, 2001)
    line_m = np.column_stack([s, 20.0 * np.sin(s / 15.0), 0.1 * np.cumsum(RNG.normal(0, 0.01, len(s)))])
    thin = simplified(line_m, 0.05)
    assert len(thin) < len(line_m) / 5
    assert (thin[0] == line_m[0]).all()
    assert (thin[-1] == line_m[-1]).all()
    ends = thin[1:] - thin[:-1]
    share = np.einsum("psk,sk->ps", line_m[:, None] - thin[:-1], ends) / (ends**2).sum(axis=1)
    off = line_m[:, None] - thin[:-1] - np.clip(share, 0, 1)[..., None] * ends
    assert np.linalg.norm(off, axis=2).min(axis=1).max() <= 0.05
    assert len(simplified(np.zeros((5, 3)), 0.01)) == 2
