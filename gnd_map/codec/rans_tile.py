"""A tile's Gaussians on a lattice in few symbols: codecs 11 to 13, which take less time than 2 to 4 and 8 to 10.

A body: how many bytes say which voxels there are (7 bits a byte, the lowest first; the highest bit: another follows),
these bytes as in codecs 2 to 4, the words of the numbers (uint16, little-endian; none where there is no voxel), two
bytes of CRC-32.
"""

from typing import Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import I64
from gnd.gnd_map.codec import kernels as k
from gnd.gnd_map.codec import rans_kernels as rk
from gnd.gnd_map.codec.coding import CHECK_BYTES, Coder, checksum
from gnd.gnd_map.codec.floats import check_number
from gnd.gnd_map.codec.lattice import Lattice, dequantise, integers_of
from gnd.gnd_map.codec.priors import priors_of
from gnd.gnd_map.codec.rans_kernels import U16
from gnd.gnd_map.codec.rans_tables import Moves, Sums, moves, sums_of
from gnd.gnd_map.codec.volume import NOTHING_KNOWN, LaidOut, box_of, code_box, code_flags, voxel_coding
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

_NOTHING = np.empty(0, np.int32)
_NO_WORDS = np.empty(0, np.uint16)
_WORD_BYTES: Final = 2
_MOST_LENGTH_BYTES: Final = 4
_ZERO_RATE: Final = 13


class SymbolCounts(NamedTuple):
    """How often each symbol came, for those who learn tables.

    Attributes:
        symbols: (DISTRIBUTIONS, SYMBOLS) int64.
        axes: (AXIS_CONTEXTS, 3) int64.
    """

    symbols: I64
    axes: I64

    @classmethod
    def none(cls) -> "SymbolCounts":
        """Nothing yet."""
        return cls(np.zeros((rk.DISTRIBUTIONS, rk.SYMBOLS), np.int64), np.zeros((rk.AXIS_CONTEXTS, 3), np.int64))


_NOT_COUNTED: Final = SymbolCounts(np.zeros((0, rk.SYMBOLS), np.int64), np.zeros((0, 3), np.int64))


def encode_tile_by_sums(tile_id: TileId, gaussians: Gaussians, lattice: Lattice) -> bytes:
    """Bytes of a tile's Gaussians.

    Raises:
        CodecError: they do not lie on the lattice, are more than a tile may hold, or lie too far apart in height.
    """
    check_number(len(gaussians))
    quantised = integers_of(gaussians, lattice)
    coder = Coder.writing(priors_of(f"tile-{lattice.name}"), 4096 + 2 * len(quantised), five=True)
    if not len(quantised):
        code_box(coder, tile_id, _NOTHING, quantised.voxel_id)
        return _sealed(coder, b"")
    box = box_of(tile_id, quantised.voxel_id)
    code_box(coder, tile_id, _NOTHING, quantised.voxel_id)
    laid_out = LaidOut.of(box, quantised.voxel_id, NOTHING_KNOWN, lattice, quantised)
    flag = np.asarray(box.empty(np.uint8, k.NONE), np.uint8)
    flag[laid_out.places] = k.PUT
    code_flags(coder, box, _NOTHING, flag)
    return _sealed(coder, numbers_written(coder, laid_out, sums_of(lattice.name)))


def numbers_written(
    coder: Coder, laid_out: LaidOut, sums: Sums, seen: SymbolCounts | None = None, learnt: Moves | None = None
) -> bytes:
    """Words of the numbers of what is laid out; what comes is added to `seen`. `learnt`: None for the frozen ones."""
    kept = np.empty(rk.MOST_SYMBOLS * len(laid_out.voxel_id), np.uint32)
    laid_out.expect()
    mode = rk.WRITE if seen is None else rk.COUNT
    coding = _coding(mode, _NO_WORDS, kept, sums, seen, learnt)
    _, n = rk.code_numbers(coding, voxel_coding(coder, laid_out), 1, 0, 0)
    words = np.empty(n + 2, np.uint16)
    return words[int(rk.shift_out(kept, n, words)) :].astype("<u2").tobytes()


