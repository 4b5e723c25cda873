"""What a vehicle uploads in the point-cloud framework: new points, deleted points, and the blocks it observed.

Three codecs of the same statement. "points", as in the paper: 12 bytes for each new and each deleted point.
"indexed": a deleted point is named by its index in the map, 4 bytes. "compact": new points as leaf cells with positions
rounded to a sixteenth of a leaf (6 mm), columns of differences, indices as differences, all through zstd. Each carries
the blocks that were observed, which the votes in the cloud need.
"""

import struct
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
import zstandard

from gnd.gnd_map.accumulate import CELLS_A_SIDE
from gnd.gnd_map.arrays import F32, F64, I32
from gnd.gnd_map.near_grid import grid_near
from studies.pcd.points import PcdCodecError, PcdError, PcdMap

Codec = Literal["points", "indexed", "compact"]
CODECS: Final[tuple[Codec, ...]] = get_args(Codec)

_MAGIC: Final = b"PCR1"
_HEAD: Final = struct.Struct("<4sB5I3i")
"""Magic, codec, points of the map, new, deleted, observed blocks, bytes of the bitmap, lowest cell of new points."""
_MAX_POINTS: Final = 50_000_000
_FRACTIONS: Final = 16


@dataclass(frozen=True, slots=True, eq=False)
class PcdReport:
    """What one drive found out about a point-cloud map."""

    new_points: F32
    """(K, 3) float32 metres, map frame: one a leaf cell."""
    deleted_index: I32
    """(D,) int32, increasing: points of the map that are gone."""
    observed: I32
    """(B,) int32, increasing: blocks of half a voxel that the drive can speak about."""
    map_size: int
    """Points of the map that the report refers to."""

    def __post_init__(self) -> None:
        p = self.new_points
        if p.dtype != np.float32 or p.ndim != 2 or p.shape[1] != 3 or not np.isfinite(p).all():
            raise PcdError(f"new points must be finite float32 (K, 3), got {p.dtype} {p.shape}")
        _check_increasing("deleted points", self.deleted_index, self.map_size)
        _check_increasing("observed blocks", self.observed, 2**31)

    def encode(self, codec: Codec = "indexed", base: PcdMap | None = None) -> bytes:
        """What is uploaded.

        Args:
            codec: see the module's head.
            base: the map that the report refers to; "points" takes the deleted points from it, "compact" its grid.

        Raises:
            PcdError: an unknown codec, or a map that is missing or another one.
        """
        if codec not in CODECS:
            raise PcdError(f"unknown codec {codec!r}, use one of {', '.join(CODECS)}")
        lowest, new = (0, 0, 0), self.new_points.astype("<f4").tobytes()
        deleted = self.deleted_index.astype("<u4").tobytes()
        if codec == "points":
            deleted = _checked_map(self, base).points_m[self.deleted_index].astype("<f4").tobytes()
        if codec == "compact":
            lowest, new = _packed_points(self.new_points, _checked_map(self, base))
            deleted = _packed(_differences(self.deleted_index))
        bitmap = _bitmap(self.observed)
        sizes = self.map_size, len(self.new_points), len(self.deleted_index), len(self.observed), len(bitmap)
        head = _HEAD.pack(_MAGIC, CODECS.index(codec), *sizes, *lowest)
        split = struct.pack("<I", len(new)) if codec == "compact" else b""
        return head + bitmap + split + new + deleted

    @classmethod
    def decode(cls, data: bytes, base: PcdMap) -> "PcdReport":
        """The report in `data`, which refers to `base`; "compact" gives new points within 6 mm.

        Raises:
            PcdCodecError: `data` is no report about this map.
        """
        if len(data) < _HEAD.size:
            raise PcdCodecError(f"a report has at least {_HEAD.size} bytes, got {len(data)}")
        magic, codec, map_size, n_new, n_deleted, n_observed, n_bitmap, *lowest = _HEAD.unpack_from(data)
        if magic != _MAGIC or codec >= len(CODECS):
            raise PcdCodecError(f"no report: begins with {magic!r}, codec {codec}")
        if map_size != len(base) or n_deleted > map_size or max(n_new, n_observed) > _MAX_POINTS:
            raise PcdCodecError(
                f"{n_new} new and {n_deleted} deleted points of a map of {map_size}; this one has {len(base)}"
            )
        observed = _observed(data[_HEAD.size : _HEAD.size + n_bitmap], n_observed)
        read = _read_compact if CODECS[codec] == "compact" else _read_plain
        new, deleted = read(data[_HEAD.size + n_bitmap :], n_new, n_deleted, (CODECS[codec], base, lowest))
        try:
            return cls(new, deleted, observed, map_size)
        except PcdError as error:
            raise PcdCodecError(f"report of {len(data)} bytes: {error}") from error


def _check_increasing(name: str, index: I32, limit: int) -> None:
    if index.dtype != np.int32 or index.ndim != 1:
        raise PcdError(f"{name}: expected int32 (N,), got {index.dtype} {index.shape}")
    steps = np.diff(index.astype(np.int64), prepend=-1, append=limit)
    if (steps <= 0).any():
        raise PcdError(f"{name}: {len(index)} numbers must increase within 0 ... {limit - 1}")


_Context = tuple[Codec, PcdMap, list[int]]


def _checked_map(report: PcdReport, base: PcdMap | None) -> PcdMap:
    if base is None or len(base) != report.map_size:
        found = "none" if base is None else f"one of {len(base)}"
        raise PcdError(f"this codec needs the map of {report.map_size} points that the report is about, got {found}")
    return base


