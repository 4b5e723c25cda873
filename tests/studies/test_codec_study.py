"""`gnd reproduce codec`: sizes by field, shifts, tables learnt from other tiles."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.codec import LATTICES, codec_of, snap
from gnd.gnd_map.codec.coding import Coder
from gnd.gnd_map.codec.lattice import integers_of
from gnd.gnd_map.codec.priors import Priors, priors_of
from gnd.gnd_map.codec.range_tile import spent_by_field, written
from gnd.gnd_map.codec.rans_tables import moves, sums_of
from gnd.gnd_map.codec.rans_tile import numbers_written
from gnd.gnd_map.codec.volume import NOTHING_KNOWN, LaidOut, box_of
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId, covering_circle
from studies.codec_study.learn import learnt, learnt_sets
from studies.codec_study.learn_rans import first_moves, learnt_sums
from studies.codec_study.scenes import LEARNT_FAMILIES, SOURCES, CodecScene
from studies.codec_study.study import codec, measured, table_of

TILE = TileId(497353963154)
STANDARD = LATTICES["standard"]


def hall(seed: int, noise_m: float = 0.01) -> tuple[GridFrame, F64]:
    """The grid around a hall of 16 m x 12 m, and points (N, 3) on its floor and walls."""
    rng = np.random.default_rng(seed)
    n = 40_000
    u, v = rng.uniform(-1, 1, (2, n))
    side, sign = rng.integers(0, 3, n), rng.choice([-1.0, 1.0], n)
    x = np.where(side == 1, 8 * sign, 8 * u)
    y = np.where(side == 2, 6 * sign, 6 * np.where(side == 1, u, v))
    z = np.where(side == 0, 0.1 * np.sin(x), 1.5 + 1.5 * v)
    points = np.stack([x, y, z], axis=1) + rng.normal(0, noise_m, (n, 3)) + [0.3, 0.2, 30.4]
    return GridFrame.around(LocalFrame.of_tile(TILE), covering_circle(*TILE.centre_rad, 60.0)), points


@pytest.fixture(scope="module")
def scene() -> CodecScene:
    grid_frame, points = hall(5)
    accumulator = VoxelAccumulator(grid_frame)
    accumulator.add(points)
    T = np.eye(4)
    T[:3, 3] = [0.3, 0.2, 30.4]
    scans = tuple((points[i::5] - T[:3, 3], T) for i in range(5))
    return CodecScene("hall", "real", {t: g for t, g in accumulator.finish().items() if len(g)}, grid_frame, scans)


def test_fields_sum_to_the_bytes_and_shifts_grow_with_the_steps(scene: CodecScene) -> None:
    found = measured(scene)
    codecs = found["codecs"]
    assert found["scans"] == 5
    assert [one["id"] for one in codecs.values()] == [2, 8, 11, 3, 9, 12, 4, 10, 13]
    for one in codecs.values():
        if one["id"] > 10:
            assert not one["fields"]
            assert not one["sets"]
            continue
        left_over = one["bytes"] - sum(one["fields"].values())
        assert 0.0 < left_over * found["voxels"] < 8 * found["tiles"], "checksum, number of the set, what is rounded up"
        assert sum(one["sets"]) == (found["tiles"] if one["id"] >= 8 else 0)
    archive, compact = (codecs[f"{name}, range coded by sets"] for name in ("archive", "compact"))
    assert archive["bytes"] > compact["bytes"]
    assert found["same_map_cm"]["p95"] < archive["shift_cm"]["p95"] < compact["shift_cm"]["p95"]
    table = table_of({"scenes": {"hall": found}})
    assert len(table.rows) == 10


def test_where_nothing_matches_no_shift_is_claimed(scene: CodecScene) -> None:
    T = np.eye(4)
    T[:3, 3] = [0.3, 0.2, 90.0]
    away = CodecScene("away", "real", scene.tiles, scene.grid_frame, tuple((points, T) for points, _ in scene.scans))
    found = measured(away)
    assert found["scans"] == 0
    assert np.isnan(found["codecs"]["standard, range coded"]["shift_cm"]["p95"])


def test_a_set_writes_what_it_was_learnt_from_shorter_than_another(scene: CodecScene) -> None:
    samples = [(tile_id, integers_of(snap(g, STANDARD), STANDARD)) for tile_id, g in scene.tiles.items()]
    own = learnt(samples * 9, STANDARD, None)

    def size(priors: Priors) -> int:
        return sum(len(written(t, q, STANDARD, priors, five=True).finish()) for t, q in samples)

    assert size(own) < 0.8 * size(Priors.flat_5())


def test_sets_are_learnt_one_for_all_and_one_a_heap(scene: CodecScene) -> None:
    maps = [*scene.tiles.items()] * 10
    assert len(learnt_sets(maps, LATTICES["archive"], 2)) == 3


def test_sums_that_have_seen_a_place_write_it_shorter_than_the_frozen_ones(scene: CodecScene) -> None:
    own = learnt_sums([*scene.tiles.items()] * 9, STANDARD, first_moves())
    assert (np.diff(own.shares.astype(np.int64), axis=1) > 0).all()
    sizes = dict.fromkeys(("own", "frozen"), 0)
    for tile_id, g in scene.tiles.items():
        q = integers_of(snap(g, STANDARD, new_map=True), STANDARD)
        for name, sums in (("own", own), ("frozen", sums_of("standard"))):
            laid_out = LaidOut.of(box_of(tile_id, q.voxel_id), q.voxel_id, NOTHING_KNOWN, STANDARD, q)
            coder = Coder.writing(priors_of("tile-standard"), 64, five=True)
            sizes[name] += len(numbers_written(coder, laid_out, sums))
    assert sizes["own"] < 0.9 * sizes["frozen"]


def test_the_frozen_moves_are_those_of_the_formulas() -> None:
    for field in fields(moves()):
        ours, frozen = (np.asarray(getattr(x, field.name), np.int64) for x in (first_moves(), moves()))
        assert np.abs(ours - frozen).max() <= 1, field.name


def test_the_tables_have_seen_neither_reserved_families_nor_most_recordings() -> None:
    assert set(LEARNT_FAMILIES) == {"street", "suburb", "avenue", "motorway", "snow"}
    assert [source.name for source in SOURCES if source.learnt] == ["kitti_raw_0027", "7fab2350"]


def test_an_unknown_set_is_refused(scene: CodecScene) -> None:
    tile_id, gaussians = next(iter(scene.tiles.items()))
    snapped = snap(gaussians, STANDARD)
    with pytest.raises(CodecError, match="set 77 of tables, the lattice standard has 5"):
        spent_by_field(tile_id, snapped, STANDARD, 77)
    body = codec_of(9).encode(tile_id, snapped)
    with pytest.raises(CodecError, match=r"set 200 of tables|checksum"):
        codec_of(9).decode(tile_id, bytes([200]) + body[1:])


def test_a_recording_gives_a_table_a_file_and_a_picture(shared_data: Path, tmp_path: Path) -> None:
    arguments = ["--recordings", str(shared_data), "--real", "apollo_ndt", "--families", "", "--out", str(tmp_path)]
    done = CliRunner().invoke(codec, arguments)
    assert done.exit_code == 0, done.output
    assert "apollo_ndt (HDL-64E)" in done.output
    assert {one.name for one in tmp_path.iterdir()} >= {"result.json", "codec.png"}
