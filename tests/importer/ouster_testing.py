"""Captures of an Ouster, written by hand: packets, metadata, pcap. The layout itself is held against ouster-sdk."""

import json
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gnd.vehicle_agent.importers.ouster.packets import PROFILES, packet_dtype

PROFILE = PROFILES["RNG19_RFL8_SIG16_NIR16"]
BEGIN_NS = 1_760_000_000_000_000_000
TURN_NS = 100_000_000
SERIAL = 122_150_000_777


def write_pcap(path: Path, packets: Iterable[tuple], cut: int = 0, link: int = 1) -> Path:
    """packets: (host_ns, source, port, payload[, bytes kept]); cut: bytes that are missing at the file's end."""
    out = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 1 << 18, link)]
    for host_ns, source, port, payload, *kept in packets:
        udp = struct.pack(">HHHH", 7501, port, 8 + len(payload), 0) + payload
        address = bytes(int(part) for part in source.split(".")) + bytes([192, 168, 1, 2])
        ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 1, 0, 64, 17, 0) + address
        frame = (b"\0" * 12 + b"\x08\x00" if link == 1 else b"") + ip + udp
        held = frame[: len(frame) - len(payload) + kept[0]] if kept else frame
        out.append(struct.pack("<IIII", host_ns // 10**9, host_ns % 10**9, len(held), len(frame)) + held)
    data = b"".join(out)
    path.write_bytes(data[: len(data) - cut])
    return path


def metadata(path: Path, beams: int = 16, columns: int = 64, **changed) -> Path:
    """Flat metadata of a small sensor of profile RNG19_RFL8_SIG16_NIR16."""
    form = {
        "columns_per_frame": columns,
        "columns_per_packet": 16,
        "column_window": changed.pop("window", [0, columns - 1]),
        "udp_profile_lidar": changed.pop("profile", PROFILE.name),
    }
    content = {
        "prod_line": "OS-1-16",
        "prod_sn": str(changed.pop("serial", SERIAL)),
        "beam_altitude_angles": np.linspace(16.0, -16.0, beams).tolist(),
        "beam_azimuth_angles": [0.0] * beams,
        "lidar_origin_to_beam_origin_mm": 15.8,
        "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1],
        "data_format": form,
        "udp_port_lidar": 7502,
        "udp_port_imu": 7503,
        **changed,
    }
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    return path


def frame_packets(
    number: int,
    range_mm: np.ndarray,
    *,
    begin_ns: int = BEGIN_NS,
    serial: int = SERIAL,
    raw_id: int | None = None,
    numbers: np.ndarray | None = None,
) -> list[bytes]:
    """Packets of a turn; range_mm: (W, B) of its columns; numbers: (W,) their measurement numbers, else in order."""
    n, beams = range_mm.shape
    layout = packet_dtype(PROFILE, beams, 16)
    packets = np.zeros(n // 16, layout)
    packets["frame_id"] = (number if raw_id is None else raw_id) % 65_536
    columns = packets["columns"]
    columns["measurement_id"] = (np.arange(n) if numbers is None else numbers).reshape(-1, 16)
    columns["status"] = 1
    columns["t_ns"] = (begin_ns + number * TURN_NS + np.arange(n) * TURN_NS // n).reshape(-1, 16)
    pixels = columns["pixels"]
    pixels["range"] = range_mm.reshape(-1, 16, beams)
    columns["pixels"] = pixels
    packets["columns"] = columns
    out = []
    for one in packets:
        data = bytearray(one.tobytes())
        data[0:2] = (1).to_bytes(2, "little")
        data[7:12] = serial.to_bytes(5, "little")
        out.append(bytes(data))
    return out


def capture_packets(turns: int = 4, columns: int = 64, beams: int = 16, *, late_ns: int = 1_000_000, **how) -> list:
    """(host_ns, source, port, payload) of turns with other ranges each."""
    found = []
    for k in range(turns):
        range_mm = 2_000 + 10 * np.arange(columns * beams).reshape(columns, beams) + k
        for i, payload in enumerate(frame_packets(k, range_mm, **how)):
            host_ns = BEGIN_NS + k * TURN_NS + (i + 1) * TURN_NS * 16 // columns + late_ns
            found.append((host_ns, "192.168.1.10", 7502, payload))
    return found


def room_ranges_mm(metadata, table, T_room_sensor: np.ndarray) -> np.ndarray:
    """(W, B) ranges in a room with pillars, each column from its own (4, 4) pose; 0 where nothing is hit."""
    R, t = T_room_sensor[:, None, :3, :3], T_room_sensor[:, None, :3, 3]
    origin = (R @ table.offset_m[..., None])[..., 0] + t
    ray = (R @ table.direction[..., None])[..., 0]
    boxes = [([-18, -11, -1.7], [18, 11, 9])]
    boxes += [([x - 0.4, y - 0.4, -1.7], [x + 0.4, y + 0.4, 3]) for x in (-12, -4, 5, 13) for y in (-7, 6.2)]
    nearest = np.full(ray.shape[:2], np.inf)
    for k, (low, high) in enumerate(boxes):
        with np.errstate(divide="ignore"):
            a, b = (np.array(low) - origin) / ray, (np.array(high) - origin) / ray
        enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
        hit = leave if k == 0 else np.where((enter > 0) & (enter < leave), enter, np.inf)
        nearest = np.minimum(nearest, hit)
    return np.round(1000 * np.where(np.isfinite(nearest), nearest, 0)).astype(np.int64)
