"""Captures of an Ouster that are not as they should be: named, and nothing else is lost."""

import json
import shutil
import struct

import numpy as np
import pytest
from ouster_testing import (
    BEGIN_NS,
    SERIAL,
    TURN_NS,
    capture_packets,
    frame_packets,
    metadata,
    room_ranges_mm,
    write_pcap,
)

from gnd.schemas.drive_mcap import load_track, read_header
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import import_recording, open_recording
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.ouster.metadata import read_metadata
from gnd.vehicle_agent.importers.ouster.points import PointTable
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.importers.udp_packets import UdpCapture

ANCHOR = RecordingAnchor(48.1, 11.5, 520.0)
FULL = 64 * 16


def opened(folder, packets, *, choices=None, cut=0, link=1, **meta):
    metadata(folder / "a.json", **meta)
    path = write_pcap(folder / "a.pcap", packets, cut=cut, link=link)
    return open_recording("auto", path, ANCHOR, choices=choices or Choices())


def noted(recording, words: str) -> bool:
    return any(words in note for note in recording.notes)


def test_a_whole_capture_needs_no_notes(tmp_path):
    recording = opened(tmp_path, capture_packets())
    assert (len(recording), recording.notes) == (4, ())
    assert recording.t_ns.tolist() == [BEGIN_NS + k * TURN_NS for k in range(4)]
    assert [len(recording.read(k)) for k in range(4)] == [FULL] * 4
    assert recording.read(3).t_offset_ns.max() == TURN_NS * 63 // 64
    assert recording.entries[0].used == "scans"
    assert "16 x lidar packets" in f"{recording.entries[0].count} x {recording.entries[0].kind}"


def test_a_bare_ip_capture_and_a_folder_are_read_alike(tmp_path):
    recording = opened(tmp_path, capture_packets(), link=101)
    again = open_recording("auto", tmp_path, ANCHOR)
    assert len(recording) == len(again) == 4
    np.testing.assert_array_equal(recording.read(2).points_m, again.read(2).points_m)
    with pytest.raises(ImportDriveError, match=r"a\.pcap: a capture of link type 105; known are 1"):
        opened(tmp_path, capture_packets(), link=105)
    shutil.copy(tmp_path / "a.pcap", tmp_path / "b.pcap")
    with pytest.raises(ImportDriveError, match=r"2 captures \(a\.pcap, b\.pcap\): name one"):
        open_recording("auto", tmp_path, ANCHOR)


