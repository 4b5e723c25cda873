"""Packets of an Ouster: our decoder against what ouster-sdk read from the same files (make_ouster_golden.py)."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gnd.vehicle_agent.importer import open_recording
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.ouster.metadata import read_metadata
from gnd.vehicle_agent.importers.ouster.packets import PROFILES, packet_dtype, ranges_mm
from gnd.vehicle_agent.importers.ouster.points import PointTable
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.importers.udp_packets import UdpCapture

GOLDEN = Path(__file__).parent / "ouster_golden"
ANCHOR = RecordingAnchor(48.1, 11.5, 520.0)
FLOAT32 = np.finfo(np.float32).eps


def expected_scan(golden, frame: int, metadata) -> tuple:
    """Points, times and rings of a frame as the library reads them: by time, second returns last."""
    table, points, t_ns, rings = PointTable.of(metadata), [], [], []
    for k, range_mm in enumerate(golden["range_mm"][frame]):
        columns, beams = np.nonzero((range_mm * ((golden["status"][frame] & 1) > 0)).T)
        xyz = golden["points_m"][k] if frame == 1 else table.points_m(np.arange(32), range_mm.T).transpose(1, 0, 2)
        points.append(xyz[beams, columns])
        t_ns.append(golden["t_ns"][frame].astype(np.int64)[columns])
        rings.append(beams)
    return np.concatenate(points), np.concatenate(t_ns), np.concatenate(rings)


def test_the_golden_files_hold_every_profile():
    assert {path.stem for path in GOLDEN.glob("*.pcap")} == set(PROFILES)


@pytest.mark.parametrize("form", ["flat", "nested"])
@pytest.mark.parametrize("profile", PROFILES)
def test_each_profile_is_read_as_ousters_own_library_does(tmp_path, profile, form):
    """Both forms of the metadata; ranges and times to the bit, points to the rounding of float32."""
    shutil.copy(GOLDEN / f"{profile}.pcap", tmp_path / "a.pcap")
    shutil.copy(GOLDEN / (f"{profile}.json" if form == "flat" else f"{profile}_nested.json"), tmp_path / "a.json")
    golden, metadata = np.load(GOLDEN / f"{profile}.npz"), read_metadata(tmp_path / "a.json")
    assert metadata.timestamp_mode == ("" if form == "flat" else "TIME_FROM_PTP_1588")
    recording = open_recording("auto", tmp_path / "a.pcap", ANCHOR)
    assert (len(recording), recording.sensor_model, recording.timed) == (3, "OS-1-8", True)
    for frame in range(3):
        points_m, t_ns, rings = expected_scan(golden, frame, metadata)
        scan = recording.read(frame)
        assert len(scan) == len(points_m) > 100
        np.testing.assert_array_equal(scan.ring, rings)
        np.testing.assert_array_equal(scan.t_ns + scan.t_offset_ns.astype(np.int64), t_ns)
        np.testing.assert_allclose(scan.points_m, points_m, rtol=FLOAT32, atol=1e-9)
    assert scan.t_ns == recording.t_ns[2] == golden["t_ns"][2].min()
    assert any("1 columns that the sensor marks as not measured" in note for note in recording.notes)


@pytest.mark.parametrize("profile", PROFILES)
def test_points_agree_before_they_are_rounded(profile):
    golden, metadata = np.load(GOLDEN / f"{profile}.npz"), read_metadata(GOLDEN / f"{profile}.json")
    layout = packet_dtype(metadata.profile, 8, 16)
    packets = [np.frombuffer(one.payload, layout)[0] for one in UdpCapture(GOLDEN / f"{profile}.pcap").packets()]
    columns = np.stack(packets)["columns"][2:4].reshape(-1)
    for k, range_mm in enumerate(ranges_mm(metadata.profile, columns["pixels"])):
        hit = (range_mm > 0) & ((columns["status"] & 1) > 0)[:, None]
        points = PointTable.of(metadata).points_m(np.arange(32), range_mm)
        np.testing.assert_allclose(points[hit], golden["points_m"][k].transpose(1, 0, 2)[hit], rtol=0, atol=1e-9)


def test_a_wrong_layout_is_noticed(tmp_path):
    """The comparison can fail: the same bytes as the single return of another profile give other ranges."""
    golden, metadata = np.load(GOLDEN / "RNG15_RFL8_NIR8_DUAL.npz"), read_metadata(GOLDEN / "RNG15_RFL8_NIR8_DUAL.json")
    packet = next(UdpCapture(GOLDEN / "RNG15_RFL8_NIR8_DUAL.pcap").packets()).payload
    for profile, same in ((PROFILES["RNG15_RFL8_NIR8_ZONE16"], True), (PROFILES["RNG19_RFL8_SIG16_NIR16"], False)):
        if profile.packet_bytes(8, 16) <= len(packet):
            columns = np.frombuffer(packet, packet_dtype(profile, 8, 16), 1)[0]["columns"]
        else:
            columns = np.frombuffer(packet.ljust(9999, b"\0"), packet_dtype(profile, 8, 16), 1)[0]["columns"]
        read = ranges_mm(profile, columns["pixels"])[0].T
        assert np.array_equal(read, golden["range_mm"][0, 0][:, :16]) == same
    assert metadata.n_beams == 8


def test_a_real_capture_has_the_ranges_and_times_that_ouster_publishes(shared_data):
    """OS-0-128, firmware 2.3: one turn, held against the digest that lies beside it."""
    place = shared_data / "captures_a" / "OS-0-128-U1_v2.3.0_1024x10.pcap"
    digest = json.loads(place.with_name(place.stem + "_digest.json").read_text())["scans"][0]
    metadata = read_metadata(place.with_suffix(".json"))
    layout = packet_dtype(metadata.profile, metadata.n_beams, metadata.columns_per_packet)
    data = [one.payload for one in UdpCapture(place).packets() if len(one.payload) == metadata.packet_bytes]
    packets = np.frombuffer(b"".join(data), layout)
    assert {int(one) for one in packets["frame_id"]} == {int(digest["FRAME_ID"])}
    columns = packets["columns"].reshape(-1)
    assert columns["measurement_id"].tolist() == list(range(1024))
    range_mm = np.ascontiguousarray(ranges_mm(metadata.profile, columns["pixels"])[0].T)
    assert hashlib.md5(range_mm.tobytes()).hexdigest() == digest["RANGE"]
    assert hashlib.md5(np.ascontiguousarray(columns["t_ns"]).tobytes()).hexdigest() == digest["TIMESTAMP"]


def test_metadata_named_by_sensor_keep_the_name_of_the_sensor(tmp_path):
    shutil.copy(GOLDEN / "LEGACY.pcap", tmp_path / "a.pcap")
    shutil.copy(GOLDEN / "LEGACY_nested.json", tmp_path / "elsewhere.json")
    (tmp_path / "b").mkdir()
    shutil.move(tmp_path / "elsewhere.json", tmp_path / "b" / "m.json")
    recording = open_recording("auto", tmp_path / "a.pcap", choices=Choices(sensor=str(tmp_path / "b" / "m.json")))
    assert (recording.sensor_model, recording.placed, recording.mount) == ("OS-1-8", False, "assumed")
