"""Seeded changes of inputs: of bytes, of text, of protobuf messages by field. The same seed makes the same change."""

import re
from collections.abc import Callable
from itertools import islice
from random import Random
from typing import Any, Final

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, Message

Mutate = Callable[[bytes, Random], bytes]

MAX_BYTES: Final = 1 << 18
_FORGED: Final = (0, 1, 2, 127, 128, 255, 256, 1023, 1024, 65535, 65536, 199_999, 200_001, 10**6, 10**9, 2**31 - 1,
                  2**31, 2**32 - 1)  # fmt: skip
_WORDS: Final = (
    "0", "-1", "1", "nan", "inf", "-inf", "1e308", "1e-320", "-0", "9" * 40, "9" * 5000, "2147483648",
    "9223372036854775808", "4294967295", "1e999", "true", "false", "null", "''", '""', "[]", "{}", "\u0661", "\x00",
    "x" * 300, "../..", "0x10", "1_000", "1.5", "[" * 3000, "{\"a\":" * 3000, "é", "\ud7ff", "1 2",
)  # fmt: skip
_MOST_MATCHES: Final = 1000
_NUMBER: Final = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_TOKEN: Final = re.compile(rb"[A-Za-z_][A-Za-z0-9_.:-]*|-?\d+(?:\.\d+)?|[^\sA-Za-z0-9]")


