"""Closed-form masses against Dempster's rule applied one observation after the other (GND, Eq. 5-12)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.gnd_map.errors import ConfigError, ShapeError
from gnd.gnd_map.evidence import ChangeState, MassParameters, masses, states

Mass = dict[frozenset[str], float]
S, C, OMEGA = frozenset("S"), frozenset("C"), frozenset("SC")
counts = st.integers(0, 25)


def combine(first: Mass, second: Mass) -> Mass:
    """Eq. 11 over all pairs of focal elements, as printed."""
    joint: dict[frozenset[str], float] = {}
    for a, m_a in first.items():
        for b, m_b in second.items():
            joint[a & b] = joint.get(a & b, 0.0) + m_a * m_b
    joint.pop(frozenset(), 0.0)
    left = sum(joint.values())  # = 1 - m(∅), but without its drift: (1 - conflict) doubles rounding at every step
    return {a: m / left for a, m in joint.items()}


def one_observation(kind: str, p: MassParameters) -> Mass:
    """Eq. 5-10."""
    s = p.lambda_s_block if kind == "BI" else 0.0
    c = {"BI": p.lambda_c_block, "BO": p.lambda_c_block, "BE": p.lambda_c_block, "PI": p.lambda_c_pass}.get(kind, 0.0)
    return {S: s, C: c, OMEGA: 1.0 - s - c}


def sequential(kinds: list[str], p: MassParameters) -> list[float]:
    mass: Mass = {OMEGA: 1.0}  # Eq. 12
    for kind in kinds:
        mass = combine(mass, one_observation(kind, p))
    return [mass.get(S, 0.0), mass.get(C, 0.0), mass.get(OMEGA, 0.0)]


def closed(bi: int, bo: int, be: int, pi: int, p: MassParameters) -> np.ndarray:
    return masses([bi], [bo], [be], [pi], p)[0]


@given(counts, counts, counts, counts, st.randoms(use_true_random=False))
def test_closed_form_is_sequential_in_any_order(bi: int, bo: int, be: int, pi: int, random) -> None:  # type: ignore[no-untyped-def]
    kinds = ["BI"] * bi + ["BO"] * bo + ["BE"] * be + ["PI"] * pi + ["PO", "PE"]
    random.shuffle(kinds)
    p = MassParameters()
    np.testing.assert_allclose(closed(bi, bo, be, pi, p), sequential(kinds, p), rtol=1e-9, atol=1e-13)


@given(st.floats(0.0, 0.99), st.floats(0.0, 0.99), st.floats(0.0, 0.99), counts, counts)
def test_closed_form_is_sequential_for_any_parameters(ls: float, lcb: float, lcp: float, bi: int, pi: int) -> None:
    p = MassParameters(ls * (1.0 - lcb), lcb, lcp)
    np.testing.assert_allclose(closed(bi, 0, 0, pi, p), sequential(["BI"] * bi + ["PI"] * pi, p), rtol=1e-7, atol=1e-10)


def test_large_counts_neither_underflow_nor_drift() -> None:
    p = MassParameters()
    kinds = ["BI", "PI", "BI", "BO"] * 2_000
    np.testing.assert_allclose(closed(4_000, 2_000, 0, 2_000, p), sequential(kinds, p), rtol=1e-6, atol=1e-12)
    for bi, bo, be, pi in [(10**9, 0, 0, 0), (0, 10**9, 0, 10**9), (10**9, 10**9, 0, 10**9), (10**9, 0, 0, 11 * 10**9)]:
        mass = closed(bi, bo, be, pi, p)
        assert np.isfinite(mass).all()
        assert mass.sum() == pytest.approx(1.0)
        assert mass.max() == pytest.approx(1.0)


def test_balanced_large_counts_keep_both_masses() -> None:
    p = MassParameters(0.5, 0.5, 0.5)  # one pass outweighs exactly one hit
    mass = closed(10**6, 0, 0, 0, p)
    np.testing.assert_allclose(mass, [0.5, 0.5, 0.0], atol=1e-12)


def test_without_observations_all_is_unknown() -> None:
    np.testing.assert_array_equal(closed(0, 0, 0, 0, MassParameters()), [0.0, 0.0, 1.0])


def test_one_observation_has_the_masses_of_its_equation() -> None:
    p = MassParameters(0.3, 0.1, 0.04)
    np.testing.assert_allclose(closed(1, 0, 0, 0, p), [0.3, 0.1, 0.6], atol=1e-15)  # Eq. 5
    np.testing.assert_allclose(closed(0, 1, 0, 0, p), [0.0, 0.1, 0.9], atol=1e-15)  # Eq. 6
    np.testing.assert_allclose(closed(0, 0, 0, 1, p), [0.0, 0.04, 0.96], atol=1e-15)  # Eq. 7
    np.testing.assert_allclose(closed(0, 0, 1, 0, p), [0.0, 0.1, 0.9], atol=1e-15)  # Eq. 9


def test_certain_observations_leave_nothing_unknown() -> None:
    mass = masses([0, 1], [0, 0], [0, 0], [0, 0], MassParameters(0.9, 0.1, 0.0))
    np.testing.assert_allclose(mass, [[0.0, 0.0, 1.0], [0.9, 0.1, 0.0]], atol=1e-12)


@given(counts, counts, counts, counts)
def test_a_pass_never_speaks_for_sustained(bi: int, bo: int, be: int, pi: int) -> None:
    p = MassParameters()
    before, after = closed(bi, bo, be, pi, p), closed(bi, bo, be, pi + 1, p)
    assert after[0] <= before[0] + 1e-15
    assert after[1] >= before[1] - 1e-15


def test_states_take_the_largest_mass_and_a_tie_is_unknown() -> None:
    mass = np.array([[0.6, 0.3, 0.1], [0.1, 0.6, 0.3], [0.1, 0.2, 0.7], [0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
    expected = [ChangeState.SUSTAINED, ChangeState.CHANGED] + [ChangeState.UNKNOWN] * 3
    assert states(mass).tolist() == expected


def test_no_voxels_no_masses() -> None:
    assert masses([], [], [], [], MassParameters()).shape == (0, 3)


def test_masses_above_one_are_refused_at_configuration() -> None:
    with pytest.raises(ConfigError, match="exceeds 1"):
        MassParameters(0.8, 0.3, 0.02)
    with pytest.raises(ConfigError, match="lambda_c_pass"):
        MassParameters(lambda_c_pass=-0.1)


def test_counts_of_different_length_are_refused() -> None:
    with pytest.raises(ShapeError, match="n_pi"):
        masses([1, 2], [0, 0], [0, 0], [1], MassParameters())
