"""A region as a static archive: names of its objects, and what its index of a district and its root say.

Anything that serves files over HTTP can serve it. What never changes has a name by its content: packs (tiles, each a
`TileReply` with its signature) and certificates. What changes is one small index a district, and the root.
"""

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate, pairwise
from types import MappingProxyType
from typing import Final

from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.archive_seal import DIGEST_BYTES, Sealed, without_seal
from gnd.schemas.catalog_signature import CatalogSignature, catalog_signature_message, decode_catalog_signature
from gnd.schemas.district_list import (
    DistrictList,
    decode_district_list,
    district_list_message,
    district_of,
    steps_of,
    sums,
)
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import archive_index_pb2, archive_root_pb2
from gnd.schemas.tile_answer import ANSWER_HASH_BYTES
from gnd.schemas.wire import (
    LAYER_PATTERN,
    MAJOR,
    check_length,
    check_major,
    check_sha,
    check_text,
    check_version,
    refusing,
    serialise,
)

ROOT_NAME: Final = "archive.gnd"
INDEX_FOLDER: Final = "index/"
PACK_FOLDER: Final = "pack/"
CERTIFICATE_FOLDER: Final = "certificate/"
_SUFFIX: Final = ".gnd"
SIGNED_BYTES: Final = 4
UNSIGNED: Final = bytes(SIGNED_BYTES)
_TILES: Final = limits.MAX_TILES_OF_DISTRICT


def index_name(layer: str, district: District) -> str:
    """Name of a district's index."""
    return f"{INDEX_FOLDER}{layer}/{district.path}{_SUFFIX}"


def place_of_index(name: str) -> tuple[str, District]:
    """Layer and district of an index; `BadValue` where it is the name of none."""
    layer, _, path = name.removeprefix(INDEX_FOLDER).removesuffix(_SUFFIX).partition("/")
    with refusing(f"archive index {name[:120]!r}"):
        check_text("layer", layer, LAYER_PATTERN)
        district = District(path)
        if index_name(layer, district) != name:
            raise BadValue("no such name")
        return layer, district


def pack_name(sha: bytes) -> str:
    """Name of a pack, by the SHA-256 of its bytes."""
    return f"{PACK_FOLDER}{sha.hex()[:2]}/{sha.hex()}"


def certificate_name(signer: bytes) -> str:
    """Name of the certificates of somebody who has signed versions."""
    return f"{CERTIFICATE_FOLDER}{signer.hex()}"


@dataclass(frozen=True, slots=True)
class Pack:
    """An object that never changes: SHA-256 and length of its bytes."""

    sha: bytes
    size_bytes: int

    def __post_init__(self) -> None:
        check_sha("pack", self.sha)
        if not 0 < self.size_bytes <= limits.MAX_PACK_BYTES:
            raise BadValue(f"pack of {self.size_bytes} bytes: 1 .. {limits.MAX_PACK_BYTES}")


@dataclass(frozen=True, slots=True)
class ArchiveEntry:
    """Where the newest version of a tile lies.

    Attributes:
        tile: which tile.
        version: its number.
        hash: first 4 bytes of its content's hash.
        signed: first 4 bytes of its signature; zeros: nobody has signed it.
        pack: the pack.
        start, size: which bytes of the pack, a `TileReply`.
    """

    tile: TileId
    version: int
    hash: bytes
    signed: bytes
    pack: Pack
    start: int
    size: int

    def __post_init__(self) -> None:
        check_version("tile version", self.version, lowest=1)
        if len(self.hash) != ANSWER_HASH_BYTES or len(self.signed) != SIGNED_BYTES:
            raise BadValue(f"tile {self.tile}: {len(self.hash)} bytes of its hash, {len(self.signed)} of its signature")
        if not 0 < self.size <= limits.MAX_TILE_REPLY_BYTES or self.start + self.size > self.pack.size_bytes:
            raise BadValue(
                f"tile {self.tile}: bytes {self.start} .. {self.start + self.size} of a pack of {self.pack.size_bytes}"
            )

    @property
    def end(self) -> int:
        """One past its last byte in the pack."""
        return self.start + self.size


