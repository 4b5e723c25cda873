"""Two reports of a vehicle that no vehicle can have made; drives of honest vehicles are never taken for such."""

from itertools import combinations
from math import cos, pi, radians
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gnd.gnd_map.geodesy import ecef_from_geodetic, meridian_radius_m, normal_radius_m
from gnd.gnd_map.tile_id import LON_TILES, TileId
from gnd.tile_store import sqlite_store
from gnd.tile_store.errors import ImpossiblePlace
from gnd.tile_store.places import REMEMBERED_PLACES, ReportPlace, apart_m, put_place, why_impossible

NS, S = 1_700_000_000_000_000_000, 10**9
LAT, LON = radians(37.56), radians(127.04)
VIEW_M = 100.0
UNCHANGED_M = 1000.0
"""Ground that did not change is told of after so much way at the latest, as `ReportParameters.unchanged_m`."""


def place(lat: float, lon: float, last_s: float, name: str = "r") -> ReportPlace:
    lon = (lon + pi) % (2.0 * pi) - pi
    return ReportPlace.of(name, NS + round(last_s * S), [TileId.from_geodetic(lat, lon)])


def moved(lat: float, lon: float, east_m: float, north_m: float) -> tuple[float, float]:
    """Where one comes from a position, a step that is short against the Earth."""
    return (
        lat + north_m / float(meridian_radius_m(lat)),
        lon + east_m / (float(normal_radius_m(lat)) * cos(lat)),
    )


@st.composite
def drives(draw: st.DrawFn) -> list[ReportPlace]:
    """The reports of an honest drive anywhere but at the poles, by a clock that is set on the way."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    lat, lon = radians(draw(st.floats(-75.0, 75.0))), radians(draw(st.floats(-180.0, 180.0)))
    fastest = draw(st.sampled_from([3.0, 14.0, 40.0, 65.0]))
    off_s, found, seen, t_s, way_m = 0.0, list[ReportPlace](), list[tuple[float, TileId]](), 0.0, 0.0
    for number in range(draw(st.integers(2, 40))):
        heading, seconds = rng.uniform(0.0, 2.0 * pi), rng.uniform(1.0, 60.0)
        length_m = rng.uniform(0.0, fastest) * seconds
        for _ in range(max(1, int(length_m // 200))):
            part = length_m / max(1, int(length_m // 200))
            lat, lon = moved(lat, lon, part * np.cos(heading), part * np.sin(heading))
            way_m += part
            beside = moved(lat, lon, *rng.uniform(-VIEW_M, VIEW_M, 2))
            seen.append((way_m, TileId.from_geodetic(beside[0], (beside[1] + pi) % (2.0 * pi) - pi)))
        t_s += seconds
        if number == 20:
            off_s = rng.uniform(-25.0, 25.0)
        tiles = [tile for at_m, tile in seen if at_m > way_m - UNCHANGED_M]
        if tiles:
            found.append(
                ReportPlace.of(str(number), NS + round((t_s + off_s) * S), [tiles[rng.integers(len(tiles))], tiles[0]])
            )
    return found


@settings(max_examples=60, deadline=None)
@given(drives())
def test_an_honest_drive_is_possible(drive: list[ReportPlace]) -> None:
    for one, other in combinations(drive, 2):
        assert why_impossible(one, other) == why_impossible(other, one) == ""


@settings(max_examples=100, deadline=None)
@given(
    st.floats(-70.0, 70.0), st.floats(-180.0, 180.0), st.floats(0.0, 2.0 * pi), st.floats(6_500.0, 60_000.0),
    st.floats(0.0, 1.0),
)  # fmt: skip
@example(0.0, 179.99, 0.0, 10_000.0, 0.5)  # over the date line
def test_a_jump_is_not(lat_deg: float, lon_deg: float, heading: float, far_m: float, share: float) -> None:
    """A vehicle that is far away after less time than 70 m/s would take, however near the limit in time or place."""
    lat, lon = radians(lat_deg), radians(lon_deg)
    there = moved(lat, lon, far_m * np.cos(heading), far_m * np.sin(heading))
    seconds = share * max(0.0, 0.97 * far_m - 4_000.0 - 100.0 - 2_100.0) / 70.0
    if 0.97 * far_m > 6_200.0:
        assert "more than 70 m/s" in why_impossible(place(lat, lon, 0.0), place(*there, seconds))
    slow_s = max(0.0, 1.01 * far_m - 4_000.0 - 2_100.0) / 70.0
    assert why_impossible(place(lat, lon, 0.0), place(*there, slow_s)) == ""


@given(st.floats(-75.0, 75.0), st.floats(-180.0, 180.0), st.floats(-30.0, 30.0), st.floats(-30.0, 30.0))
def test_the_distance_is_never_more_than_it_is(lat_deg: float, lon_deg: float, east_km: float, north_km: float) -> None:
    lat, lon = radians(lat_deg), radians(lon_deg)
    there = moved(lat, lon, 1000.0 * east_km, 1000.0 * north_km)
    chord_m = float(np.linalg.norm(ecef_from_geodetic(lat, lon, 0.0) - ecef_from_geodetic(*there, 0.0)))
    assert 0.96 * chord_m - 120.0 <= apart_m(place(lat, lon, 0.0), place(*there, 0.0)) <= chord_m + 0.01 * chord_m


def test_both_sides_of_the_date_line_are_neighbours() -> None:
    west = ReportPlace.of("a", NS, [TileId.from_indices(LON_TILES - 1, 1 << 18)])
    east = ReportPlace.of("b", NS, [TileId.from_indices(0, 1 << 18)])
    assert apart_m(west, east) == apart_m(east, west) == 0.0


def test_what_a_private_vehicle_tells_of_its_begin_does_not_matter() -> None:
    """The begin of a trip is told to the hour; the last scan is told as it was, and that is all that is asked."""
    assert {name for name in ReportPlace.__slots__ if name.endswith("_ns")} == {"last_ns"}


def test_the_store_remembers_the_newest_and_refuses_in_any_order(tmp_path: Path) -> None:
    far = moved(LAT, LON, 30_000.0, 0.0)
    with sqlite_store.SqliteStore(tmp_path / "map.sqlite") as store:
        store.transact(lambda c, _now: put_place(c, "car", place(LAT, LON, 1000.0, "first")))
        for last_s in (900.0, 1100.0):  # a report that was delayed, and the next one
            with pytest.raises(ImpossiblePlace, match=r"29\.7 km from report first and 100 s apart: more than 70 m/s"):
                store.transact(lambda c, _now, at=last_s: put_place(c, "car", place(*far, at, "far")))
        store.transact(lambda c, _now: put_place(c, "car", place(*far, 1500.0, "later")))
        store.transact(lambda c, _now: put_place(c, "other", place(*far, 1000.0, "another")))
        for number in range(2 * REMEMBERED_PLACES):
            store.transact(lambda c, _now, n=number: put_place(c, "car", place(*far, 2000.0 + n, f"next-{n}")))
        kept = store.look(lambda c: c.fetch("places_of_vehicle", {"vehicle": "car", "n": 1000}))
        assert len(kept) == REMEMBERED_PLACES + 1
