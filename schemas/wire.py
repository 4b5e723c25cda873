"""What all encode/decode pairs share: bytes to protobuf under a limit, and protobuf's values to checked ones."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Final, Protocol, TypeVar

from google.protobuf.message import DecodeError, Message

from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import BadValue, Malformed, SchemaError, TooLarge, WrongVersion
from gnd.schemas.wire_fields import check_field_count

MAJOR: Final = 1
SHA_BYTES: Final = 32
MAX_VERSION: Final = 2**32 - 1

VEHICLE_PATTERN: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
LAYER_PATTERN: Final = re.compile(r"[a-z][a-z0-9_]{0,31}")
WORD_PATTERN: Final = re.compile(r"[a-z][a-z_]{0,31}")
PRINTABLE_PATTERN: Final = re.compile(r"[^\x00-\x1f\x7f]{0,128}")
REASON_PATTERN: Final = re.compile(r"[^\x00-\x1f\x7f]{0,1024}")


class Versioned(Protocol):
    """A generated message that carries its major version."""

    major: int


MessageT = TypeVar("MessageT", bound=Message)
WordT = TypeVar("WordT", bound=str)


def parse(kind: type[MessageT], data: bytes, limit: int, *, max_fields: int | None = None) -> MessageT:
    """The protobuf message in `data`; `TooLarge` before parsing, `Malformed` when the bytes are none."""
    name = kind.DESCRIPTOR.name
    if len(data) > limit:
        raise TooLarge(f"{name} of {len(data)} bytes exceeds the limit of {limit} bytes")
    if max_fields is not None:
        check_field_count(name, data, max_fields)
    message = kind()
    try:
        message.ParseFromString(data)
    except DecodeError as error:
        raise Malformed(f"{len(data)} bytes are not a {name}: truncated or of another kind") from error
    return message


def check_major(message: Versioned, name: str) -> None:
    """`WrongVersion` unless the message is of the major version that this program reads."""
    if message.major != MAJOR:
        raise WrongVersion(f"{name} of major version {message.major}; this program reads {MAJOR}")


def serialise(message: Message, limit: int) -> bytes:
    """The bytes of `message`, the same for the same value; `TooLarge` when a reader would refuse them."""
    data = message.SerializeToString(deterministic=True)
    if len(data) > limit:
        raise TooLarge(f"{message.DESCRIPTOR.name} of {len(data)} bytes exceeds the limit of {limit} bytes")
    return data


@contextmanager
def refusing(what: object, kind: type[SchemaError] = BadValue) -> Iterator[None]:
    """Errors of the values inside get `what` in front; `gnd_map`'s and numpy's become `kind`."""
    try:
        yield
    except SchemaError as error:
        raise type(error)(f"{what}: {error}") from error
    except (GndError, ValueError, OverflowError) as error:
        raise kind(f"{what}: {error}") from error


def tile_id(morton: int) -> TileId:
    """The tile of a Morton code; `BadValue` when it is outside 39 bits."""
    with refusing(f"tile {morton}"):
        return TileId(morton)


def check_sha(name: str, sha: bytes, *, may_be_empty: bool = False) -> None:
    """`BadValue` unless `sha` has 32 bytes (or none, where that means "no content")."""
    if len(sha) != SHA_BYTES and not (may_be_empty and not sha):
        raise BadValue(f"{name} has {len(sha)} bytes, expected {SHA_BYTES}{' or none' if may_be_empty else ''}")


def check_version(name: str, version: int, *, lowest: int) -> None:
    """`BadValue` unless `lowest` <= `version` < 2^32."""
    if not lowest <= version <= MAX_VERSION:
        raise BadValue(f"{name} {version} is outside {lowest} .. {MAX_VERSION}")


def check_pair(name: str, version: int, sha: bytes) -> None:
    """`BadValue` unless version 0 goes with an empty hash ("none") and every other version with a hash."""
    check_version(f"{name} version", version, lowest=0)
    check_sha(f"{name} sha", sha, may_be_empty=True)
    if (version == 0) != (not sha):
        raise BadValue(f"{name} version {version} with a sha of {len(sha)} bytes: 0 and empty go together")


def check_unsigned(name: str, number: int, *, bits: int) -> None:
    """`BadValue` unless 0 <= `number` < 2^bits."""
    if not 0 <= number < 2**bits:
        raise BadValue(f"{name} {number} is outside 0 .. 2^{bits} - 1")


def check_text(name: str, text: str, pattern: re.Pattern[str]) -> None:
    """`BadValue` unless the whole `text` matches `pattern`."""
    if not pattern.fullmatch(text):
        raise BadValue(f"{name} {text[:80]!r} does not match {pattern.pattern}")


def check_length(name: str, count: int, limit: int, what: str) -> None:
    """`TooLarge` when `count` exceeds `limit`."""
    if count > limit:
        raise TooLarge(f"{name} has {count} {what}, the limit is {limit}")


def word_of(number: int, words: Mapping[int, WordT], name: str) -> WordT:
    """The word for an enum's number; `BadValue` for a number that this program does not know."""
    if number not in words:
        raise BadValue(f"{name} {number} is unknown; known are {', '.join(f'{n} = {w}' for n, w in words.items())}")
    return words[number]


def check_word(word: str, words: Mapping[int, str], name: str) -> None:
    """`BadValue` unless `word` is one of the enum's words."""
    if word not in words.values():
        raise BadValue(f"{name} {word!r} is unknown; known are {', '.join(words.values())}")


def number_of(word: str, words: Mapping[int, str]) -> int:
    """The enum's number of a word that `check_word` has passed."""
    return next(number for number, name in words.items() if name == word)