@dataclass(frozen=True)
class ArchiveIndex:
    """What an archive holds of a district: one entry a tile, ascending."""

    layer: str
    district: District
    entries: tuple[ArchiveEntry, ...] = ()
    catalog: CatalogSignature | None = field(default=None, compare=False)
    """Of who answers for the district's catalog on the bus; None: nobody does."""
    sealed: Sealed | None = field(default=None, compare=False)
    """Its seal, of one that was read; None: nobody answers for it."""

    def __post_init__(self) -> None:
        check_text("layer", self.layer, LAYER_PATTERN)
        check_length("ArchiveIndex", len(self.entries), _TILES, "tiles")
        check_length("ArchiveIndex", len(self.packs), limits.MAX_PACKS_OF_DISTRICT, "packs")
        for before, after in pairwise(self.entries):
            if before.tile >= after.tile:
                raise BadValue(f"ArchiveIndex lists tile {after.tile} after {before.tile}: ascending, none twice")
        for entry in self.entries:
            if entry.tile.district != self.district:
                raise BadValue(f"tile {entry.tile} is not in district {self.district}")

    @cached_property
    def packs(self) -> tuple[Pack, ...]:
        """The packs that are named, each once."""
        return tuple(dict.fromkeys(entry.pack for entry in self.entries))

    @cached_property
    def by_tile(self) -> Mapping[TileId, ArchiveEntry]:
        """The entries by their tiles."""
        return MappingProxyType({entry.tile: entry for entry in self.entries})

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ArchiveIndex, without a seal."""
        number = {pack: place for place, pack in enumerate(self.packs)}
        places = [entry.tile.morton - self.district.first_morton for entry in self.entries]
        message = archive_index_pb2.ArchiveIndex(
            major=MAJOR,
            layer=self.layer,
            district=self.district.path,
            packs=b"".join(pack.sha for pack in self.packs),
            pack_bytes=[pack.size_bytes for pack in self.packs],
            places=steps_of(places),
            versions=[entry.version for entry in self.entries],
            hashes=b"".join(entry.hash for entry in self.entries),
            signed=b"".join(entry.signed for entry in self.entries),
            packs_of=[number[entry.pack] for entry in self.entries],
            starts=[entry.start for entry in self.entries],
            sizes=[entry.size for entry in self.entries],
            catalog=catalog_signature_message(self.catalog),
        )
        return serialise(message, limits.MAX_ARCHIVE_INDEX_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "ArchiveIndex":
        """The value in `data`; `SchemaError` when it is none."""
        kind = archive_index_pb2.ArchiveIndex
        message, sealed = without_seal(kind, "index", data, limits.MAX_ARCHIVE_INDEX_BYTES)
        check_major(message, "ArchiveIndex")
        check_length("ArchiveIndex", len(message.places), _TILES, "tiles")
        with refusing("ArchiveIndex"):
            district = District(message.district)
            entries = tuple(_entries(message, district, _packs(message)))
            catalog = decode_catalog_signature(message.catalog) if message.HasField("catalog") else None
            return cls(message.layer, district, entries, catalog, sealed)


def _packs(message: archive_index_pb2.ArchiveIndex) -> list[Pack]:
    check_length("ArchiveIndex", len(message.pack_bytes), limits.MAX_PACKS_OF_DISTRICT, "packs")
    shas = _cut("packs", message.packs, 32, len(message.pack_bytes))
    return [Pack(sha, size) for sha, size in zip(shas, message.pack_bytes, strict=True)]


def _entries(
    message: archive_index_pb2.ArchiveIndex, district: District, packs: Sequence[Pack]
) -> Iterator[ArchiveEntry]:
    count = len(message.places)
    for name in ("versions", "packs_of", "starts", "sizes"):
        if len(getattr(message, name)) != count:
            raise BadValue(f"{len(getattr(message, name))} {name} of {count} tiles")
    if any(place >= len(packs) for place in message.packs_of):
        raise BadValue(f"a tile in pack {max(message.packs_of)} of {len(packs)}")
    places = list(accumulate(message.places))
    if places and places[-1] >= _TILES:
        raise BadValue(f"a tile at place {places[-1]} of a district's {_TILES}")
    columns = zip(
        places,
        message.versions,
        _cut("hashes", message.hashes, ANSWER_HASH_BYTES, count),
        _cut("signatures", message.signed, SIGNED_BYTES, count),
        message.packs_of,
        message.starts,
        message.sizes,
        strict=True,
    )
    for place, version, content, signed, pack, start, size in columns:
        tile = TileId(district.first_morton + place)
        yield ArchiveEntry(tile, version, content, signed, packs[pack], start, size)


@dataclass(frozen=True, slots=True)
class ArchiveRoot:
    """The districts of an archive by layer, each ascending.

    Attributes:
        districts: of each layer.
        digests: how the index of each district is named, by layer in the order of `districts`; empty: not told.
        sealed: its seal, of one that was read; None: nobody answers for it.
        lists: which districts the map has, by layer, as a publisher has signed it; not part of what is compared: it
            is signed again where nothing has changed.
    """

    districts: Mapping[str, tuple[District, ...]] = field(default_factory=dict)
    digests: Mapping[str, tuple[bytes, ...]] = field(default_factory=dict)
    sealed: Sealed | None = field(default=None, compare=False)
    lists: Mapping[str, DistrictList] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        for layer in self.districts:
            check_text("layer", layer, LAYER_PATTERN)
        total = sum(map(len, self.districts.values()))
        check_length("ArchiveRoot", total, limits.MAX_DISTRICTS_OF_ARCHIVE, "districts")
        counts = {layer: len(some) for layer, some in self.digests.items()}
        if counts and counts != {layer: len(some) for layer, some in self.districts.items()}:
            raise BadValue(f"ArchiveRoot with {sum(counts.values())} digests of {total} indexes")

    def digest(self, layer: str, district: District) -> bytes:
        """How the index of a district is named; empty: not told."""
        some = self.districts.get(layer, ())
        place = bisect_left(some, district)
        is_listed = place < len(some) and some[place] == district
        return self.digests[layer][place] if is_listed and self.digests else b""

    def encode(self) -> bytes:
        """Bytes of gnd.v1.ArchiveRoot, without a seal."""
        layers = sorted(self.districts)
        numbers = [[one.first_morton // _TILES for one in self.districts[layer]] for layer in layers]
        message = archive_root_pb2.ArchiveRoot(
            major=MAJOR,
            layers=layers,
            counts=[len(some) for some in numbers],
            districts=[step for some in numbers for step in steps_of(some)],
            digests=b"".join(one for layer in layers for one in self.digests.get(layer, ())),
            lists=[district_list_message(self.lists[layer]) for layer in sorted(self.lists)],
        )
        return serialise(message, limits.MAX_ARCHIVE_ROOT_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "ArchiveRoot":
        """The value in `data`; `SchemaError` when it is none."""
        kind = archive_root_pb2.ArchiveRoot
        message, sealed = without_seal(kind, "root", data, limits.MAX_ARCHIVE_ROOT_BYTES)
        check_major(message, "ArchiveRoot")
        check_length("ArchiveRoot", len(message.districts), limits.MAX_DISTRICTS_OF_ARCHIVE, "districts")
        layers, counts = list(message.layers), list(message.counts)
        if layers != sorted(set(layers)) or len(counts) != len(layers) or sum(counts) != len(message.districts):
            raise BadValue(
                f"ArchiveRoot with {len(layers)} layers, {len(counts)} counts and {len(message.districts)} districts"
            )
        parts = list(zip(layers, pairwise([0, *accumulate(counts)]), strict=True))
        digests = _cut("digests", message.digests, DIGEST_BYTES, sum(counts)) if message.digests else []
        lists = {one.head.layer: one for one in map(decode_district_list, message.lists)}
        if len(lists) != len(message.lists):
            raise BadValue(f"ArchiveRoot with {len(message.lists)} lists of districts, of {len(lists)} layers")
        with refusing("ArchiveRoot"):
            return cls(
                {layer: tuple(map(district_of, sums(message.districts[begin:end]))) for layer, (begin, end) in parts},
                {layer: tuple(digests[begin:end]) for layer, (begin, end) in parts} if digests else {},
                sealed,
                lists,
            )


def _cut(what: str, data: bytes, each: int, count: int) -> list[bytes]:
    if len(data) != each * count:
        raise BadValue(f"{len(data)} bytes of {what}, need {each} for each of {count}")
    return [data[at : at + each] for at in range(0, len(data), each)]
