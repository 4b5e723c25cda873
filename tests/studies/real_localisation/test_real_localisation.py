"""The parts of `gnd reproduce real-localisation` on real recordings: floors well below what is reached, fast."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gnd.fleet_sim.drives import PERFECT
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.importer import map_track, no_progress, open_recording
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.localise import localisation_error
from studies.frame.errors import RealDataError
from studies.real.scene import RecordedScans, RecordedScene, load, place
from studies.real_localisation.apollo import apollo_map, gaussians_apart, on_apollos_map
from studies.real_localisation.convergence import convergence_of
from studies.real_localisation.flexmap import flexmap_of, is_flexmap
from studies.real_localisation.halves import METHODS, Half, gicp_reference, localised
from studies.real_localisation.nagoya import dead_reckoned, gps_ns, is_nagoya, nagoya_of, read_pos, read_reference
from studies.real_localisation.odometry import compared, odometries
from studies.real_localisation.study import RealLocalisationOptions


@pytest.fixture(scope="module")
def kitti(shared_data: Path) -> RecordedScans:
    return load(open_recording("kitti", shared_data / "kitti00_start16"), 8, no_progress)


@pytest.mark.slow
def test_odometries_agree_with_each_other_and_not_with_the_ground_truth(kitti: RecordedScans) -> None:
    rows = {row["name"]: row for row in compared(odometries(kitti), kitti)}
    ours, kiss = rows["ours, growing map"], rows["KISS-ICP"]
    assert ours["way_less_positions_m"] < -0.3  # the ground truth is longer than what LiDAR sees
    if not kiss["absent"]:
        assert abs(kiss["way_m"] - ours["way_m"]) < 0.15
    for name in ("small_gicp VGICP, growing map", "small_gicp GICP, scan to scan"):
        assert abs(rows[name]["end_along_m"]) < 0.1


@pytest.mark.slow
def test_registration_finds_real_scans_as_small_gicp_does(kitti: RecordedScans) -> None:
    half = Half.of(place(kitti, 0), "even", "odd")
    rows = {(row["off_m"], row["method"]): row for row in convergence_of(half, trials=4)}
    for off_m in (0.3, 1.0, 2.0):
        assert rows[off_m, "ours"]["converged"] == 1.0
        assert rows[off_m, "ours"]["error_m_p50"] < 0.03
    assert rows[0.3, "small_gicp GICP"]["converged"] == 1.0
    reference = gicp_reference(half)
    assert reference is not None
    off = T_inverse(half.scene.poses.at(reference.t_ns)) @ reference.T_dst_vehicle
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.05


@pytest.fixture(scope="module")
def apollo(shared_data: Path) -> RecordedScene:
    recording = open_recording("apollo", shared_data / "apollo_ndt")
    scans = tuple(scan for i in range(2) if (scan := cleaned(recording.read(i)).scan) is not None)
    return place(RecordedScans(recording.name, scans, map_track(recording), recording, ()), 0)


def test_apollos_map_lies_on_the_scans(shared_data: Path, apollo: RecordedScene) -> None:
    """Its cells, turned by the convergence, on our Gaussians of the same scans: centimetres apart along the normals."""
    theirs = apollo_map(shared_data / "apollo_ndt", apollo)
    found = gaussians_apart(theirs, Half.made("both", apollo, [0, 1], [0, 1]))
    assert found["compared"] > 500
    assert found["along_normal_m_p50"] < 0.015
    assert np.abs(found["shift_enu_m"]).max() < 0.05


def test_registration_on_apollos_map(shared_data: Path, apollo: RecordedScene) -> None:
    rows = on_apollos_map(apollo_map(shared_data / "apollo_ndt", apollo), Half.made("both", apollo, [0, 1], [0, 1]))
    assert all(row["within_10_cm"] == 1.0 for row in rows)
    assert max(row["heading_deg"] for row in rows) < 0.05


@pytest.mark.slow
def test_a_slam_track_and_its_lanes_on_the_earth(shared_data: Path) -> None:
    folder = shared_data / "flexmap_georef"
    assert is_flexmap(folder)
    assert not is_nagoya(folder)
    found, _ = flexmap_of(folder)
    assert found["held_out_m"]["bent"]["p50"] < 0.2
    assert found["held_out_m"]["bent"]["p95"] < 2.0
    assert found["held_out_in_lanes"]["bent"] > 0.97
    assert found["held_out_in_lanes"]["rigid"] < found["held_out_in_lanes"]["bent"]
    assert found["track_in_lanes"] > 0.99


@pytest.fixture(scope="module")
def nagoya(shared_data: Path) -> dict[str, dict[str, Any]]:
    found = nagoya_of(shared_data / "gnss_nagoya")
    return {row["name"]: row for row in found["by"]}


def test_wheel_and_gyro_on_the_earth(nagoya: dict[str, dict[str, Any]]) -> None:
    for row in nagoya.values():
        assert row["off_m"]["p95"] < row["rigid_off_m"]["p95"] / 5
        assert row["heading_deg"]["p50"] < 0.6
    assert (
        nagoya["RTK, all"]["off_m"]["p95"] < nagoya["RTK, all"]["fixes_off_m"]["p95"] / 4
    )  # wrong fixes lose their say
    assert nagoya["RTK, fixed"]["off_m"]["p50"] < 0.25
    assert nagoya["single point"]["off_m"]["p95"] < 8.0


def test_dead_reckoning_without_errors_is_the_reference(shared_data: Path) -> None:
    reference = read_reference(shared_data / "gnss_nagoya" / "reference.csv").chosen(slice(0, 1500))
    track = dead_reckoned(reference, PERFECT)
    p = reference.enu_m(LocalFrame(float(reference.lat_rad[0]), float(reference.lon_rad[0])))
    way = np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1).sum()
    driven = np.linalg.norm(np.diff(track.T_dst_vehicle[:, :3, 3], axis=0), axis=1).sum()
    assert driven == pytest.approx(way, rel=0.01)


def test_both_kinds_of_times_in_rtklib_files_are_one(tmp_path: Path) -> None:
    row = "35.165360868 136.881409540 41.4082 1 16 0.0049 0.0046 0.0102 0.0028 0.0018 -0.0033 0.03 6.4\n"
    (tmp_path / "a.pos").write_text("% header\n2270 194670.200 " + row)
    (tmp_path / "b.pos").write_text("% header\n2023/07/11 06:04:30.200 " + row)
    (a, quality), (b, _) = (read_pos(tmp_path / name) for name in ("a.pos", "b.pos"))
    assert a.t_ns.tolist() == b.t_ns.tolist() == [gps_ns(2270, 194670.2)]
    assert quality.tolist() == [1]
    assert a.sigma_m.tolist() == [0.02]  # the least that is believed
    (tmp_path / "c.pos").write_text("no positions here\n")
    with pytest.raises(RealDataError, match=r"c\.pos"):
        read_pos(tmp_path / "c.pos")


def test_options_are_checked(tmp_path: Path) -> None:
    with pytest.raises(RealDataError, match="no such file or folder"):
        RealLocalisationOptions((tmp_path / "none",))
    with pytest.raises(RealDataError, match="--scans none"):
        RealLocalisationOptions(())
    (tmp_path / "a" / "x").mkdir(parents=True)
    (tmp_path / "b" / "x").mkdir(parents=True)
    with pytest.raises(RealDataError, match="one name twice"):
        RealLocalisationOptions((tmp_path / "a" / "x", tmp_path / "b" / "x"))


@pytest.mark.slow
def test_refined_poses_of_a_real_drive_stay_where_its_scans_fit(shared_data: Path) -> None:
    """Wheels on a thinly mapped road once pulled submaps a quarter of a metre along it."""
    recorded = load(open_recording("kitti", shared_data / "kitti00_start16"), 16, no_progress)
    half = Half.of(place(recorded, 0), "second-half", "first-half")
    found = localised(half, 0, METHODS["with_submap"]).estimates
    assert len(found) >= 4
    error = localisation_error(found, half.scene.poses)
    assert max(error.longitudinal_max_m, error.lateral_max_m) < 0.06
