"""Targets: messages of the bus, keys, and what vehicles and ROS 2 programs put beside them."""

import contextlib
import zlib
from collections.abc import Callable, Sequence
from functools import lru_cache
from random import Random
from typing import Any

import numpy as np
from feature_values import FEATURE_GOLDEN
from fuzz_mutators import Mutate, bytes_mutated, message_mutated, text_mutated
from fuzz_target import FuzzTarget
from google.protobuf.message import DecodeError, Message
from schema_values import GOLDEN, HELD, REPORT_ID, TILE, gaussians, kind_of
from survey_street import Driven, survey_of_drive

from gnd.deploy.map_export.autoware_messages import differential_service, read_request
from gnd.fleet_bus.ros2_attachments import RosAttachment
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.codec.coding import CHECK_BYTES, checksum
from gnd.gnd_map.content import encode_content_delta
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.region import parse_region
from gnd.gnd_map.tile import Tile
from gnd.schemas import keys
from gnd.schemas.archive import ArchiveIndex, ArchiveRoot
from gnd.schemas.archive_seal import ArchiveSeal, with_seal
from gnd.schemas.drive import (
    Detections,
    DriveHeader,
    DriveItem,
    GnssFix,
    LaneLook,
    MotionSample,
    ReferencePose,
    Scan,
)
from gnd.schemas.drive_mcap import _MESSAGES as ITEM_MESSAGES
from gnd.schemas.drive_mcap import ITEM_TOPICS, item_of, message_of
from gnd.schemas.errors import Malformed
from gnd.schemas.generated import (
    archive_index_pb2,
    archive_root_pb2,
    catalog_pb2,
    change_ack_pb2,
    change_report_pb2,
    district_list_pb2,
    report_question_pb2,
    report_states_pb2,
    tile_blob_pb2,
    tile_reply_pb2,
    tile_request_pb2,
    tile_update_pb2,
    tiles_reply_pb2,
    tiles_request_pb2,
    traffic_sample_pb2,
    version_signatures_pb2,
)
from gnd.schemas.limits import MAX_ARCHIVE_INDEX_BYTES, MAX_ARCHIVE_ROOT_BYTES
from gnd.schemas.packed import decode_upload
from gnd.schemas.report_id import check_report_id, report_id_of_bytes
from gnd.schemas.report_states import ReportQuestion, ReportState, ReportStates
from gnd.schemas.survey import SurveyReport
from gnd.schemas.tile_answer import tile_of_answer
from gnd.schemas.tiles import TileReply, blob_of, content_of, tile_after
from gnd.schemas.tiles_batch import TilesReply
from gnd.schemas.updates import TileUpdate, updated
from gnd.schemas.upload_head import head_of_upload
from gnd.schemas.version_signature import VersionSignature, decode_signatures, signatures_message
from gnd.tile_store.arguments import parse_place, parse_tile, parse_time_ns, parse_versions
from gnd.vehicle_agent.sources import ros2_messages
from gnd.vehicle_agent.sources.plain_keys import header_message, read_header_message

_MESSAGES: dict[str, type[Message]] = {
    "TileRequest": tile_request_pb2.TileRequest,
    "TileBlob": tile_blob_pb2.TileBlob,
    "TileReply": tile_reply_pb2.TileReply,
    "TilesRequest": tiles_request_pb2.TilesRequest,
    "TilesReply": tiles_reply_pb2.TilesReply,
    "Catalog": catalog_pb2.Catalog,
    "DistrictList": district_list_pb2.DistrictList,
    "ArchiveIndex": archive_index_pb2.ArchiveIndex,
    "ArchiveRoot": archive_root_pb2.ArchiveRoot,
    "ChangeAck": change_ack_pb2.ChangeAck,
    "TileUpdate": tile_update_pb2.TileUpdate,
    "TrafficSample": traffic_sample_pb2.TrafficSample,
}
_FILES = {
    "TileRequest": "tiles", "TileBlob": "tiles", "TileReply": "tiles", "Catalog": "tiles",
    "TilesRequest": "tiles_batch", "TilesReply": "tiles_batch", "ChangeAck": "changes", "TileUpdate": "updates",
    "TrafficSample": "traffic", "ArchiveIndex": "archive", "ArchiveRoot": "archive",
    "DistrictList": "district_list",
}  # fmt: skip


