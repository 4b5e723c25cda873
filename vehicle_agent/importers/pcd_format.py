"""PCD files (Point Cloud Library, versions 0.6 and 0.7): ascii, binary and binary_compressed."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.jit import kernel
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.files import read_file

U8 = NDArray[np.uint8]

MAX_POINTS = 20_000_000
MAX_HEADER_BYTES = 4096
MAX_POINT_BYTES = 4096
_MOST_OF_A_BYTE = 88  # LZF: three bytes stand for 264 at most
SIZES = {"F": (4, 8), "U": (1, 2, 4, 8), "I": (1, 2, 4, 8)}  # bytes of floats, unsigned and signed integers


@dataclass(frozen=True, slots=True)
class _Header:
    dtype: np.dtype[np.void]
    points: int
    data: str


def read_pcd(path: Path) -> NDArray[np.void]:
    """The points of a PCD file as a structured array (N,) with the file's field names.

    Raises:
        ImportDriveError: not a PCD file, truncated, or of an encoding that does not exist.
    """
    data = read_file(path)
    header, body = _split(path, data)
    if not header.points:
        return np.empty(0, header.dtype)
    if header.data == "ascii":
        return _from_ascii(path, header, body)
    if header.data == "binary_compressed":
        return _from_columns(path, header, body)
    if header.data != "binary":
        raise ImportDriveError(f"{path}: DATA {header.data}; ascii, binary and binary_compressed are read")
    needed = header.points * header.dtype.itemsize
    if len(body) < needed:
        raise ImportDriveError(f"{path}: {len(body)} bytes of points, {needed} announced")
    return np.frombuffer(body, header.dtype, header.points)


def _split(path: Path, data: bytes) -> tuple[_Header, bytes]:
    """Header and what follows it."""
    lines: dict[str, list[str]] = {}
    stream = io.BytesIO(data[:MAX_HEADER_BYTES])
    while "DATA" not in lines:
        line = stream.readline()
        if not line.endswith(b"\n"):
            raise ImportDriveError(f"{path}: no line DATA in the first {MAX_HEADER_BYTES} bytes; not a PCD file")
        words = line.decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            lines[words[0]] = words[1:]
    try:
        return _header(lines), data[stream.tell() :]
    except (KeyError, IndexError, ValueError) as error:
        raise ImportDriveError(f"{path}: PCD header without a usable {error}") from error


def _header(lines: dict[str, list[str]]) -> _Header:
    names, sizes, types = lines["FIELDS"], lines["SIZE"], lines["TYPE"]
    counts = lines.get("COUNT", ["1"] * len(names))
    fields = [
        (name, _type(kind, int(size)), (_count(count),)) if count != "1" else (name, _type(kind, int(size)))
        for name, size, kind, count in zip(names, sizes, types, counts, strict=True)
    ]
    points = int(lines["POINTS"][0])
    if not 0 <= points <= MAX_POINTS:
        raise ValueError(f"POINTS {points} (0 ... {MAX_POINTS})")
    dtype = np.dtype(fields)
    if not 0 < dtype.itemsize <= MAX_POINT_BYTES:
        raise ValueError(f"point of {dtype.itemsize} bytes (1 ... {MAX_POINT_BYTES})")
    return _Header(dtype, points, lines["DATA"][0])


def _count(text: str) -> int:
    """Numbers of a field; numpy makes room for what a dtype says."""
    count = int(text)
    if not 1 <= count <= MAX_POINT_BYTES:
        raise ValueError(f"COUNT {count} (1 ... {MAX_POINT_BYTES})")
    return count


def _type(kind: str, size: int) -> str:
    if size not in SIZES[kind]:
        raise ValueError(f"TYPE {kind} of SIZE {size}")
    return f"<{kind.lower()}{size}"


def _from_ascii(path: Path, header: _Header, body: bytes) -> NDArray[np.void]:
    try:
        lines = [line for line in body.decode("ascii").splitlines() if line.strip()]
        rows = np.loadtxt(lines, dtype=header.dtype, ndmin=1) if lines else np.empty(0, header.dtype)
    except (ValueError, OverflowError) as error:
        raise ImportDriveError(f"{path}: {error}") from error
    if len(rows) != header.points:
        raise ImportDriveError(f"{path}: {len(rows)} points, {header.points} announced")
    return rows


def _from_columns(path: Path, header: _Header, body: bytes) -> NDArray[np.void]:
    """binary_compressed: two sizes, then all fields one after the other, LZF-compressed."""
    if len(body) < 8:
        raise ImportDriveError(f"{path}: ends before its compressed points")
    packed_size, size = (int(n) for n in np.frombuffer(body, "<u4", 2))
    needed = header.points * header.dtype.itemsize
    if size != needed or len(body) < 8 + packed_size:
        raise ImportDriveError(
            f"{path}: {len(body) - 8} of {packed_size} compressed bytes, {size} uncompressed, {needed} announced"
        )
    if size > _MOST_OF_A_BYTE * packed_size:
        raise ImportDriveError(f"{path}: {packed_size} compressed bytes cannot hold {size}")
    columns = np.zeros(size, np.uint8)
    if _lzf_decompress(np.frombuffer(body, np.uint8, packed_size, 8), columns) != size:
        raise ImportDriveError(f"{path}: compressed points are damaged")
    points = np.empty(header.points, header.dtype)
    start = 0
    for name in header.dtype.names or ():
        field = header.dtype[name]
        end = start + header.points * field.itemsize
        points[name] = columns[start:end].view(field.base).reshape(points[name].shape)
        start = end
    return points


@kernel
def _lzf_decompress(source: U8, out: U8) -> int:
    """LZF (M. Lehmann): a control byte below 32 starts literals, others a copy from before. Bytes written, or -1."""
    i, o = 0, 0
    while i < source.shape[0]:
        control = int(source[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > source.shape[0] or o + length > out.shape[0]:
                return -1
            for _ in range(length):
                out[o] = source[i]
                i += 1
                o += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= source.shape[0]:
                return -1
            length += int(source[i])
            i += 1
        if i >= source.shape[0]:
            return -1
        start = o - ((control & 31) << 8) - int(source[i]) - 1
        i += 1
        length += 2
        if start < 0 or o + length > out.shape[0]:
            return -1
        for k in range(length):
            out[o] = out[start + k]
            o += 1
    return o
