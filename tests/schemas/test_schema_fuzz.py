"""Whatever arrives, decoding gives a value or a SchemaError: never another exception, never a warning."""

import contextlib
import random
from typing import Any

import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from hypothesis import given, settings
from hypothesis import strategies as st
from schema_values import GOLDEN, HELD, KINDS, TILE, kind_of

from gnd.schemas.errors import SchemaError
from gnd.schemas.generated import (
    archive_index_pb2,
    archive_root_pb2,
    catalog_pb2,
    change_ack_pb2,
    change_report_pb2,
    district_list_pb2,
    tile_reply_pb2,
    tile_request_pb2,
    tile_update_pb2,
    tiles_reply_pb2,
    tiles_request_pb2,
    traffic_sample_pb2,
)
from gnd.schemas.tiles import TileReply, tile_after, tile_of
from gnd.schemas.tiles_batch import TilesReply, tile_of_answer
from gnd.schemas.updates import TileUpdate, updated

MESSAGES: dict[str, type[Message]] = {
    "TileRequest": tile_request_pb2.TileRequest,
    "TileReply": tile_reply_pb2.TileReply,
    "TilesRequest": tiles_request_pb2.TilesRequest,
    "TilesReply": tiles_reply_pb2.TilesReply,
    "ArchiveIndex": archive_index_pb2.ArchiveIndex,
    "ArchiveRoot": archive_root_pb2.ArchiveRoot,
    "Catalog": catalog_pb2.Catalog,
    "DistrictList": district_list_pb2.DistrictList,
    "ChangeReport": change_report_pb2.ChangeReport,
    "ChangeAck": change_ack_pb2.ChangeAck,
    "TileUpdate": tile_update_pb2.TileUpdate,
    "TrafficSample": traffic_sample_pb2.TrafficSample,
}
MUTATIONS = 600


def decode(kind: Any, data: bytes) -> bool:
    """Whether `data` is accepted; what is accepted must survive another round, and tiles must open or be refused."""
    try:
        value = kind.decode(data)
    except SchemaError:
        return False
    assert kind.decode(value.encode()) == value
    with contextlib.suppress(SchemaError):
        open_contents(value)
    return True


def open_contents(value: Any) -> None:
    """Decode what a message brings; only a SchemaError may come of it."""
    if isinstance(value, TileReply) and value.blob:
        tile_of(value.blob)
    if isinstance(value, TileReply) and value.delta:
        tile_after(value.delta, HELD)
    if isinstance(value, TileUpdate):
        updated(value, HELD)
    for answer in value.answers if isinstance(value, TilesReply) else ():
        with contextlib.suppress(SchemaError):
            tile_of_answer(TILE, answer, HELD)


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda k: k.__name__)
@given(data=st.binary(max_size=300))
@settings(max_examples=150)
def test_random_bytes(kind: Any, data: bytes) -> None:
    decode(kind, data)


@pytest.mark.parametrize("name", GOLDEN)
def test_every_truncation_of_a_good_message_is_refused_or_a_message(name: str) -> None:
    data = GOLDEN[name].encode()
    kind = kind_of(name)
    for end in range(len(data)):
        decode(kind, data[:end])
    assert decode(kind, data)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """One to four flips, cuts, repeats or insertions of bytes."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(out) + 1)
        match rng.randrange(5):
            case 0 if at < len(out):
                out[at] ^= 1 << rng.randrange(8)
            case 1 if at < len(out):
                out[at] = rng.choice([0, 1, 0x7F, 0x80, 0xFF])
            case 2:
                del out[at : at + rng.randint(1, 8)]
            case 3:
                out[at:at] = rng.randbytes(rng.randint(1, 8))
            case _:
                out[at:at] = out[rng.randrange(len(out) + 1) :][: rng.randint(1, 40)]
    return bytes(out)


@pytest.mark.parametrize("name", GOLDEN)
def test_mutated_bytes(name: str) -> None:
    rng = random.Random(name)
    data, kind = GOLDEN[name].encode(), kind_of(name)
    for _ in range(MUTATIONS // 4):
        decode(kind, mutated(data, rng))


EXTREMES: dict[int, list[Any]] = {
    FieldDescriptor.CPPTYPE_UINT32: [0, 1, 2, 2**31 - 1, 2**31, 2**32 - 1],
    FieldDescriptor.CPPTYPE_UINT64: [0, 1, 2**31, 2**39 - 1, 2**39, 2**63, 2**64 - 1],
    FieldDescriptor.CPPTYPE_INT32: [-(2**31), -1, 0, 1, 2**31 - 1],
    FieldDescriptor.CPPTYPE_INT64: [-(2**63), -1, 0, 1, 2**63 - 1],
    FieldDescriptor.CPPTYPE_DOUBLE: [0.0, -1.0, 1e308, float("inf"), float("-inf"), float("nan")],
    FieldDescriptor.CPPTYPE_BOOL: [False, True],
    FieldDescriptor.CPPTYPE_ENUM: [0, 1, 2, 3, 4, -1, 2**31 - 1],
}


def extreme(field: FieldDescriptor, before: Any, rng: random.Random) -> Any:
    """A value of the field's type that nobody sends in earnest."""
    if field.cpp_type != FieldDescriptor.CPPTYPE_STRING:
        return rng.choice(EXTREMES[field.cpp_type])
    if field.type == FieldDescriptor.TYPE_BYTES:
        return rng.choice([b"", b"\0" * 32, before[:-1], before + b"\0", before * 3, mutated(before, rng)])
    return rng.choice(["", "\0", "/", "**", "é" * 50, before + before, before.lower(), "9" * 2000])


def disturb(message: Message, rng: random.Random) -> None:
    """Change one field of the message or of a submessage, keeping the encoding itself sound."""
    field = rng.choice(message.DESCRIPTOR.fields)
    if field.is_repeated:
        items = getattr(message, field.name)
        action = rng.randrange(3)
        if len(items) and action == 0:
            del items[rng.randrange(len(items))]
        elif field.message_type is None:
            items.append(extreme(field, b"", rng))
        elif len(items) and action == 1:
            items.append(items[rng.randrange(len(items))])
        elif len(items):
            disturb(items[rng.randrange(len(items))], rng)
    elif field.message_type is not None:
        disturb(getattr(message, field.name), rng)
    else:
        setattr(message, field.name, extreme(field, getattr(message, field.name), rng))


@pytest.mark.parametrize("name", [n for n in GOLDEN if n.split("-")[0] in MESSAGES])
def test_sound_encodings_of_unsound_values(name: str) -> None:
    rng = random.Random(name)
    data, kind = GOLDEN[name].encode(), kind_of(name)
    refused = 0
    for _ in range(MUTATIONS // 4):
        message = MESSAGES[name.split("-")[0]].FromString(data)
        for _ in range(rng.randint(1, 2)):
            disturb(message, rng)
        refused += not decode(kind, message.SerializeToString())
    assert refused > MUTATIONS // 40, "the fuzz hardly disturbs anything"