def resealed(body: bytes) -> bytes:
    """A range-coded body with the right checksum."""
    data = body[:-CHECK_BYTES]
    return data + checksum(data)


def _body_mutated(body: bytes, rng: Random) -> bytes:
    """A body of a tile, a delta or flags: changed and, mostly, with one of the checksums that such bodies have."""
    found = bytes_mutated(body, rng)
    kind = rng.randrange(4)
    if kind == 0:
        return found[:1] + resealed(found[1:])
    return resealed(found) if kind < 3 else found


_OWN: dict[str, Mutate] = dict.fromkeys(("body", "bodies", "coded_delta", "flags", "measured", "wanted"), _body_mutated)


def _bitmap_mutated(data: bytes, rng: Random) -> bytes:
    """The bitmap itself changes, not its zlib stream."""
    try:
        plain = zlib.decompress(data)
    except zlib.error:
        return bytes_mutated(data, rng)
    if rng.randrange(8) == 0:
        plain = bytes(rng.choice((1 << 16, (1 << 17) + 1, 1 << 22)))
    return zlib.compress(bytes_mutated(plain, rng))


_OWN["observed_bitmap"] = _bitmap_mutated


def _opened(value: Any) -> None:
    """Decode what a message brings, as clients do; a refusal of one part is no refusal of the others."""
    if isinstance(value, TileReply) and value.blob:
        content_of(value.blob)
    if isinstance(value, TileReply) and value.delta:
        tile_after(value.delta, HELD)
    if isinstance(value, TileUpdate):
        updated(value, HELD)
    for answer in value.answers if isinstance(value, TilesReply) else ():
        with contextlib.suppress(GndError):
            tile_of_answer(TILE, answer, HELD)


def _message_target(name: str) -> FuzzTarget:
    kind = kind_of(name)

    def call(data: bytes) -> object:
        value = kind.decode(data)
        assert kind.decode(value.encode()) == value
        _opened(value)
        return value

    seeds = [value.encode() for golden, value in GOLDEN.items() if golden.split("-")[0] == name]
    mutate = message_mutated(_MESSAGES[name], _OWN)
    reads = (f"schemas/{_FILES[name]}.py:{name}.decode",)
    return FuzzTarget(name, reads, f"gnd.v1.{name} (protobuf)", call, lambda: seeds + _more_seeds(name), mutate)


def _more_seeds(name: str) -> list[bytes]:
    """With bodies that can be decoded: the golden ones are not looked into."""
    after = Tile(TILE, 4, snap(gaussians([-604, 7, 8], count=300), LATTICES["standard"]))
    if name == "TileReply":
        return [TileReply("blob", blob_of(HELD, codec)).encode() for codec in (0, 1, 3, 9)]
    if name == "TileBlob":
        return [blob_of(HELD, codec).encode() for codec in (0, 1, 3, 9)]
    if name == "TileUpdate":
        coded = encode_content_delta(HELD, after)
        return [TileUpdate(TILE, "ndt", 4, 3, after.sha, HELD.sha, "merged", coded_delta=coded, put_voxels=2).encode()]
    seal = ArchiveSeal(bytes(8), 3, 1_795_780_247, bytes(8), bytes(64))
    if name == "ArchiveIndex":
        indexes = [one.encode() for one in GOLDEN.values() if isinstance(one, ArchiveIndex)]
        return [with_seal("index", body, seal, MAX_ARCHIVE_INDEX_BYTES) for body in indexes]
    if name == "ArchiveRoot":
        roots = [one.encode() for one in GOLDEN.values() if isinstance(one, ArchiveRoot)]
        return [with_seal("root", body, seal, MAX_ARCHIVE_ROOT_BYTES) for body in roots]
    return []


