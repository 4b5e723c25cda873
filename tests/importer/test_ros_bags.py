"""Bags of ROS 2: containers, sensors with their time fields, GNSS, motion, mounts, poses, damage."""

import io
import json
import shutil
import tracemalloc
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from bag_testing import SECOND, cloud, fix, imu, odometry, transforms, write_bag
from click.testing import CliRunner
from recording_testing import scan_of, true_pose
from rosbags.rosbag2 import CompressionMode, storage_mcap
from rosbags.rosbag2 import reader as rosbag2_reader

from gnd.extras import MissingExtra
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import exp_so3, log_so3, quaternion_xyzw_from_R
from gnd.schemas.drive_mcap import load_track, read_header
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import import_recording, open_recording
from gnd.vehicle_agent.importer_cli import import_drives
from gnd.vehicle_agent.importers import optional
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.planes import open_planes
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.importers.ros.bag import Bag
from gnd.vehicle_agent.importers.sweep_times import FoundSweep

TOKYO = LocalFrame(np.radians(35.6586), np.radians(139.7454), 60.0)
START = 1_700_000_000 * SECOND
STEP = SECOND // 10
FEW = scan_of(0, 60).astype(np.float32)
XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
OFFSET = np.linspace(0.0, 0.0999, 60)  # seconds after the beginning of the sweep


def points(fields: list[tuple[str, str]], time: str | None = None, values: np.ndarray | None = None) -> np.ndarray:
    out = np.zeros(60, np.dtype(XYZ + fields))
    for axis, name in enumerate("xyz"):
        out[name] = FEW[:, axis]
    if "ring" in out.dtype.names:
        out["ring"] = np.arange(60) % 32
    if time is not None:
        out[time] = values
    return out


def since_1970(k: int) -> np.ndarray:
    return (START + k * STEP) * 1e-9 + OFFSET


SENSORS = {
    # driver's fields, stamp in the sweep (share), times of the points of scan k
    "velodyne": ([("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")], 1.0, lambda k: OFFSET - 0.1),
    "ouster": ([("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2")], 0.0, lambda k: np.round(OFFSET * 1e9)),
    "hesai": ([("intensity", "<f4"), ("ring", "<u2"), ("timestamp", "<f8")], 0.0, since_1970),
    "robosense": ([("intensity", "<f4"), ("ring", "<u2"), ("timestamp", "<f8")], 1.0, since_1970),
    "livox": ([("tag", "u1"), ("line", "u1"), ("timestamp", "<f8")], 0.0, lambda k: since_1970(k) * 1e9),
    "livox offset": ([("offset_time", "<u4")], 0.0, lambda k: np.round(OFFSET * 1e9)),
    "autoware": ([("time_stamp", "<u4")], 0.0, lambda k: np.round(OFFSET * 1e9)),
    "microseconds": ([("t", "<u4")], 0.0, lambda k: np.round(OFFSET * 1e6)),
    "milliseconds": ([("time", "<f4")], 0.0, lambda k: OFFSET * 1e3),
    "64 bits": ([("timestamp", "<f8")], 0.5, lambda k: since_1970(k) * 1e6),
}


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_times_of_every_sensor(tmp_path, sensor, storage):
    """Sweeps begin when the first point was measured, whatever the driver stamps and counts."""
    fields, share, times = SENSORS[sensor]
    time = next(name for name, _ in fields if "t" in name and name not in ("intensity", "tag"))
    clouds = [
        ("/points", START + k * STEP, cloud(points(fields, time, times(k)), START + k * STEP + round(share * STEP)))
        for k in range(3)
    ]
    recording = open_recording("auto", write_bag(tmp_path / "bag", clouds, storage))
    np.testing.assert_allclose(recording.t_ns - START, [0, STEP, 2 * STEP], atol=1_000)
    for k in range(3):
        scan = recording.read(k)
        np.testing.assert_allclose(
            scan.t_ns + scan.t_offset_ns.astype(float) - START, k * STEP + OFFSET * 1e9, atol=1_000
        )
        np.testing.assert_array_equal(scan.points_m, FEW)
    assert f"times of points: {time}" in recording.entries[0].detail


