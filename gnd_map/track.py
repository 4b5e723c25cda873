"""Where a LiDAR was while its scans counted, and what it looked like: the few bytes that let the cloud predict which
voxels a drive has observed (`visibility`), in place of a bitmap of them.

Positions are integers relative to the district's south-west corner: 64ths of a tile (about 0.6 m) east and north, half
metres of ellipsoidal height. A drive is a list of polylines ("pieces"); between two of them no scan counted.

Encoded (about 20 bytes and 0.2 to 1 byte every 10 m): the view (9 signed bytes of elevation, sectors uint16, rays,
range), then as varints the number of pieces, and of each piece its scans, its vertices, and every vertex as zigzag
differences to the one before; last a CRC-16. Little-endian.
"""

import struct
from binascii import crc_hqx
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I32, check_array
from gnd.gnd_map.errors import CodecError, TrackError
from gnd.gnd_map.tile_id import District, TileId

STEPS: Final = 64
"""Horizontal units in a tile."""
HEIGHT_UNIT_M: Final = 0.5
LEVELS: Final = 9
"""Elevations that cut a sensor's rays into eighths."""
LEVEL_DEG: Final = 0.25
SECTORS: Final = 16
"""Sectors of azimuth, the first from straight ahead 22.5° to the left."""
MAX_PIECES: Final = 256
MAX_VERTICES: Final = 4096
MAX_SCANS: Final = 1_000_000
MAX_TRACK_BYTES: Final = 16_384
_MARGIN: Final = 16 * STEPS  # of the district; what a sensor sees from farther away is nothing
_LOWEST, _HIGHEST = (-_MARGIN, -_MARGIN, -2_000), (32 * STEPS + _MARGIN, 32 * STEPS + _MARGIN, 20_000)
_VIEW: Final = struct.Struct(f"<{LEVELS}bHBB")
_CRC: Final = struct.Struct("<H")
_MAX_VARINT_BYTES: Final = 4
_LONGEST_UNIT_M: Final = 0.6


@dataclass(frozen=True, slots=True)
class TrackView:
    """What a LiDAR looks at, as its own scans tell; so no table of sensors is needed.

    Attributes:
        levels: elevations at the quantiles 0, 1/8 … 1 of its rays, ascending, in quarters of a degree, up positive.
        sectors: bit k: it sees the azimuths from k·22.5° to (k+1)·22.5°, counted from straight ahead to the left.
        rays_log2: rays a scan, the logarithm to base 2 in quarters.
        range_m: how far nearly all of its rays reach.
    """

    levels: tuple[int, ...]
    sectors: int = (1 << SECTORS) - 1
    rays_log2: int = 60
    range_m: int = 100

    def __post_init__(self) -> None:
        if len(self.levels) != LEVELS or list(self.levels) != sorted(self.levels):
            raise TrackError(f"a view has {LEVELS} ascending elevations, got {self.levels}")
        if not -128 <= self.levels[0] <= self.levels[-1] <= 127:
            raise TrackError(
                f"elevations of {self.levels[0]} … {self.levels[-1]} quarter degrees are not in -128 … 127"
            )
        if not 0 < self.sectors < 1 << SECTORS:
            raise TrackError(f"sectors {self.sectors:#x} are none of {SECTORS}")
        if not 0 <= self.rays_log2 <= 96 or not 1 <= self.range_m <= 255:
            raise TrackError(f"2^({self.rays_log2}/4) rays and {self.range_m} m: at most 2^24 rays, 1 … 255 m")

    @property
    def rays(self) -> float:
        """Rays a scan."""
        return float(2.0 ** (self.rays_log2 / 4))

    @property
    def elevations_rad(self) -> F64:
        """(LEVELS,) the elevations in radians."""
        return np.radians(np.array(self.levels) * LEVEL_DEG)


@dataclass(frozen=True, slots=True, eq=False)
class TrackPiece:
    """A polyline along which scans counted.

    Attributes:
        vertices: int32 (N, 3), N >= 1: east, north, up in the units of the module's head.
        scans: how many, evenly along it.
    """

    vertices: I32
    scans: int

    def __post_init__(self) -> None:
        check_array("vertices", self.vertices, np.int32, (None, 3))
        if len(self.vertices) < 1 or not 1 <= self.scans <= MAX_SCANS:
            raise TrackError(f"{len(self.vertices)} vertices, {self.scans} scans: at least one, at most {MAX_SCANS}")
        if (self.vertices < _LOWEST).any() or (self.vertices > _HIGHEST).any():
            low, high = self.vertices.min(axis=0).tolist(), self.vertices.max(axis=0).tolist()
            raise TrackError(f"vertices {low} … {high} lie outside {_LOWEST} … {_HIGHEST}")

    def __eq__(self, other: object) -> bool:
        same = isinstance(other, TrackPiece) and self.scans == other.scans
        return same and isinstance(other, TrackPiece) and np.array_equal(self.vertices, other.vertices)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, slots=True)