def _read_plain(data: bytes, n_new: int, n_deleted: int, context: _Context) -> tuple[F32, I32]:
    codec, base, _ = context
    width = 12 if codec == "points" else 4
    if len(data) != 12 * n_new + width * n_deleted:
        raise PcdCodecError(f"{len(data)} bytes for {n_new} new and {n_deleted} deleted points of {width} bytes")
    new = np.frombuffer(data, "<f4", 3 * n_new).reshape(-1, 3).astype(np.float32)
    rest = data[12 * n_new :]
    if codec == "indexed":
        return new, np.frombuffer(rest, "<u4").astype(np.int64).clip(max=2**31 - 1).astype(np.int32)
    return new, _find_points(base, np.frombuffer(rest, "<f4").reshape(-1, 3).astype(np.float32))


def _find_points(base: PcdMap, points: F32) -> I32:
    """Index of each point in the map, found by its exact coordinates."""
    known, wanted = (np.ascontiguousarray(p).view("V12").ravel() for p in (base.points_m, points))
    order = np.argsort(known, kind="stable")
    at = np.minimum(np.searchsorted(known[order], wanted), len(known) - 1) if len(known) else np.zeros(0, np.int64)
    if len(at) != len(wanted) or (known[order][at] != wanted).any():
        raise PcdCodecError(f"some of {len(wanted)} deleted points are not in the map")
    return np.sort(order[at]).astype(np.int32)


def _packed_points(points: F32, base: PcdMap) -> tuple[tuple[int, int, int], bytes]:
    """Lowest leaf cell (3,), and sorted cells as differences by column with their fractions."""
    fine = np.floor(_grid(points, base) * _FRACTIONS).astype(np.int64)
    fine = fine[np.lexsort((fine // _FRACTIONS).T[::-1])]
    cells = fine // _FRACTIONS
    low = cells.min(axis=0) if len(cells) else np.zeros(3, np.int64)
    columns = [np.diff(cells[:, a], prepend=low[a]).astype("<i2").tobytes() for a in range(3)]
    if len(cells) and int(np.ptp(cells, axis=0).max()) > np.iinfo(np.int16).max:
        raise PcdError(f"new points span {np.ptp(cells, axis=0).max()} leaf cells; the codec holds 32767")
    columns.append((fine - cells * _FRACTIONS).astype(np.uint8).T.tobytes())
    return (int(low[0]), int(low[1]), int(low[2])), _packed(b"".join(columns))


def _read_compact(data: bytes, n_new: int, n_deleted: int, context: _Context) -> tuple[F32, I32]:
    _, base, lowest = context
    if len(data) < 4 or struct.unpack_from("<I", data)[0] > len(data) - 4:
        raise PcdCodecError(f"{len(data)} bytes end before the new points do")
    end = 4 + struct.unpack_from("<I", data)[0]
    columns = _unpacked(data[4:end], 9 * n_new)
    steps = np.frombuffer(columns, "<i2", 3 * n_new).reshape(3, -1).T.astype(np.int64)
    cells = np.cumsum(steps, axis=0) + np.array(lowest)
    fraction = np.frombuffer(columns, np.uint8, offset=6 * n_new).reshape(3, -1).T
    g = (cells + (fraction + 0.5) / _FRACTIONS) / CELLS_A_SIDE + _origin_g(base)
    deleted = np.cumsum(np.frombuffer(_unpacked(data[end:], 4 * n_deleted), "<u4").astype(np.int64))
    if len(deleted) and deleted[-1] >= 2**31:
        raise PcdCodecError(f"deleted index {deleted[-1]} does not fit")
    return base.grid_frame.map_of_grid(g).astype(np.float32), deleted.astype(np.int32)


def _grid(points: F32, base: PcdMap) -> F64:
    """(K, 3) leaf cell coordinates from the frame's origin."""
    return np.asarray((grid_near(base.grid_frame, points.astype(np.float64)) - _origin_g(base)) * CELLS_A_SIDE)


def _origin_g(base: PcdMap) -> F64:
    return np.asarray(np.floor(base.grid_frame.grid_of(np.zeros((1, 3)))[0]))


def _differences(index: I32) -> bytes:
    return np.diff(index.astype(np.int64), prepend=0).astype("<u4").tobytes()


def _packed(data: bytes) -> bytes:
    return bytes(zstandard.ZstdCompressor(level=12).compress(data))


def _unpacked(data: bytes, size: int) -> bytes:
    """Exactly `size` bytes out of zstd; never more in memory."""
    try:
        if zstandard.frame_content_size(data) != size:
            raise PcdCodecError(f"{len(data)} bytes do not unpack to the expected {size}")
        return bytes(zstandard.ZstdDecompressor().decompress(data))
    except zstandard.ZstdError as error:
        raise PcdCodecError(f"{len(data)} bytes are no zstd data: {error}") from error


def _bitmap(observed: I32) -> bytes:
    """Block numbers as differences."""
    return _packed(_differences(observed))


def _observed(data: bytes, n: int) -> I32:
    index = np.cumsum(np.frombuffer(_unpacked(data, 4 * n), "<u4").astype(np.int64))
    if len(index) and index[-1] >= 2**31:
        raise PcdCodecError(f"observed block {index[-1]} does not fit")
    return index.astype(np.int32)