def drive_messages(n: int = 8, lever=(0.0, 0.0, 0.0), lag: int = 0) -> list:
    """A room driven through in Tokyo, heading 30° north of east: clouds, fixes of 2 cm, odometry, mounts."""
    T_map = np.eye(4)
    T_map[:3, :3] = exp_so3([0.0, 0.0, np.radians(30.0)])
    made = [("/tf_static", START, transforms(START, ("base_link", "lidar", (0, 0, 1.73), (0, 0, 0, 1)),
                                             ("base_link", "gnss", lever, (0, 0, 0, 1))))]  # fmt: skip
    for k in range(n):
        T, t_ns = true_pose(k), START + k * STEP
        data = np.zeros(48_000, np.dtype(XYZ))
        for axis, name in enumerate("xyz"):
            data[name] = scan_of(k)[:, axis]
        lat, lon, height = TOKYO.geodetic_from_enu((T_map @ T @ [*lever, 1.0])[:3])
        made += [
            ("/points", t_ns + lag, cloud(data, t_ns)),
            ("/gnss", t_ns + 1, fix(t_ns, (np.degrees(lat), np.degrees(lon), height), 0.02)),
            ("/odom", t_ns + 2, odometry(t_ns, T[:3, 3], quaternion_xyzw_from_R(T[:3, :3]), 5.0, 0.1)),
            ("/diagnostics", t_ns + 3, imu(t_ns, (0, 0, 0.1), "imu")),
        ]
    return made


def truth(n: int = 8) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = exp_so3([0.0, 0.0, np.radians(30.0)])
    return T @ np.stack([true_pose(k) for k in range(n)])


def in_tokyo(drive: Path) -> np.ndarray:
    """(N, 4, 4) reference poses of a drive in ENU of the tower."""
    return TOKYO.T_self_other(read_header(drive).anchor) @ load_track(drive).reference.T_map_vehicle


def test_a_bag_lands_where_it_was_recorded(tmp_path):
    """Place, heading, motion and mount come from the bag; nothing is made up."""
    bag, out = write_bag(tmp_path / "bag", drive_messages(lever=(0.5, 0.2, 0.0))), tmp_path / "a.mcap"
    imported = import_recording("auto", bag, out)
    header, track = read_header(out), load_track(out)
    found = in_tokyo(out)
    assert np.abs(found[:, :3, 3] - truth()[:, :3, 3]).max() < 0.05
    turn = np.linalg.norm(log_so3(np.swapaxes(found[:, :3, :3], 1, 2) @ truth()[:, :3, :3]), axis=1)
    assert np.degrees(turn).max() < 1.0
    assert (header.mount, header.stand_ins, header.nowhere) == ("given", (), False)
    np.testing.assert_allclose(header.T_vehicle_lidar[:3, 3], [0, 0, 1.73])
    np.testing.assert_allclose(track.motion.speed_mps, 5.0)
    np.testing.assert_allclose(track.gnss.sigma_m, 0.02)
    assert imported.quality.gnss_m < 0.05


def test_the_bag_is_listed_with_what_is_used(tmp_path):
    bag = write_bag(tmp_path / "bag", drive_messages(3))
    listed = json.loads(CliRunner().invoke(import_drives, ["auto", str(bag), "--json"]).output)
    used = {one["name"]: one["used"] for one in listed["holds"]}
    assert used == {"/points": "scans", "/gnss": "place", "/odom": "speed and yaw rate", "/diagnostics": "",
                    "/tf_static": "mount: lidar on base_link"}  # fmt: skip
    assert listed["place"][:2] == pytest.approx([35.6586, 139.7454], abs=1e-4)
    odometry_entry = next(one for one in listed["holds"] if one["name"] == "/diagnostics")
    assert odometry_entry["count"] == 3


@pytest.mark.parametrize("topic", ["/odom", "/tf:odom:base_link"])
def test_poses_of_a_topic_become_the_track(tmp_path, topic):
    messages = drive_messages()
    for k in range(8):
        T = true_pose(k)
        edge = ("odom", "base_link", T[:3, 3], quaternion_xyzw_from_R(T[:3, :3]))
        messages.append(("/tf", START + k * STEP, transforms(START + k * STEP, edge)))
    bag, out = write_bag(tmp_path / "bag", sorted(messages, key=lambda one: one[1])), tmp_path / "a.mcap"
    heading = RecordingAnchor(35.6586, 139.7454, 60.0, 60.0)
    import_recording("auto", bag, out, choices=Choices(poses=topic, anchor=heading))
    assert np.abs(in_tokyo(out) - truth()).max() < 1e-6
    imported = import_recording("auto", bag, out, choices=Choices(poses=topic))  # laid over the fixes
    assert np.abs(in_tokyo(out)[:, :3, 3] - truth()[:, :3, 3]).max() < 1e-3
    assert any("laid over 8 fixes" in note for note in imported.notes)
    with pytest.raises(ImportDriveError, match=r"--poses /nothing: neither a file nor a topic.*: /odom; tf: /tf:odom"):
        open_recording("auto", bag, choices=Choices(poses="/nothing"))