# --- uploads ----------------------------------------------------------------------------------------------------------


@lru_cache
def _surveys() -> tuple[bytes, ...]:
    (one,) = survey_of_drive(Driven("car-1", submaps=3))
    return (one.encode(),)


def _small_survey() -> bytes:
    """A survey with one small body a submap, so that a call takes little."""
    message = change_report_pb2.ChangeReport.FromString(_surveys()[0])
    for submap in message.survey.submaps:
        at = min(range(len(submap.body)), key=lambda k: len(submap.body[k]))
        tile, body = submap.tile[at], submap.body[at]
        del submap.tile[:], submap.body[:]
        submap.tile.append(tile)
        submap.body.append(body)
    return message.SerializeToString(deterministic=True)


def _uploads(*names: str) -> list[bytes]:
    values = {**GOLDEN, **FEATURE_GOLDEN}
    return [value.encode() for golden, value in values.items() if golden.split("-")[0] in names]


def _upload_target(name: str, reads: tuple[str, ...], call: Callable[[bytes], object], *kinds: str) -> FuzzTarget:
    def seeds() -> list[bytes]:
        return _uploads(*kinds) + ([_small_survey()] if "Survey" in kinds else [])

    mutate = message_mutated(change_report_pb2.ChangeReport, _OWN)
    return FuzzTarget(name, reads, "gnd.v1.ChangeReport (protobuf)", call, seeds, mutate)


def _decode_upload(data: bytes) -> object:
    upload = decode_upload(data)
    if isinstance(upload, SurveyReport):
        for submap in upload.submaps:
            submap.gaussians()
    elif not isinstance(upload, SurveyReport):
        assert type(upload).decode(upload.encode()) == upload
    return upload


_UPLOADS = (
    _upload_target(
        "ChangeReport",
        ("schemas/changes.py:ChangeReport.decode", "schemas/bitmap.py:decode_observed"),
        lambda data: kind_of("ChangeReport").decode(data),
        "ChangeReport",
    ),
    _upload_target(
        "upload",
        (
            "schemas/packed.py:decode_upload",
            "schemas/packed.py:PackedReport.decode",
            "schemas/packed.py:PackedGaussians.decode",
            "schemas/features.py:FeatureReport.decode",
        ),
        _decode_upload,
        "PackedReport",
        "PackedGaussians",
        "FeatureReport",
        "ChangeReport",
    ),
    _upload_target(
        "survey", ("schemas/survey.py:SurveyReport.decode", "gnd_map/submap.py:decode_submap"), _decode_upload, "Survey"
    ),
    _upload_target(
        "upload-head",
        (),
        head_of_upload,
        "PackedReport",
        "PackedGaussians",
        "FeatureReport",
        "ChangeReport",
        "Survey",
    ),
)

_STATES = ReportStates(
    (ReportState(REPORT_ID, "wanted", b"mask"), ReportState(REPORT_ID, "quarantined", reason="because")),
)


# --- text and the like ------------------------------------------------------------------------------------------------

MOST_RADIUS_M = 1_000.0
_KEYS = (
    keys.tile_key("ndt", TILE), keys.update_key("ndt", TILE), keys.batch_key("ndt", TILE.district),
    keys.catalog_key("ndt", TILE.district), keys.change_key("ndt", TILE.district), keys.traffic_key("car-1"),
    keys.state_key("car-1"), keys.list_key("ndt", "main"),
    keys.alive_key("merger", "m1"), keys.tiles_key("ndt", "13033"), "gnd/v2/tile/ndt/**",
)  # fmt: skip
_PARSERS = (
    keys.parse_tile_key, keys.parse_update_key, keys.parse_batch_key, keys.parse_catalog_key, keys.parse_change_key,
    keys.parse_traffic_key, keys.parse_state_key, keys.parse_alive_key, keys.parse_tiles_key,
    keys.parse_health_key, keys.parse_list_key,
)  # fmt: skip


