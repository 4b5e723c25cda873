"""Plans and drives of the new layer study."""

from pathlib import Path

import numpy as np

from studies.new_layer_study.driving import STRAIGHT, TRACK, RouteTask, along_and_across, drive_of, layer_truth
from studies.new_layer_study.study import NewLayerOptions, noisy_tracks, tasks_of


def test_the_sweep_shares_its_middle_with_the_usual_drives(tmp_path: Path) -> None:
    options = NewLayerOptions(seeds=(14, 15), levels=(1.0, 0.5, 2.0), drives=3)
    tracks = noisy_tracks(options, 14)
    assert list(tracks["beacon"]) == [0.5, 1.0, 2.0]
    assert tracks["beacon"][1.0] == tracks["lane"][1.0] == RouteTask(TRACK, 14, 0.0)
    assert noisy_tracks(options, 15) == {}
    plan = tasks_of(options, 14, tmp_path / "run")
    assert sum(task.kind == TRACK for task in plan.routes) == 5
    assert sum(len(drives) for task, drives in plan.routes.items() if task.kind == TRACK) == 15
    keys = {drive.key for drives in plan.routes.values() for drive in drives}
    assert len(keys) == 15 + 2 * options.motorway_drives
    assert noisy_tracks(NewLayerOptions(levels=()), 11) == {}


def test_a_noisier_drive_goes_the_same_way_with_the_same_luck() -> None:
    usual, noisy = (drive_of(RouteTask(TRACK, 14, 0.15, beacon=level), 1) for level in (1.0, 2.0))
    np.testing.assert_array_equal(usual.truth.poses, noisy.truth.poses)
    np.testing.assert_array_equal(usual.gnss.xy_m, noisy.gnss.xy_m)
    assert len(usual.looks[3].kinds) == len(noisy.looks[3].kinds) > 0
    assert noisy.looks[3].sigma_range_m[0] == 2.0 * usual.looks[3].sigma_range_m[0]


def test_directions_along_a_straight_road_are_its_heading() -> None:
    task = RouteTask(STRAIGHT, 14, 0.5)
    truth, drive = layer_truth(task.route), drive_of(task, 1)
    heading = float(drive.truth.poses[0, 2])
    np.testing.assert_allclose(
        truth.along, np.tile([np.cos(heading), np.sin(heading)], (len(truth.xy_m), 1)), atol=0.02
    )
    ahead = drive.truth.poses + np.array([np.cos(heading), np.sin(heading), 0.0])
    np.testing.assert_allclose(along_and_across(ahead, drive.truth.poses)[0], [1.0, 0.0], atol=1e-9)


def test_drives_have_hard_noise_unless_kind_is_asked_for(tmp_path: Path) -> None:
    hard, kind = (drive_of(RouteTask(TRACK, 14, 0.15, noise=noise), 1) for noise in ("hard", "kind"))
    np.testing.assert_array_equal(hard.truth.poses, kind.truth.poses)
    shares = []
    for drive in (hard, kind):
        beacon = np.bincount(np.concatenate(drive.truth.of_detection)[np.concatenate(drive.truth.of_detection) > 0])
        most, off = int(beacon.argmax()), []
        place = drive.route.features.xy_m[np.flatnonzero(drive.route.features.feature_id == most)[0]]
        for look, of, pose in zip(drive.looks, drive.truth.of_detection, drive.truth.look_poses, strict=True):
            off += (look.range_m[of == most] - np.hypot(*(place - pose[:2]))).tolist()
        shares.append(abs(np.mean(off)) / (1.0 / np.sqrt(len(off))))
    assert shares[0] > 6.0 > 4.0 > shares[1], "in sigmas of a mean: hard errors stay with a beacon, white ones do not"
    plans = [tasks_of(NewLayerOptions(seeds=(14,), noise=noise), 14, tmp_path) for noise in ("hard", "kind")]
    folders = [{task.layers.path.parent for drives in plan.routes.values() for task in drives} for plan in plans]
    assert folders[0].isdisjoint(folders[1]), "both may lie in one folder"
