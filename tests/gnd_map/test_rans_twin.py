"""The rANS kernels against a plain twin in Python's own integers: the same words, and read again the same numbers."""

import hashlib
from collections.abc import Callable
from dataclasses import fields
from importlib import resources
from typing import Any, cast

import numpy as np
import pytest
from codec_samples import ARCTIC, KARLSRUHE, street

from gnd.gnd_map.codec import LATTICES, Lattice, snap
from gnd.gnd_map.codec import rans_kernels as rk
from gnd.gnd_map.codec import voxel_kernels as v
from gnd.gnd_map.codec.coding import CHECK_BYTES, Coder, checksum
from gnd.gnd_map.codec.lattice import integers_of
from gnd.gnd_map.codec.priors import priors_of
from gnd.gnd_map.codec.rans_tables import FILE, LATTICES_WITH_SUMS, moves, pack, sums_of, unpack
from gnd.gnd_map.codec.rans_tile import (
    SymbolCounts,
    decode_tile_by_sums,
    encode_tile_by_sums,
    numbers_written,
    read_numbers,
)
from gnd.gnd_map.codec.volume import NOTHING_KNOWN, LaidOut, box_of, voxel_coding
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

FROZEN = "6fa6c90dce2d17688e3986f2b379aa77991c0229513b3db5a93085ab64c7695a"
STANDARD = LATTICES["standard"]
ALL = pytest.mark.parametrize("lattice", LATTICES.values(), ids=lambda lattice: lattice.name)