def _every(parsers: Sequence[Callable[[str], object]]) -> Callable[[bytes], object]:
    def call(data: bytes) -> object:
        text, found, refusal = data.decode("utf-8", "replace"), [], None
        for parse in parsers:
            try:
                found.append(parse(text))
            except GndError as error:
                refusal = error
        if not found and refusal is not None:
            raise refusal
        return found

    return call


def _small_region(text: str) -> object:
    """Not circles of many kilometres: whoever types one waits for its hundred thousands of tiles."""
    words = text.split(",")
    with contextlib.suppress(ValueError, IndexError):
        if float(words[2]) > MOST_RADIUS_M:
            return None
    return parse_region(text)


def _header() -> bytes:
    header = DriveHeader("drive-1", "car-1", "VLP-16", LocalFrame(0.855, 0.146, 110.0), np.eye(4), "made up")
    return header_message(header, list(ITEM_TOPICS))


def _item(data: bytes) -> object:
    """The first byte says on which topic the message comes."""
    return item_of(ITEM_TOPICS[(data[0] if data else 0) % len(ITEM_TOPICS)], data[1:])


def _items() -> list[bytes]:
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], np.float32)
    row = np.array([1.5, 2.5], np.float32)
    items: list[DriveItem] = [
        Scan(1_000_000_000, points, np.array([0, 5], np.uint32), np.array([0, 1], np.uint16)),
        MotionSample(1_000_000_000, 3.5, 0.01),
        GnssFix(1_000_000_000, 0.85, 0.14, 110.0, 1.5),
        ReferencePose(1_000_000_000, np.eye(4)),
        Detections(1_000_000_000, "camera", "signs", ("traffic_sign",) * 2, row, 0 * row, row, row, row, row, 1.0),
        LaneLook(1_000_000_000, (points[:, :2].copy(), points[:, :2].copy()), 0.1, 0.01),
    ]
    found = [message_of(item) for item in items]
    return [bytes([ITEM_TOPICS.index(topic)]) + body for topic, body in found]


def _item_mutated(data: bytes, rng: Random) -> bytes:
    if not data or rng.randrange(20) == 0:
        return bytes_mutated(data, rng)
    return data[:1] + message_mutated(ITEM_MESSAGES[ITEM_TOPICS[data[0] % len(ITEM_TOPICS)]])(data[1:], rng)


_ROS_TYPES = (
    ros2_messages.CLOUD, ros2_messages.IMU, ros2_messages.FIX, ros2_messages.ODOMETRY, ros2_messages.TRANSFORMS,
    ros2_messages.POSE,
)  # fmt: skip


def _ros_message(data: bytes) -> object:
    return ros2_messages.decode(_ROS_TYPES[data[0] % len(_ROS_TYPES)] if data else _ROS_TYPES[0], data[1:])


def _ros_seeds() -> list[bytes]:
    return [bytes([k]) + ros2_messages.encode(name, {}) for k, name in enumerate(_ROS_TYPES)]


def _report_id(data: bytes) -> object:
    if len(data) == 16:
        check_report_id(report_id_of_bytes(data))
    return check_report_id(data.decode("utf-8", "replace"))


def _request(data: bytes) -> object:
    return read_request(differential_service(), data)


def _request_seeds() -> list[bytes]:
    area = {"center_x": 1.0, "center_y": 2.0, "radius": 100.0}
    return [ros2_messages.encode(differential_service().request, {"area": area, "cached_ids": ["a", "b"]})]


def _signed_versions(data: bytes) -> object:
    """The first byte says how many versions there are."""
    message = version_signatures_pb2.VersionSignatures()
    try:
        message.ParseFromString(data[1:])
    except DecodeError as error:
        raise Malformed("no signatures") from error  # in a reply that is one
    found = decode_signatures(message, data[0] if data else 0)
    if (again := signatures_message(found)) is not None:
        assert decode_signatures(again, len(found)) == found
    for one in found:
        if one is not None:
            one.statement("ndt", TILE, 3, HELD.sha, 9750).text(one.signer, one.signed_s)
    return found


