"""Looks of detectors in recorded drives: what is written is read back; recordings without them are as they were."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas import limits
from gnd.schemas.drive import Detections, DriveHeader, DriveItem, GnssFix, LaneLook, MotionSample
from gnd.schemas.drive_mcap import DETECTIONS_TOPIC, LANES_TOPIC, DriveWriter, drive_counts, load_track, read_drive
from gnd.schemas.errors import BadValue, DriveError, TooLarge
from gnd.schemas.generated import detections_pb2, lane_look_pb2
from gnd.schemas.look_messages import detections_message_of, detections_of, lane_message_of, lanes_of

T0_NS = 1_700_000_000_000_000_000
HEADER = DriveHeader("drive-1", "car-1", "VLP-16", LocalFrame(0.6555, 2.2172, 30.25), np.eye(4))
OLD_TOPICS = ["/lidar/points", "/vehicle/motion", "/gnss", "/reference/pose"]


def f32(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def look(t_ns: int = T0_NS, n: int = 2, **changes: Any) -> Detections:
    columns: dict[str, Any] = {
        "kinds": ("traffic_sign", "de274_50")[:n] if n < 3 else ("traffic_sign",) * n,
        "range_m": np.linspace(1.0, 80.0, n, dtype=np.float32),
        "bearing_rad": np.linspace(-np.pi, np.pi, n, dtype=np.float32),
        "height_m": np.linspace(-1.0, 5.0, n, dtype=np.float32),
        "sigma_range_m": np.full(n, 0.7, np.float32),
        "sigma_bearing_rad": np.full(n, 0.03, np.float32),
    }
    return Detections(**({"t_ns": t_ns, "sensor": "camera", "layer": "signs"} | columns | changes))


def lanes(t_ns: int = T0_NS, *lengths: int) -> LaneLook:
    return LaneLook(t_ns, tuple(np.arange(2 * n, dtype=np.float32).reshape(n, 2) for n in lengths), 0.5, 0.02)


def write(path: Path, items: list[DriveItem]) -> Path:
    with DriveWriter(path, HEADER) as writer:
        for item in items:
            writer.add(item)
    return path


def same_look(a: Detections, b: Detections) -> bool:
    names = ("range_m", "bearing_rad", "height_m", "sigma_range_m", "sigma_bearing_rad")
    columns = all(np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in names)
    return columns and (a.t_ns, a.sensor, a.layer, a.kinds) == (b.t_ns, b.sensor, b.layer, b.kinds)


def same_lanes(a: LaneLook, b: LaneLook) -> bool:
    lines = len(a) == len(b) and all(map(np.array_equal, a.polylines, b.polylines))
    return lines and (a.t_ns, a.sigma_m, a.sigma_rad) == (b.t_ns, b.sigma_m, b.sigma_rad)


def with_looks() -> list[DriveItem]:
    items: list[DriveItem] = []
    for k in range(30):
        t_ns = T0_NS + k * 66_666_667
        items += [MotionSample(t_ns, 9.0, 0.0), look(t_ns + 1, n=k % 3), lanes(t_ns + 2, *[2] * (k % 4))]
    return items


def test_looks_are_read_back_in_time_order_with_everything_else(tmp_path: Path) -> None:
    content = with_looks()
    found = list(read_drive(write(tmp_path / "drive.mcap", content)))
    assert [type(item) for item in found] == [type(item) for item in content]
    for one, expected in zip(found, content, strict=True):
        if isinstance(one, Detections) and isinstance(expected, Detections):
            assert same_look(one, expected)
            assert one.range_m.dtype == np.float32
            assert one.range_m.flags.c_contiguous
        elif isinstance(one, LaneLook) and isinstance(expected, LaneLook):
            assert same_lanes(one, expected)
        else:
            assert one == expected


@settings(max_examples=50, deadline=None)
@given(
    columns=st.lists(
        st.tuples(
            st.floats(0, 1e4, width=32),
            st.floats(-3.140625, 3.140625, width=32),
            st.floats(-100, 100, width=32) | st.just(float("nan")),
            st.floats(0.0009765625, 100, width=32),
        ),
        max_size=40,
    ),
    t_ns=st.integers(0, 2**63 - 1),
)
def test_any_look_survives_its_message(columns: list[tuple[float, float, float, float]], t_ns: int) -> None:
    table = np.array(columns, np.float32).reshape(-1, 4).T.copy()
    one = Detections(t_ns, "lidar", "poles", ("pole",) * len(columns), table[0], table[1], table[2], table[3], table[3])
    data = detections_message_of(one).SerializeToString()
    assert same_look(detections_of(detections_pb2.Detections.FromString(data)), one)


@given(lengths=st.lists(st.integers(2, 9), max_size=6))
def test_any_lane_look_survives_its_message(lengths: list[int]) -> None:
    one = lanes(5, *lengths)
    data = lane_message_of(one).SerializeToString()
    assert same_lanes(lanes_of(lane_look_pb2.LaneLook.FromString(data)), one)


def test_a_reader_of_older_recordings_sees_what_it_always_saw(tmp_path: Path) -> None:
    content = with_looks()
    path = write(tmp_path / "drive.mcap", content)
    with path.open("rb") as stream:
        seen = [channel.topic for _, channel, _ in make_reader(stream).iter_messages(topics=OLD_TOPICS)]
    assert seen == ["/vehicle/motion"] * 30
    assert len(load_track(path).motion.t_ns) == 30
    assert (drive_counts(path).motion, drive_counts(path).detections, drive_counts(path).lanes) == (30, 30, 30)


def test_recordings_without_looks_have_no_topics_for_them(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.mcap", [MotionSample(T0_NS, 1.0, 0.0), GnssFix(T0_NS, 0.65, 2.2, 30.0, 2.5)])
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {c.topic for c in summary.channels.values()}.isdisjoint({DETECTIONS_TOPIC, LANES_TOPIC})
    assert (drive_counts(path).detections, drive_counts(path).lanes) == (0, 0)


def test_programs_that_read_mcap_with_protobuf_decode_the_looks(tmp_path: Path) -> None:
    path = write(tmp_path / "drive.mcap", [look(n=2), lanes(T0_NS, 3)])
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}
    assert list(found[DETECTIONS_TOPIC].kinds) == ["traffic_sign", "de274_50"]
    assert list(found[LANES_TOPIC].lengths) == [3]


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"sensor": "radar"}, "sensor 'radar'"),
        ({"layer": "Signs"}, "layer"),
        ({"kinds": ("traffic sign", "x")}, "kind"),
        ({"kinds": ("traffic_sign",)}, "shape"),
        ({"range_m": f32(1.0, -0.5)}, "-0.5"),
        ({"range_m": f32(1.0, np.nan)}, "not finite"),
        ({"range_m": np.array([1.0, 2.0])}, "dtype"),
        ({"bearing_rad": f32(0.0, 3.2)}, "3.2"),
        ({"height_m": f32(0.0, np.inf)}, "not finite"),
        ({"height_m": f32(0.0)}, "shape"),
        ({"sigma_range_m": f32(0.5, 0.0)}, "sigmas of 0.0 m"),
        ({"sigma_bearing_rad": f32(-0.1, 0.1)}, "-0.1"),
        ({"t_ns": -1}, "-1"),
    ],
)
def test_a_look_that_cannot_be_is_refused(changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(BadValue, match=complaint):
        look(**changes)


def test_more_detections_than_a_look_can_have_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TooLarge, match="1025"):
        look(n=limits.MAX_DETECTIONS_OF_LOOK + 1)
    assert len(look(n=limits.MAX_DETECTIONS_OF_LOOK)) == limits.MAX_DETECTIONS_OF_LOOK
    full = look(n=limits.MAX_DETECTIONS_OF_LOOK, kinds=("k" * 64,) * limits.MAX_DETECTIONS_OF_LOOK)
    assert len(list(read_drive(write(tmp_path / "full.mcap", [full])))) == 1, "the limit of bytes allows a full look"


def test_a_million_detections_in_one_message_are_refused_before_they_are_parsed(tmp_path: Path) -> None:
    path = tmp_path / "flood.mcap"
    flood = detections_message_of(look(n=1))
    flood.range_m.extend([1.0] * 1_000_000)
    with DriveWriter(path, HEADER) as writer:
        writer._add_small(DETECTIONS_TOPIC, T0_NS, flood)
    with pytest.raises(DriveError, match=r"4000\d\d\d bytes exceeds the limit of 131072 bytes"):
        list(read_drive(path))


@pytest.mark.parametrize(
    ("polylines", "kind", "complaint"),
    [
        ((np.zeros((1, 2), np.float32),), BadValue, "1 points"),
        ((np.zeros((3, 3), np.float32),), BadValue, "shape"),
        ((np.zeros((3, 2)),), BadValue, "dtype"),
        ((np.full((3, 2), np.nan, np.float32),), BadValue, "not finite"),
        ((np.zeros((2, 2), np.float32),) * 65, TooLarge, "65"),
        ((np.zeros((16_385, 2), np.float32),), TooLarge, "16385"),
    ],
)
def test_a_lane_look_that_cannot_be_is_refused(polylines: Any, kind: type[Exception], complaint: str) -> None:
    with pytest.raises(kind, match=complaint):
        LaneLook(T0_NS, polylines)


def test_the_largest_lane_look_can_be_read(tmp_path: Path) -> None:
    one = lanes(T0_NS, limits.MAX_POINTS_OF_LANE_LOOK)
    assert len(list(read_drive(write(tmp_path / "full.mcap", [one])))) == 1


def test_messages_whose_columns_do_not_agree_are_refused() -> None:
    short = detections_message_of(look())
    del short.bearing_rad[1:]
    with pytest.raises(BadValue, match="bearing_rad"):
        detections_of(short)
    unknown = detections_message_of(look())
    unknown.sensor = "sonar"
    with pytest.raises(BadValue, match="'sonar'"):
        detections_of(unknown)
    torn = lane_message_of(lanes(T0_NS, 3))
    torn.lengths[0] = 2
    with pytest.raises(BadValue, match="3 x, 3 y for 2 points"):
        lanes_of(torn)


def test_bytes_that_are_in_recordings_already_are_still_read_and_written() -> None:
    detections = (
        "0a060880e2cfaa06120663616d6572611a057369676e73220c747261666669635f7369676e220864653237345f35302a080000803f0000a0"
        "423208db0f49c0db0f49403a08000080bf0000a04042083333333f3333333f4a088fc2f53c8fc2f53c"
    )
    markings = (
        "0a060880e2cfaa06120202031a14000000000000004000000000000000400000804022140000803f000040400000803f000040400000a040"
        "29000000000000e03f317b14ae47e17a943f"
    )
    assert detections_message_of(look()).SerializeToString(deterministic=True).hex() == detections
    assert lane_message_of(lanes(T0_NS, 2, 3)).SerializeToString(deterministic=True).hex() == markings
    assert same_look(detections_of(detections_pb2.Detections.FromString(bytes.fromhex(detections))), look())
    assert same_lanes(lanes_of(lane_look_pb2.LaneLook.FromString(bytes.fromhex(markings))), lanes(T0_NS, 2, 3))
