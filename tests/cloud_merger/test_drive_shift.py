"""The shift that each drive has in common with itself, and covariances of the merged layer that allow for it."""

import numpy as np
import pytest
from feature_cloud import change, merge, report

from gnd.cloud_merger.features import FeatureMergeParameters
from gnd.cloud_merger.features.drive_shift import DriveShift
from gnd.cloud_merger.features.rls import PlaceEstimate, estimate
from gnd.gnd_map.features import full_covariance, hit, six_of
from gnd.schemas.features import Found

EVERY = FeatureMergeParameters(renewal_gain=1.0)


def places_of(rng: np.random.Generator, n: int, shift_m: float) -> list[PlaceEstimate]:
    """Measurements of the origin that claim covariances of their own and are shifted besides."""
    out = []
    for _ in range(n):
        A = rng.normal(size=(2, 2)) * 0.3 + 0.2 * np.eye(2)
        cov = np.diag([0.0, 0.0, 1.0])
        cov[:2, :2] = A @ A.T + 0.01 * np.eye(2)
        error = np.linalg.cholesky(cov[:2, :2]) @ rng.normal(size=2) + shift_m * rng.normal(size=2)
        out.append(PlaceEstimate(np.array([[*error, 0.0]]), cov))
    return out


def shift_of(places: list[PlaceEstimate]) -> DriveShift:
    shift = DriveShift()
    for place in places:
        shift.add(place)
    return shift


def test_its_size_is_found() -> None:
    found = [shift_of(places_of(np.random.default_rng([2, seed]), 40, 0.6)).variance_m2 for seed in range(60)]
    assert np.mean(found) == pytest.approx(0.36, rel=0.2)


def test_drives_that_agree_add_little() -> None:
    rows = [places_of(np.random.default_rng([3, seed]), 11, 0.0) for seed in range(100)]
    more = [np.trace(shift_of(one).added_m2()) / np.trace(estimate(one).cov_m2[:2, :2]) for one in rows]
    assert np.mean(more) < 0.3
    assert shift_of(rows[0][:1]).variance_m2 == 0.0


def test_what_it_adds_is_that_of_the_weighted_mean() -> None:
    """Against the covariance of Σ K_i s_i with K_i written out."""
    places = places_of(np.random.default_rng(4), 6, 2.0)
    shift = shift_of(places)
    W = [np.linalg.inv(place.cov_m2[:2, :2]) for place in places]
    C = np.linalg.inv(sum(W))
    want = sum(shift.variance_m2 * (C @ one) @ (C @ one).T for one in W)
    assert shift.variance_m2 > 0.0
    np.testing.assert_allclose(shift.added_m2(), want, rtol=1e-9)


def test_far_from_the_tiles_origin_no_digits_are_lost() -> None:
    places = places_of(np.random.default_rng(5), 8, 0.5)
    far = [PlaceEstimate(one.points_m + np.array([5e5, -5e5, 0.0]), one.cov_m2) for one in places]
    assert shift_of(far).variance_m2 == pytest.approx(shift_of(places).variance_m2, rel=1e-6)


def squares_of(vehicles: int, shift_m: float, runs: int = 100) -> float:
    """Mean normalised squared error of what the cloud publishes of drives that do not tell of their shift."""
    squares = []
    for seed in range(runs):
        rng = np.random.default_rng([6, seed])
        reports = []
        for number in range(vehicles):
            error = rng.normal(0, 0.3, 2) + rng.normal(0, shift_m, 2)
            cov = np.diag([0.09, 0.09, 1e4])
            one = Found("traffic_sign", np.array([[*error, 0.0]]), six_of(cov), hit(0.97), 4)
            reports.append(report(number, change(one), vehicle=f"car-{number}"))
        got = max(merge((), reports, EVERY).estimates, key=lambda one: one.vehicles)
        error = got.points_m[0, :2]
        squares.append(float(error @ np.linalg.solve(full_covariance(got.cov_m2)[:2, :2], error)))
    return float(np.mean(squares))


def test_the_layer_says_how_sure_it_is_though_no_drive_does() -> None:
    """Drives 1.2 times as far off as they claim: without their shift the normalised squared error would be 2.9."""
    assert 1.5 < squares_of(11, 0.2) < 2.6
    assert 1.3 < squares_of(11, 0.0) < 2.4


def test_of_two_drives_nobody_can_tell() -> None:
    """What cannot be known is not claimed to be: two drives are believed, and the error is larger than the claim."""
    assert squares_of(2, 0.3) > 2.4
