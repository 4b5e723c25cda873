"""What somebody decides about a change is done whole or not at all, leaves all else as it is, and is written down."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from store_helpers import EAST, TILE, Maker, report, tile_of_voxels

from gnd.gnd_map.tile import Tile
from gnd.tile_store import judging
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.errors import ChangedMeanwhile, StoreError, UnknownVersion
from gnd.tile_store.judging import ChangedTile, MapChange
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import Publication

NAMES = {tile: report(number, tile).report_id for number, tile in ((1, TILE), (2, EAST))}


def merged(store: SqlStore, number: int, content) -> None:
    """A shard publishes what one report says."""
    store.put_reports([report(number, content.tile_id)])
    (claim,) = store.claim("one", 1, 30.0)
    name = report(number, content.tile_id).report_id
    base = store.load(claim).base_version
    (done,) = store.publish([Publication(claim, base, content, report_ids=(name,))])
    assert done.status == "published"


@pytest.fixture
def store(maker: Maker):
    """Two tiles in each of which a report has put voxel 3 beside 1 and 2, and in one of them 7."""
    with maker.open() as opened:
        opened.put_tiles([tile_of_voxels(TILE, 1, 2), tile_of_voxels(EAST, 1, 2)])
        merged(opened, 1, tile_of_voxels(TILE, 1, 2, 3, 7))
        merged(opened, 2, tile_of_voxels(EAST, 1, 2, 3))
        yield opened


def change(*tiles: ChangedTile) -> MapChange:
    both = (ChangedTile(TILE, 1, 2, (3,), (NAMES[TILE],)), ChangedTile(EAST, 1, 2, (3,), (NAMES[EAST],)))
    return MapChange("ndt", "new", tuple(sorted(tiles or both, key=lambda one: one.tile.morton)))


def voxels(store: SqlStore, tile) -> list[int]:
    return store.get("ndt", tile).decode_gaussians().gaussians.voxel_id.tolist()


def test_rolling_back_gives_back_the_voxels_of_the_change_alone(store):
    made = judging.take_back(store, change(), "ann@desk", "it was a lorry")
    assert made == {TILE: 3, EAST: 3}
    assert (voxels(store, TILE), voxels(store, EAST)) == ([1, 2, 7], [1, 2])
    assert store.history("ndt", TILE)[-1].kind == "rollback"
    assert {(one.tile, one.version) for one in store.notices()} >= {(TILE, 3), (EAST, 3)}
    (told,) = judging.judged(store, "ndt", [TILE, EAST])
    assert (told.key, told.who, told.judgement, told.why) == (change().key, "ann@desk", "rolled back", "it was a lorry")
    assert told.tiles == tuple(sorted((TILE.morton, EAST.morton)))
    assert store.look(lambda c: trials.doubted_reports(c, "ndt", TILE)) == []


def test_what_is_gone_and_changed_comes_back_as_it_was(store):
    before = store.get("ndt", TILE).decode_gaussians().gaussians
    g = before.select([2, 7])
    moved = Tile(TILE, 0, replace(g, mean_m=g.mean_m + np.float32(0.2)))
    merged(store, 3, moved)
    part = ChangedTile(TILE, 2, 3, (1, 3, 7), ())
    judging.take_back(store, change(part), "ann", "no")
    now = store.get("ndt", TILE).decode_gaussians().gaussians
    assert now.voxel_id.tolist() == [1, 2, 3, 7]
    assert now.select([1, 3, 7]) == before.select([1, 3, 7])
    assert now.select([2]) == moved.gaussians.select([2])


def test_doubting_takes_back_and_doubts_the_reports_until_somebody_clears_them(store):
    judging.take_back(store, change(), "ann", "a mirror", doubt=True)
    assert voxels(store, TILE) == [1, 2, 7]
    (doubted,) = store.look(lambda c: trials.doubted_reports(c, "ndt", TILE))
    assert (doubted.report_id, doubted.version, doubted.cleared_ns) == (NAMES[TILE], 3, None)
    assert store.doubted_vehicles("ndt", TILE) == {report(1, TILE).vehicle}
    from gnd.cloud_merger.release.doubts import clear_and_reenter

    assert clear_and_reenter(store, ("ndt", TILE), "bob", "it is there") == 1
    assert store.doubted_vehicles("ndt", TILE) == frozenset()
    assert store.look(lambda c: trials.steered(c, "ndt", TILE))[-1].action == "cleared"


def test_accepting_changes_nothing_but_the_record_and_holds_for_these_voxels_alone(store):
    judging.accept(store, change(), "ann", "")
    assert voxels(store, TILE) == [1, 2, 3, 7]
    assert store.history("ndt", TILE)[-1].version == 2
    (told,) = judging.judged(store, "ndt", [TILE, EAST])
    assert (told.judgement, told.key) == ("accepted", change().key)
    grown = change(ChangedTile(TILE, 1, 2, (3, 7), ()))
    assert grown.key != told.key
    assert replace(change(), what="modified").key != told.key


@pytest.mark.parametrize("decide", ["accept", "roll back", "doubt"])
def test_a_decision_about_another_version_does_nothing_at_all(store, decide):
    merged(store, 4, tile_of_voxels(EAST, 1, 2, 3, 9))
    do = judging.accept if decide == "accept" else partial(judging.take_back, doubt=decide == "doubt")
    with pytest.raises(ChangedMeanwhile, match=r"version 3 by now, 2 was looked at"):
        do(store, change(), "ann", "x")
    assert (voxels(store, TILE), store.get("ndt", TILE).version) == ([1, 2, 3, 7], 2)
    assert judging.judged(store, "ndt", [TILE, EAST]) == []
    assert store.doubted_vehicles("ndt", TILE) == frozenset()


def test_what_cannot_be_is_refused_by_name(store):
    with pytest.raises(StoreError, match="no report behind"):
        judging.take_back(store, change(ChangedTile(TILE, 1, 2, (3,), ("0" * 26,))), "ann", "x", doubt=True)
    assert store.get("ndt", TILE).version == 2
    with pytest.raises(StoreError, match="characters"):
        judging.accept(store, change(), "", "")
    with pytest.raises(StoreError, match="501"):
        judging.accept(store, change(), "ann", "x" * 501)
    with pytest.raises(UnknownVersion):
        judging.take_back(store, change(ChangedTile(TILE, 1, 9, (3,))), "ann", "x")
    for wrong in (lambda: ChangedTile(TILE, 2, 2, (3,)), lambda: ChangedTile(TILE, 1, 2, ()),
                  lambda: ChangedTile(TILE, 1, 2, (3, 3)), lambda: MapChange("signs", "new", change().tiles),
                  lambda: MapChange("ndt", "new", 2 * change().tiles), lambda: MapChange("ndt", "x", ())):  # fmt: skip
        with pytest.raises(StoreError):
            wrong()
