"""Streets of chosen lengths and places."""

import hashlib
from collections import Counter
from typing import Any

import numpy as np
import pytest

from gnd.fleet_sim.errors import WorldError
from gnd.fleet_sim.shapes import Ball
from gnd.fleet_sim.street import SITES, SiteName, StreetOptions, street
from gnd.fleet_sim.world import World, to_json
from gnd.gnd_map.tile_id import TileId

PINNED = {
    1: "6be8c9916764804a2bc5ef5b57c4eb4a343465f2471a13fef975b907b6a42013",
    7: "4d34a56b95f80bfa50e014506e0fd2775277ae651c15a7e12b2a593907c83473",
    21: "5b1a6d6271e53829e6ef1376e42a5c44a96aa5dfe44eee57c1feff44ed7d684b",
}


@pytest.mark.parametrize("seed", PINNED)
def test_the_street_without_options_never_changes(seed: int) -> None:
    """Every result of `gnd fleet` and of the benchmarks refers to these bytes."""
    assert hashlib.sha256(to_json(street(seed)).encode()).hexdigest() == PINNED[seed]
    assert street(seed) == street(seed, StreetOptions())


def edits_of(world: World) -> dict[str, tuple[str, float]]:
    """Edit and place along the street of everything that was edited, by name."""
    return {o.name: (o.edit, o.shapes[0].x_m) for o in world.objects if o.edit != "kept"}


def tiles_of(world: World, reach_m: float) -> list[TileId]:
    """Tiles at points along the street and 50 m beside it."""
    x = np.arange(-reach_m, reach_m + 1.0, 10.0)
    points = np.concatenate([np.stack([x, np.full_like(x, y), np.zeros_like(x)], axis=1) for y in (-50.0, 0.0, 50.0)])
    lat, lon, _ = world.frame.geodetic_from_enu(world.map_of_street(points))
    return [TileId.from_geodetic(float(a), float(b)) for a, b in zip(lat, lon, strict=True)]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("length_m", [100.0, 123.4, 400.0, 500.0, 1000.0])
def test_a_street_of_any_length_has_edits_of_all_kinds_where_it_is_driven(seed: int, length_m: float) -> None:
    world = street(seed, StreetOptions(length_m=length_m))
    assert world.half_length_m == length_m / 2
    edits = edits_of(world)
    count = Counter(edit for edit, _ in edits.values())
    assert min(count[edit] for edit in ("added", "removed", "moved", "reshaped")) >= 4
    assert all(abs(x) <= max(length_m / 2, 70.0) for _, x in edits.values())


@pytest.mark.parametrize("seed", range(3))
def test_a_street_of_400_m_is_edited_all_along(seed: int) -> None:
    edits = edits_of(street(seed, StreetOptions(length_m=400.0)))
    assert 60 <= len(edits) <= 100
    for middle in np.arange(-175.0, 176.0, 50.0):
        assert sum(abs(x - middle) <= 25.0 for _, x in edits.values()) >= 3, f"around {middle:.0f} m"


@pytest.mark.parametrize("seed", range(4))
def test_nothing_stands_in_the_lanes(seed: int) -> None:
    for o in street(seed, StreetOptions(length_m=1000.0)).objects:
        for shape in o.shapes:
            _, y0, _, y1, top = shape.bounds()
            low = shape.z_m if isinstance(shape, Ball) else shape.bottom_m
            in_lane = y0 < 3.2 and y1 > -3.2 and low < 4.0 and top > 0.05
            assert not in_lane, o.name


@pytest.mark.parametrize("length_m", [200.0, 400.0])
@pytest.mark.parametrize(("site", "districts"), [("border", 2), ("wangsimni", 1), ("north49", 1)])
def test_a_site_lies_where_it_says(site: SiteName, districts: int, length_m: float) -> None:
    for seed in range(3):
        tiles = tiles_of(street(seed, StreetOptions(length_m=length_m, site=site)), length_m / 2 + 50.0)
        assert len({tile.district for tile in tiles}) == districts
        lat_deg, lon_deg = np.degrees(tiles[len(tiles) // 2].centre_rad)
        assert (lat_deg, lon_deg) == pytest.approx((49.0, 8.4) if site == "north49" else (37.56, 127.036), abs=0.01)


def test_wangsimni_begins_in_the_tiles_of_figure_2() -> None:
    tiles = {tile.morton for tile in tiles_of(street(3, StreetOptions(400.0, "wangsimni")), 200.0)}
    assert tiles & {497353963152, 497353963153, 497353963154, 497353963155}


def test_a_position_replaces_the_site() -> None:
    world = street(2, StreetOptions(lat_deg=-33.9, lon_deg=18.4))
    assert np.degrees([world.lat_rad, world.lon_rad]).tolist() == pytest.approx([-33.9, 18.4], abs=2e-4)
    assert world.objects == street(2).objects


def test_the_site_does_not_change_what_stands_there() -> None:
    assert len({street(5, StreetOptions(site=site)).objects for site in SITES}) == 1


def test_a_share_of_the_edits_leaves_the_state_before_and_the_other_edits_as_they_are() -> None:
    whole, part = street(3, StreetOptions(400.0)), street(3, StreetOptions(400.0, edit_share=0.3))
    assert {o.name: o.shapes for o in part.in_state("before")} == {o.name: o.shapes for o in whole.in_state("before")}
    some, all_of_them = edits_of(part), edits_of(whole)
    assert 0.15 * len(all_of_them) <= len(some) <= 0.45 * len(all_of_them)
    assert some.items() <= all_of_them.items()
    made = {o.name for o in part.objects if o.edit != "kept"}
    after = {o.name: o.shapes for o in part.in_state("after")}
    assert {n: s for n, s in after.items() if n in made} == {
        o.name: o.shapes for o in whole.in_state("after") if o.name in made
    }
    assert not edits_of(street(3, StreetOptions(400.0, edit_share=0.0)))
    assert street(3, StreetOptions(400.0, edit_share=0.0)).in_state("after") == tuple(
        o for o in street(3, StreetOptions(400.0, edit_share=0.0)).objects
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"length_m": 99.9}, "100 … 1000"),
        ({"length_m": 1e9}, "100 … 1000"),
        ({"length_m": float("nan")}, "nan"),
        ({"length_m": "400"}, "numbers"),
        ({"lat_deg": "north", "lon_deg": 1.0}, "numbers"),
        ({"site": "mars"}, "mars"),
        ({"edit_share": 1.1}, "edit_share"),
        ({"edit_share": float("nan")}, "nan"),
        ({"lat_deg": 10.0}, "both"),
        ({"lon_deg": 10.0}, "both"),
        ({"lat_deg": 91.0, "lon_deg": 0.0}, "lat_deg"),
        ({"lat_deg": float("nan"), "lon_deg": 0.0}, "lat_deg"),
        ({"lat_deg": 10.0, "lon_deg": float("inf")}, "lon_deg"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(WorldError, match=message):
        StreetOptions(**options)
