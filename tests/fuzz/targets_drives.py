"""Targets: drives, trajectories, and the recordings of others that `gnd import` reads."""

import io
import json
import lzma
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import dpkt
import laspy
import numpy as np
import pyarrow as pa
from bag_testing import cloud as ros_cloud
from bag_testing import fix as ros_fix
from bag_testing import write_bag
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from fuzz_folder import folder, in_recording, on_file
from fuzz_mcap import mcap_mutated
from fuzz_mutators import bytes_mutated, message_mutated, text_mutated
from fuzz_target import FuzzTarget
from lzf_testing import lzf_compress
from mcap_protobuf.writer import Writer as ProtobufWriter
from ouster_testing import capture_packets, metadata, write_pcap
from pyarrow import feather
from targets_bus import ITEM_MESSAGES, _items

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveHeader
from gnd.schemas.drive_mcap import ITEM_TOPICS, DriveWriter, item_of, load_track, read_drive, read_header
from gnd.schemas.trajectory_files import kitti_text, read_kitti, read_tum, times_text, tum_text
from gnd.vehicle_agent.importer import open_recording
from gnd.vehicle_agent.importers.apollo_map import read_ndt_map
from gnd.vehicle_agent.importers.argoverse_logs import _columns
from gnd.vehicle_agent.importers.fields import scan_of_fields
from gnd.vehicle_agent.importers.files import read_file
from gnd.vehicle_agent.importers.ouster.metadata import read_metadata
from gnd.vehicle_agent.importers.pcd import read_scan
from gnd.vehicle_agent.importers.pcd_format import read_pcd
from gnd.vehicle_agent.importers.point_cloud2 import decode_cloud
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.importers.trajectories.pose_file import read_poses
from gnd.vehicle_agent.localise.drawn_map import read_fixes
from gnd.vehicle_agent.localise.drawn_map import read_track as read_drawn_track
from gnd.vehicle_agent.way import read_way

_FOXGLOVE = {"<f4": 7, "<u4": 5, "<u2": 3}
ANCHOR = RecordingAnchor(49.0, 8.4, 160.0, 90.0)
Files = Callable[[], Mapping[str, bytes]]


def opened(kind: str, named: str = "") -> Callable[[Path], object]:
    """Open a recording as `gnd import` does and read its first scans."""

    def read(place: Path) -> object:
        recording = open_recording(kind, place / named if named else place, ANCHOR)
        return [recording.read(number) for number in range(min(len(recording), 2))]

    return read


def _recording_target(name: str, reads: tuple[str, ...], form: str, kind: str, files: Files, at: str, mutate: Any,
                      named: str = "", rounds: int = 40) -> FuzzTarget:  # fmt: skip
    call = in_recording(name, files, at, opened(kind, named))
    return FuzzTarget(name, reads, form, call, lambda: [files()[at]], mutate, rounds=rounds)


# --- our own ----------------------------------------------------------------------------------------------------------


@cache
def _drive() -> bytes:
    header = DriveHeader("drive-1", "car-1", "VLP-16", LocalFrame(0.855, 0.146, 110.0), np.eye(4), "made up")
    path = folder("seeds") / "drive.mcap"
    with DriveWriter(path, header) as writer:
        for item in (item_of(ITEM_TOPICS[data[0]], data[1:]) for data in _items()):
            writer.add(item)
            writer.add(replace(item, t_ns=item.t_ns + 100_000_000))
    return path.read_bytes()


def _read_drive(path: Path) -> object:
    return read_header(path), load_track(path), list(read_drive(path))


@cache
def _foreign() -> bytes:
    """Clouds of Foxglove, as another program writes them."""
    path = folder("seeds") / "foreign.mcap"
    points = _points()
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        for k in range(3):
            cloud = PointCloud(point_stride=points.dtype.itemsize, data=_points(seed=k).tobytes(), frame_id="lidar")
            cloud.timestamp.FromNanoseconds(10**18 + k * 10**8)
            for name, (kind, offset) in (points.dtype.fields or {}).items():
                cloud.fields.add(name=name, offset=offset, type=_FOXGLOVE[kind.str])
            writer.write_message("/points", cloud, log_time=10**18 + k * 10**8)
    return path.read_bytes()


_MESSAGES = {kind.DESCRIPTOR.full_name: message_mutated(kind) for kind in (*ITEM_MESSAGES.values(), PointCloud)}
_drive_mutated = mcap_mutated(_MESSAGES)


