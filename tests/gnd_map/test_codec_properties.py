"""What every codec and lattice promises, at the limits of what voxels and tiles may hold."""

import numpy as np
import pytest
from codec_samples import ARCTIC, KARLSRUHE, SEOUL, TILES, changed, extreme_gaussians, ids_in, street
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gnd.gnd_map.codec import (
    CODECS,
    LATTICES,
    MAX_VOXELS,
    REPORT,
    Codec,
    Flags,
    Lattice,
    best_codec,
    decode_delta,
    decode_flags,
    decode_mask,
    decode_measured,
    decode_tiles,
    encode_delta,
    encode_flags,
    encode_mask,
    encode_measured,
    encode_tiles,
    is_on,
    snap,
    volume,
)
from gnd.gnd_map.codec.lattice import dequantise, quantise
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import content_sha
from gnd.gnd_map.tile_id import TileId

ALL_LATTICES = [*LATTICES.values(), REPORT]
by_lattice = pytest.mark.parametrize("lattice", ALL_LATTICES, ids=lambda lattice: lattice.name)
by_codec = pytest.mark.parametrize("codec", CODECS.values(), ids=lambda codec: codec.name)
by_tile = pytest.mark.parametrize("tile_id", TILES, ids=str)
few = settings(max_examples=15)


def fitting(codec: Codec, gaussians: Gaussians) -> Gaussians:
    return gaussians if codec.lattice is None else snap(gaussians, codec.lattice)


def same_bits(a: Gaussians, b: Gaussians) -> bool:
    """Also of zeros: 0.0 and -0.0 differ."""
    return all(x.tobytes() == y.tobytes() for x, y in zip(a.columns, b.columns, strict=True))


# --- lattices ---------------------------------------------------------------------------------------------------------


@by_lattice
@given(g=extreme_gaussians(KARLSRUHE))
def test_snapping_twice_is_snapping_once_to_the_bit(lattice: Lattice, g: Gaussians) -> None:
    once = snap(g, lattice)
    assert same_bits(snap(once, lattice), once)
    assert is_on(once, lattice)
    assert np.array_equal(once.voxel_id, g.voxel_id)


@by_lattice
@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(0, 2**30 - 1))
@few
def test_what_one_voxel_becomes_does_not_depend_on_the_others(lattice: Lattice, seed: int, rows: int) -> None:
    g = street(SEOUL, np.random.default_rng(seed), 30)
    chosen = np.flatnonzero([rows >> i & 1 for i in range(len(g))])
    assert same_bits(snap(g.take(chosen), lattice), snap(g, lattice).take(chosen))


@by_lattice
def test_a_street_is_moved_by_little(lattice: Lattice) -> None:
    g = street(SEOUL, np.random.default_rng(1), 3000)
    snapped = snap(g, lattice)
    off_m = np.abs(snapped.mean_m - g.mean_m)
    assert np.median(off_m) < 0.02
    assert off_m.max() < 0.25
    for axis in (0, 3, 5):
        ratio = np.sqrt(snapped.cov_m2[:, axis] / g.cov_m2[:, axis])
        assert 0.9 < np.median(ratio) < 1.1
        assert ratio.max() < 2.0
        assert ratio.min() > 0.5


@by_lattice
@given(count=st.integers(1, 2**31 - 1), new_map=st.booleans())
@few
def test_counts_are_the_nearest_of_the_lattice_and_twenty_stay_enough(
    lattice: Lattice, count: int, new_map: bool
) -> None:
    one = street(SEOUL, np.random.default_rng(2), 1)
    g = Gaussians(one.voxel_id, np.array([count], np.int32), one.cells, one.mean_m, one.cov_m2)
    found, cells = (int(column[0]) for column in snap(g, lattice, new_map=new_map).columns[1:3])
    numbers = (new_map and lattice.map_counts) or lattice.counts
    assert set(numbers) <= set(lattice.counts)
    assert found in numbers
    assert (found >= 20) == (count >= 20)
    assert cells == min(found, 20)
    nearest = min(numbers, key=lambda level: abs(np.log(level / count)))
    assert found == nearest or {found, nearest} == {10, 20}  # twenty stay enough


def test_finer_counts_that_lie_on_the_lattice_stay() -> None:
    """Tiles that were published before counts became coarser keep their content, and their hash."""
    q = quantise(street(SEOUL, np.random.default_rng(2), 60), LATTICES["standard"])
    assert len(np.unique(q.count)) > 4
    g = dequantise(q, LATTICES["standard"])
    assert snap(g, LATTICES["standard"], new_map=True) == g
    assert len(np.unique(g.count)) == len(np.unique(q.count))