class Track:
    """Where the sensor of one report was while its scans counted.

    Attributes:
        district: whose south-west corner the positions are relative to.
        view: what the sensor looks at.
        pieces: in the order of time.
    """

    district: District
    view: TrackView
    pieces: tuple[TrackPiece, ...]

    def __post_init__(self) -> None:
        n = sum(len(piece.vertices) for piece in self.pieces)
        if len(self.pieces) > MAX_PIECES or n > MAX_VERTICES:
            raise TrackError(
                f"a track of {len(self.pieces)} pieces with {n} vertices; the limits are {MAX_PIECES}, {MAX_VERTICES}"
            )

    @property
    def scans(self) -> int:
        """Scans that counted."""
        return sum(piece.scans for piece in self.pieces)

    @property
    def way_m(self) -> float:
        """Length of all pieces together, at most: a unit is nowhere longer than at the equator."""
        units = [
            np.linalg.norm(np.diff(piece.vertices.astype(np.float64), axis=0), axis=1).sum() for piece in self.pieces
        ]
        return float(sum(units)) * _LONGEST_UNIT_M

    def tile_coordinates(self, piece: TrackPiece) -> F64:
        """(N, 3) float64 of a piece's vertices: continuous tile coordinates (u, v) of `tile_id`, height in metres.

        East of the date line, u runs on beyond 2^20.
        """
        corner = TileId(self.district.first_morton)
        uv = piece.vertices[:, :2] / STEPS + [corner.lon_index, corner.lat_index]
        return np.column_stack([uv, piece.vertices[:, 2] * HEIGHT_UNIT_M])


def encode_track(track: Track) -> bytes:
    """Bytes of a track; the district is not among them.

    Raises:
        TrackError: more than MAX_TRACK_BYTES.
    """
    view = track.view
    head = _VIEW.pack(*view.levels, view.sectors, view.rays_log2, view.range_m)
    body = head + b"".join(map(_varint, _numbers(track)))
    if len(body) + _CRC.size > MAX_TRACK_BYTES:
        raise TrackError(f"a track of {len(body) + _CRC.size} bytes, the limit is {MAX_TRACK_BYTES}")
    return body + _CRC.pack(crc_hqx(body, 0))


def _numbers(track: Track) -> Iterator[int]:
    yield len(track.pieces)
    before = np.zeros((1, 3), np.int32)
    for piece in track.pieces:
        yield piece.scans
        yield len(piece.vertices)
        steps = np.diff(np.concatenate([before, piece.vertices]), axis=0).astype(np.int64)
        yield from ((steps << 1) ^ (steps >> 63)).ravel().tolist()
        before = piece.vertices[-1:]


def decode_track(district: District, data: bytes) -> Track:
    """The track in `data`.

    Raises:
        CodecError: too long, truncated, damaged, or values that no track has.
    """
    least = _VIEW.size + 1 + _CRC.size
    if not least <= len(data) <= MAX_TRACK_BYTES:
        raise CodecError(f"a track of {len(data)} bytes, expected {least} … {MAX_TRACK_BYTES}")
    body = data[: -_CRC.size]
    if _CRC.unpack(data[-_CRC.size :])[0] != crc_hqx(body, 0):
        raise CodecError(f"a track of {len(data)} bytes is damaged: its checksum differs")
    try:
        *levels, sectors, rays_log2, range_m = _VIEW.unpack_from(body)
        return Track(district, TrackView(tuple(levels), sectors, rays_log2, range_m), _pieces(body[_VIEW.size :]))
    except TrackError as error:
        raise CodecError(f"a track of {len(data)} bytes: {error}") from error
    except StopIteration as error:
        raise CodecError(f"a track of {len(data)} bytes ends before its last vertex") from error


def _pieces(body: bytes) -> tuple[TrackPiece, ...]:
    numbers = _varints(body)
    pieces, last = [], np.zeros(3, np.int64)
    for _ in range(_at_most(next(numbers), MAX_PIECES, "pieces")):
        scans, n = next(numbers), _at_most(next(numbers), MAX_VERTICES, "vertices")
        folded = np.array([next(numbers) for _ in range(3 * n)], np.int64).reshape(n, 3)
        steps = (folded >> 1) ^ -(folded & 1)
        vertices = last + np.cumsum(steps, axis=0)
        pieces.append(TrackPiece(vertices.clip(-(2**31), 2**31 - 1).astype(np.int32), scans))
        last = vertices[-1]
    if next(numbers, None) is not None:
        raise CodecError("a track has bytes behind its last vertex")
    return tuple(pieces)


def _at_most(n: int, most: int, what: str) -> int:
    if n > most:
        raise CodecError(f"a track claims {n} {what}, the limit is {most}")
    return n


def _varint(number: int) -> bytes:
    """Seven bits a byte, lowest first, the highest bit says that more follow."""
    parts = []
    while number > 0x7F:
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*parts, number])


def _varints(body: bytes) -> Iterator[int]:
    """The numbers in `body`; after its end, `CodecError` in the middle of one, else the end of the iterator."""
    number = length = 0
    for byte in body:
        number |= (byte & 0x7F) << 7 * length
        length += 1
        if byte < 0x80:
            yield number
            number = length = 0
        elif length == _MAX_VARINT_BYTES:
            raise CodecError(f"a track holds a number of more than {_MAX_VARINT_BYTES} bytes")
    if length:
        raise CodecError("a track ends in the middle of a number")
