from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim.cars import SLOT_M, parked_cars
from gnd.fleet_sim.errors import DriveSimError, SimShapeError, WorldError
from gnd.fleet_sim.shapes import Ball, Block, Post
from gnd.fleet_sim.street import street
from gnd.fleet_sim.world import World, from_json, read_world, to_json, write_world
from gnd.gnd_map.tile_id import TileId


def test_the_same_seed_gives_the_same_world_to_the_bit(street_1: World) -> None:
    assert to_json(street(1)) == to_json(street_1)


def test_another_seed_gives_another_world(street_1: World) -> None:
    assert to_json(street(2)) != to_json(street_1)


def test_a_written_world_is_read_back_to_the_bit(street_1: World, tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    write_world(street_1, path)
    assert read_world(path) == street_1
    assert [p.name for p in tmp_path.iterdir()] == ["world.json"]


@pytest.mark.parametrize("seed", range(5))
def test_every_street_lies_in_two_districts(seed: int) -> None:
    world = street(seed)
    ends = world.map_of_street(np.array([[-90.0, 0.0, 0.0], [90.0, 0.0, 0.0]]))
    lat, lon, height = world.frame.geodetic_from_enu(ends)
    tiles = [TileId.from_geodetic(float(a), float(b)) for a, b in zip(lat, lon, strict=True)]
    assert tiles[0].district != tiles[1].district
    assert {tile.lon_index // 32 for tile in tiles} == {27946, 27947}
    assert np.all(np.abs(height - 30.0) < 5.0)


@pytest.mark.parametrize("seed", range(5))
def test_every_kind_of_edit_occurs_in_every_street(seed: int) -> None:
    edits = Counter(o.edit for o in street(seed).objects)
    assert edits["added"] >= 20
    assert edits["removed"] >= 8
    assert edits["moved"] >= 16, "eight things, each once before and once after"
    assert edits["reshaped"] >= 6


def test_edited_things_stand_in_one_state_and_kept_things_in_both(street_1: World) -> None:
    for o in street_1.objects:
        assert len(o.states) == (2 if o.edit == "kept" else 1), o.name
        if o.edit in ("added", "removed"):
            assert o.states == (("after",) if o.edit == "added" else ("before",))


def test_moved_and_reshaped_things_keep_their_name(street_1: World) -> None:
    for edit in ("moved", "reshaped"):
        before = {o.name for o in street_1.in_state("before") if o.edit == edit}
        assert before == {o.name for o in street_1.in_state("after") if o.edit == edit}


def test_walls_move_by_the_planned_distances(street_1: World) -> None:
    after = {o.name: o for o in street_1.in_state("after")}
    moved = [o for o in street_1.in_state("before") if o.kind == "wall" and o.edit == "moved"]
    shifts = sorted(round(abs(after[o.name].shapes[0].y_m - o.shapes[0].y_m), 3) for o in moved)
    assert shifts == [0.3, 0.6, 1.2, 2.0]


def test_street_and_map_coordinates_are_inverse_and_the_shear_keeps_walls_upright(street_1: World) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * 40
    np.testing.assert_allclose(street_1.street_of_map(street_1.map_of_street(points)), points, atol=1e-12)
    up = street_1.map_of_street(np.array([[0.0, 0.0, 1.0]]))[0]
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=1e-15)
    along = street_1.map_of_street(np.array([[1.0, 0.0, 0.0]]))[0]
    assert along[2] == pytest.approx(street_1.slope)
    assert np.arctan2(along[1], along[0]) == pytest.approx(street_1.heading_rad)


@pytest.mark.parametrize("text", ["[]", "", "{}", '{"format": "gnd.world", "version": 1, "seed"'])
def test_a_file_that_is_no_world_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(WorldError, match=r"world\.json"):
        read_world(path)


def test_a_missing_or_binary_world_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match="cannot read"):
        read_world(tmp_path / "none.json")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(WorldError, match="cannot read"):
        read_world(tmp_path / "binary.json")


def test_a_world_that_cannot_be_written_leaves_nothing(street_1: World, tmp_path: Path) -> None:
    with pytest.raises(WorldError, match="cannot write"):
        write_world(street_1, tmp_path / "no" / "such" / "world.json")
    assert list(tmp_path.iterdir()) == []


def test_a_negative_seed_and_an_unknown_state_are_refused(street_1: World) -> None:
    with pytest.raises(WorldError, match="-3"):
        street(-3)
    with pytest.raises(WorldError, match="unknown state"):
        street_1.in_state("later")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "make",
    [
        lambda: Block(0, 0, 1, 0, 0, 1),
        lambda: Block(0, 0, 1, 1, 2, 1),
        lambda: Post(0, 0, -0.1, 0, 1),
        lambda: Ball(0, 0, 0, 0),
        lambda: Ball(0, 0, float("inf"), 1),
        lambda: Post(0, 0, 0.1, 0, 1, reflectivity=1.5),
    ],
)
def test_impossible_shapes_are_refused(make: object) -> None:
    with pytest.raises(SimShapeError):
        make()  # type: ignore[operator]


def test_json_of_a_world_is_the_same_after_a_round_trip(street_1: World) -> None:
    assert to_json(from_json(to_json(street_1))) == to_json(street_1)


def test_parked_cars_come_from_the_seed_and_stand_clear_of_everything(street_1: World) -> None:
    cars = parked_cars(street_1, "after", 0.2, 5)
    assert cars == parked_cars(street_1, "after", 0.2, 5)
    assert cars != parked_cars(street_1, "after", 0.2, 6)
    blocks = [o.shapes[0].bounds() for o in street_1.in_state("after") if o.kind == "barrier"]
    for x0, y0, x1, y1, _ in (car.bounds() for car in cars):
        assert max(abs(y0), abs(y1)) < street_1.kerb_m
        assert not any(a < x1 and c > x0 and b < y1 and d > y0 for a, b, c, d, _ in blocks)


def test_the_share_of_taken_slots_is_as_asked(street_1: World) -> None:
    full = len(parked_cars(street_1, "before", 1.0, 1)) / 6
    assert full == pytest.approx(2 * 240 / SLOT_M, abs=3), "nothing stands in the parking lanes of the empty street"
    some = np.mean([len(parked_cars(street_1, "before", 0.2, seed)) / 6 for seed in range(40)])
    assert some / full == pytest.approx(0.2, abs=0.03)
    assert parked_cars(street_1, "before", 0.0, 1) == ()
    with pytest.raises(DriveSimError, match=r"1\.5"):
        parked_cars(street_1, "before", 1.5, 1)