def _trajectory() -> Trajectory:
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = [0.0, 1.5, 3.0]
    return Trajectory(np.array([1, 2, 3], np.int64) * 10**9, T)


def _kitti_pair(path: Path) -> object:
    times = path.with_name("times.txt")
    if not times.exists():
        times.write_text(times_text(_trajectory().t_ns))
    return read_kitti(path, times)


def _way() -> bytes:
    one = {"t_ns": 1, "wall_ns": 2, "odometer_m": 3.0, "lat_rad": 0.8, "lon_rad": 0.1, "tile": 5, "version": 1}
    return (json.dumps(one) + "\n").encode()


# --- clouds -----------------------------------------------------------------------------------------------------------

_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2")])


def _points(n: int = 24, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = np.zeros(n, _POINT)
    for name in ("x", "y", "z", "intensity"):
        points[name] = rng.uniform(-20, 20, n)
    points["t"], points["ring"] = np.arange(n) * 4_000_000, np.arange(n) % 4
    return points


def _pcd(data: str) -> bytes:
    points = _points()
    size = " ".join(str(points.dtype[name].itemsize) for name in points.dtype.names or ())
    head = (f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(points.dtype.names or ())}\nSIZE {size}\nTYPE F F F F U U\n"
            f"COUNT 1 1 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\n"
            f"DATA {data}\n").encode()  # fmt: skip
    if data == "ascii":
        return head + b"".join(" ".join(map(str, row)).encode() + b"\n" for row in points.tolist())
    if data == "binary":
        return head + points.tobytes()
    columns = b"".join(points[name].tobytes() for name in points.dtype.names or ())
    packed = lzf_compress(columns)
    return head + struct.pack("<II", len(packed), len(columns)) + packed


def _pcd_mutated(data: bytes, rng: Random) -> bytes:
    """The header changes as text, what follows as bytes."""
    at = data.find(b"\n", max(data.find(b"DATA"), 0)) + 1
    if at <= 0 or rng.randrange(3) == 0:
        return bytes_mutated(data, rng)
    return text_mutated(data[:at], rng) + data[at:] if rng.randrange(3) else data[:at] + bytes_mutated(data[at:], rng)


def _pcd_scan(path: Path) -> object:
    return read_pcd(path), read_scan(path, 0)


def _pcd_folder() -> dict[str, bytes]:
    return {f"scans/{k:06d}.pcd": _pcd("binary") for k in range(3)} | {
        "scans/poses.txt": "".join(f"{k * 0.1} {k} 0 0 0 0 0 1\n" for k in range(3)).encode()
    }


def _feathers() -> list[bytes]:
    table = pa.table({"x": np.arange(9.0), "laser_number": np.arange(9, dtype=np.uint8)})
    coded = pa.table({"x": pa.array(["a"] * 9).dictionary_encode(), "laser_number": table["laser_number"]})
    found = []
    for one, packed in ((table, "zstd"), (table, "uncompressed"), (coded, "lz4")):
        feather.write_feather(one, out := io.BytesIO(), compression=packed)
        found.append(out.getvalue())
    return found


def _las(compress: bool = False) -> bytes:
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = [0.001] * 3
    las, stream = laspy.LasData(header), io.BytesIO()
    points = _points()
    las.x, las.y, las.z = points["x"], points["y"], points["z"]
    las.gps_time = 1e8 + points["t"] * 1e-9
    las.write(stream, do_compress=compress)
    return stream.getvalue()


def _las_files(ending: str) -> Files:
    return lambda: {f"{k}.{ending}": _las(ending == "laz") for k in range(3)}


def _cloud_message() -> bytes:
    from bag_testing import STORE

    message = ros_cloud(_points(), 10**18)
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def _cloud(data: bytes) -> object:
    decoded = decode_cloud("a cloud", data)
    return scan_of_fields(decoded.points, decoded.stamp_ns)


def _bag(storage: str) -> bytes:
    path = folder("seeds") / f"bag-{storage}"
    if not path.exists():
        clouds = [("/points", 10**18 + k * 10**8, ros_cloud(_points(seed=k), 10**18 + k * 10**8)) for k in range(3)]
        fixes = [("/fix", 10**18 + k * 10**8, ros_fix(10**18 + k * 10**8, (49.0, 8.4, 110.0), 1.0)) for k in range(3)]
        write_bag(path, [*clouds, *fixes], storage)
    ending = {"mcap": "*.mcap", "sqlite3": "*.db3"}[storage]
    return next(path.glob(ending)).read_bytes()