def test_a_new_map_differs_from_a_merged_one_by_its_counts_only() -> None:
    g = street(SEOUL, np.random.default_rng(2), 60)
    merged, new = snap(g, LATTICES["standard"]), snap(g, LATTICES["standard"], new_map=True)
    assert np.array_equal(merged.mean_m, new.mean_m)
    assert np.array_equal(merged.cov_m2, new.cov_m2)
    assert np.array_equal(merged.cells, new.cells)
    assert len(np.unique(new.count)) < len(np.unique(merged.count))
    assert is_on(new, LATTICES["standard"])


@by_lattice
def test_nothing_here_stays(lattice: Lattice) -> None:
    g = Gaussians.nothing_at([3, 5])
    assert same_bits(snap(g, lattice), g)
    assert not is_on(g, lattice)


# --- codecs of tiles --------------------------------------------------------------------------------------------------


@by_codec
@by_tile
@given(data=st.data())
@settings(max_examples=5)
def test_decoding_gives_back_every_bit_of_extremes(codec: Codec, tile_id: TileId, data: st.DataObject) -> None:
    g = fitting(codec, data.draw(extreme_gaussians(tile_id)))
    body = codec.encode(tile_id, g)
    assert codec.decode(tile_id, body) == g
    assert codec.encode(tile_id, codec.decode(tile_id, body)) == body


@by_codec
@by_tile
def test_decoding_gives_back_every_bit_of_a_street(codec: Codec, tile_id: TileId) -> None:
    for n in (0, 1, 2, 900):
        g = fitting(codec, street(tile_id, np.random.default_rng(n), n))
        found = codec.decode(tile_id, codec.encode(tile_id, g))
        assert found == g
        assert all(column.flags.c_contiguous and column.flags.writeable for column in found.columns)


@pytest.mark.slow
@by_codec
def test_a_tile_as_full_as_can_be(codec: Codec) -> None:
    g = fitting(codec, _full_tile())
    assert len(g) == MAX_VOXELS
    assert codec.decode(SEOUL, codec.encode(SEOUL, g)) == g


def _full_tile() -> Gaussians:
    """200,000 voxels, few different ones."""
    grid, part = VoxelGrid.of(SEOUL), street(SEOUL, np.random.default_rng(3), 500)
    lowest = int(grid.voxel_id(0, 0, -20))
    ids = np.arange(lowest, lowest + MAX_VOXELS, dtype=np.int32)
    rows = np.random.default_rng(4).integers(0, len(part), MAX_VOXELS)
    _, count, cells, mean, cov = part.columns
    return Gaussians(ids, count[rows], cells[rows], mean[rows], cov[rows])


@by_codec
def test_what_does_not_lie_on_the_lattice_is_not_written(codec: Codec) -> None:
    g = street(SEOUL, np.random.default_rng(5), 50)
    if codec.lattice is None:
        assert codec.decode(SEOUL, codec.encode(SEOUL, g)) == g
        return
    with pytest.raises(CodecError, match="do not lie on the lattice"):
        codec.encode(SEOUL, g)
    with pytest.raises(CodecError, match="hold no Gaussian"):
        codec.encode(SEOUL, Gaussians.nothing_at([1, 2]))


@pytest.mark.parametrize("codec", [CODECS[i] for i in (1, 5, 6, 7)], ids=lambda codec: codec.name)
def test_columns_of_another_tile_are_refused(codec: Codec) -> None:
    body = codec.encode(SEOUL, fitting(codec, street(SEOUL, np.random.default_rng(6), 20)))
    with pytest.raises(CodecError, match="checksum"):
        codec.decode(KARLSRUHE, body)
    assert len(codec.decode(SEOUL, body)) > 0


@pytest.mark.parametrize("codec", [CODECS[i] for i in (2, 3, 4, 12)], ids=lambda codec: codec.name)
@by_tile
def test_range_coded_bytes_of_another_tile_are_refused_or_give_gaussians_whose_hash_tells(
    codec: Codec, tile_id: TileId
) -> None:
    for seed in range(20):
        g = fitting(codec, street(tile_id, np.random.default_rng(seed), 40))
        body = codec.encode(tile_id, g)
        for other in set(TILES) - {tile_id}:
            try:
                found = codec.decode(other, body)
            except CodecError:
                continue
            assert content_sha(other, found) != content_sha(tile_id, g)


@by_lattice
@given(g=extreme_gaussians(SEOUL))
@few
def test_the_best_codec_can_express_the_gaussians(lattice: Lattice, g: Gaussians) -> None:
    codec = CODECS[best_codec(snap(g, lattice))]
    assert codec.decode(SEOUL, codec.encode(SEOUL, snap(g, lattice))) == snap(g, lattice)


# --- deltas and reports -----------------------------------------------------------------------------------------------