def test_lost_packets_are_counted_and_the_rest_is_kept(tmp_path):
    packets = capture_packets()
    del packets[6], packets[5]
    recording = opened(tmp_path, packets)
    assert noted(recording, "32 of 256 columns missing, in 1 of 4 frames")
    assert [len(recording.read(k)) for k in range(4)] == [FULL, FULL // 2, FULL, FULL]


def test_a_lost_frame_is_counted(tmp_path):
    packets = capture_packets(5)
    recording = opened(tmp_path, packets[:8] + packets[12:])
    assert len(recording) == 4
    assert noted(recording, "1 frames of which no packet was captured")


def test_packets_late_or_twice_change_nothing(tmp_path):
    packets = capture_packets()
    (tmp_path / "whole").mkdir()
    whole = opened(tmp_path / "whole", packets)
    packets[3], packets[4] = packets[4], packets[3]  # over the border of two frames
    packets.insert(9, packets[8])
    recording = opened(tmp_path, packets)
    assert recording.notes == ("16 columns captured twice: taken once",)
    for k in range(4):
        np.testing.assert_array_equal(recording.read(k).points_m, whole.read(k).points_m)


def test_frames_cut_off_at_the_ends_are_left_out(tmp_path):
    recording = opened(tmp_path, capture_packets(5)[2:-2])
    assert len(recording) == 3
    assert noted(recording, "2 frames cut off by the capture: left out")


def test_a_truncated_packet_is_counted_and_so_is_one_of_another_size(tmp_path):
    packets = capture_packets()
    packets[5] = (*packets[5], 100)  # the capture kept 100 bytes of it
    packets.append((packets[-1][0] + 1, "192.168.1.10", 7502, b"\1" * 1000))
    packets.append((packets[-1][0] + 1, "192.168.1.10", 7503, b"\0" * 48))
    recording = opened(tmp_path, packets)
    assert noted(recording, "1 packets cut off or captured in part")
    assert noted(recording, "16 of 256 columns missing")
    held = {entry.kind: entry for entry in recording.entries}
    assert "not of 3328 bytes" in held["packets of 1000 bytes"].why
    assert "a speed as well" in held["IMU packets"].why


def test_a_file_cut_off_gives_what_is_before_and_says_so(tmp_path):
    recording = opened(tmp_path, capture_packets(6), cut=2000)  # in the last packet
    assert [len(recording.read(k)) for k in range(5)] == [FULL] * 5
    assert noted(recording, "1 packets cut off")
    assert noted(recording, "1 frames cut off by the capture")
    whole = write_pcap(tmp_path / "b.pcap", capture_packets(6)).stat().st_size
    again = opened(tmp_path, capture_packets(6), cut=whole // 12 - 8)  # in the header of a packet
    assert noted(again, "the capture is damaged after 22 packets, the rest is left out")
    with pytest.raises(ImportDriveError, match=r"1 whole frame .*at least 2\. .*1 packets cut off"):
        opened(tmp_path, capture_packets(2), cut=2000)


def test_invalid_columns_have_no_points(tmp_path):
    packets = capture_packets()
    data = bytearray(packets[5][3])
    column = 12 + 16 * 12
    data[32 + 3 * column + 10] = 0  # status of its fourth column
    packets[5] = (*packets[5][:3], bytes(data))
    recording = opened(tmp_path, packets)
    assert noted(recording, "1 columns that the sensor marks as not measured")
    assert [len(recording.read(k)) for k in range(4)] == [FULL, FULL - 16, FULL, FULL]


def test_a_window_over_the_end_of_the_turn_counts_as_full(tmp_path):
    numbers = (48 + np.arange(32)) % 64
    packets = []
    for k in range(3):
        packets += [
            (BEGIN_NS + k * TURN_NS, "192.168.1.10", 7502, payload)
            for payload in frame_packets(k, np.full((32, 16), 4_000 + k), numbers=numbers)
        ]
    recording = opened(tmp_path, packets, window=[48, 15])
    assert (len(recording), recording.notes) == (3, ())
    angle = np.degrees(np.arctan2(*recording.read(0).points_m[:, [1, 0]].T))
    assert np.abs(angle).min() > 85.0  # behind the cable's side: columns 48 ... 15 of 64 look to -x


def test_metadata_of_another_mode_are_found_out(tmp_path):
    recording = opened(tmp_path, capture_packets(columns=128), columns=64)
    assert noted(recording, "256 columns beyond the 64 of the metadata")


def test_frame_numbers_begin_again_at_zero(tmp_path):
    packets = []
    for k, raw in enumerate([65_534, 65_535, 0, 1]):
        packets += [
            (BEGIN_NS + k * TURN_NS, "192.168.1.10", 7502, payload)
            for payload in frame_packets(k, np.full((64, 16), 4_000), raw_id=raw)
        ]
    recording = opened(tmp_path, packets)
    assert (len(recording), recording.notes) == (4, ())


def test_a_sensor_that_was_started_again_keeps_all_its_frames(tmp_path):
    packets = []
    for k, raw in enumerate([900, 901, 5, 6]):
        packets += [
            (BEGIN_NS + k * TURN_NS, "192.168.1.10", 7502, payload)
            for payload in frame_packets(k, np.full((64, 16), 4_000), raw_id=raw)
        ]
    recording = opened(tmp_path, packets)
    assert len(recording) == 4
    assert noted(recording, "starts anew 1 times")


def two_sensors():
    other = capture_packets(serial=SERIAL + 1)
    return sorted(capture_packets() + [(t, "192.168.1.11", 7502, data) for t, _, _, data in other])


def test_two_sensors_in_one_capture_are_told_apart(tmp_path):
    metadata(tmp_path / "left.json")
    metadata(tmp_path / "right.json", serial=SERIAL + 1, lidar_origin_to_beam_origin_mm=27.7)
    path = write_pcap(tmp_path / "a.pcap", two_sensors())
    with pytest.raises(ImportDriveError, match=r"--topic 192\.168\.1\.10:7502 .*left\.json; --topic 192\.168\.1\.11"):
        open_recording("auto", path, ANCHOR)
    for wanted, name in (("192.168.1.11", "right"), (str(SERIAL), "left")):
        recording = open_recording("auto", path, ANCHOR, choices=Choices(topic=wanted))
        assert f"{name}.json" in recording.source
        assert [len(recording.read(k)) for k in range(4)] == [FULL] * 4
        assert any("another sensor: --topic" in entry.why for entry in recording.entries)
    with pytest.raises(ImportDriveError, match=r"--topic 7777: no such sensor; it holds 192\.168\.1\.10:7502, 192"):
        open_recording("auto", path, ANCHOR, choices=Choices(topic="7777"))


def test_metadata_of_one_of_two_sensors_read_that_one(tmp_path):
    metadata(tmp_path / "a.json", serial=SERIAL + 1)
    path = write_pcap(tmp_path / "a.pcap", two_sensors())
    recording = open_recording("auto", path, ANCHOR)
    assert "192.168.1.11" in next(entry.name for entry in recording.entries if entry.used == "scans")


def test_metadata_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ImportDriveError, match=r"another sensor or setting: a\.json is of OS-1-16 .*serial number"):
        opened(tmp_path, capture_packets(), serial=42)
    with pytest.raises(ImportDriveError, match=r"packets of 4352 bytes; .*3328 bytes \(RNG19_RFL8_SIG16_NIR16 with 16"):
        opened(tmp_path, capture_packets(), profile="RNG19_RFL8_SIG16_NIR16_DUAL")
    with pytest.raises(ImportDriveError, match=r"4352 bytes; the capture holds 5 packets of 900 bytes"):
        opened(tmp_path, [(1, "10.0.0.1", 7502, b"\1" * 900)] * 5, profile="RNG19_RFL8_SIG16_NIR16_DUAL",
               choices=Choices(sensor=str(tmp_path / "a.json")))  # fmt: skip
    with pytest.raises(ImportDriveError, match="'RNG99' is not read; known are LEGACY"):
        opened(tmp_path, capture_packets(), profile="RNG99")
    for key in ("lidar_origin_to_beam_origin_mm", "lidar_to_sensor_transform", "beam_azimuth_angles"):
        with pytest.raises(ImportDriveError, match=f"without '{key}'"):
            opened(tmp_path, capture_packets(), **{key: None})
    with pytest.raises(ImportDriveError, match="no rigid 4x4 matrix"):
        opened(tmp_path, capture_packets(), lidar_to_sensor_transform=[2.0] * 16)
    with pytest.raises(ImportDriveError, match="16 altitudes and 3 azimuths"):
        opened(tmp_path, capture_packets(), beam_azimuth_angles=[0.0] * 3)


def test_sizes_of_no_sensor_are_refused_before_room_is_made_for_them(tmp_path):
    with pytest.raises(ImportDriveError, match="2147483648 columns a frame"):
        read_metadata(metadata(tmp_path / "a.json", columns=2**31))
    with pytest.raises(ImportDriveError, match=r"2000 altitudes and 2000 azimuths \(1 \.\.\. 1024\)"):
        read_metadata(metadata(tmp_path / "a.json", beams=2_000))


def test_packets_longer_than_any_end_the_capture_there(tmp_path):
    opened(tmp_path, capture_packets())
    path = tmp_path / "a.pcap"
    data = bytearray(path.read_bytes())
    size = struct.unpack_from("<I", data, 24 + 8)[0]
    at = 24 + 14 * (16 + size) + 8  # the fifteenth packet of sixteen says that it is of 4 GiB
    data[at : at + 4] = b"\xff" * 4
    path.write_bytes(data)
    recording = open_recording("auto", path, ANCHOR)
    assert noted(recording, "damaged after 14 packets, the rest is left out: a packet or block of 4294967295 bytes")
    assert len(recording) == 3


def test_pieces_of_a_packet_that_never_ends_are_counted_once_each(tmp_path):
    ip = b"\0" * 12 + b"\x08\x00" + struct.pack(">BBHHHBBH8x", 0x45, 0, 0, 7, 0x2000, 64, 17, 0)
    frames = b"".join(
        struct.pack("<IIII", 1, 0, 42, 42) + ip[:20] + struct.pack(">H", 0x2000 | k) + ip[22:] + b"12345678"
        for k in range(8191)
    )
    (tmp_path / "a.pcap").write_bytes(struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 1 << 18, 1) + frames)
    capture = UdpCapture(tmp_path / "a.pcap")
    assert list(capture.packets()) == []
    assert capture.incomplete == 1


