"""Masses of features: step by step, in one go, and by enumerating the power set."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.vehicle_agent.features.slamcu.tracked_feature import (
    KNOWN_MASSES,
    NEW_MASSES,
    FeatureClass,
    TrackedFeature,
    add_evidence,
    bounded_below,
    counted,
    existence_of,
    recount,
)

CONFIDENCE = 0.9
SETS = (frozenset({"yes"}), frozenset({"no"}), frozenset({"yes", "no"}))


def entry(*, known: bool) -> TrackedFeature:
    masses = KNOWN_MASSES if known else NEW_MASSES
    return TrackedFeature(1, known, "sign", np.zeros(2), None, 0.0, masses)


def by_enumeration(prior: np.ndarray, looks: list[bool]) -> np.ndarray:
    """Eq. (5) to (7) by the definition: every pair of sets."""
    masses, left = dict(zip(SETS, prior[:3].tolist(), strict=True)), 1.0
    for measured in looks:
        side = SETS[0] if measured else SETS[1]
        new = {side: 0.9, SETS[2]: 0.1}
        out = dict.fromkeys((*SETS, frozenset()), 0.0)
        for (a, m_a), (b, m_b) in product(masses.items(), new.items()):
            out[a & b] += m_a * m_b  # Eq. (7)
        conflict = out.pop(frozenset())
        left *= 1.0 - conflict
        masses = {a: m / (1.0 - conflict) for a, m in out.items()}  # Eq. (6)
    return np.array([*(masses[a] for a in SETS), 1.0 - left])


@given(st.lists(st.booleans(), max_size=14), st.booleans())
def test_masses_after_a_sequence_of_looks(looks: list[bool], known: bool) -> None:
    one = entry(known=known)
    prior = one.masses
    for t, measured in enumerate(looks):
        add_evidence([one] if measured else [], [] if measured else [one], CONFIDENCE, t)
    want = by_enumeration(prior, looks)
    assert np.allclose(one.masses, want, atol=1e-9)
    assert np.allclose(counted(prior, sum(looks), len(looks) - sum(looks), 0.9), want, atol=1e-9)
    assert (one.hits, one.misses, len(one.history)) == (sum(looks), len(looks) - sum(looks), len(looks))


@given(st.integers(0, 5000), st.integers(0, 5000), st.booleans())
def test_any_number_of_looks_gives_masses(hits: int, misses: int, known: bool) -> None:
    one = entry(known=known)
    recount(one, hits, misses, CONFIDENCE, 0)
    assert one.masses[:3].sum() == pytest.approx(1.0)
    assert (one.masses[:3] >= 0.0).all()
    assert 0.0 <= one.masses[3] <= 1.0
    if abs(hits - misses) > 3:
        assert existence_of(one.masses).state == ("exist" if hits > misses else "absent")


def test_no_mass_vanishes() -> None:
    one = entry(known=True)
    for t in range(500):
        add_evidence([one], [], CONFIDENCE, t)
    assert one.masses[1] > 0.0
    for t in range(40):
        add_evidence([], [one], CONFIDENCE, t)
    assert existence_of(one.masses).state == "absent"


def test_history_is_bounded() -> None:
    one = entry(known=False)
    for t in range(3000):
        add_evidence([one], [], CONFIDENCE, t)
    assert len(one.masses_over_time()) == 1024
    assert one.masses_over_time()[-1].t_ns == 2999


def test_classes() -> None:
    known, new = entry(known=True), entry(known=False)
    assert known.feature_class == FeatureClass.NORMAL
    assert new.feature_class == FeatureClass.UNCLASSIFIED
    add_evidence([new], [known], CONFIDENCE, 0)
    add_evidence([new], [known], CONFIDENCE, 1)
    assert known.feature_class == FeatureClass.DELETED
    assert new.feature_class == FeatureClass.UNCLASSIFIED  # two false alarms at one place happen
    add_evidence([new], [], CONFIDENCE, 2)
    assert new.feature_class == FeatureClass.NEW
    assert not known.exists
    assert new.exists


def test_the_bound_keeps_the_sum() -> None:
    masses = bounded_below(np.array([[1.0, 0.0, 0.0, 0.5]]))
    assert masses[0, :3].sum() == pytest.approx(1.0)
    assert masses[0, 1] > 0.0