@by_tile
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 1.0])
@pytest.mark.parametrize("lattice", [None, *LATTICES.values()], ids=str)
def test_a_delta_gives_the_new_state(tile_id: TileId, share: float, lattice: Lattice | None) -> None:
    rng = np.random.default_rng(7)
    base = street(tile_id, rng, 200)
    new = changed(base, tile_id, rng, share)
    if lattice is not None:
        new = snap(new, lattice)
    for held in (base, base if lattice is None else snap(base, lattice), Gaussians.empty()):
        assert decode_delta(tile_id, held, encode_delta(tile_id, held, new)) == new
    assert decode_delta(tile_id, new, encode_delta(tile_id, new, new)) == new


@given(data=st.data())
@settings(max_examples=20)
def test_a_delta_between_extremes(data: st.DataObject) -> None:
    lattice = data.draw(st.sampled_from([*LATTICES.values()]))
    base, new = (data.draw(extreme_gaussians(ARCTIC, 8)) for _ in range(2))
    new = snap(new, lattice)
    held = data.draw(st.sampled_from([base, snap(base, lattice)]))
    assert decode_delta(ARCTIC, held, encode_delta(ARCTIC, held, new)) == new


def test_a_delta_against_another_base_is_refused_or_gives_another_state() -> None:
    rng = np.random.default_rng(8)
    base = snap(street(SEOUL, rng, 300), LATTICES["standard"])
    new = snap(changed(base, SEOUL, rng, 0.1), LATTICES["standard"])
    body = encode_delta(SEOUL, base, new)
    for other in (base.take(np.arange(1, len(base))), Gaussians.empty(), new):
        try:
            assert decode_delta(SEOUL, other, body) != new
        except CodecError:
            continue


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.1, 1.0]), n_new=st.integers(0, 30))
@few
def test_flags_come_back(seed: int, share: float, n_new: int) -> None:
    rng = np.random.default_rng(seed)
    flags = [_flags(tile_id, rng, share, n_new) for tile_id in TILES]
    found = decode_flags([(f.tile_id, f.base) for f in flags], encode_flags(flags))
    for ours, theirs in zip(found, flags, strict=True):
        assert ours.tile_id == theirs.tile_id
        assert np.array_equal(ours.voxel_id, theirs.voxel_id)
        assert np.array_equal(ours.change_class, theirs.change_class)


def _flags(tile_id: TileId, rng: np.random.Generator, share: float, n_new: int) -> Flags:
    base = street(tile_id, rng, int(rng.integers(0, 60)))
    touched = base.voxel_id[rng.random(len(base)) < share]
    ids = np.union1d(touched, ids_in(tile_id, rng, n_new)).astype(np.int32)
    classes = np.where(np.isin(ids, base.voxel_id), rng.integers(2, 4, len(ids)), 1).astype(np.uint8)
    return Flags(tile_id, base, ids, classes)


def test_boxes_of_a_message_have_a_limit_together(monkeypatch: pytest.MonkeyPatch) -> None:
    flags = [_flags(tile_id, np.random.default_rng(9), 0.5, 9) for tile_id in TILES]
    body, bases = encode_flags(flags), [(f.tile_id, f.base) for f in flags]
    monkeypatch.setattr(volume, "MAX_MESSAGE_VOLUME", 30_000)
    with pytest.raises(CodecError, match="voxels in one message: the limit is 30000"):
        decode_flags(bases, body)
    with pytest.raises(CodecError, match="voxels in one message: the limit is 30000"):
        encode_flags(flags)


@given(data=st.data())
@few
def test_measured_gaussians_come_back(data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    tiles = []
    for tile_id in (SEOUL, ARCTIC):
        base = street(tile_id, rng, int(rng.integers(0, 60)))
        tiles.append((tile_id, base, snap(data.draw(extreme_gaussians(tile_id, 8)), REPORT)))
    found = decode_measured([(t, base, m.voxel_id) for t, base, m in tiles], encode_measured(tiles))
    assert found == [m for _, _, m in tiles]


@given(st.dictionaries(st.integers(0, 1023), st.integers(0, 2**31 - 1), max_size=60))
def test_tiles_of_a_district_come_back(entries: dict[int, int]) -> None:
    ascending = sorted(entries.items())
    assert decode_tiles(encode_tiles(ascending)) == ascending


@given(hnp.arrays(np.bool_, st.integers(0, 300)))
def test_masks_come_back(mask: np.ndarray) -> None:
    assert np.array_equal(decode_mask(encode_mask(mask), len(mask)), mask)


@pytest.mark.parametrize(
    "entries", [[(3, 1), (3, 2)], [(4, 1), (3, 1)], [(1024, 1)], [(-1, 1)], [(0, -1)], [(0, 2**31)]]
)
def test_tiles_that_are_none_are_not_written(entries: list[tuple[int, int]]) -> None:
    with pytest.raises(CodecError):
        encode_tiles(entries)
