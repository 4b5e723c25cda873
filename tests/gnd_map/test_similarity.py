"""Similarity of voxel states: the paper's cases (GND, Eq. 13-17) and the properties that clustering rests on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.gnd_map.errors import ConfigError, ShapeError
from gnd.gnd_map.gaussian import six_entries
from gnd.gnd_map.se3 import exp_so3
from gnd.gnd_map.similarity import (
    SimilarityMode,
    alike,
    far_at,
    pairs_within,
    pairwise,
    shape_types,
    similarity,
    similarity_plain,
)

MODES: list[SimilarityMode] = ["paper", "default"]
PLANE = np.array([0.08, 0.08, 0.0004])
LINE = np.array([0.0005, 0.0005, 0.08])
SPHERE = np.array([0.03, 0.04, 0.05])


def cov(variances: np.ndarray, turn: list[float] | None = None) -> np.ndarray:
    R = exp_so3(np.array(turn if turn is not None else [0.0, 0.0, 0.0]))
    return six_entries(R @ np.diag(variances) @ R.T)


def one(a: np.ndarray, b: np.ndarray, shift_m: list[float], mode: SimilarityMode) -> float:
    yes, zero = np.array([True]), np.zeros((1, 3))
    return float(similarity(yes, zero, a[None], yes, np.array([shift_m]), b[None], mode)[0])


def random_states(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, 3, 3)) * rng.uniform(0.005, 0.3, (n, 1, 3))
    return rng.random(n) < 0.7, rng.uniform(-0.5, 0.5, (n, 3)), six_entries(root @ np.swapaxes(root, 1, 2))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("variances", [PLANE, LINE, SPHERE, np.zeros(3)])
def test_identical_states_are_alike(mode: SimilarityMode, variances: np.ndarray) -> None:
    c = cov(variances, [0.3, -0.2, 0.9])
    assert one(c, c, [0.0, 0.0, 0.0], mode) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("mode", MODES)
def test_existence(mode: SimilarityMode) -> None:
    exists_a, exists_b = np.array([False, True, False]), np.array([False, False, True])
    zero, c = np.zeros((3, 3)), np.tile(cov(SPHERE), (3, 1))
    assert similarity(exists_a, zero, c, exists_b, zero, c, mode).tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize("mode", MODES)
@given(seed=st.integers(0, 10**6), noise_m=st.floats(0.0, 0.3))
def test_symmetric_and_between_zero_and_one(mode: SimilarityMode, seed: int, noise_m: float) -> None:
    a, b = random_states(50, seed), random_states(50, seed + 1)
    forth, back = similarity(*a, *b, mode, noise_m), similarity(*b, *a, mode, noise_m)
    np.testing.assert_allclose(forth, back, rtol=1e-9, atol=1e-12)
    assert ((forth >= 0.0) & (forth <= 1.0)).all()


def test_each_pair_may_have_its_own_noise() -> None:
    """Observers whose poses are known poorly see the same wall apart: with more noise two Gaussians are more alike."""
    a, b = random_states(60, 7), random_states(60, 8)
    noise_m = np.random.default_rng(9).choice([0.02, 0.05, 0.15], 60)
    each = similarity(*a, *b, "default", noise_m)
    for value in np.unique(noise_m):
        alone = similarity(*a, *b, "default", float(value))
        np.testing.assert_array_equal(each[noise_m == value], alone[noise_m == value])
    shifted = [np.broadcast_to(cov(PLANE), (3, 6)), np.array([[0.0, 0.0, 0.1]] * 3)]
    yes, zero = np.ones(3, np.bool_), np.zeros((3, 3))
    grown = similarity(yes, zero, shifted[0], yes, shifted[1], shifted[0], "default", np.array([0.02, 0.05, 0.15]))
    assert (np.diff(grown) > 0.1).all()
    with pytest.raises(ShapeError):
        similarity(*a, *b, "default", noise_m[:5])
    with pytest.raises(ConfigError, match="negative"):
        similarity(*a, *b, "default", -noise_m)


@pytest.mark.parametrize("mode", MODES)
def test_the_l2_term_is_equation_15(mode: SimilarityMode) -> None:
    c, d = cov(SPHERE, [0.1, 0.2, 0.3]), np.array([0.2, -0.1, 0.3])
    noise = 0.05**2 if mode == "default" else 1e-6
    full = np.array([[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]])
    expected = np.exp(-(d @ np.linalg.inv(2.0 * full + noise * np.eye(3)) @ d) / 2.0)
    assert one(c, c, d.tolist(), mode) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("angle", [0.0, 0.2, 0.7, np.pi / 2, 2.5])
@pytest.mark.parametrize(("variances", "axis"), [(PLANE, 0), (LINE, 1)])
def test_paper_shape_is_the_cosine_between_normals_or_directions(
    angle: float, variances: np.ndarray, axis: int
) -> None:
    turn = [0.0, 0.0, 0.0]
    turn[axis] = angle
    assert one(cov(variances), cov(variances, turn), [0.0] * 3, "paper") == pytest.approx(abs(np.cos(angle)), abs=1e-9)


def test_paper_types_differ_or_are_spheres() -> None:
    assert one(cov(PLANE), cov(LINE), [0.0] * 3, "paper") == 0.0
    assert one(cov(PLANE), cov(SPHERE), [0.0] * 3, "paper") == 0.0
    assert one(cov(SPHERE), cov(SPHERE, [1.0, 0.5, 0.2]), [0.0] * 3, "paper") == pytest.approx(1.0)


def test_types_of_equation_16() -> None:
    ratios = np.array([PLANE, LINE, SPHERE, [0.0001, 0.002, 0.08], [0.0, 0.0, 0.0]])
    kinds, feature = shape_types(np.stack([cov(v, [0.4, 0.1, 0.2]) for v in ratios]))
    assert kinds.tolist() == [1, 2, 0, 2, 0]  # λ3 ≫ λ2 ≫ λ1 counts as a line
    R = exp_so3(np.array([0.4, 0.1, 0.2]))
    assert abs(feature[0] @ R[:, 2]) == pytest.approx(1.0)
    assert abs(feature[1] @ R[:, 2]) == pytest.approx(1.0)


def test_default_shape_is_bhattacharyya_of_equal_means() -> None:
    a, b = cov(PLANE), cov(SPHERE, [0.3, 0.0, 0.5])
    A, B = (np.array([[s[0], s[1], s[2]], [s[1], s[3], s[4]], [s[2], s[4], s[5]]]) + 0.0025 * np.eye(3) for s in (a, b))
    distance = 0.5 * np.log(np.linalg.det((A + B) / 2.0) / np.sqrt(np.linalg.det(A) * np.linalg.det(B)))
    assert one(a, b, [0.0] * 3, "default") == pytest.approx(np.exp(-distance), rel=1e-9)


def test_default_tells_a_turned_plane_from_a_noisy_one() -> None:
    assert one(cov(PLANE), cov(PLANE, [np.pi / 2, 0.0, 0.0]), [0.0] * 3, "default") < 0.5
    assert one(cov(PLANE), cov(PLANE, [0.05, 0.0, 0.0]), [0.02, 0.02, 0.02], "default") > 0.85
    assert one(cov(PLANE), cov(PLANE), [0.0, 0.0, 0.4], "default") < 0.01


def test_a_thin_wall_three_centimetres_off_is_lost_to_the_paper_only() -> None:
    wall = cov(np.array([0.08, 0.08, 0.0001]))
    assert one(wall, wall, [0.0, 0.0, 0.03], "paper") < 0.2
    assert one(wall, wall, [0.0, 0.0, 0.03], "default") > 0.8


@pytest.mark.parametrize("mode", MODES)
def test_pairwise_is_similarity_of_every_pair_within_a_group(mode: SimilarityMode) -> None:
    group = np.array([4, 4, 4, 7, 9, 9, 2, 2, 2, 2])
    exists, mean, c = random_states(10, 5)
    i, j, found = pairwise(group, exists, mean, c, mode)
    expected = [(a, b) for a in range(10) for b in range(a + 1, 10) if group[a] == group[b]]
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected
    for a, b, value in zip(i, j, found, strict=True):
        s = slice(a, a + 1), slice(b, b + 1)
        one_pair = similarity(*(x[s[0]] for x in (exists, mean, c)), *(x[s[1]] for x in (exists, mean, c)), mode)
        assert value == pytest.approx(one_pair[0], rel=1e-12)


def test_no_rows_no_pairs() -> None:
    i, j = pairs_within(np.empty(0, np.int64))
    assert len(i) == len(j) == 0
    assert len(pairs_within(np.array([1, 2, 3]))[0]) == 0


def test_float32_columns_are_welcome() -> None:
    exists, mean, c = random_states(5, 6)
    result = similarity(exists, mean.astype(np.float32), c.astype(np.float32), exists, mean, c)
    assert result.dtype == np.float64


def test_wrong_arguments_are_refused() -> None:
    exists, mean, c = random_states(3, 7)
    with pytest.raises(ShapeError, match="cov_b"):
        similarity(exists, mean, c, exists, mean, c[:2])
    with pytest.raises(ConfigError, match="mode"):
        similarity(exists, mean, c, exists, mean, c, "new")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="negative"):
        similarity(exists, mean, c, exists, mean, c, "default", -0.1)


@given(seed=st.integers(0, 10**6), noise_m=st.floats(0.0, 0.3))
def test_the_kernel_gives_what_plain_numpy_gives(seed: int, noise_m: float) -> None:
    a, b = random_states(80, seed), random_states(80, seed + 1)
    b = b[0], a[1] + 0.1 * b[1], a[2] * 1.2  # near enough that most are alike
    noise = np.full(80, noise_m)
    plain = similarity_plain(*a, *b, "default", noise)
    np.testing.assert_allclose(similarity(*a, *b, "default", noise), plain, rtol=0.0, atol=2e-15)
    assert (plain > 1e-3).sum() > 10


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.05, 0.5]), st.sampled_from([0.01, 0.1, 1.0]))
def test_one_pair_in_a_kernel_is_as_plain_numpy_has_it(seed: int, noise_m: float, apart: float) -> None:
    (yes, a, cov_a), (_, other, cov_b) = random_states(20, seed), random_states(20, seed + 1)
    yes, b = np.ones_like(yes), a + apart * other
    cov_b[::2] = cov_a[::2]
    plain = similarity_plain(yes, a, cov_a, yes, b, cov_b, "default", np.full(20, noise_m))
    found = [alike(a[k], cov_a[k], b[k], cov_b[k], noise_m**2, np.inf) for k in range(20)]
    np.testing.assert_allclose(found, plain, rtol=0.0, atol=2e-15)
    assert found == [alike(b[k], cov_b[k], a[k], cov_a[k], noise_m**2, np.inf) for k in range(20)]
    for least in (0.05, 0.3, 0.7):  # what is left out early would not have been near
        early = [alike(a[k], cov_a[k], b[k], cov_b[k], noise_m**2, far_at(least)) for k in range(20)]
        assert [value >= least for value in early] == [value >= least for value in found]
