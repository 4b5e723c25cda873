"""Map features of streets: what they are, the map before, its file, and scores against them."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim import parts
from gnd.fleet_sim.errors import EvaluationError, WorldError
from gnd.fleet_sim.feature_files import read_feature_layers, write_feature_layers
from gnd.fleet_sim.feature_scores import FeatureClassScore, FeatureScore, driven, score_features, tiles_of_one_drive
from gnd.fleet_sim.feature_truth import FeatureTruth, TrueFeature, base_features, feature_truth, holds
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape
from gnd.fleet_sim.street import street
from gnd.fleet_sim.world import Edit, State, World, WorldObject
from gnd.gnd_map.features import Feature, FeatureTile, geodetic_in_tile, hit, points_in_tile
from gnd.gnd_map.tile_id import TileId

BOTH: tuple[State, ...] = ("before", "after")


@pytest.fixture(scope="module")
def truth(street_1: World) -> FeatureTruth:
    return feature_truth(street_1)


def object_of(name: str, kind: str, states: tuple[State, ...], edit: Edit, x: float) -> WorldObject:
    made = parts.sign(x, -6.8, 0.03, 0.9, 2.5, 0.1) if kind == "sign" else parts.lamp(x, 6.75, 0.03, 1)
    return WorldObject(name, kind, states, edit, made)


def hand_made(world: World) -> World:
    """The world with nothing on it but five signs and two lamps."""
    return replace(
        world,
        objects=(
            object_of("kept", "sign", BOTH, "kept", 10.0),
            object_of("gone", "sign", ("before",), "removed", 20.0),
            object_of("fresh", "sign", ("after",), "added", 30.0),
            object_of("moved", "sign", ("before",), "moved", 40.0),
            object_of("moved", "sign", ("after",), "moved", 42.0),
            object_of("nudged", "sign", ("before",), "moved", 50.0),
            object_of("nudged", "sign", ("after",), "moved", 50.02),
            object_of("lamp", "lamp", BOTH, "kept", 0.0),
            object_of("dark", "lamp", ("before",), "removed", 5.0),
        ),
    )


def test_features_are_classed_as_the_paper_does(street_1: World) -> None:
    found = feature_truth(hand_made(street_1))
    states = {(f.name, f.state, f.moved) for f in found.of("signs")}
    assert states == {
        ("kept", "normal", False),
        ("gone", "deleted", False),
        ("fresh", "new", False),
        ("moved", "deleted", True),
        ("moved", "new", True),
        ("nudged", "normal", False),
    }
    assert [(f.name, f.state) for f in found.of("streetlights")] == [("lamp", "new")], "the map has none"
    all_mapped = feature_truth(hand_made(street_1), mapped_streetlights=1.0)
    assert {(f.name, f.state) for f in all_mapped.of("streetlights")} == {("lamp", "normal"), ("dark", "deleted")}
    assert len({f.feature_id for f in all_mapped.features}) == len(all_mapped.features)
    with pytest.raises(WorldError, match=r"1\.5"):
        feature_truth(street_1, mapped_streetlights=1.5)


def test_features_lie_where_their_solids_stand(street_1: World) -> None:
    found = feature_truth(hand_made(street_1))
    kept = named(found, "kept", "normal")
    x, y, z = street_1.street_of_map(np.array([kept.position_map_m]))[0]
    assert (x, y) == pytest.approx((10.0, -6.8), abs=0.07)
    assert z == pytest.approx(0.03 + 2.5, abs=1e-9)
    lamp = street_1.street_of_map(found.positions_m("streetlights"))[0]
    assert lamp == pytest.approx([0.0, 6.75, 0.03], abs=1e-9)
    lat, lon, height = found.geodetic("signs")
    assert street_1.frame.enu_from_geodetic(lat, lon, height) == pytest.approx(found.positions_m("signs"), abs=1e-6)


def test_streets_have_enough_changed_signs_and_lamps(truth: FeatureTruth) -> None:
    counts = truth.counts()
    assert counts["signs"]["deleted"] >= 6
    assert counts["signs"]["new"] >= 9
    changed = {o.name for o in truth.world.objects if o.kind == "lamp" and o.edit != "kept"}
    assert len(changed) >= 3
    assert counts["streetlights"]["new"] >= 15


def test_the_map_before_holds_what_stood_before(truth: FeatureTruth) -> None:
    layers = base_features(truth)
    assert set(layers) == {"signs"}
    known = {f.feature_id: f for f in truth.of("signs", "normal", "deleted")}
    errors = []
    for tile in layers["signs"]:
        for feature in tile.features:
            lat, lon, height = geodetic_in_tile(tile.tile_id, feature.points_m)
            assert TileId.from_geodetic(float(lat[0]), float(lon[0])) == tile.tile_id
            place = truth.world.frame.enu_from_geodetic(lat, lon, height)[0]
            errors.append(place - known.pop(feature.feature_id).position_map_m)
            assert feature.existence.exist == pytest.approx(0.95)
    assert not known
    assert np.std(errors) == pytest.approx(0.1, rel=0.3)
    again = base_features(feature_truth(street(1)))
    assert again == layers, "the same to the bit"
    some = base_features(feature_truth(truth.world, mapped_streetlights=0.5))
    lamps = [o for o in truth.world.in_state("before") if o.kind == "lamp"]
    assert sum(len(tile.features) for tile in some["streetlights"]) == round(0.5 * len(lamps))


def test_layers_are_read_back_from_their_file(truth: FeatureTruth, tmp_path: Path) -> None:
    layers, path = base_features(truth), tmp_path / "features.json"
    write_feature_layers(layers, path)
    assert read_feature_layers(path) == layers
    assert not list(tmp_path.glob("*.part"))
    with pytest.raises(WorldError, match="cannot write"):
        write_feature_layers(layers, tmp_path / "none" / "features.json")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"format": "gnd.world"}, "gnd.features"),
        ({"version": 2}, "version 1"),
        ({"layers": []}, "layers"),
        ({"layers": {"ndt": []}}, "'ndt' is no feature layer"),
        ({"layers": {"signs": [{"tile": "1/2", "version": 1, "body": ""}]}}, "1/2"),
        ({"layers": {"signs": [{"tile": "13033/03021/23031/22102", "version": 1, "body": "AAAA"}]}}, "22102"),
        ({"layers": {"signs": [{"tile": "13033/03021/23031/22102", "version": 1, "body": "?"}]}}, "22102"),
    ],
)
def test_files_that_are_no_layers_are_refused(change: dict[str, object], complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "features.json"
    path.write_text(json.dumps({"format": "gnd.features", "version": 1, "layers": {}} | change))
    with pytest.raises(WorldError, match=complaint):
        read_feature_layers(path)
    with pytest.raises(WorldError, match="cannot read"):
        read_feature_layers(tmp_path / "none.json")


def map_of(truth: FeatureTruth, places: Iterable[tuple[int, tuple[float, float, float]]]) -> tuple[FeatureTile, ...]:
    """Tiles with signs of given ids at given places in the map frame."""
    tiles: dict[TileId, list[Feature]] = {}
    for number, place in places:
        lat, lon, height = truth.world.frame.geodetic_from_enu(np.array([place]))
        tile = TileId.from_geodetic(float(lat[0]), float(lon[0]))
        cov = np.array([0.01, 0.0, 0.0, 0.01, 0.0, 0.01])
        feature = Feature(number, "traffic_sign", points_in_tile(tile, lat, lon, height), cov, hit(0.9))
        tiles.setdefault(tile, []).append(feature)
    return tuple(FeatureTile.of(tile, 1, found) for tile, found in tiles.items())


def off(feature: TrueFeature, dx_m: float) -> tuple[float, float, float]:
    x, y, z = feature.position_map_m
    return x + dx_m, y, z


@pytest.fixture(scope="module")
def small(street_1: World) -> FeatureTruth:
    return feature_truth(hand_made(street_1))


def named(truth: FeatureTruth, name: str, state: str) -> TrueFeature:
    return next(f for f in truth.features if (f.name, f.state) == (name, state))


def rights(score: FeatureScore) -> dict[str, tuple[int, int, int]]:
    return {name: (s.right, s.wrong, s.missed) for name, s in score.classes.items()}


def test_the_map_before_misses_every_change(small: FeatureTruth) -> None:
    score = score_features(small, "signs", base_features(small)["signs"])
    assert rights(score) == {"normal": (2, 2, 0), "deleted": (0, 0, 2), "new": (0, 0, 2)}
    assert score.classes["normal"].precision == 0.5
    assert score.classes["deleted"].recall == 0.0
    assert 0.0 < max(score.normal_error_m) < 0.5
    told = score.as_dict()
    assert json.loads(json.dumps(told)) == told


def test_a_perfect_map_has_everything_right(small: FeatureTruth) -> None:
    normal = [(f.feature_id, f.position_map_m) for f in small.of("signs", "normal")]
    new = [(1000 + k, off(f, 0.3)) for k, f in enumerate(small.of("signs", "new"))]
    score = score_features(small, "signs", map_of(small, normal + new))
    assert rights(score) == {"normal": (2, 0, 0), "deleted": (2, 0, 0), "new": (2, 0, 0)}
    assert [s.f1 for s in score.classes.values()] == [1.0, 1.0, 1.0]
    assert score.mean_error_m == pytest.approx(0.3, abs=0.01)
    assert score.error_95_m == pytest.approx(0.3, abs=0.01)
    assert score.truth == {"normal": 2, "deleted": 2, "new": 2}


def test_wrong_maps_are_counted_as_wrong(small: FeatureTruth) -> None:
    kept, gone, fresh = (
        named(small, name, state) for name, state in (("kept", "normal"), ("gone", "deleted"), ("fresh", "new"))
    )
    places = [
        (gone.feature_id, gone.position_map_m),
        (1001, off(fresh, 1.2)),
        (1002, off(kept, 0.1)),
        (1003, off(fresh, 0.2)),
        (1004, off(fresh, 0.4)),
    ]
    score = score_features(small, "signs", map_of(small, places))
    assert rights(score) == {"normal": (0, 1, 2), "deleted": (1, 2, 1), "new": (1, 3, 1)}
    assert score.mean_error_m == pytest.approx(0.2, abs=0.01), "one to one, nearest first"


def test_a_mapped_sign_whose_place_was_corrected_counts_as_moved(small: FeatureTruth) -> None:
    old, new = named(small, "moved", "deleted"), named(small, "moved", "new")
    corrected = score_features(small, "signs", map_of(small, [(old.feature_id, off(new, 0.1))]))
    assert rights(corrected)["deleted"] == (2, 2, 0)
    assert rights(corrected)["new"] == (1, 0, 1)
    x, y, z = (0.7 * a + 0.3 * b for a, b in zip(old.position_map_m, new.position_map_m, strict=True))
    halfway = score_features(small, "signs", map_of(small, [(old.feature_id, (x, y, z))]))
    assert rights(halfway)["deleted"] == (1, 2, 1), "nearer to where it stood"


def test_what_does_not_count_is_neither_right_nor_wrong(small: FeatureTruth) -> None:
    fresh, moved = named(small, "fresh", "new"), named(small, "moved", "new")
    places = [(1001, off(fresh, 0.1)), (1002, off(moved, 0.1))]
    score = score_features(small, "signs", map_of(small, places), only=[moved.feature_id])
    assert rights(score) == {"normal": (0, 0, 0), "deleted": (0, 0, 0), "new": (1, 0, 0)}
    far = replace(fresh, position_map_m=tuple(small.world.map_of_street(np.array([150.0, 5.0, 0.0])).tolist()))
    assert fresh in driven(small)
    assert far not in driven(replace(small, features=(*small.features, far)))


def test_one_drive_alone_is_scored_on_what_it_says(small: FeatureTruth) -> None:
    base = base_features(small)["signs"]
    fresh = named(small, "fresh", "new")
    (tile,) = map_of(small, [(77, off(fresh, 0.5))])
    gone = named(small, "gone", "deleted").feature_id
    after = tiles_of_one_drive(base, [gone], {tile.tile_id: tile.features})
    assert rights(score_features(small, "signs", after)) == {
        "normal": (2, 1, 0),
        "deleted": (1, 0, 1),
        "new": (1, 0, 1),
    }


def test_what_something_was_put_around_does_not_count(small: FeatureTruth) -> None:
    kept = named(small, "kept", "normal")
    shop = parts.slab(5.0, 15.0, -9.0, -6.0, 0.0, 3.0)
    shed = parts.slab(5.0, 15.0, -9.0, -6.0, 0.0, 2.4)
    for block, buried in ((shop, True), (shed, False)):
        around = WorldObject("around", "building", ("after",), "added", (block,))
        found = feature_truth(replace(small.world, objects=(*small.world.objects, around)))
        assert named(found, "kept", "normal").buried is buried
        assert (kept.feature_id in {f.feature_id for f in driven(found)}) is not buried
    assert not any(f.buried for f in small.features)


@pytest.mark.parametrize(("x_m", "doubled"), [(10.7, True), (11.3, False)])
def test_a_new_sign_right_before_an_old_one_does_not_count(small: FeatureTruth, x_m: float, doubled: bool) -> None:
    second = object_of("second", "sign", ("after",), "added", x_m)
    found = feature_truth(replace(small.world, objects=(*small.world.objects, second)))
    new, kept = named(found, "second", "new"), named(found, "kept", "normal")
    assert (new.doubled, kept.doubled) == (doubled, False)
    assert (new in driven(found), kept in driven(found)) == (not doubled, True)
    double = map_of(found, [(kept.feature_id, kept.position_map_m), (1000, new.position_map_m)])
    assert rights(score_features(found, "signs", double))["new"] == ((0, 0, 2) if doubled else (1, 0, 2))


@pytest.mark.parametrize(
    ("shape", "inside", "outside"),
    [
        (Block(1.0, 2.0, 2.0, 0.5, 0.0, 1.0, np.pi / 2), (1.4, 3.9, 0.5), (2.9, 2.1, 0.5)),
        (Block(0.0, 0.0, 2.0, 2.0, 0.0, 1.0, rise_x=0.25), (1.9, 0.0, 1.4), (-1.9, 0.0, 0.6)),
        (Post(0.0, 0.0, 0.2, 0.0, 3.0), (0.1, 0.1, 2.9), (0.15, 0.15, 1.0)),
        (Ball(0.0, 0.0, 2.0, 1.0), (0.5, 0.5, 2.5), (0.6, 0.6, 2.6)),
    ],
)
def test_points_inside_solids_are_told(shape: Shape, inside: tuple[float, ...], outside: tuple[float, ...]) -> None:
    assert holds(shape, np.array(inside))
    assert not holds(shape, np.array(outside))


def test_scores_of_nothing_are_perfect_and_bad_tolerances_refused(small: FeatureTruth) -> None:
    empty = FeatureClassScore(0, 0, 0)
    assert (empty.precision, empty.recall, empty.f1) == (1.0, 1.0, 1.0)
    with pytest.raises(EvaluationError, match="0"):
        score_features(small, "signs", [], tolerance_m=0.0)
    none = score_features(small, "poles", [])
    assert np.isnan(none.mean_error_m)
