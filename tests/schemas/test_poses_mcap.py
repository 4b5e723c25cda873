"""The MCAP file of poses: read again with Foxglove's own messages, and nothing of ours but the frame."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.schemas.errors import BadValue, TrajectoryError
from gnd.schemas.poses_mcap import HealthNote, PoseTrack, write_poses_mcap

T0_NS = 1_700_000_000_123_456_789
COV_M2 = np.stack([np.diag([0.01, 0.04, 0.09]) + 0.002, 2.0 * np.eye(3), 3.0 * np.eye(3)])
ANCHOR = LocalFrame(math.radians(37.56), math.radians(127.04), 30.0)


def track(name: str, n: int, **values: Any) -> PoseTrack:
    k = np.arange(n)
    T = T_from_R_t(exp_so3(np.stack([0 * k, 0 * k, 0.1 * k], axis=1)), np.stack([10.0 * k, -5.0 * k, 2.0 + k], axis=1))
    return PoseTrack(name, Trajectory(T0_NS + 100_000_000 * k.astype(np.int64), T), **values)


def messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """(log time, message) by topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as stream:
        for _, channel, message, decoded in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def test_a_viewer_finds_poses_paths_positions_frame_and_health(tmp_path: Path) -> None:
    path = tmp_path / "poses.mcap"
    refined, online = track("refined", 3, position_cov_m2=COV_M2), track("online", 4)
    notes = [HealthNote(T0_NS, "info", "good"), HealthNote(T0_NS + 250_000_000, "warning", "degraded: stale_map")]
    write_poses_mcap(path, ANCHOR, [refined, online], notes, {"drive_id": "d"})
    found = messages(path)
    assert {topic: len(each) for topic, each in found.items()} == {
        "/refined/pose": 3, "/refined/path": 1, "/refined/fix": 3, "/tf": 3,
        "/online/pose": 4, "/online/path": 1, "/online/fix": 4, "/health": 2,
    }  # fmt: skip
    t_ns, pose = found["/refined/pose"][2]
    assert (t_ns, pose.frame_id) == (T0_NS + 200_000_000, "map")
    assert pose.timestamp.seconds * 10**9 + pose.timestamp.nanos == t_ns
    assert (pose.pose.position.x, pose.pose.position.y, pose.pose.position.z) == (20.0, -10.0, 4.0)
    assert pose.pose.orientation.z == pytest.approx(math.sin(0.1))
    assert [p.position.x for p in found["/online/path"][0][1].poses] == [0.0, 10.0, 20.0, 30.0]
    assert [(note.level, note.message) for _, note in found["/health"]] == [(2, "good"), (3, "degraded: stale_map")]
    transform = found["/tf"][1][1]
    assert (transform.parent_frame_id, transform.child_frame_id, transform.translation.x) == ("map", "vehicle", 10.0)


def test_positions_on_the_earth_are_those_of_pyproj(tmp_path: Path) -> None:
    path = tmp_path / "poses.mcap"
    write_poses_mcap(path, ANCHOR, [track("refined", 3, position_cov_m2=COV_M2), track("online", 1)])
    enu_to_ecef = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0=37.56 +lon_0=127.04 +h_0=30"
    )
    ecef_to_geodetic = pyproj.Transformer.from_crs(4978, 4979, always_xy=True)
    found = messages(path)
    for k, (_, fix) in enumerate(found["/refined/fix"]):
        lon, lat, height = ecef_to_geodetic.transform(*enu_to_ecef.transform(10.0 * k, -5.0 * k, 2.0 + k))
        assert (fix.latitude, fix.longitude) == pytest.approx((lat, lon), abs=1e-11)
        assert fix.altitude == pytest.approx(height, abs=1e-6)
        assert np.array_equal(np.reshape(fix.position_covariance, (3, 3)), COV_M2[k])
        assert fix.position_covariance_type == 3  # known
    assert found["/online/fix"][0][1].position_covariance_type == 0  # unknown


def test_a_track_beside_a_drive_leaves_the_vehicle_where_the_drive_says(tmp_path: Path) -> None:
    write_poses_mcap(tmp_path / "poses.mcap", ANCHOR, [track("refined", 3)], moves_vehicle=False)
    found = messages(tmp_path / "poses.mcap")
    assert "/tf" not in found
    assert len(found["/refined/pose"]) == 3


def test_the_frame_is_in_the_metadata(tmp_path: Path) -> None:
    path = tmp_path / "poses.mcap"
    write_poses_mcap(path, ANCHOR, [], metadata={"drive_id": "d"})
    with path.open("rb") as stream:
        record = next(iter(make_reader(stream).iter_metadata()))
    assert record.name == "gnd.poses"
    assert float(record.metadata["map_anchor_lat_rad"]) == ANCHOR.lat_rad
    assert float(record.metadata["map_anchor_lon_rad"]) == ANCHOR.lon_rad
    assert (float(record.metadata["map_anchor_height_m"]), record.metadata["drive_id"]) == (30.0, "d")


def test_a_track_without_poses_has_its_topics_and_no_messages(tmp_path: Path) -> None:
    path = tmp_path / "poses.mcap"
    write_poses_mcap(path, ANCHOR, [track("refined", 0)])
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert "/refined/pose" in {channel.topic for channel in summary.channels.values()}
    assert messages(path) == {}


def test_what_cannot_be_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match="cannot write"):
        write_poses_mcap(tmp_path / "none" / "poses.mcap", ANCHOR, [track("refined", 1)])
    with pytest.raises(BadValue, match="letters"):
        track("re fined", 1)
    with pytest.raises(BadValue, match=r"3 poses, but covariances \(2, 3, 3\)"):
        track("refined", 3, position_cov_m2=COV_M2[:2])
    with pytest.raises(BadValue, match="level 'bad'"):
        HealthNote(T0_NS, "bad", "")
    assert list(tmp_path.iterdir()) == []