def _bag_metadata() -> bytes:
    _bag("mcap")
    return (folder("seeds") / "bag-mcap" / "metadata.yaml").read_bytes()


# --- captures ---------------------------------------------------------------------------------------------------------


def _ouster() -> dict[str, bytes]:
    made = folder("seeds")
    packets = [one for k, one in enumerate(capture_packets(turns=3, columns=32, beams=4)) if k < 12]
    pcap = write_pcap(made / "ouster.pcap", packets).read_bytes()
    return {"a.pcap": pcap, "a.json": metadata(made / "ouster.json", beams=4, columns=32).read_bytes()}


def _ouster_ng() -> dict[str, bytes]:
    """The same as pcapng: a section, an interface that says how its times count, a block a packet."""
    made, pcap = _ouster(), io.BytesIO()
    pcap.write(_ng_block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)))
    pcap.write(_ng_block(1, struct.pack("<HHI", 1, 0, 1 << 18) + struct.pack("<HHB3xHH", 9, 1, 9, 0, 0)))
    for stamp_s, frame in dpkt.pcap.Reader(io.BytesIO(made["a.pcap"])):
        high, low = divmod(round(stamp_s * 10**9), 1 << 32)
        packed = frame + bytes(-len(frame) % 4)
        pcap.write(_ng_block(6, struct.pack("<IIIII", 0, high, low, len(frame), len(frame)) + packed))
    return {"a.pcap": pcap.getvalue(), "a.json": made["a.json"]}


def _ng_block(kind: int, body: bytes) -> bytes:
    size = 12 + len(body)
    return struct.pack("<II", kind, size) + body + struct.pack("<I", size)


def _velodyne() -> dict[str, bytes]:
    """Packets of a VLP-16 whose azimuths go round in twelve packets."""
    packets = []
    for k in range(40):
        body = b""
        for block in range(12):
            azimuth = (k * 12 + block) * 300 % 36_000
            body += struct.pack("<HH", 0xEEFF, azimuth) + struct.pack("<HB", 2_000 + k, 10) * 32
        payload = body + struct.pack("<IBB", k * 1_330, 0x37, 0x22)
        packets.append((10**18 + k * 1_330_000, "192.168.1.201", 2368, payload))
    return {"v.pcap": write_pcap(folder("seeds") / "velodyne.pcap", packets).read_bytes()}


# --- folders ----------------------------------------------------------------------------------------------------------


def _bins(width: int) -> bytes:
    rng = np.random.default_rng(3)
    rows = rng.uniform(-20, 20, (40, width)).astype("<f4")
    rows[:, 3] = 0.3
    if width == 5:
        rows[:, 4] = np.arange(40) % 16
    return rows.tobytes()


def _kitti() -> dict[str, bytes]:
    pose = "1 0 0 {k} 0 1 0 0 0 0 1 0\n"
    return {f"velodyne/{k:06d}.bin": _bins(4) for k in range(3)} | {
        "times.txt": b"0.0\n0.1\n0.2\n",
        "poses.txt": "".join(pose.format(k=k) for k in range(3)).encode(),
        "calib.txt": b"P0: 1 0\nTr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n",
    }


def _kitti_raw() -> dict[str, bytes]:
    stamps = "".join(f"2011-09-26 13:02:25.{k}00000000\n" for k in range(3)).encode()
    oxts = " ".join(["49.0", "8.4", "110.0", "0.1", "0.0", "1.0", *["0.5"] * 17, "1.0", "0.2", *["4"] * 5])
    return {f"velodyne_points/data/{k:010d}.bin": _bins(4) for k in range(3)} | {
        "velodyne_points/timestamps.txt": stamps,
        "oxts/timestamps.txt": stamps,
        **{f"oxts/data/{k:010d}.txt": oxts.encode() for k in range(3)},
    }