def decode_tile_by_sums(tile_id: TileId, body: bytes, lattice: Lattice) -> Gaussians:
    """The Gaussians of `encode_tile_by_sums`.

    Raises:
        CodecError: damaged, truncated, or values that are no Gaussians.
    """
    stream, words = _opened(body)
    coder = Coder.over(priors_of(f"tile-{lattice.name}"), stream, five=True)
    box = code_box(coder, tile_id, _NOTHING, None)
    if box is None:
        coder.end()
        _refuse_more(len(words), 0)
        return Gaussians.empty()
    flag = np.asarray(box.empty(np.uint8, k.NONE), np.uint8)
    check_number(code_flags(coder, box, _NOTHING, flag))
    coder.end()
    voxel_id = box.voxel_ids(*np.unravel_index(np.flatnonzero(flag != k.NONE), flag.shape))
    if len(voxel_id) == 0:
        raise CodecError("a tile that claims Gaussians and holds none")
    laid_out = LaidOut.of(box, voxel_id, NOTHING_KNOWN, lattice, None)
    read_numbers(coder, laid_out, sums_of(lattice.name), words)
    return dequantise(laid_out.read(), lattice)


def read_numbers(coder: Coder, laid_out: LaidOut, sums: Sums, words: U16) -> None:
    """Fill the table; all words, and the state with which the writer began, must be what is left in the end."""
    if len(words) < 2:
        raise CodecError(f"{len(words)} words of numbers, fewer than the 2 of a state")
    laid_out.expect()
    coding = _coding(rk.READ, words, _NOTHING_KEPT, sums)
    first = int(words[0]) << rk.WORD_BITS | int(words[1])
    state, used = rk.code_numbers(coding, voxel_coding(coder, laid_out), 1, first, 2)
    if used > len(words):
        raise CodecError(f"{len(words)} words of numbers for {len(laid_out.voxel_id)} voxels: truncated")
    _refuse_more(len(words), used)
    if state != rk.LEAST:
        raise CodecError(f"{len(words)} words of numbers end in the state {state}, expected {rk.LEAST}")


_NOTHING_KEPT = np.empty(0, np.uint32)


def _coding(
    mode: int, words: U16, kept: rk.U32, sums: Sums, seen: SymbolCounts | None = None, learnt: Moves | None = None
) -> rk.SumCoding:
    learnt, counted = learnt or moves(), seen or _NOT_COUNTED
    return rk.SumCoding(
        mode, words, kept, sums.says.copy(), sums.shares, sums.axes, learnt.odds, learnt.inverse, learnt.place_moves,
        learnt.scale_moves, learnt.plain_bits, _ZERO_RATE, counted.symbols, counted.axes,
    )  # fmt: skip


def _refuse_more(words: int, used: int) -> None:
    if words != used:
        raise CodecError(f"{words} words of numbers, {used} of them used")


# --- the body --------------------------------------------------------------------------------------------------------


def _sealed(coder: Coder, words: bytes) -> bytes:
    stream = coder.stream()
    data = _length(len(stream)) + stream + words
    return data + checksum(data)


def _length(n: int) -> bytes:
    """A length, 7 bits a byte, the lowest first."""
    found = bytearray()
    while n >> 7:
        found.append(n & 0x7F | 0x80)
        n >>= 7
    return bytes([*found, n])


def _opened(body: bytes) -> tuple[bytes, U16]:
    """The two parts of a body."""
    if len(body) < 1 + CHECK_BYTES:
        raise CodecError(f"{len(body)} bytes, fewer than the {1 + CHECK_BYTES} of length and checksum")
    data, check = body[:-CHECK_BYTES], body[-CHECK_BYTES:]
    if checksum(data) != check:
        raise CodecError(f"{len(body)} bytes with checksum {check.hex()}, computed {checksum(data).hex()}: damaged")
    n, at = 0, 0
    while True:
        if at == min(_MOST_LENGTH_BYTES, len(data)):
            raise CodecError(f"{len(body)} bytes: their first {at} tell no length")
        n |= (data[at] & 0x7F) << 7 * at
        at += 1
        if data[at - 1] < 0x80:
            break
    rest = len(data) - at - n
    if rest < 0 or rest % _WORD_BYTES:
        raise CodecError(f"{len(body)} bytes, {n} of them say which voxels: {rest} are left for words")
    return data[at : at + n], np.frombuffer(data, "<u2", rest // _WORD_BYTES, at + n).astype(np.uint16)
