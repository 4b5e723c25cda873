"""A vehicle that was lost for five kilometres tells of signs 21 m beside their places: the layer must not follow it."""

from collections import defaultdict

import numpy as np
import pytest
from feature_cloud import ABSENT, TILE, change, feature, found, report, seen

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.features import FeatureMergeParameters, merge_layer
from gnd.cloud_merger.features import merge as merging
from gnd.cloud_merger.features.kept import FeatureInbox
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.features import FeatureTile, hit
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.features import FeatureReport
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.status import status_of
from gnd.tile_store.values import StoreConfig

ROAD = [TileId.from_indices(TILE.lon_index + 4 * n, TILE.lat_index) for n in range(66)]
"""A tile each 150 m: 10 km."""
LOST = range(16, 49)
"""5 km of them."""
OFF_M = 21.0
EVERYWHERE = (1 << 64) - 1
NO_CHANGE: frozenset[int] = frozenset()


def mapped(n: int) -> tuple:
    """The two signs that the map has in a tile."""
    return FeatureTile.of(ROAD[n], 1, [feature(2 * n + 1, -9.0, 3.0), feature(2 * n + 2, -7.5, -6.0)]).features


def drive(car: int, lost: range | None = None, gone: frozenset[int] = NO_CHANGE) -> list[FeatureReport]:
    """What a vehicle says: of each third tile that there is a new sign, of which it misses one in four and is not sure
    of any; of those in `gone` that a sign is gone.
    """
    rng = np.random.default_rng([car, 5])
    by_district = defaultdict(list)
    for n, tile in enumerate(ROAD):
        is_lost, base = lost is not None and n in lost, mapped(n)
        said: list = []
        off_m = OFF_M if is_lost else 0.0
        for one in base:
            east, north = one.points_m[0, :2] + 0.2 * rng.standard_normal(2)
            if is_lost:
                said += [seen(one.feature_id, ABSENT), found(east + off_m, north)]
            elif one.feature_id in gone:
                said.append(seen(one.feature_id, ABSENT))
            else:
                said.append(seen(one.feature_id, at_m=(east, north)))
        if n % 3 == 0 and (n // 3 + car) % 4:
            said.append(found(-10.0 + off_m + 0.2 * rng.standard_normal(), -12.0, existence=hit(0.6)))
        by_district[tile.district].append(change(*said, base=base, viewed=EVERYWHERE, tile=tile))
    return [report(100 * car + k, *changes, vehicle=f"car-{car}") for k, changes in enumerate(by_district.values())]


def layer_of(reports: list[FeatureReport]) -> dict:
    epochs = {tile: mapped(n) for n, tile in enumerate(ROAD)}
    return {tile: one.features for tile, one in merge_layer(epochs, reports).items()}


def without_refuting(reports: list[FeatureReport]) -> dict:
    """The same when nobody asks who is contradicted."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merging, "refuted_of", lambda tests: {one.report_id: "" for one in tests if not one.report_id})
        return layer_of(reports)


def held(layer: dict) -> dict:
    """Places of the features by tile."""
    return {tile: np.array([one.points_m[0, :2] for one in features]) for tile, features in layer.items() if features}


def alike(one: dict, other: dict, within_m: float) -> bool:
    one, other = held(one), held(other)
    return one.keys() == other.keys() and all(
        len(one[tile]) == len(other[tile])
        and np.linalg.norm(one[tile][:, None] - other[tile][None], axis=2).min(axis=1).max() < within_m
        for tile in one
    )


@pytest.mark.parametrize("lost_car", [1, 3, 5])
def test_five_vehicles_of_which_one_is_lost_are_as_good_as_four(lost_car: int) -> None:
    four = [one for car in range(1, 6) if car != lost_car for one in drive(car)]
    five = [*four, *drive(lost_car, LOST)]
    assert alike(layer_of(five), layer_of(four), 0.3)
    if lost_car > 1:  # the first to pass speaks of another time, and says nothing against what is found later
        assert not alike(without_refuting(five), layer_of(four), 0.3)
    assert layer_of(five) == layer_of(list(reversed(five)))


def test_of_three_vehicles_the_lost_one_does_not_win() -> None:
    two = layer_of([*drive(1), *drive(2)])
    three = layer_of([*drive(1), *drive(2), *drive(3, LOST)])
    there = held(three)
    assert all(
        np.linalg.norm(there[tile][:, None] - xy[None], axis=2).min(axis=0).max() < 0.4
        for tile, xy in held(two).items()
    )


def test_a_change_that_two_vehicles_see_is_no_contradiction() -> None:
    """Half of all signs have gone since three older drives: the newest two say so, and are believed."""
    gone = frozenset(range(1, 2 * len(ROAD) + 1, 2))
    old = [one for car in (1, 2, 3) for one in drive(car)]
    new = [one for car in (4, 5, 6, 7) for one in drive(car, gone=gone)]
    left = {one.feature_id for features in layer_of([*old, *new]).values() for one in features}
    assert left.isdisjoint(gone)


def filled(path, cars: dict[int, range | None]) -> tuple[dict, list[dict]]:
    """The layer and the named vehicles of a store whose shard has merged what the cars said, one after the other."""
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([FeatureTile.of(tile, 1, mapped(n)) for n, tile in enumerate(ROAD)], layer="signs")
        inbox = FeatureInbox(store, FeatureMergeParameters(), (), reach_tiles=3)
        worker = Worker(store, ShardConfig(store_path=path))
        for car, lost in cars.items():
            store.put_reports([row for one in drive(car, lost) for row in inbox.rows(one, 0)])
            while claims := store.claim("one", 64, 30.0):
                store.publish(worker.merge(claims))
        heads = {tile: store.get("signs", tile).decode_features().features for tile in ROAD}
        return heads, status_of(store)["named_vehicles"]


def test_a_shard_leaves_the_lost_vehicle_out_and_names_it(tmp_path) -> None:
    five, named = filled(tmp_path / "five.sqlite", {1: None, 2: None, 3: LOST, 4: None, 5: None})
    four, nobody = filled(tmp_path / "four.sqlite", {1: None, 2: None, 4: None, 5: None})
    assert alike(five, four, 0.3)
    assert [one["vehicle"] for one in named] == ["car-3"]
    assert "21" in named[0]["says"] or "contradicted" in named[0]["says"]
    assert nobody == []


def test_who_was_refuted_goes_into_the_journal_so_the_layer_can_be_computed_anew(tmp_path) -> None:
    """The drives an hour apart, so that each is folded before the next; then every version is verified."""
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([FeatureTile.of(tile, 1, mapped(n)) for n, tile in enumerate(ROAD)], layer="signs")
        inbox = FeatureInbox(store, FeatureMergeParameters(), (), reach_tiles=3)
        config = ShardConfig(store_path=store.path)
        worker = Worker(store, config)
        for hour, (car, lost) in enumerate([(1, None), (2, None), (3, LOST), (4, None), (5, None), (6, None)]):
            rows = [row for one in drive(car, lost) for row in inbox.rows(one, hour * 3600 * 10**9)]
            store.put_reports(rows)
            while claims := store.claim("one", 64, 30.0):
                store.publish(worker.merge(claims))
        verifier = Verifier(store, config)
        checked = [one for tile in ROAD for one in verifier.history("signs", tile)]
        heads = {tile: store.get("signs", tile).decode_features().features for tile in ROAD}
        refuted = store.refuted_reports("signs", ["car-3"])
    assert {one.status for one in checked} == {"given", "same"}
    assert len(checked) > 2 * len(ROAD)
    assert refuted
    others = layer_of([one for car in (1, 2, 4, 5, 6) for one in drive(car)])
    stretch = [ROAD[n] for n in LOST]  # elsewhere it tells the truth, and counts
    assert alike({tile: heads[tile] for tile in stretch}, {tile: others[tile] for tile in stretch}, 0.3)
