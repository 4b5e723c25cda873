"""How vehicles fare on versions of tiles that are on trial: what the release of a version is decided by."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import health_report_pb2, tile_health_pb2
from gnd.schemas.wire import (
    LAYER_PATTERN,
    MAJOR,
    check_length,
    check_major,
    check_text,
    check_unsigned,
    check_version,
    parse,
    refusing,
    serialise,
)

_SHARES: Final = ("matched_permille", "fit_permille", "elsewhere_permille")
_COUNTS: Final = ("scans", "inside", "gated", "not_good")
_DISTRICT_BITS: Final = 10


@dataclass(frozen=True, slots=True)
class TileHealth:
    """One vehicle on one version of a tile, its whole visit so far; see tile_health.proto."""

    tile: TileId
    version: int
    scans: int = 0
    matched_permille: int = 0
    fit_permille: int = 0
    elsewhere_permille: int = 0
    inside: int = 0
    gated: int = 0
    not_good: int = 0
    left: bool = False

    def __post_init__(self) -> None:
        check_version("tile version", self.version, lowest=1)
        for name in (*_COUNTS, *_SHARES):
            check_unsigned(name, getattr(self, name), bits=31)
        for name in _SHARES:
            if getattr(self, name) > 1000:
                raise BadValue(f"{name} of tile {self.tile} is {getattr(self, name)}, a share has at most 1000")
        if self.scans == 0 and any(getattr(self, name) for name in _SHARES):
            raise BadValue(f"tile {self.tile} has shares of no scans")
        if max(self.gated, self.not_good) > self.inside:
            raise BadValue(
                f"tile {self.tile}: {self.gated} scans gated and {self.not_good} not good of {self.inside} inside"
            )

    @property
    def is_told(self) -> bool:
        """Whether it says anything beyond that the version was taken."""
        return self.scans > 0 or self.inside > 0


@dataclass(frozen=True, slots=True)
class HealthReport:
    """What a vehicle tells of the tiles of one district; who it is stands in the key."""

    layer: str
    district: District
    t_ns: int
    tiles: tuple[TileHealth, ...]
    """Ascending, each once."""

    def __post_init__(self) -> None:
        check_text("layer", self.layer, LAYER_PATTERN)
        check_unsigned("t_ns", self.t_ns, bits=63)
        check_length("HealthReport", len(self.tiles), limits.MAX_TILES_OF_HEALTH, "tiles")
        if not self.tiles:
            raise BadValue("HealthReport about no tiles")
        if any(one.tile.district != self.district for one in self.tiles):
            raise BadValue(f"HealthReport for district {self.district} about a tile of another")
        if any(a.tile >= b.tile for a, b in pairwise(self.tiles)):
            raise BadValue("HealthReport about tiles that do not ascend")

    def encode(self) -> bytes:
        """Bytes of gnd.v1.HealthReport."""
        message = health_report_pb2.HealthReport(
            major=MAJOR,
            layer=self.layer,
            district=self.district.first_morton >> _DISTRICT_BITS,
            t_ns=self.t_ns,
            tiles=map(_message, self.tiles),
        )
        return serialise(message, limits.MAX_HEALTH_REPORT_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "HealthReport":
        """The value in `data`; `SchemaError` when it is none."""
        message = parse(
            health_report_pb2.HealthReport,
            data,
            limits.MAX_HEALTH_REPORT_BYTES,
            max_fields=limits.MAX_TILES_OF_HEALTH + 16,
        )
        check_major(message, "HealthReport")
        check_length("HealthReport", len(message.tiles), limits.MAX_TILES_OF_HEALTH, "tiles")
        first = message.district << _DISTRICT_BITS
        with refusing("HealthReport"):
            district = TileId(first).district
            tiles = tuple(_value(first, one) for one in message.tiles)
        return cls(message.layer, district, message.t_ns, tiles)


def _message(one: TileHealth) -> tile_health_pb2.TileHealth:
    return tile_health_pb2.TileHealth(
        index=one.tile.morton & ((1 << _DISTRICT_BITS) - 1),
        version=one.version,
        left=one.left,
        **{name: getattr(one, name) for name in (*_COUNTS, *_SHARES)},
    )


def _value(first: int, one: tile_health_pb2.TileHealth) -> TileHealth:
    if one.index >= 1 << _DISTRICT_BITS:
        raise BadValue(f"tile {one.index} of a district: there are 0 .. {(1 << _DISTRICT_BITS) - 1}")
    told = {name: getattr(one, name) for name in (*_COUNTS, *_SHARES)}
    return TileHealth(TileId(first + one.index), one.version, left=one.left, **told)