def _nuscenes() -> dict[str, bytes]:
    def table(*rows: dict[str, Any]) -> bytes:
        return json.dumps(rows).encode()

    sweeps = [
        {"token": f"d{k}", "sample_token": "s", "ego_pose_token": f"e{k}", "calibrated_sensor_token": "c",
         "timestamp": 1_532_402_927_647_951 + 50_000 * k, "filename": f"sweeps/LIDAR_TOP/{k}.bin",
         "next": "", "prev": "", "is_key_frame": True, "fileformat": "pcd"}
        for k in range(3)
    ]  # fmt: skip
    poses = [
        {"token": f"e{k}", "timestamp": 1_532_402_927_647_951 + 50_000 * k, "rotation": [1.0, 0.0, 0.0, 0.0],
         "translation": [400.0 + k, 1100.0, 0.0]} for k in range(3)
    ]  # fmt: skip
    mount = {"token": "c", "sensor_token": "n", "translation": [0.9, 0.0, 1.8], "rotation": [0.7, 0, 0, -0.7]}
    return {
        "v1.0-mini/scene.json": table({"token": "sc", "name": "scene-0061", "log_token": "l", "nbr_samples": 1,
                                       "first_sample_token": "s", "last_sample_token": "s"}),
        "v1.0-mini/log.json": table({"token": "l", "location": "singapore-onenorth", "vehicle": "n015"}),
        "v1.0-mini/sample.json": table({"token": "s", "scene_token": "sc", "timestamp": 1, "next": "", "prev": ""}),
        "v1.0-mini/sample_data.json": table(*sweeps),
        "v1.0-mini/ego_pose.json": table(*poses),
        "v1.0-mini/calibrated_sensor.json": table(mount),
        "v1.0-mini/sensor.json": table({"token": "n", "channel": "LIDAR_TOP", "modality": "lidar"}),
        **{f"sweeps/LIDAR_TOP/{k}.bin": _bins(5) for k in range(3)},
    }  # fmt: skip


def _apollo_map() -> dict[str, bytes]:
    cell = struct.pack("<iffII12f", 3, 0.1, 0.0, 0, 4, *([0.4, 0.5, 0.6] + [0.3] * 9))
    column = struct.pack("<I", 1) + cell + struct.pack("<iiI", 3, 3, 0)
    body = zlib.compress(struct.pack("<2I", 1, 2) + column + column)
    node = struct.pack("<5I", 0, 10, 100, 50, len(body)) + body
    config = (b"<version>map_ndt_v01</version><x>2</x><resolutions><resolution>1.0</resolution></resolutions>"
              b"<resolutions_z><resolution>1.0</resolution></resolutions_z>")  # fmt: skip
    return {"ndt_map/map/000/north/10/00000100/00000050": node, "ndt_map/config.xml": config}


def _apollo_mutated(data: bytes, rng: Random) -> bytes:
    """What is packed in a node changes, or bytes of the node."""
    if rng.randrange(4) == 0:
        return bytes_mutated(data, rng)
    try:
        plain = bytes_mutated(zlib.decompressobj().decompress(data[20:], 1 << 20), rng)
    except zlib.error:
        return bytes_mutated(data, rng)
    body = zlib.compress(plain, 1)
    return data[:16] + struct.pack("<I", len(body)) + body


def _poses_texts() -> list[bytes]:
    path = _trajectory()
    return [
        tum_text(path).encode(),
        kitti_text(path).encode(),
        b"timestamp,x,y,z,qx,qy,qz,qw\n1.0,0,0,0,0,0,0,1\n2.0,1,0,0,0,0,0,1\n3.0,2,0,0,0,0,0,1\n",
        b"time,lat,lon,height,roll,pitch,yaw\n1.5e9,49.0,8.4,110,0,0,90\n1500000001,49.00001,8.4,110,0,0,90\n",
        b"%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m)\n"
        b"2022/07/12 01:00:00.000 35.1 136.9 80.1 1 20 0.01 0.01 0.02\n"
        b"2022/07/12 01:00:00.200 35.10001 136.9 80.1 1 20 0.01 0.01 0.02\n",
        b"$GPGGA,120000.00,4900.0000,N,00824.0000,E,4,12,0.8,110.0,M,48.0,M,,*52\n"
        b"$GPRMC,120000.00,A,4900.0000,N,00824.0000,E,10.0,90.0,230926,,,A*5B\n"
        b"$GPGGA,120001.00,4900.0010,N,00824.0000,E,4,12,0.8,110.0,M,48.0,M,,*52\n",
        json.dumps({"type": "FeatureCollection", "features": [
            {"type": "Feature", "properties": {"time": 1.5e9 + k},
             "geometry": {"type": "Point", "coordinates": [8.4, 49.0 + k * 1e-5, 110.0]}} for k in range(3)]}).encode(),
        json.dumps({"type": "Feature", "properties": {"coordTimes": [1.5e9, 1.5e9 + 1]},
                    "geometry": {"type": "LineString", "coordinates": [[8.4, 49, 110], [8.41, 49, 110]]}}).encode(),
    ]  # fmt: skip