@pytest.mark.parametrize(
    ("storage", "mode"), [("mcap", "STORAGE"), ("mcap", "MESSAGE"), ("sqlite3", "MESSAGE"), ("sqlite3", "FILE")]
)
def test_compressed_bags_give_the_same_points(tmp_path, storage, mode):
    clouds = [("/points", START + k * STEP, cloud(points([]), START + k * STEP)) for k in range(3)]
    bag = write_bag(tmp_path / "bag", clouds, storage, CompressionMode[mode])
    recording = open_recording("auto", bag)
    assert len(recording) == 3
    np.testing.assert_array_equal(recording.read(2).points_m, FEW)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_split_bags_single_files_and_other_endings(tmp_path, storage):
    for part in range(2):
        clouds = [
            ("/points", START + k * STEP, cloud(points([]), START + k * STEP)) for k in range(3 * part, 3 * part + 3)
        ]
        write_bag(tmp_path / f"part{part}", clouds, storage)
    split = tmp_path / "split"
    split.mkdir()
    for path in sorted(tmp_path.glob("part*/*.mcap")) + sorted(tmp_path.glob("part*/*.db3")):
        shutil.copy(path, split / path.name)
    recording = open_recording("auto", split)
    assert (np.diff(recording.t_ns) == STEP).all()
    assert len(recording) == 6
    single = next(iter(sorted(split.iterdir())))
    assert len(open_recording("auto", single)) == 3
    (split / "notes.bin").write_bytes(b"what is this?")
    with pytest.raises(ImportDriveError, match="no single file of a kind that is read"):
        open_recording("auto", split / "notes.bin")


def test_a_damaged_part_is_named_and_passed_over(tmp_path):
    write_bag(tmp_path / "a", [("/points", START + k, cloud(points([]), START + k * STEP)) for k in range(3)])
    broken = tmp_path / "a" / "b.mcap"
    broken.write_bytes(next(iter(sorted((tmp_path / "a").glob("*.mcap")))).read_bytes()[:700])
    (tmp_path / "a" / "metadata.yaml").unlink()
    recording = open_recording("auto", tmp_path / "a")
    assert len(recording) == 3
    assert any(note.startswith("passed over: b.mcap: ") for note in recording.notes)
    with pytest.raises(ImportDriveError, match=r"no readable bag: passed over: b\.mcap"):
        open_recording("auto", tmp_path / "a", choices=Choices(strict=True))


def test_speed_of_wheels_and_turn_rate_of_an_imu(tmp_path):
    """The IMU lies on its side: its y axis points up."""
    upright = exp_so3([np.pi / 2, 0.0, 0.0])  # R_base_imu: y of the IMU is z of the vehicle
    made = [("/tf_static", START, transforms(START, ("base_link", "imu", (0, 0, 0), quaternion_xyzw_from_R(upright))))]
    for k in range(4):
        t_ns = START + k * STEP
        made.append(("/points", t_ns, cloud(points([]), t_ns)))
        made.append(("/wheels", t_ns + 1, odometry(t_ns, (k, 0, 0), (0, 0, 0, 1), 7.0, 0.0)))
        made.append(("/imu", t_ns + 2, imu(t_ns, (0.0, 0.3, 0.0))))
    recording = open_recording("auto", write_bag(tmp_path / "bag", made))
    assert [sample.speed_mps for sample in recording.motion] == [7.0] * 4
    np.testing.assert_allclose([sample.yaw_rate_radps for sample in recording.motion], 0.3, atol=1e-12)


