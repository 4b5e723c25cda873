"""Hard noise of simulated perception: what stays with signs and drives, misses by range, look-alikes."""

from dataclasses import replace

import numpy as np
import pytest

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.drive import RoadDrive, RoadDriveOptions, drive_route
from gnd.fleet_sim.roads.hard_noise import HardNoise, erring_profile, lookalikes
from gnd.fleet_sim.roads.motorway import motorway
from gnd.fleet_sim.roads.sight import CAMERA, polar

ROUTE = motorway(31, 5000.0)
QUIET = HardNoise(
    sign_range_share=0.0, sign_bearing_rad=0.0, yaw_rad=0.0, range_share=0.0, pitch_rad=0.0, white_ln_sigma=0.0,
    miss_near=0.1, miss_far=0.1, least_seen=1.0, confused=0.0, confused_signs=0.0, lookalikes_per_km=0.0,
    profile_m=0.0, profile_rad=0.0, profile_dropped=0.0, profile_missing=0.0,
)  # fmt: skip


def driven(hard: HardNoise | None, seed: int = 1) -> RoadDrive:
    return drive_route(ROUTE, seed, RoadDriveOptions(hard=hard))


def errors_of(drive: RoadDrive) -> dict[int, np.ndarray]:
    """By sign: range as a share, and bearing error [rad] of all of its detections, (N, 3) with the true range."""
    found: dict[int, list[tuple[float, float, float]]] = {}
    rows = {int(one): row for row, one in enumerate(ROUTE.features.feature_id)}
    range_m, bearing = polar(drive.truth.look_poses, ROUTE.features.xy_m)
    for n, (look, of) in enumerate(zip(drive.looks, drive.truth.of_detection, strict=True)):
        for k, sign in enumerate(of.tolist()):
            if sign:
                true = range_m[n, rows[sign]], bearing[n, rows[sign]]
                off = (float(look.range_m[k]) / true[0] - 1.0, float(look.bearing_rad[k]) - true[1], true[0])
                found.setdefault(sign, []).append(off)
    return {sign: np.array(rows_) for sign, rows_ in found.items()}


def test_without_its_parts_it_is_the_kind_noise() -> None:
    errors = np.concatenate(list(errors_of(driven(QUIET)).values()))
    assert np.std(errors[:, 0] * errors[:, 2]) == pytest.approx(1.0, rel=0.1)
    assert np.degrees(np.std(errors[:, 1])) == pytest.approx(2.5, rel=0.1)


def test_the_kind_drive_does_not_change_with_the_hard_one() -> None:
    kind, again, hard = driven(None), driven(None), driven(HardNoise())
    for one, other in zip(kind.looks, again.looks, strict=True):
        assert np.array_equal(one.range_m, other.range_m)
    assert np.array_equal(kind.gnss.xy_m, hard.gnss.xy_m)
    assert np.array_equal(kind.motion.speed_mps, hard.motion.speed_mps)
    assert np.array_equal(kind.truth.look_poses, hard.truth.look_poses)


def test_errors_stay_with_each_sign_and_differ_between_drives() -> None:
    stays = replace(QUIET, sign_range_share=0.05, sign_bearing_rad=np.radians(1.0))
    one, other = (
        {sign: rows.mean(axis=0) for sign, rows in errors_of(driven(stays, seed)).items() if len(rows) > 15}
        for seed in (1, 2)
    )
    means = np.array(list(one.values()))
    assert 0.025 < means[:, 0].std() < 0.08  # averaging over a passage does not remove them
    assert 0.5 < np.degrees(means[:, 1].std()) < 1.7
    both = np.array([(one[sign][0], other[sign][0]) for sign in one.keys() & other.keys()])
    assert abs(np.corrcoef(both.T)[0, 1]) < 0.6


def test_the_drives_error_is_common_to_its_signs() -> None:
    turned = [np.concatenate(list(errors_of(driven(replace(QUIET, yaw_rad=0.1), seed)).values())) for seed in (1, 2)]
    assert all(np.degrees(np.std(rows[:, 1])) < 3.0 for rows in turned)
    assert np.std([rows[:, 1].mean() for rows in turned]) > 0.01


def test_far_signs_are_missed_more_often() -> None:
    drive = driven(replace(QUIET, miss_near=0.05, miss_far=0.6))
    range_m, _ = polar(drive.truth.look_poses, ROUTE.features.xy_m)
    free = drive.truth.in_view & ~drive.truth.hidden
    free[:, ROUTE.features.rows("deleted")] = False
    hit = np.zeros_like(free)
    for n, of in enumerate(drive.truth.of_detection):
        hit[n] = np.isin(ROUTE.features.feature_id, of)
    near, far = free & (range_m < 40.0), free & (range_m > 65.0)
    assert hit[near].mean() > 0.85
    assert 0.35 < hit[far].mean() < 0.7


def test_look_alikes_stand_at_the_same_places_in_every_drive() -> None:
    hard = replace(QUIET, lookalikes_per_km=3.0, lookalike_seen=1.0, lookalike_rate=(0.7, 0.7))
    places, _ = lookalikes(ROUTE, hard)
    assert len(places) > 8
    for seed in (1, 2):
        drive = driven(hard, seed)
        at = []
        for look, of, pose in zip(drive.looks, drive.truth.of_detection, drive.truth.look_poses, strict=True):
            for k in np.flatnonzero(of == 0):
                angle, r = pose[2] + float(look.bearing_rad[k]), float(look.range_m[k])
                at.append(pose[:2] + r * np.array([np.cos(angle), np.sin(angle)]))
        near = np.linalg.norm(np.array(at)[:, None] - places[None], axis=2) < 8.0
        assert (near.sum(axis=0) >= 3).mean() > 0.6
        assert near.any(axis=1).mean() > 0.5


def test_the_profile_of_occlusion_errs() -> None:
    free_m = np.full((2000, CAMERA.azimuths_rad().size), np.inf, np.float32)
    free_m[:, 20:50] = 30.0
    hard = replace(QUIET, profile_m=1.0, profile_dropped=0.2, profile_missing=0.1)
    wrong = erring_profile(free_m, CAMERA, hard, np.random.default_rng(1))
    kept = np.isfinite(wrong)
    assert not kept[:, :20].any()
    assert not kept[:, 50:].any()
    assert kept[:, 20:50].mean() == pytest.approx(0.8 * 0.9, abs=0.03)
    assert np.std(wrong[kept]) == pytest.approx(1.0, rel=0.1)
    turned = erring_profile(free_m, CAMERA, replace(QUIET, profile_rad=0.05), np.random.default_rng(1))
    assert np.isfinite(turned).sum() == np.isfinite(free_m).sum()
    assert not np.array_equal(turned, free_m)


def test_impossible_noise_is_refused() -> None:
    with pytest.raises(RoadError, match="they must rise"):
        HardNoise(miss_near=0.6, miss_far=0.5)
    with pytest.raises(RoadError, match="shares within 0"):
        HardNoise(confused=1.5)