class Twin:
    """Writes the numbers of a tile word for word from their description, slowly: what is expected of each number is
    asked of the kernels' plain functions.
    """

    def __init__(self, lattice: str) -> None:
        sums, self.moves = sums_of(lattice), moves()
        self.says = [[int(x) for x in row] for row in sums.says]
        self.shares, self.axes = sums.shares.tolist(), sums.axes.tolist()
        self.kept: list[tuple[int, int]] = []
        self.starts = np.concatenate([[0], np.cumsum([n for family in rk.FAMILIES for n in family])]).tolist()

    def take(self, starts: list[int], symbol: int) -> None:
        self.kept.append((starts[symbol], starts[symbol + 1] - starts[symbol]))

    def plain(self, bits: int, n: int) -> None:
        self.kept.append((bits << 15 - n, 1 << 15 - n))

    def number(self, family: int, contexts: tuple[int, ...], odd: int) -> None:
        rows = [self.says[self.starts[5 * family + i] + c] for i, c in enumerate(contexts)]
        p = int(self.moves.odds[min(max(sum(row[0] for row in rows) // 16 + 2048, 0), 4095)])
        self.take([0, p, 32768], int(odd != 0))
        for row in rows:
            row[0] += ((32768 if odd == 0 else 0) - p) * 13 // 1024
        if odd == 0:
            return
        place, scale = (sum(row[i] for row in rows) for i in (1, 2))
        width = min(max(round_half_up(scale + 3 * 4096, 2048), 0), 19)
        quarters = round_half_up(place, 1024)
        whole, quarter = divmod(quarters + 2, 4)
        beside = odd - 1 if odd > 0 else odd
        which = (sum(rk.SHAPES[:family]) + shape(family, contexts, quarter)) * 20 + width
        self.off(self.shares[which], width, beside - whole)
        entry = min(max((beside * 4096 - place) * int(self.moves.inverse[width]) // 2**20, -31), 31) + 32
        for row in rows:
            row[1] += int(self.moves.place_moves[width, entry])
            row[2] += int(self.moves.scale_moves[width, entry])

    def off(self, starts: list[int], width: int, off: int) -> None:
        n = int(self.moves.plain_bits[width])
        coarse, low = divmod(off, 1 << n)
        if abs(coarse) <= 7:
            self.take(starts, coarse + 7)
        else:
            beyond = abs(coarse) - 7
            self.take(starts, 15)
            self.plain((coarse < 0) << 4 | beyond.bit_length() - 1, 5)
            if beyond > 1:
                self.plain(beyond - (1 << beyond.bit_length() - 1), beyond.bit_length() - 1)
        if n:
            self.plain(low, n)

    def words(self) -> bytes:
        state, found = 1 << 16, []
        for start, share in reversed(self.kept):
            if state >= share << 17:
                found.append(state & 0xFFFF)
                state >>= 16
            state = (state // share << 15) + state % share + start
        found += [state & 0xFFFF, state >> 16]
        return b"".join(word.to_bytes(2, "little") for word in reversed(found))


def round_half_up(value: int, unit: int) -> int:
    return (2 * value + unit) // (2 * unit)


def shape(family: int, contexts: tuple[int, ...], quarter: int) -> int:
    second, fifth = contexts[1], contexts[4]
    by_family = {0: second, 3: second * 4 + quarter, 5: fifth // 4, 6: fifth // 4, 7: fifth, 8: fifth, 9: fifth // 9}
    return by_family.get(family, quarter)


def laid_out(tile_id: TileId, g: Gaussians, lattice: Lattice) -> LaidOut:
    q = integers_of(g, lattice)
    return LaidOut.of(box_of(tile_id, q.voxel_id), q.voxel_id, NOTHING_KNOWN, lattice, q)


def coder_of(lattice: Lattice) -> Coder:
    return Coder.writing(priors_of(f"tile-{lattice.name}"), 64, five=True)


def twin_words(one: LaidOut) -> bytes:
    """Walks the table as the kernel does."""
    twin, m = Twin(one.lattice.name), voxel_coding(coder_of(one.lattice), one)
    one.expect()
    for row in range(1, len(one.table)):
        z, y, x = (int(one.table[row, i]) for i in (v.Z, v.Y, v.X))
        place, axis = z * m.floor_step + y * m.line_step + x, int(one.table[row, v.AXIS])
        occupied, n = int(plain_of("_occupied")(m, place)), int(plain_of("_known_around")(m, place, -1))
        first, second = (int(one.table[m.known[i], v.AXIS]) if n > i else 3 for i in (0, 1))
        twin.take(twin.axes[(first * 4 + second) * 64 + occupied], axis)
        voxel = plain_of("_voxel_at")(m, row, 0, axis, n, occupied)
        for family in range(10):
            *contexts, want = (int(c) for c in plain_of("_expected")(m, voxel, family))
            odd = int(one.table[row, v._COLUMN[family]]) - want
            twin.number(family, tuple(contexts), odd)
            m.memo[family] = odd
        m.where[place] = row
    one.where[:] = -1
    return twin.words()


def plain_of(name: str) -> Callable[..., Any]:
    """A kernel's source."""
    return cast("Callable[..., Any]", getattr(v, name).py_func)


@ALL
def test_the_kernel_writes_what_the_twin_writes(lattice: Lattice) -> None:
    one = laid_out(KARLSRUHE, snap(street(KARLSRUHE, np.random.default_rng(5), 60), lattice), lattice)
    expected, counts = twin_words(one), SymbolCounts.none()
    assert numbers_written(coder_of(lattice), one, sums_of(lattice.name)) == expected
    one.where[:] = -1
    assert numbers_written(coder_of(lattice), one, sums_of(lattice.name), counts) == expected
    assert counts.axes.sum() == len(one.voxel_id)
    assert 0 < counts.symbols.sum() < 10 * len(one.voxel_id)


def test_numbers_far_from_what_is_expected_come_back() -> None:
    """Beyond all symbols: the sign, the length and the digits are plain."""
    q = integers_of(snap(street(ARCTIC, np.random.default_rng(2), 30), STANDARD), STANDARD)
    for step in (1, 40, -700, 8191, -8191):
        q.step[:, 2] = np.where(np.arange(len(q)) % 3 == 0, step, 0)
        one = LaidOut.of(box_of(ARCTIC, q.voxel_id), q.voxel_id, NOTHING_KNOWN, STANDARD, q)
        words = np.frombuffer(numbers_written(coder_of(STANDARD), one, sums_of("standard")), "<u2").astype(np.uint16)
        assert read_again(one, words).tolist() == one.table[1:, v.AXIS : v.SELF].tolist()


def read_again(one: LaidOut, words: np.ndarray) -> np.ndarray:
    empty = LaidOut.of(one.box, one.voxel_id, NOTHING_KNOWN, one.lattice, None)
    read_numbers(coder_of(one.lattice), empty, sums_of(one.lattice.name), words)
    return empty.table[1:, v.AXIS : v.SELF]


@pytest.fixture(scope="module")
def body() -> bytes:
    return encode_tile_by_sums(KARLSRUHE, snap(street(KARLSRUHE, np.random.default_rng(5), 200), STANDARD), STANDARD)


def resealed(data: bytes) -> bytes:
    return data + checksum(data)


def test_words_that_are_missing_left_over_or_others_are_named(body: bytes) -> None:
    data, begin = body[:-CHECK_BYTES], 2 + (body[0] & 0x7F | body[1] << 7)  # of the words
    assert 2 < begin < len(data)
    for damaged, message in (
        (data[:-2], "truncated|end in the state"),
        (data + bytes(2), "of them used"),
        (data + bytes(1), "are left for words"),
        (data[:-2] + bytes(2), "end in the state|truncated|of them used|outside"),
        (b"\xff\xff\xff\xff" + data[1:], "tell no length"),
        (b"\xff\xff\x7f" + data[1:], "are left for words"),
        (data[:begin], "fewer than the 2 of a state"),
        (b"", "fewer than"),
    ):
        with pytest.raises(CodecError, match=message):
            decode_tile_by_sums(KARLSRUHE, resealed(damaged), STANDARD)
    with pytest.raises(CodecError, match="checksum"):
        decode_tile_by_sums(KARLSRUHE, data + b"..", STANDARD)
    nothing = encode_tile_by_sums(KARLSRUHE, Gaussians.empty(), STANDARD)
    with pytest.raises(CodecError, match="of them used"):
        decode_tile_by_sums(KARLSRUHE, resealed(nothing[:-CHECK_BYTES] + bytes(2)), STANDARD)


def test_the_frozen_tables_never_change() -> None:
    """Another file makes other bytes of the same tile: the codec ids would change their meaning."""
    data = resources.files("gnd.gnd_map.codec").joinpath(FILE).read_bytes()
    assert hashlib.sha256(data).hexdigest() == FROZEN
    again, sums = unpack(pack(moves(), {name: sums_of(name) for name in LATTICES_WITH_SUMS}))
    pairs = [(getattr(moves(), f.name), getattr(again, f.name)) for f in fields(again)]
    for name in LATTICES_WITH_SUMS:
        pairs += [(getattr(sums_of(name), f.name), getattr(sums[name], f.name)) for f in fields(sums[name])]
    assert len(pairs) == 14
    assert all(np.array_equal(one, other) for one, other in pairs)


@ALL
def test_every_symbol_has_a_share_and_all_are_one(lattice: Lattice) -> None:
    for starts in (sums_of(lattice.name).shares, sums_of(lattice.name).axes):
        assert (np.diff(starts.astype(np.int64), axis=1) > 0).all()
        assert set(starts[:, 0]) == {0}
        assert set(starts[:, -1]) == {rk.ONE}
    assert 0 < int(moves().odds.min()) < int(moves().odds.max()) < rk.ONE