def bytes_mutated(data: bytes, rng: Random) -> bytes:
    """One to four flips, cuts, repeats, insertions or forged sizes."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        _change(out, rng)
    return bytes(out[:MAX_BYTES])


def _change(out: bytearray, rng: Random) -> None:
    at = rng.randrange(len(out) + 1)
    kind = rng.randrange(9)
    if kind == 0 and at < len(out):
        out[at] ^= 1 << rng.randrange(8)
    elif kind == 1 and at < len(out):
        out[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF))
    elif kind == 2:
        del out[at : at + rng.randint(1, 8)]
    elif kind == 3:
        out[at:at] = rng.randbytes(rng.randint(1, 8))
    elif kind == 4:
        out[at:at] = out[rng.randrange(len(out) + 1) :][: rng.randint(1, 200)]
    elif kind == 5:
        width = rng.choice((2, 4, 8))
        number = rng.choice(_FORGED) % (1 << 8 * width)
        out[at : at + width] = number.to_bytes(width, rng.choice(("little", "little", "big")))
    elif kind == 6:
        del out[at:]
    elif kind == 7:
        near = rng.randrange(min(len(out), 64) + 1)
        out[near : near + 1] = rng.randbytes(1)
    else:
        _swap(out, rng)


def _swap(out: bytearray, rng: Random) -> None:
    """Two pieces of one length change places."""
    n = rng.randint(1, 16)
    if len(out) > 2 * n:
        a, b = rng.randrange(len(out) - n), rng.randrange(len(out) - n)
        out[a : a + n], out[b : b + n] = out[b : b + n], out[a : a + n]


def text_mutated(data: bytes, rng: Random) -> bytes:
    """Numbers become extremes, words change places, lines go, come twice or are cut; sometimes only bytes change."""
    kind = rng.randrange(8)
    if kind == 0:
        return bytes_mutated(data, rng)
    if kind <= 3:
        return _replaced(data, _NUMBER, rng)
    if kind <= 5:
        return _replaced(data, _TOKEN, rng)
    lines = data.splitlines(keepends=True)
    at = rng.randrange(len(lines) + 1)
    if kind == 6:
        del lines[at : at + rng.randint(1, 3)]
    else:
        lines[at:at] = lines[rng.randrange(len(lines) + 1) :][: rng.randint(1, 4)]
    return b"".join(lines)[:MAX_BYTES]


def _replaced(data: bytes, pattern: re.Pattern[bytes], rng: Random) -> bytes:
    """One to three matches become an extreme word, or another match."""
    for _ in range(rng.randint(1, 3)):
        found = list(islice(pattern.finditer(data), _MOST_MATCHES))
        if not found:
            return bytes_mutated(data, rng)
        at = rng.choice(found)
        word = rng.choice(_WORDS).encode() if rng.random() < 0.6 else rng.choice(found)[0]
        data = data[: at.start()] + word + data[at.end() :]
    return data[:MAX_BYTES]


# --- protobuf ---------------------------------------------------------------------------------------------------------

_EXTREMES: Final[dict[int, list[Any]]] = {
    FieldDescriptor.CPPTYPE_UINT32: [0, 1, 2, 3, 7, 1023, 1024, 65536, 200_001, 2**31 - 1, 2**31, 2**32 - 1],
    FieldDescriptor.CPPTYPE_UINT64: [0, 1, 2**31, 2**39 - 1, 2**39, 2**62, 2**63 - 1, 2**63, 2**64 - 1],
    FieldDescriptor.CPPTYPE_INT32: [-(2**31), -1, 0, 1, 1000, 2**31 - 1],
    FieldDescriptor.CPPTYPE_INT64: [-(2**63), -1, 0, 1, 10**9, 2**63 - 1],
    FieldDescriptor.CPPTYPE_DOUBLE: [
        0.0, -0.0, -1.0, 1e-320, 1.0, 1e9, 1e308, float("inf"), float("-inf"), float("nan"),
    ],
    FieldDescriptor.CPPTYPE_FLOAT: [0.0, -1.0, 1e-40, 1.0, 1e30, float("inf"), float("-inf"), float("nan")],
    FieldDescriptor.CPPTYPE_BOOL: [False, True],
    FieldDescriptor.CPPTYPE_ENUM: [0, 1, 2, 3, 4, 5, 6, -1, 2**31 - 1],
}  # fmt: skip


def message_mutated(kind: type[Message], repair: dict[str, Mutate] | None = None) -> Mutate:
    """A mutator of the messages of one kind: field by field, at any depth.

    Args:
        kind: of message.
        repair: by name of a field of bytes, how it is changed; others are changed as bytes.
    """
    own = repair or {}

    def mutate(data: bytes, rng: Random) -> bytes:
        message = kind()
        try:
            message.ParseFromString(data)
        except DecodeError:
            return bytes_mutated(data, rng)
        if rng.randrange(6) == 0:
            return bytes_mutated(data, rng)
        for _ in range(rng.randint(1, 3)):
            _change_message(message, rng, own)
        return message.SerializeToString()

    return mutate


def _change_message(message: Message, rng: Random, own: dict[str, Mutate]) -> None:
    """Change one field, or one of a message in it."""
    fields = list(message.DESCRIPTOR.fields)
    there = [f for f, _ in message.ListFields()]
    field = rng.choice(there if there and rng.randrange(5) else fields)
    if rng.randrange(12) == 0:
        message.ClearField(field.name)
    elif field.is_repeated:
        _change_list(message, field, rng, own)
    elif field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
        inner = getattr(message, field.name)
        inner.SetInParent()
        _change_message(inner, rng, own)
    else:
        setattr(message, field.name, _value(field, getattr(message, field.name), rng, own))


def _change_list(message: Message, field: FieldDescriptor, rng: Random, own: dict[str, Mutate]) -> None:
    values = getattr(message, field.name)
    kind = rng.randrange(5)
    at = rng.randrange(len(values)) if len(values) else 0
    is_message = field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE
    if kind == 0 and len(values):
        del values[at]
    elif is_message:
        one = values[at] if len(values) and kind < 4 else values.add()
        if kind == 1 and len(values):
            values.add().CopyFrom(rng.choice(list(values)))
        _change_message(one, rng, own)
    elif kind == 1:
        values.extend(rng.choices(list(values) or [_zero(field)], k=rng.choice((1, 2, 8, 300))))
    elif kind == 2 or not len(values):
        values.append(_value(field, values[at] if len(values) else _zero(field), rng, own))
    else:
        values[at] = _value(field, values[at], rng, own)


def _zero(field: FieldDescriptor) -> Any:
    return {FieldDescriptor.TYPE_BYTES: b"", FieldDescriptor.TYPE_STRING: ""}.get(field.type, 0)


def _value(field: FieldDescriptor, before: Any, rng: Random, own: dict[str, Mutate]) -> Any:
    if field.type == FieldDescriptor.TYPE_BYTES:
        return own.get(field.name, bytes_mutated)(before, rng)
    if field.type == FieldDescriptor.TYPE_STRING:
        return text_mutated(before.encode(), rng).decode(errors="ignore")
    extremes = _EXTREMES[field.cpp_type]
    if field.cpp_type in (FieldDescriptor.CPPTYPE_UINT32, FieldDescriptor.CPPTYPE_UINT64) and rng.randrange(2):
        low, high = 0, max(extremes)
        return min(max(low, before + rng.choice((-2, -1, 1, 2, 64))), high)
    return rng.choice(extremes)


def repaired(mutate: Mutate, repair: Callable[[bytes], bytes]) -> Mutate:
    """As `mutate`, three times of four with the checksums made right again."""

    def mutate_and_repair(data: bytes, rng: Random) -> bytes:
        found = mutate(data, rng)
        return repair(found) if rng.randrange(4) else found

    return mutate_and_repair