def _signature_lists() -> list[bytes]:
    signed = [
        VersionSignature(bytes(7) + bytes([k]), "merged", 1_700_000_000 + k, 1_700_000_003, bytes(64))
        for k in (1, 2, 3)
    ]
    lists = [signed, signed[:1], [signed[0], None, signed[2]], signed[:1] * 3]
    return [bytes([len(one)]) + _signatures(one) for one in lists]


def _signatures(some: list[VersionSignature | None] | list[VersionSignature]) -> bytes:
    message = signatures_message(some)
    assert message is not None
    return message.SerializeToString()


TARGETS = (
    FuzzTarget(
        "VersionSignatures", ("schemas/version_signature.py:decode_signatures",),
        "gnd.v1.VersionSignatures (protobuf, in replies)", _signed_versions, _signature_lists, bytes_mutated,
    ),
    *(_message_target(name) for name in _MESSAGES),
    *_UPLOADS,
    FuzzTarget(
        "ReportStates",
        ("schemas/report_states.py:ReportStates.decode",),
        "gnd.v1.ReportStates (protobuf)",
        ReportStates.decode,
        lambda: [_STATES.encode()],
        message_mutated(report_states_pb2.ReportStates, _OWN),
    ),
    FuzzTarget(
        "ReportQuestion",
        ("schemas/report_states.py:ReportQuestion.decode",),
        "gnd.v1.ReportQuestion (protobuf)",
        ReportQuestion.decode,
        lambda: [ReportQuestion((REPORT_ID, REPORT_ID)).encode()],
        message_mutated(report_question_pb2.ReportQuestion),
    ),
    FuzzTarget(
        "keys",
        tuple(f"schemas/keys.py:{parse.__name__}" for parse in _PARSERS),
        "keys of the bus",
        _every(_PARSERS),
        lambda: [key.encode() for key in _KEYS],
        text_mutated,
    ),
    FuzzTarget(
        "arguments",
        (
            "gnd_map/region.py:parse_region",
            *(f"tile_store/arguments.py:parse_{what}" for what in ("tile", "place", "time_ns", "versions")),
        ),
        "regions, tiles, places, times and versions as text",
        _every((_small_region, parse_tile, parse_place, parse_time_ns, parse_versions)),
        lambda: [b"13033/03021/**", b"497353963154", b"37.5,127.0,500", b"2026-11-23T12:00:00Z", b"3..7", b"**"],
        text_mutated,
    ),
    FuzzTarget(
        "report-id", (), "ULIDs", _report_id, lambda: [REPORT_ID.encode(), bytes(range(16))], text_mutated
    ),
    FuzzTarget(
        "live-header",
        ("vehicle_agent/sources/plain_keys.py:read_header_message",),
        "header of a live vehicle (JSON)",
        read_header_message,
        lambda: [_header()],
        text_mutated,
    ),
    FuzzTarget(
        "drive-items", (), "messages of a drive's topics (protobuf)", _item, _items, _item_mutated
    ),
    FuzzTarget(
        "ros2-messages",
        ("vehicle_agent/sources/ros2_messages.py:decode",),
        "messages of ROS 2 (CDR)",
        _ros_message,
        _ros_seeds,
        bytes_mutated,
    ),
    FuzzTarget(
        "map-request",
        ("deploy/map_export/autoware_messages.py:read_request",),
        "Autoware's request of map cells (CDR)",
        _request,
        _request_seeds,
        bytes_mutated,
    ),
    FuzzTarget(
        "ros2-attachment",
        ("fleet_bus/ros2_attachments.py:RosAttachment.decode",),
        "attachments of rmw_zenoh",
        RosAttachment.decode,
        lambda: [RosAttachment(1, 2, bytes(16)).encode(), RosAttachment(1, 2, bytes(16), has_names=True).encode()],
        bytes_mutated,
    ),
)  # fmt: skip