def test_without_metadata_it_says_where_to_get_them(tmp_path):
    path = write_pcap(tmp_path / "a.pcap", capture_packets())
    (tmp_path / "other.json").write_text(json.dumps({"drives": []}))
    with pytest.raises(ImportDriveError, match=r"16 packets of 3328 bytes .* but no metadata.*--sensor FILE"):
        open_recording("auto", path, ANCHOR)
    with pytest.raises(ImportDriveError, match="no readable JSON"):
        open_recording("auto", path, ANCHOR, choices=Choices(sensor=str(tmp_path / "gone.json")))


OFF_NS = BEGIN_NS - 55_000_000_000


def test_a_clock_that_was_not_set_is_laid_on_the_captures(tmp_path):
    """Internal oscillator: the sensor was switched on 55 s before."""
    recording = opened(tmp_path, capture_packets(begin_ns=BEGIN_NS - OFF_NS), timestamp_mode="TIME_FROM_INTERNAL_OSC")
    assert noted(recording, "clock was not set (TIME_FROM_INTERNAL_OSC)")
    late_ns = recording.t_ns - (BEGIN_NS + np.arange(4) * TURN_NS)
    assert len(set(late_ns.tolist())) == 1
    assert 0 < late_ns[0] <= 1_000_000 + TURN_NS // 64