def _xz(data: bytes, rng: Random) -> bytes:
    return _xz_bomb() if rng.randrange(2000) == 0 else bytes_mutated(data, rng)


@cache
def _xz_bomb() -> bytes:
    return lzma.compress(bytes(1 << 28), preset=0)


_IMPORTERS = "vehicle_agent/importers"
TARGETS = (
    FuzzTarget("drive", ("schemas/drive_mcap.py:read_header", "schemas/drive_mcap.py:read_drive",
                         "schemas/drive_mcap.py:load_track", "schemas/mcap_file.py:open_mcap",
                         "src/gnd/recorded.py:open_drive"),
               "a drive (MCAP)", on_file("drive.mcap", _read_drive), lambda: [_drive()], _drive_mutated),
    FuzzTarget("tum", ("schemas/trajectory_files.py:read_tum",),
               "TUM trajectories",
               on_file("tum.txt", read_tum), lambda: [tum_text(_trajectory()).encode()], text_mutated),
    FuzzTarget("kitti-trajectory", ("schemas/trajectory_files.py:read_kitti",), "KITTI trajectories",
               on_file("kitti.txt", _kitti_pair), lambda: [kitti_text(_trajectory()).encode()], text_mutated),
    FuzzTarget("drawn-fixes", ("vehicle_agent/localise/drawn_map.py:read_fixes",), "fixes along a drawn map (text)",
               on_file("fixes.txt", read_fixes), lambda: [b"49 8.4\n49.1 8.4\n"], text_mutated),
    FuzzTarget("drawn-track", ("vehicle_agent/localise/drawn_map.py:read_track",), "poses of a drawn map (text)",
               on_file("track.txt", read_drawn_track), lambda: [kitti_text(_trajectory()).encode()], text_mutated),
    FuzzTarget("way", ("vehicle_agent/way.py:read_way",), "the way of an agent (JSON lines)",
               on_file("way.jsonl", read_way), lambda: [_way()], text_mutated),
    FuzzTarget("pcd", (f"{_IMPORTERS}/pcd_format.py:read_pcd", f"{_IMPORTERS}/pcd.py:read_scan"), "PCD files",
               on_file("a.pcd", _pcd_scan), lambda: [_pcd(kind) for kind in ("ascii", "binary", "binary_compressed")],
               _pcd_mutated),
    _recording_target("pcd-folder", (f"{_IMPORTERS}/pcd.py:open_pcd",), "a folder of PCD files: its poses", "pcd",
                      _pcd_folder, "scans/poses.txt", text_mutated),
    FuzzTarget("las", (f"{_IMPORTERS}/las.py:open_las",), "LAS files",
               in_recording("las", _las_files("las"), "1.las", opened("las")), lambda: [_las()], bytes_mutated,
               rounds=40),
    FuzzTarget("laz", (), "LAZ files", in_recording("laz", _las_files("laz"), "1.laz", opened("las")),
               lambda: [_las(True)], bytes_mutated, rounds=40),
    FuzzTarget("feather", (f"{_IMPORTERS}/feather_header.py:read_feather",), "tables of Argoverse 2 (Feather)",
               on_file("a.feather", lambda path: _columns(path, ("x", "laser_number"))), _feathers, bytes_mutated),
    FuzzTarget("xz", (f"{_IMPORTERS}/files.py:read_file",), "packed scans (xz)", on_file("a.bin.xz", read_file),
               lambda: [lzma.compress(_bins(4))], _xz, rounds=20),
    FuzzTarget("point-cloud2", (f"{_IMPORTERS}/point_cloud2.py:decode_cloud", f"{_IMPORTERS}/fields.py:unpack"),
               "sensor_msgs/PointCloud2 (CDR)", _cloud, lambda: [_cloud_message()], bytes_mutated),
    _recording_target("bag-mcap", (f"{_IMPORTERS}/ros/reader.py:open_ros", f"{_IMPORTERS}/ros/bag.py:Bag.decode",
                                   f"{_IMPORTERS}/ros/small_messages.py:read_small"),
                      "bags of ROS 2 (MCAP)", "ros", lambda: {"bag.mcap": _bag("mcap")}, "bag.mcap", mcap_mutated({}),
                      rounds=20),
    _recording_target("bag-sqlite", (), "bags of ROS 2 (SQLite)", "ros", lambda: {"bag.db3": _bag("sqlite3")},
                      "bag.db3", bytes_mutated, rounds=10),
    _recording_target("foreign-mcap", (f"{_IMPORTERS}/mcap_clouds.py:open_mcap_clouds",), "MCAP files of clouds",
                      "mcap", lambda: {"a.mcap": _foreign()}, "a.mcap", _drive_mutated, rounds=20),
    _recording_target("own-drive", (), "a drive as a recording (MCAP)", "mcap", lambda: {"a.mcap": _drive()}, "a.mcap",
                      _drive_mutated, rounds=10),
    _recording_target("ouster-pcap", (f"{_IMPORTERS}/pcap.py:open_pcap", f"{_IMPORTERS}/ouster/capture.py:open_ouster",
                                      f"{_IMPORTERS}/ouster/frames.py:OusterFrames.read"),
                      "captures of Ouster (pcap)", "pcap", _ouster, "a.pcap", bytes_mutated, "a.pcap", rounds=20),
    _recording_target("ouster-pcapng", (), "captures of Ouster (pcapng)", "pcap", _ouster_ng, "a.pcap", bytes_mutated,
                      "a.pcap", rounds=20),
    _recording_target("ouster-metadata", (f"{_IMPORTERS}/ouster/metadata.py:read_metadata",), "metadata of Ouster",
                      "pcap", _ouster, "a.json", text_mutated, "a.pcap", rounds=20),
    FuzzTarget("ouster-metadata-alone", (), "metadata of Ouster (JSON)", on_file("a.json", read_metadata),
               lambda: [_ouster()["a.json"]], text_mutated),
    _recording_target("velodyne-pcap", (f"{_IMPORTERS}/pcap.py:_Turns.read",), "captures of Velodyne (pcap)", "pcap",
                      _velodyne, "v.pcap", bytes_mutated, "v.pcap", rounds=10),
    _recording_target("kitti-bin", (f"{_IMPORTERS}/kitti.py:open_kitti",), "KITTI scans", "kitti", _kitti,
                      "velodyne/000001.bin", bytes_mutated),
    _recording_target("kitti-times", (), "KITTI times", "kitti", _kitti, "times.txt", text_mutated),
    _recording_target("kitti-poses", (), "KITTI poses", "kitti", _kitti, "poses.txt", text_mutated),
    _recording_target("kitti-calib", (), "KITTI calibration", "kitti", _kitti, "calib.txt", text_mutated),
    _recording_target("bins", (f"{_IMPORTERS}/bins.py:open_bins", f"{_IMPORTERS}/bins.py:read_bin"), "rows of float32",
                      "bin", lambda: {f"{k}.bin": _bins(5) for k in range(3)}, "1.bin", bytes_mutated),
    _recording_target("kitti-raw-times", (f"{_IMPORTERS}/kitti_raw.py:open_kitti_raw",), "KITTI raw: times",
                      "kitti-raw", _kitti_raw, "velodyne_points/timestamps.txt", text_mutated),
    _recording_target("kitti-raw-oxts", (), "KITTI raw: positions", "kitti-raw", _kitti_raw,
                      "oxts/data/0000000001.txt", text_mutated),
    *(_recording_target(f"nuscenes-{table}", (f"{_IMPORTERS}/nuscenes.py:open_nuscenes",), f"nuScenes: {table}.json",
                        "nuscenes", _nuscenes, f"v1.0-mini/{table}.json", text_mutated)
      for table in ("scene", "log", "sample_data", "ego_pose", "calibrated_sensor")),
    FuzzTarget("apollo-ndt-map", (f"{_IMPORTERS}/apollo_map.py:read_ndt_map",), "Apollo's NDT map",
               in_recording("apollo-ndt-map", _apollo_map, "ndt_map/map/000/north/10/00000100/00000050", read_ndt_map),
               lambda: [_apollo_map()["ndt_map/map/000/north/10/00000100/00000050"]], _apollo_mutated),
    FuzzTarget("apollo-ndt-config", (), "Apollo's NDT map: config.xml",
               in_recording("apollo-ndt-config", _apollo_map, "ndt_map/config.xml", read_ndt_map),
               lambda: [_apollo_map()["ndt_map/config.xml"]], text_mutated),
    FuzzTarget("poses", (f"{_IMPORTERS}/trajectories/pose_file.py:read_poses",),
               "poses: TUM, KITTI, CSV, RTKLIB, NMEA, GeoJSON", on_file("poses.txt", read_poses), _poses_texts,
               text_mutated),
)  # fmt: skip
