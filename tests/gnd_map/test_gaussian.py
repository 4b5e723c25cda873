"""Columns of Gaussians check themselves; moments add, and give mean and covariance."""

import numpy as np
import pytest

from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.gaussian import Gaussians, Moments, concat, full_matrices, six_entries


def some(ids: list[int], seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    n = len(ids)
    root = rng.normal(scale=0.2, size=(n, 3, 3))
    return Gaussians(
        np.array(ids, dtype=np.int32),
        rng.integers(20, 500, n).astype(np.int32),
        rng.integers(20, 60, n).astype(np.int32),
        rng.uniform(-0.5, 0.5, (n, 3)).astype(np.float32),
        six_entries(root @ np.swapaxes(root, 1, 2)).astype(np.float32),
    )


def moments_of(points: np.ndarray) -> Moments:
    outer = six_entries(np.einsum("ni,nj->ij", points, points))
    return Moments(np.array([len(points)]), np.array([1], np.int32), points.sum(axis=0)[None], outer[None])


def test_rows_are_taken_selected_and_joined() -> None:
    all_five = some([-7, -1, 0, 3, 90])
    assert all_five.take([1, 3]).voxel_id.tolist() == [-1, 3]
    assert all_five.take(np.array([True, False, False, False, True])).voxel_id.tolist() == [-7, 90]
    assert all_five.select([90, 5, -7]) == all_five.take([0, 4])
    assert concat([all_five.take([1, 4]), all_five.take([0, 2, 3])]) == all_five
    assert concat([]) == Gaussians.empty()
    assert len(all_five) == 5


def test_equality_is_of_every_bit() -> None:
    a, b = some([1, 2]), some([1, 2])
    assert a == b
    b.mean_m[0, 0] = np.nextafter(b.mean_m[0, 0], np.float32(1.0))
    assert a != b


def test_full_covariance_is_symmetric_and_in_order() -> None:
    six = np.array([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])
    full = full_matrices(six)
    np.testing.assert_array_equal(full[0], [[1, 2, 3], [2, 4, 5], [3, 5, 6]])
    np.testing.assert_array_equal(six_entries(full), six)
    assert some([4]).full_cov().dtype == np.float64


def test_nothing_here_is_count_zero() -> None:
    nothing = Gaussians.nothing_at([5, 2, 5])
    assert nothing.voxel_id.tolist() == [2, 5]
    assert not nothing.exists.any()


@pytest.mark.parametrize(
    ("column", "row", "value", "message"),
    [
        ("voxel_id", 1, -7, "strictly increasing"),
        ("count", 0, -1, "negative counts"),
        ("cells", 2, -3, "negative counts"),
        ("mean_m", (1, 2), 2.5, "means beyond 2.0 m in 1 of 3"),
        ("mean_m", (1, 2), np.nan, "not finite"),
        ("cov_m2", (0, 3), -1e-6, "negative variances"),
        ("cov_m2", (0, 1), np.inf, "not finite"),
        ("count", 1, 0, "count 0 but other values"),
    ],
)
def test_impossible_values_are_refused(column: str, row: object, value: float, message: str) -> None:
    good = some([-7, 1, 3])
    columns = dict(
        zip(("voxel_id", "count", "cells", "mean_m", "cov_m2"), (c.copy() for c in good.columns), strict=True)
    )
    columns[column][row] = value  # type: ignore[index]
    with pytest.raises(ShapeError, match=message):
        Gaussians(**columns)  # type: ignore[arg-type]


def test_wrong_types_and_lengths_are_refused() -> None:
    good = some([1, 2])
    with pytest.raises(ShapeError, match="int32"):
        Gaussians(good.voxel_id.astype(np.int64), good.count, good.cells, good.mean_m, good.cov_m2)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match=r"mean_m: expected shape \(2, 3\), got \(1, 3\)"):
        Gaussians(good.voxel_id, good.count, good.cells, good.mean_m[:1], good.cov_m2)
    with pytest.raises(ShapeError, match="numpy array"):
        Gaussians([1, 2], good.count, good.cells, good.mean_m, good.cov_m2)  # type: ignore[arg-type]


def test_a_voxel_twice_is_refused() -> None:
    with pytest.raises(ShapeError, match="strictly increasing"):
        concat([some([1, 2]), some([2, 3])])


def test_moments_give_numpy_mean_and_population_covariance() -> None:
    points = np.random.default_rng(1).normal(size=(500, 3)) * [0.3, 0.2, 0.01]
    moments = moments_of(points)
    np.testing.assert_allclose(moments.mean_m()[0], points.mean(axis=0), atol=1e-15)
    np.testing.assert_allclose(full_matrices(moments.cov_m2())[0], np.cov(points.T, bias=True), atol=1e-15)


def test_moments_of_parts_add_to_the_whole() -> None:
    points = np.random.default_rng(2).normal(size=(300, 3))
    total = moments_of(points[:100]) + moments_of(points[100:])
    whole = moments_of(points)
    assert total.count.tolist() == [300]
    np.testing.assert_allclose(total.cov_m2(), whole.cov_m2(), rtol=1e-12)
    assert (total + Moments.zeros(1)).mean_m() == pytest.approx(whole.mean_m())


def test_moments_of_a_published_gaussian_lead_back_to_it() -> None:
    gaussians = some([-3, 8, 9])
    again = Moments.of(gaussians).to_gaussians(gaussians.voxel_id)
    np.testing.assert_allclose(again.cov_m2, gaussians.cov_m2, atol=1e-7)
    np.testing.assert_allclose(again.mean_m, gaussians.mean_m, atol=1e-7)
    assert again.count.tolist() == gaussians.count.tolist()


def test_to_gaussians_sorts_by_voxel() -> None:
    moments = Moments(
        np.array([4, 2]), np.array([3, 1], np.int32), np.array([[4.0, 0, 0], [0, 0, 1.0]]), np.ones((2, 6))
    )
    gaussians = moments.to_gaussians([9, -9])
    assert gaussians.voxel_id.tolist() == [-9, 9]
    assert gaussians.count.tolist() == [2, 4]
    assert gaussians.mean_m.tolist() == [[0.0, 0.0, 0.5], [1.0, 0.0, 0.0]]


def test_moments_of_other_voxels_do_not_add() -> None:
    with pytest.raises(ShapeError, match="2 and 3"):
        Moments.zeros(2) + Moments.zeros(3)