@pytest.mark.parametrize(("imus", "kept"), [((0, 1, 2), [0, 1, 2, 3, 4]), ((0, 9), [0, 1, 2, 7, 8, 9]), ((30,), [])])
def test_speeds_far_from_any_turn_rate_are_left_out(tmp_path, imus, kept):
    """An IMU that was recorded for a part of the way: its last rate is not held, and no line is drawn over the gap."""
    made = [("/tf_static", START, transforms(START, ("base_link", "imu", (0, 0, 0), (0, 0, 0, 1))))]
    for k in range(10):
        made.append(("/points", START + k * STEP, cloud(points([]), START + k * STEP)))
        made.append(("/wheels", START + k * STEP, odometry(START + k * STEP, (k, 0, 0), (0, 0, 0, 1), 7.0, 0.0)))
    made += [("/imu", START + k * STEP, imu(START + k * STEP, (0.0, 0.0, 0.3))) for k in imus]
    recording = open_recording("auto", write_bag(tmp_path / "bag", sorted(made, key=lambda one: one[1])))
    assert [(sample.t_ns - START) // STEP for sample in recording.motion] == kept
    used = {one.name: (one.used, one.why) for one in recording.entries}
    if kept:
        assert used["/imu"][0] == "yaw rate"
        assert f"/wheels: {10 - len(kept)} speeds without a number or without a turn rate" in " ".join(recording.notes)
    else:
        assert used["/wheels"] == ("", "no turn rate of the IMU near its times")


def test_fixes_without_a_position_and_without_a_covariance(tmp_path):
    place = (35.6586, 139.7454, 60.0)
    made = [
        *[("/points", START + k * STEP, cloud(points([]), START + k * STEP)) for k in range(4)],
        ("/gnss", START + 1, fix(START, place, 0.3, status=-1)),
        ("/gnss", START + 2, fix(START + STEP, (np.nan, 0.0, 0.0), 0.3)),
        ("/gnss", START + 3, fix(START + 2 * STEP, place, 0.3)),
        ("/gnss", START + 4, fix(START + 3 * STEP, place, 0.3, known=0)),
    ]
    recording = open_recording("auto", write_bag(tmp_path / "bag", sorted(made, key=lambda one: one[1])))
    assert [one.sigma_m for one in recording.gnss] == pytest.approx([0.3, 2.5])
    assert recording.notes[-2:] == (
        "/gnss: 2 fixes without a position: left out",
        "/gnss: 1 fixes without a covariance: taken as 2.5 m",
    )


def test_two_sensors_on_one_topic_are_refused(tmp_path):
    made = [
        ("/points", START + k * STEP, cloud(points([]), START + k * STEP, ("left", "right")[k % 2])) for k in range(4)
    ]
    with pytest.raises(ImportDriveError, match=r"clouds of 2 sensors on /points \(2 in left, 2 in right\)"):
        open_recording("auto", write_bag(tmp_path / "bag", made))


@pytest.mark.parametrize(("ahead_s", "said"), [(18, "GPS time is 18 s ahead"), (37, "TAI is 37 s ahead")])
def test_points_of_another_clock_are_named(tmp_path, ahead_s, said):
    fields = [("timestamp", "<f8")]
    made = [
        ("/points", START + k * STEP, cloud(points(fields, "timestamp", since_1970(k) + ahead_s), START + k * STEP))
        for k in range(3)
    ]
    recording = open_recording("auto", write_bag(tmp_path / "bag", made))
    assert any(said in note for note in recording.notes)
    np.testing.assert_allclose(recording.read(1).t_ns, START + STEP, atol=1_000)


def test_a_time_field_that_is_chosen(tmp_path):
    fields = [("time", "<f4"), ("when", "<f4")]
    data = points(fields, "when", OFFSET * 1e3)
    made = [("/points", START + k * STEP, cloud(data, START + k * STEP)) for k in range(3)]
    bag = write_bag(tmp_path / "bag", made)

    def times(field: str):
        result = CliRunner().invoke(import_drives, ["auto", str(bag), "--time-field", field, "--json"])
        if result.exception:
            raise result.exception
        return json.loads(result.output)["holds"][0]["detail"]

    assert "times of points: when, against the stamp, in ms" in times("when:ms")
    assert "no times of points" in times("none")
    with pytest.raises(ImportDriveError, match="no such field; fields are x, y, z, time, when"):
        times("wann")
    with pytest.raises(ImportDriveError, match="unit h; known are s, ms, us, ns"):
        times("when:h")


def test_raw_packets_of_a_real_bag_are_refused_with_what_to_do(shared_data):
    with pytest.raises(ImportDriveError, match=r"velodyne_packets holds packets: play the bag through velodyne_point"):
        open_recording("auto", shared_data / "captures_a" / "nebula_vlp32" / "1713492677464078412")


def test_a_real_bag_without_clouds(shared_data):
    """Apollo's poses are no bag; the turtlebot's, if it is there, holds odometry only."""
    with pytest.raises(ImportDriveError, match="no single file of a kind that is read"):
        open_recording("auto", shared_data / "apollo_ndt" / "pcds" / "poses.txt")


def test_bags_make_room_for_no_more_than_they_hold_and_unpack_to_no_more_than_they_say(tmp_path):
    write_bag(tmp_path / "bag", [("/points", SECOND, cloud(np.zeros(3, [(axis, "<f4") for axis in "xyz"]), SECOND))])
    Bag(tmp_path / "bag")  # bounds the library, once a process
    with pytest.raises(ValueError, match="4611686018427387904 bytes wanted at 0, 5 are left"):
        storage_mcap.read_exact(io.BytesIO(b"12345"), 1 << 62)
    for kind, packed in (("zstd", zstandard.compress(bytes(10**7))), ("lz4", lz4.frame.compress(bytes(10**7)))):
        assert storage_mcap.decompress(packed, kind, 10**7, 0) == bytes(10**7)
        tracemalloc.start()
        with pytest.raises((ValueError, storage_mcap.ReaderError), match=r"Zstandard frame of 10000000|got 1001\."):
            storage_mcap.decompress(packed, kind, 1_000, 0)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
        tracemalloc.stop()
        with pytest.raises(ValueError, match="a chunk that unpacks to 268435457 bytes"):
            storage_mcap.decompress(packed, kind, (1 << 28) + 1, 0)
    with pytest.raises(ValueError, match="Zstandard frame of 268435457 bytes"):
        rosbag2_reader.zstd.decompress(zstandard.compress(bytes((1 << 28) + 1)))


def test_without_rosbags_it_says_which_extra(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", [("/points", START + k, cloud(points([]), START + k)) for k in range(2)])

    def missing(name: str):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(optional, "import_module", missing)
    with pytest.raises(MissingExtra, match=r"rosbags is not installed; it comes with: pip install 'gnd-fleet\[ros\]'"):
        open_recording("auto", bag)


@pytest.mark.slow
def test_a_real_drive_as_a_bag_of_tokyo(shared_data, tmp_path):
    """KITTI raw 0027 with its INS: 24 scans, put at Tokyo with a noise of 0.5 m; it lands there within sigma."""
    kitti = open_planes(shared_data / "kitti_raw_0027", None)
    frame, rng = kitti.anchor.frame, np.random.default_rng(7)
    mount = ("base_link", "lidar", kitti.T_vehicle_lidar[:3, 3], (0, 0, 0, 1))
    made = [("/tf_static", int(kitti.t_ns[0]) - STEP, transforms(int(kitti.t_ns[0]), mount))]
    sweep = FoundSweep(np.radians(176.0), clockwise=True)  # decision 80
    true_ns, true = [], []
    for k in range(24):
        begin_ns, ins, motion = int(kitti.t_ns[k]) - STEP // 2, kitti.gnss[k], kitti.motion[k]
        measured = kitti.read(k).points_m[::3]
        data = np.zeros(len(measured), np.dtype([*XYZ, ("t", "<u4")]))
        for axis, name in enumerate("xyz"):
            data[name] = measured[:, axis]
        data["t"] = np.round(sweep.share(np.arctan2(measured[:, 1], measured[:, 0])) * STEP)
        p = frame.enu_from_geodetic(ins.lat_rad, ins.lon_rad, ins.height_m)
        true_ns.append(ins.t_ns)
        true.append(p)
        lat, lon, height = TOKYO.geodetic_from_enu(p + rng.normal(0, 0.5, 3))
        place = (np.degrees(lat), np.degrees(lon), height)
        made.append(("/points", begin_ns, cloud(data, begin_ns)))
        made.append(("/gnss", ins.t_ns, fix(ins.t_ns, place, 0.5, frame="base_link")))
        made.append(("/odom", ins.t_ns, odometry(ins.t_ns, p, (0, 0, 0, 1), motion.speed_mps, motion.yaw_rate_radps)))
    bag = write_bag(tmp_path / "bag", sorted(made, key=lambda one: one[1]), "sqlite3")
    imported = import_recording("auto", bag, tmp_path / "a.mcap")
    reference = load_track(tmp_path / "a.mcap").reference
    found = Trajectory(reference.t_ns, in_tokyo(tmp_path / "a.mcap")).at(np.array(true_ns), tolerance_ns=STEP)
    off = found[:, :3, 3] - np.array(true)
    horizontal = np.linalg.norm(off[:, :2], axis=1)
    assert np.sqrt((horizontal**2).mean()) < 0.5  # one sigma of a single fix
    assert horizontal.max() < 1.0
    assert np.abs(off[:, 2]).max() < 0.5
    assert (read_header(tmp_path / "a.mcap").stand_ins, read_header(tmp_path / "a.mcap").deskew) == ((), "measured")
    last = (true[-1] + true[-2]) / 2  # where the last sweep begins; the first begins before the first fix
    assert imported.quality.way_m == pytest.approx(float(np.linalg.norm(last - true[0])), rel=0.02)
