"""Makes tests/importer/ouster_golden anew: packets written and decoded by Ouster's own library, made with 1.0.1.

ouster-sdk pins other versions of libraries than ours, so it needs an environment of its own:

    python -m venv sdk && sdk/bin/pip install ouster-sdk==1.0.1
    sdk/bin/python tests/importer/make_ouster_golden.py

For each lidar profile: a capture of three frames over the end of the 16 bits of frame numbers, the metadata in the flat
and in the nested form, and what the library reads from it (times, status, ranges, points of the second frame).
"""

import json
from pathlib import Path

import numpy as np
from ouster.sdk import core, pcap
from ouster.sdk._bindings import client

OUT = Path(__file__).parent / "ouster_golden"
PROFILES = (
    "LEGACY",
    "RNG19_RFL8_SIG16_NIR16",
    "RNG19_RFL8_SIG16_NIR16_DUAL",
    "RNG15_RFL8_NIR8",
    "RNG15_RFL8_NIR8_DUAL",
    "FUSA_RNG15_RFL8_NIR8_DUAL",
    "RNG15_RFL8_WIN8",
    "RNG15_RFL8_NIR8_ZONE16",
    "RNG19_RFL8_SIG16_NIR16_ZONE16",
    "RNG19_RFL8_SIG16_ZONE16_DUAL",
)
H, W, FRAMES = 8, 32, 3
BEGIN_NS = 1_760_000_000_000_000_000
COLUMN_NS = 3_125_000


def flat_metadata(number: int, profile: str) -> dict:
    """The form of firmware 2.x; every profile another geometry, the last ones with a beam that begins higher up."""
    rng = np.random.default_rng(number)
    meta = {
        "prod_line": "OS-1-8",
        "prod_pn": "840-103574-06",
        "prod_sn": str(122_150_000_100 + number),
        "build_rev": "v2.5.2",
        "build_date": "2023-09-01T00:00:00Z",
        "image_rev": "ousteros-image-prod-aries-v2.5.2",
        "status": "RUNNING",
        "lidar_mode": "1024x10",
        "initialization_id": 5_431_292,
        "beam_altitude_angles": np.round(np.linspace(22.5, -22.5, H) + rng.normal(0.0, 0.1, H), 3).tolist(),
        "beam_azimuth_angles": np.round(np.tile([4.2, 1.4, -1.4, -4.2], H // 4) + rng.normal(0, 0.05, H), 3).tolist(),
        "lidar_origin_to_beam_origin_mm": round(15.806 + number, 3),
        "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18 + number, 0, 0, 0, 1],
        "imu_to_sensor_transform": [1, 0, 0, 6.253, 0, 1, 0, -11.775, 0, 0, 1, 7.645, 0, 0, 0, 1],
        "data_format": {
            "columns_per_frame": W,
            "columns_per_packet": 16,
            "pixels_per_column": H,
            "pixel_shift_by_row": [0] * H,
            "column_window": [0, W - 1],
            "udp_profile_lidar": profile,
            "udp_profile_imu": "LEGACY",
        },
        "udp_port_lidar": 7502,
        "udp_port_imu": 7503,
    }
    if number >= 8:
        meta["beam_to_lidar_transform"] = [1, 0, 0, 12.5, 0, 1, 0, 0, 0, 0, 1, 9.25, 0, 0, 0, 1]
    return meta


def frames(info: core.SensorInfo, form: client.PacketFormat, number: int) -> list[core.LidarFrame]:
    """Ranges over all bits of the profile, a sixth of them none; one column of the second frame was not measured."""
    rng = np.random.default_rng(1000 + number)
    made = []
    for k in range(FRAMES):
        frame = core.LidarFrame(info)
        for name in ("RANGE", "RANGE2"):
            if name in frame.fields:
                most = form.field_value_mask(name)
                value = rng.integers(0, most, (H, W), endpoint=True) & most
                frame.field(name)[:] = np.where(rng.random((H, W)) < 1 / 6, 0, value)
        frame.field("REFLECTIVITY")[:] = rng.integers(0, 256, (H, W))
        frame.status[:] = 1
        if k == 1:
            frame.status[5] = 0
        frame.measurement_id[:] = np.arange(W)
        frame.timestamp[:] = BEGIN_NS + (k * W + np.arange(W)) * COLUMN_NS
        frame.frame_id = 70_000 + k if form.max_frame_id >> 16 else (65_534 + k) % 65_536
        made.append(frame)
    return made


def write(number: int, profile: str) -> None:
    """The files of a profile."""
    flat = OUT / f"{profile}.json"
    flat.write_text(json.dumps(flat_metadata(number, profile)) + "\n")
    info = core.SensorInfo(flat.read_text())
    nested = json.loads(info.to_json_string())
    nested["config_params"]["timestamp_mode"] = "TIME_FROM_PTP_1588"
    (OUT / f"{profile}_nested.json").write_text(json.dumps(nested) + "\n")
    form = client.PacketFormat(info)
    packets = []
    for frame in frames(info, form, number):
        for packet in client.frame_to_packets(frame, form, 5_431_292, int(info.sn)):
            packet.host_timestamp = int(max(form.packet_header(core.ColHeader.TIMESTAMP, packet.buf))) + 1_000_000
            packets.append(packet)
    capture = OUT / f"{profile}.pcap"
    pcap.record(packets, str(capture))
    decode(profile, info, capture, OUT / f"{profile}_nested.json")


def decode(profile: str, info: core.SensorInfo, capture: Path, nested: Path) -> None:
    """What the library reads from the capture, with the metadata in either form."""
    read = [one[0] for one in pcap.PcapFrameSetSource(str(capture), meta=[str(capture.with_suffix(".json"))])]
    names = [name for name in ("RANGE", "RANGE2") if name in read[0].fields]
    lut, lut_nested = core.XYZLut(info), core.XYZLut(core.SensorInfo(nested.read_text()))
    points = np.array([lut(read[1].field(name)) for name in names])
    assert np.array_equal(points, [lut_nested(read[1].field(name)) for name in names])
    np.savez_compressed(
        OUT / f"{profile}.npz",
        t_ns=np.array([one.timestamp for one in read]),
        status=np.array([one.status for one in read]).astype(np.uint32),
        range_mm=np.array([[one.field(name) for name in names] for one in read]).astype(np.uint32),
        points_m=points,
    )
    print(profile, len(read), points.shape, [one.frame_id for one in read])


if __name__ == "__main__":
    OUT.mkdir(exist_ok=True)
    for number, profile in enumerate(PROFILES):
        write(number, profile)
