"""Point clouds as PCD files (version 0.7), `binary` and `binary_compressed`, x y z as float32."""

import struct

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F32
from gnd.gnd_map.jit import kernel

_U8 = npt.NDArray[np.uint8]
_HEADER = (
    "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    "WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {kind}\n"
)
_LITERALS, _MOST, _FAR, _SLOTS = 32, 264, 8192, 1 << 16


def pcd_binary(points_m: F32) -> bytes:
    """The file of points (N, 3), point after point."""
    return _HEADER.format(n=len(points_m), kind="binary").encode() + points_m.astype("<f4").tobytes()


def pcd_compressed(points_m: F32) -> bytes:
    """The file of points (N, 3), column after column, packed by LZF as the Point Cloud Library does."""
    columns = points_m.astype("<f4").T.tobytes()
    packed = lzf_compress(columns)
    head = _HEADER.format(n=len(points_m), kind="binary_compressed").encode()
    return head + struct.pack("<II", len(packed), len(columns)) + packed


def lzf_compress(data: bytes) -> bytes:
    """`data` in the format of LibLZF: runs of literals, and copies of 3 … 264 bytes from at most 8192 bytes before."""
    source = np.frombuffer(data, np.uint8)
    target = np.empty(len(source) + len(source) // _LITERALS + 4, np.uint8)
    return target[: _lzf(source, target, np.full(_SLOTS, -1, np.int64))].tobytes()


def lzf_decompress(data: bytes, size: int) -> bytes:
    """What `lzf_compress` packed; for tests and readers, byte by byte."""
    out, at = bytearray(), 0
    while at < len(data) and len(out) < size:
        control, at = data[at], at + 1
        if control < _LITERALS:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length, at = length + data[at], at + 1
        start = len(out) - ((control & 31) << 8) - data[at] - 1
        at += 1
        for k in range(length + 2):
            out.append(out[start + k])
    return bytes(out)


@kernel
def _lzf(source: _U8, target: _U8, last: npt.NDArray[np.int64]) -> int:
    """Greedy: the latest place with the same three bytes (by hash) is copied as far as it agrees."""
    n, at, out, run = len(source), 0, 1, 0  # target[out - run - 1] will say how long the run of literals is
    while at < n:
        length = 0
        if at + 2 < n:
            slot = ((source[at] << 16 | source[at + 1] << 8 | source[at + 2]) * 2654435761 >> 8) & (_SLOTS - 1)
            start, last[slot] = last[slot], at
            if start >= 0 and at - start <= _FAR:
                while length < _MOST and at + length < n and source[start + length] == source[at + length]:
                    length += 1
        if length >= 3:
            if run > 0:
                target[out - run - 1] = run - 1
            else:
                out -= 1
            away, count = at - start - 1, length - 2
            if count < 7:
                target[out] = (away >> 8) | (count << 5)
            else:
                target[out] = (away >> 8) | (7 << 5)
                out += 1
                target[out] = count - 7
            target[out + 1] = away & 255
            out += 3
            run = 0
            at += length
            continue
        target[out] = source[at]
        out += 1
        at += 1
        run += 1
        if run == _LITERALS:
            target[out - run - 1] = run - 1
            run = 0
            out += 1
    if run > 0:
        target[out - run - 1] = run - 1
    else:
        out -= 1
    return out
