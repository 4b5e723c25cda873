"""Merged tiles lie where their base lies: on its lattice, or anywhere; the same reports give the same bits."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from merger_world import BALL, POLE, TILE, VOXEL_BY_VOXEL, WALL, WALL_AGAIN, change_of, gaussians_of, report_of

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.codec import LATTICES, is_on, lattice_of, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import split
from gnd.tile_store.errors import StoreError
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig

# Shapes that lie on no lattice by chance.
STATES = {voxel: (0.013 * voxel, 0.031, -0.2 + 0.0017 * voxel, 0.28, 0.27, 0.021) for voxel in range(30)}
CHANGED = {5: POLE, 7: None, 40: BALL, 41: WALL}


def open_store(path, lattice):
    """A store with one tile, on the lattice or as measured."""
    store = SqliteStore(path, StoreConfig(merge_delay_s=0.0))
    plain = gaussians_of(STATES)
    store.put_tiles([Tile(TILE, 1, snap(plain, LATTICES[lattice]) if lattice else plain)])
    return store


def put(store, base, number, changed, tile=TILE):
    observed = sorted({*STATES, *changed})
    report = report_of(number, change_of(base, observed, changed, tile=tile))
    sha = report.tiles[0].base_sha
    store.put_reports([ReportRow(report.report_id, "ndt", t, "car", number, body, sha) for t, body in split(report)])


def merge_once(store, **config):
    worker = Worker(store, ShardConfig(store_path=store.path, confirmation=VOXEL_BY_VOXEL, **config))
    return store.publish(worker.merge(store.claim("one", 16, 30.0)))


def head(store, tile=TILE):
    return store.get("ndt", tile)


@pytest.mark.parametrize("lattice", list(LATTICES))
def test_a_merged_tile_lies_on_the_lattice_of_its_base_and_keeps_what_nobody_changed(tmp_path, lattice):
    with open_store(tmp_path / "map.sqlite", lattice) as store:
        base = head(store).decode().gaussians
        for number in (1, 2, 3):
            put(store, base, number, CHANGED)
        assert [r.status for r in merge_once(store)] == ["published"]
        stored = head(store)
        merged = stored.decode().gaussians
        assert lattice_of(stored.codec_id) is LATTICES[lattice]
        assert is_on(merged, LATTICES[lattice])
        untouched = sorted(set(STATES) - set(CHANGED))
        assert merged.select(untouched) == base.select(untouched)
        assert set(merged.voxel_id.tolist()) == {*STATES, *CHANGED} - {7}
        wall = merged.select([41])
        np.testing.assert_allclose(wall.mean_m, gaussians_of({41: WALL}).mean_m, atol=0.03)


def test_a_map_of_floats_stays_one(tmp_path):
    with open_store(tmp_path / "map.sqlite", None) as store:
        base = head(store).decode().gaussians
        for number in (1, 2):
            put(store, base, number, {40: POLE})
        merge_once(store)
        stored = head(store)
        assert lattice_of(stored.codec_id) is None
        (row,) = np.flatnonzero(stored.decode().gaussians.voxel_id == 40)
        assert stored.decode().gaussians.take([row]).mean_m == pytest.approx(gaussians_of({40: POLE}).mean_m)


@pytest.mark.parametrize("codec", ["archive", "standard", "compact", "float"])
def test_a_tile_without_base_lies_where_the_shard_is_told(tmp_path, codec):
    unmapped = TileId(TILE.morton - 2)
    with open_store(tmp_path / "map.sqlite", "standard") as store:
        for number in (1, 2):
            put(store, None, number, STATES, tile=unmapped)
        merge_once(store, codec=codec)
        merged = head(store, unmapped).decode().gaussians
        assert len(merged) == len(STATES)
        assert [is_on(merged, lattice) for name, lattice in LATTICES.items() if name != codec].count(True) == 0
        assert codec == "float" or is_on(merged, LATTICES[codec])


def test_an_empty_base_does_not_make_new_content_coarser(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([Tile(TILE, 1, Gaussians.empty())])
        for number in (1, 2):
            put(store, Gaussians.empty(), number, STATES)
        merge_once(store, codec="archive")
        assert is_on(head(store).decode().gaussians, LATTICES["archive"])


def test_an_unknown_codec_is_refused():
    with pytest.raises(StoreError, match="codec 'zip' is unknown; known are archive, standard, compact, float"):
        ShardConfig(codec="zip")


def test_the_same_reports_give_the_same_bits_in_whatever_order_and_batches(tmp_path):
    """Promise 3, on a lattice: also where reports refer to versions that lay between."""
    said = {1: CHANGED, 2: {**CHANGED, 41: WALL_AGAIN}, 3: {5: POLE, 41: WALL_AGAIN}}
    shas = set()
    for n, order in enumerate(permutations(said)):
        with open_store(tmp_path / f"{n}.sqlite", "standard") as store:
            base = head(store).decode().gaussians
            for turn, number in enumerate(order):
                put(store, base, number, said[number])
                if turn != n % 3:  # so that batches differ, too
                    merge_once(store)
            merge_once(store)
            shas.add(head(store).sha)
    assert len(shas) == 1


def test_merging_what_a_vehicle_measured_against_the_merged_version_moves_nothing_else(tmp_path):
    with open_store(tmp_path / "map.sqlite", "standard") as store:
        base = head(store).decode().gaussians
        put(store, base, 1, {40: POLE})
        put(store, base, 2, {40: POLE})
        merge_once(store)
        second = head(store).decode()
        report = report_of(3, replace(change_of(second.gaussians, [*STATES, 40], {}), base_version=2))
        rows = [ReportRow(report.report_id, "ndt", t, "car", 3, body, second.sha) for t, body in split(report)]
        store.put_reports(rows)
        assert [r.status for r in merge_once(store)] == ["unchanged"]
        assert head(store).decode() == second
        assert base.select(list(STATES)) == second.gaussians.select(list(STATES))