def test_no_clock_at_all_makes_up_the_day_and_says_so(tmp_path):
    packets = [(0, *rest) for _, *rest in capture_packets(begin_ns=55_000_000_000)]
    recording = opened(tmp_path, packets)
    assert not recording.timed
    assert noted(recording, "neither the sensor's clock")


def test_atomic_time_becomes_utc_and_other_differences_are_warnings(tmp_path):
    ahead = opened(tmp_path, capture_packets(begin_ns=BEGIN_NS + 37 * 10**9), timestamp_mode="TIME_FROM_PTP_1588")
    assert ahead.t_ns.tolist() == [BEGIN_NS + k * TURN_NS for k in range(4)]
    assert noted(ahead, "(TIME_FROM_PTP_1588) is 36.9")
    odd = opened(tmp_path, capture_packets(begin_ns=BEGIN_NS + 18 * 10**9))
    assert odd.t_ns[0] == BEGIN_NS + 18 * 10**9
    assert noted(odd, "warning: the sensor's clock")


def test_a_clock_that_is_set_in_the_capture_costs_no_frame(tmp_path):
    """The first two turns count from the start of the sensor, the others are UTC."""
    before = capture_packets(4, begin_ns=55_000_000_000)[:8]
    recording = opened(tmp_path, before + capture_packets(4)[8:])
    assert len(recording) == 4
    assert np.abs(np.diff(recording.t_ns) - TURN_NS).max() < 3_000_000


def test_a_clock_that_steps_back_loses_only_the_frames_that_overlap(tmp_path):
    first, second = capture_packets(4), capture_packets(8, begin_ns=BEGIN_NS - 2 * TURN_NS)
    recording = opened(tmp_path, first[:16] + second[16:])
    assert noted(recording, "2 frames in or after which the sensor's clock stepped")
    assert len(recording) == 6
    assert (np.diff(recording.t_ns) > 0).all()


def test_the_mixed_capture_of_a_velodyne_and_an_ouster(tmp_path, shared_data):
    """The Velodyne is read as before; the Ouster's packets are named with what to do."""
    velodyne = (shared_data / "captures_a" / "sample_velodyne_vlp16_gps.pcap").read_bytes()
    (tmp_path / "o").mkdir()
    other = write_pcap(tmp_path / "o" / "b.pcap", capture_packets(), link=1).read_bytes()
    head = other[:24]
    records, at = [], 24
    while at < len(velodyne):
        seconds, micros, size, whole = np.frombuffer(velodyne, "<u4", 4, at).tolist()
        records.append(np.array([seconds, micros * 1000, size, whole], "<u4").tobytes() + velodyne[at + 16 :][:size])
        at += 16 + size
    (tmp_path / "a.pcap").write_bytes(head + b"".join(records) + other[24:])
    recording = open_recording("auto", tmp_path / "a.pcap", ANCHOR)
    assert recording.source.endswith("velodyne-decoder")
    assert any("--sensor FILE.json" in entry.why for entry in recording.entries)
    metadata(tmp_path / "m.json")
    chosen = open_recording("auto", tmp_path / "a.pcap", ANCHOR, choices=Choices(sensor=str(tmp_path / "m.json")))
    assert (chosen.sensor_model, len(chosen)) == ("OS-1-16", 4)


def test_a_drive_of_a_capture_has_the_way_of_the_sensor(tmp_path):
    """A sensor that drives at 4 m/s through a room: odometry over the decoded turns finds its way, times of points in
    the drive are those of the columns.
    """
    meta = read_metadata(metadata(tmp_path / "a.json", columns=512, beams=32))
    table, way = PointTable.of(meta), 4.0
    packets = []
    for k in range(10):
        T = np.tile(np.eye(4), (512, 1, 1))
        T[:, 0, 3] = way * 0.1 * (k + np.arange(512) / 512)
        range_mm = room_ranges_mm(meta, table, T)
        for i, payload in enumerate(frame_packets(k, range_mm)):
            packets.append((BEGIN_NS + k * TURN_NS + (i + 1) * TURN_NS // 32, "192.168.1.10", 7502, payload))
    path = write_pcap(tmp_path / "a.pcap", packets)
    done = import_recording("auto", path, tmp_path / "drive.mcap", anchor=ANCHOR)
    assert (done.scans, done.bad) == (10, ())
    header, track = read_header(tmp_path / "drive.mcap"), load_track(tmp_path / "drive.mcap")
    assert (header.deskew, header.sensor_model, header.nowhere) == ("measured", "OS-1-16", False)
    p = track.reference.T_map_vehicle[:, :3, 3]
    driven_m = np.linalg.norm(p - p[0], axis=1)
    np.testing.assert_allclose(driven_m, way * 0.1 * np.arange(10), atol=0.04)
