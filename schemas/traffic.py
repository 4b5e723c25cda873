"""What a vehicle says about its traffic, position and health."""

import math
from dataclasses import dataclass
from typing import Final, Literal

from gnd.schemas import limits
from gnd.schemas.doubt import DoubtReason
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import traffic_line_pb2, traffic_sample_pb2
from gnd.schemas.wire import (
    MAJOR,
    VEHICLE_PATTERN,
    WORD_PATTERN,
    check_length,
    check_major,
    check_text,
    check_unsigned,
    check_word,
    number_of,
    parse,
    serialise,
    word_of,
)

Direction = Literal["up", "down"]
_DIRECTION: Final[dict[int, Direction]] = {1: "up", 2: "down"}
NO_POSITION: Final = (0.0, 0.0)
"""Latitude and longitude of a sample that does not tell where the vehicle is."""
_MAX_LINES: Final = 64
_MAX_REASONS: Final = 32


@dataclass(frozen=True, slots=True)
class TrafficLine:
    """Totals of one kind of message in one direction since the vehicle started."""

    kind: str
    """tile, delta, catalog, change, ack, update, control."""
    direction: Direction
    """"up" = from the vehicle to the cloud."""
    messages: int
    app_bytes: int
    """Payloads, without keys and what the transport adds."""

    def __post_init__(self) -> None:
        check_text("traffic kind", self.kind, WORD_PATTERN)
        check_word(self.direction, _DIRECTION, "traffic direction")
        check_unsigned("messages", self.messages, bits=63)
        check_unsigned("app_bytes", self.app_bytes, bits=63)


@dataclass(frozen=True, slots=True)
class TrafficSample:
    """A vehicle's ledger totals, position and health at one time of its drive."""

    vehicle: str
    t_ns: int
    odometer_m: float
    lines: tuple[TrafficLine, ...]
    """No pair of kind and direction twice."""
    wire_up_bytes: int
    """Sent on the vehicle's own connection, transport included."""
    wire_down_bytes: int
    lat_rad: float
    lon_rad: float
    health: str
    """good, degraded, lost, or another lower-case word."""
    tiles: int
    """Tiles downloaded so far."""
    reports: int
    """Reports acknowledged so far."""
    scans_taken_back: int = 0
    """Scans of which nothing was concluded because their poses turned out to be wrong."""
    tiles_held_back: int = 0
    """Tiles of which nothing was told because an error of the poses explains what seemed to have changed."""
    tiles_doubtful: int = 0
    """Tiles reported with a doubt, those held back included."""
    doubts: tuple[int, ...] = ()
    """The same by reason, in the order of the bits of `DoubtReason`; missing ones at the end are 0."""

    map_stale_h: int = 0
    """Hours since the publishers of its map have confirmed it for the last time, where that is too long; else 0."""

    def __post_init__(self) -> None:
        check_text("vehicle", self.vehicle, VEHICLE_PATTERN)
        check_text("health", self.health, WORD_PATTERN)
        check_unsigned("t_ns", self.t_ns, bits=63)
        check_unsigned("wire_up_bytes", self.wire_up_bytes, bits=63)
        check_unsigned("wire_down_bytes", self.wire_down_bytes, bits=63)
        check_unsigned("tiles", self.tiles, bits=32)
        check_unsigned("reports", self.reports, bits=32)
        for name in ("scans_taken_back", "tiles_held_back", "tiles_doubtful", "map_stale_h"):
            check_unsigned(name, getattr(self, name), bits=32)
        check_length("TrafficSample", len(self.doubts), _MAX_REASONS, "reasons of doubt")
        for tiles in self.doubts:
            check_unsigned("tiles by reason of doubt", tiles, bits=32)
        self._check_position()
        self._check_lines()

    @property
    def has_position(self) -> bool:
        """Whether the vehicle tells where it is."""
        return (self.lat_rad, self.lon_rad) != NO_POSITION

    @property
    def doubts_in_words(self) -> dict[str, int]:
        """Tiles by reason, of those reasons that are known here and that there are."""
        words = (reason.name.lower() for reason in DoubtReason if reason.name)
        return {word: n for word, n in zip(words, self.doubts, strict=False) if n}

    def _check_position(self) -> None:
        if not (math.isfinite(self.odometer_m) and self.odometer_m >= 0):
            raise BadValue(f"odometer {self.odometer_m} m is not a distance")
        if not (abs(self.lat_rad) <= math.pi / 2 and abs(self.lon_rad) <= math.pi):
            raise BadValue(f"position ({self.lat_rad}, {self.lon_rad}) rad is not on the Earth")

    def _check_lines(self) -> None:
        check_length("TrafficSample", len(self.lines), _MAX_LINES, "lines")
        if len({(line.kind, line.direction) for line in self.lines}) < len(self.lines):
            raise BadValue(f"TrafficSample of {self.vehicle} has two lines of one kind and direction")

    def encode(self) -> bytes:
        """Bytes of gnd.v1.TrafficSample."""
        message = traffic_sample_pb2.TrafficSample(
            major=MAJOR,
            vehicle=self.vehicle,
            t_ns=self.t_ns,
            odometer_m=self.odometer_m,
            lines=map(_line_message, self.lines),
            wire_up_bytes=self.wire_up_bytes,
            wire_down_bytes=self.wire_down_bytes,
            lat_rad=self.lat_rad,
            lon_rad=self.lon_rad,
            health=self.health,
            tiles=self.tiles,
            reports=self.reports,
            scans_taken_back=self.scans_taken_back,
            tiles_held_back=self.tiles_held_back,
            tiles_doubtful=self.tiles_doubtful,
            doubts=self.doubts,
            map_stale_h=self.map_stale_h,
        )
        return serialise(message, limits.MAX_TRAFFIC_SAMPLE_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "TrafficSample":
        """The value in `data`; `SchemaError` when it is none."""
        m = parse(traffic_sample_pb2.TrafficSample, data, limits.MAX_TRAFFIC_SAMPLE_BYTES)
        check_major(m, "TrafficSample")
        return cls(
            vehicle=m.vehicle,
            t_ns=m.t_ns,
            odometer_m=m.odometer_m,
            lines=tuple(map(_line_value, m.lines)),
            wire_up_bytes=m.wire_up_bytes,
            wire_down_bytes=m.wire_down_bytes,
            lat_rad=m.lat_rad,
            lon_rad=m.lon_rad,
            health=m.health,
            tiles=m.tiles,
            reports=m.reports,
            scans_taken_back=m.scans_taken_back,
            tiles_held_back=m.tiles_held_back,
            tiles_doubtful=m.tiles_doubtful,
            doubts=tuple(m.doubts),
            map_stale_h=m.map_stale_h,
        )


def _line_message(line: TrafficLine) -> traffic_line_pb2.TrafficLine:
    message = traffic_line_pb2.TrafficLine(kind=line.kind, messages=line.messages, app_bytes=line.app_bytes)
    message.direction = traffic_line_pb2.TrafficLine.Direction.ValueType(number_of(line.direction, _DIRECTION))
    return message


def _line_value(message: traffic_line_pb2.TrafficLine) -> TrafficLine:
    direction = word_of(message.direction, _DIRECTION, "traffic direction")
    return TrafficLine(message.kind, direction, message.messages, message.app_bytes)
