"""Which districts a layer of a map has: a publisher's signature over all of them, so that none is left out unnoticed.

It says nothing of what is in a district, of which the catalog has a signature of its own: so it changes only when a
district appears, and when it is signed again with a later time.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import accumulate, pairwise
from typing import Final

from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District, TileId
from gnd.schemas import limits
from gnd.schemas.archive_seal import SealNumber, check_signed_state
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import district_list_pb2
from gnd.schemas.wire import (
    LAYER_PATTERN,
    MAJOR,
    VEHICLE_PATTERN,
    check_length,
    check_major,
    check_sha,
    check_text,
    parse,
    serialise,
)

HEAD_ONLY: Final = b"\x01"
"""The payload of a question after a list without its districts."""
_TEXT: Final = b"gnd districts 1"
_NUMBERS: Final = 2**29
"""Of districts: the first fifteen base-4 digits of their tiles' paths, the first of which is 0 or 1."""


def packed(numbers: Iterable[int]) -> bytes:
    """Numbers of districts (Morton code / 1024), 8 bytes each, little-endian."""
    return b"".join(number.to_bytes(8, "little") for number in numbers)


@dataclass(frozen=True, slots=True)
class DistrictsHead:
    """What is signed of a list.

    Attributes:
        layer: name of the layer.
        region: name of the part of the map: that of its store.
        count: how many districts there are.
        digest: SHA-256 over all of them, as `packed`, ascending; 32 bytes.
    """

    layer: str
    region: str
    count: int
    digest: bytes

    def __post_init__(self) -> None:
        check_text("layer", self.layer, LAYER_PATTERN)
        check_text("region", self.region, VEHICLE_PATTERN)
        check_length("DistrictList", self.count, limits.MAX_DISTRICTS_OF_ARCHIVE, "districts")
        check_sha("digest of districts", self.digest)

    @classmethod
    def of(cls, layer: str, region: str, numbers: Sequence[int]) -> "DistrictsHead":
        """That of the numbers of districts, which are ascending."""
        return cls(layer, region, len(numbers), sha256(packed(numbers)).digest())

    def text(self, order: SealNumber, signer: bytes) -> bytes:
        """The bytes that are signed: all integers little-endian.

        Args:
            order: number and time of the list.
            signer: id of the certificate, 8 bytes.
        """
        names = (one.encode() for one in (self.layer, self.region))
        return b"".join(
            (
                _TEXT,
                *(len(name).to_bytes(1, "little") + name for name in names),
                self.count.to_bytes(4, "little"),
                self.digest,
                order.number.to_bytes(8, "little"),
                order.signed_s.to_bytes(8, "little"),
                signer,
            )
        )


@dataclass(frozen=True, slots=True)
class DistrictsSignature:
    """Who answers for a list.

    Attributes:
        number: how often the list was signed, from 1.
        signed_s: when it was signed, POSIX seconds.
        signer: first 8 bytes of the SHA-256 of the signer's certificate (DER).
        signature: r and s, 32 bytes each.
    """

    number: int
    signed_s: int
    signer: bytes
    signature: bytes

    def __post_init__(self) -> None:
        check_signed_state("list of districts", self.number, self.signed_s, self.signer, self.signature)

    @property
    def order(self) -> SealNumber:
        """Which state of the list it is."""
        return SealNumber(self.signed_s, self.number)


@dataclass(frozen=True)
class DistrictList:
    """A list as it is signed.

    Attributes:
        head: what is signed of it.
        signature: of who answers for it.
        numbers: of the districts (Morton code / 1024), ascending; None: only the head was asked for.
    """

    head: DistrictsHead
    signature: DistrictsSignature
    numbers: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if self.numbers is None:
            return
        for before, after in pairwise(self.numbers):
            if before >= after:
                raise BadValue(f"DistrictList names district {after} after {before}: ascending, none twice")
        if self.numbers and not (self.numbers[0] >= 0 and self.numbers[-1] < _NUMBERS):
            raise BadValue(f"DistrictList with districts {self.numbers[0]} to {self.numbers[-1]}: 0 .. {_NUMBERS - 1}")
        if DistrictsHead.of(self.head.layer, self.head.region, self.numbers) != self.head:
            raise BadValue(f"DistrictList of {len(self.numbers)} districts, not those of its digest")

    @property
    def text(self) -> bytes:
        """The bytes that must have been signed."""
        return self.head.text(self.signature.order, self.signature.signer)

    @property
    def without_districts(self) -> "DistrictList":
        """Its head alone."""
        return replace(self, numbers=None)

    def encode(self) -> bytes:
        """Bytes of gnd.v1.DistrictList."""
        return serialise(district_list_message(self), limits.MAX_DISTRICT_LIST_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "DistrictList":
        """The value in `data`; `SchemaError` when it is none."""
        return decode_district_list(parse(district_list_pb2.DistrictList, data, limits.MAX_DISTRICT_LIST_BYTES))


def district_list_message(told: DistrictList) -> district_list_pb2.DistrictList:
    """A list as a message, or as a part of one."""
    signed, is_whole = told.signature, told.numbers is not None
    return district_list_pb2.DistrictList(
        major=MAJOR,
        layer=told.head.layer,
        region=told.head.region,
        districts=steps_of(told.numbers or ()),
        count=0 if is_whole else told.head.count,
        digest=b"" if is_whole else told.head.digest,
        number=signed.number,
        signed_s=signed.signed_s,
        signer=signed.signer,
        signature=signed.signature,
    )


def decode_district_list(message: district_list_pb2.DistrictList) -> DistrictList:
    """The list in a message, or in a part of one; `SchemaError` where it is none."""
    check_major(message, "DistrictList")
    check_length("DistrictList", len(message.districts), limits.MAX_DISTRICTS_OF_ARCHIVE, "districts")
    signature = DistrictsSignature(message.number, message.signed_s, message.signer, message.signature)
    if message.digest:
        if message.districts:
            raise BadValue(f"DistrictList with {len(message.districts)} districts and a digest in their place")
        return DistrictList(DistrictsHead(message.layer, message.region, message.count, message.digest), signature)
    if message.count:
        raise BadValue(f"DistrictList of {message.count} districts without their digest")
    numbers = tuple(sums(message.districts))
    if numbers and numbers[-1] >= _NUMBERS:
        raise BadValue(f"DistrictList names district {numbers[-1]}: 0 .. {_NUMBERS - 1}")
    return DistrictList(DistrictsHead.of(message.layer, message.region, numbers), signature, numbers)


def district_of(number: int) -> District:
    """The district of a number (Morton code / 1024)."""
    return TileId(number * TILES_OF_DISTRICT).district


def steps_of(numbers: Sequence[int]) -> list[int]:
    """The first of ascending numbers, and the differences."""
    return [*numbers[:1], *(after - before for before, after in pairwise(numbers))]


def sums(steps: Sequence[int]) -> list[int]:
    """Numbers of districts, of the first one and the differences; BadValue where one comes twice."""
    if any(step == 0 for step in steps[1:]):
        raise BadValue("a district twice")
    return list(accumulate(steps))
