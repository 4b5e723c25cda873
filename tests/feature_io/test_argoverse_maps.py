"""Argoverse 2 maps: where a city's coordinates lie, what a map gives, what is wrong with one."""

import copy
import json
from typing import Any

import numpy as np
import pyproj
import pytest

from gnd.tile_store.feature_io import errors
from gnd.tile_store.feature_io.argoverse import CITIES, city_of, geodetic_of_city, read_argoverse
from gnd.tile_store.feature_io.values import ImportOptions

NAME = "log_map_archive_00000000____PIT_city_1.json"


def at(*places: tuple[float, float]) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": 60.0} for x, y in places]


def lane(id_: int, left: Any, right: Any, mark: str = "SOLID_WHITE") -> dict[str, Any]:
    return {
        "id": id_, "is_intersection": False, "lane_type": "VEHICLE", "left_lane_boundary": left,
        "right_lane_boundary": right, "left_lane_mark_type": mark, "right_lane_mark_type": "NONE",
        "successors": [], "predecessors": [], "right_neighbor_id": None, "left_neighbor_id": None,
    }  # fmt: skip


LEFT, RIGHT, FAR = at((5000, 2400), (5050, 2400)), at((5000, 2396), (5050, 2396)), at((5000, 2404), (5050, 2404))
MAP: dict[str, Any] = {
    "lane_segments": {
        "1": lane(1, LEFT, RIGHT),
        "2": lane(2, LEFT[::-1], FAR[::-1]),
        "3": lane(3, FAR, at((1, 1), (2, 2))),
    },
    "pedestrian_crossings": {"7": {"id": 7, "edge1": at((0, 0), (0, 4)), "edge2": at((3, 0), (3, 4))}},
    "drivable_areas": {"9": {"id": 9, "area_boundary": at((0, 0), (9, 0), (9, 9))}},
}  # fmt: skip


def read(told: Any, **options: Any) -> Any:
    return read_argoverse(json.dumps(told).encode(), NAME, "m", ImportOptions(**options))


@pytest.mark.parametrize("name", CITIES)
def test_city_coordinates_are_utm_less_the_origin(name: str) -> None:
    city = CITIES[name]
    utm = pyproj.Transformer.from_crs(4326, 32600 + city.zone, always_xy=True)
    p = np.array([[0.0, 0.0], [5045.0, 2364.0], [-3000.0, 700.0]])
    lat, lon = geodetic_of_city(p, city)
    east, north = utm.transform(np.degrees(lon), np.degrees(lat))
    origin = utm.transform(city.lon_deg, city.lat_deg)
    np.testing.assert_allclose(np.column_stack([east, north]) - origin, p, atol=1e-6)
    assert np.degrees([lat[0], lon[0]]) == pytest.approx([city.lat_deg, city.lon_deg], abs=1e-11)


def test_a_map_gives_borders_crosswalks_and_areas() -> None:
    found = read(MAP)
    assert found.layers == {"crosswalks": 1, "drivable_areas": 1, "lanes": 4}
    shared = found.features[0]  # lanes 1 and 2 name the same border, in opposite directions
    assert dict(shared.attributes)["lanes"] == "1:left 2:left"
    assert dict(shared.attributes) == {"lane_type": "VEHICLE", "lanes": "1:left 2:left", "mark": "SOLID_WHITE"}
    crosswalk, area = found.features[-2:]
    assert (len(crosswalk), len(area)) == (5, 4)
    for ring in (crosswalk, area):
        assert (ring.lat_rad[0], ring.lon_rad[0]) == (ring.lat_rad[-1], ring.lon_rad[-1])
    assert {one.cov_m2[5] for one in found.features} == {1e4}  # z has no known datum


def test_a_height_offset_makes_heights_known() -> None:
    (one, *_) = read(MAP, height_offset_m=170.0, sigma_up_m=0.5).features
    assert one.height_m.tolist() == [230.0, 230.0]
    assert one.cov_m2[5] == 0.25


def test_kinds_go_where_they_are_told_to() -> None:
    found = read(MAP, layers={"crosswalk": "zebras", "drivable_area": "-"})
    assert found.layers == {"lanes": 4, "zebras": 1}
    assert found.left_out == {"drivable_area": 1}


def changed(path: list[Any], value: Any) -> Any:
    told = copy.deepcopy(MAP)
    inner = told
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return told


LANE = ["lane_segments", "1"]
BAD = [
    ({}, errors.BadElement, "has no lane_segments"),
    (changed([*LANE, "id"], 5), errors.DuplicateId, "lane segment 1 says that its id is 5"),
    (changed([*LANE, "left_lane_boundary"], []), errors.BadElement, "lane segment 1: left_lane_boundary has 0 points"),
    (changed([*LANE, "left_lane_boundary", 0, "x"], "5"), errors.BadElement, "'5' is no number"),
    (changed([*LANE, "left_lane_boundary", 0], {"x": 1}), errors.BadElement, "has no y"),
    (changed([*LANE, "left_lane_boundary", 0, "x"], 2e5), errors.BadGeometry, "200000 m from the city's origin"),
    (changed([*LANE, "successors"], None), errors.BadElement, "lane segment 1: successors is NoneType"),
]


@pytest.mark.parametrize(("told", "kind", "said"), BAD, ids=[said for _, _, said in BAD])
def test_a_map_with_a_fault_is_refused(told: Any, kind: type[Exception], said: str) -> None:
    with pytest.raises(kind) as caught:
        read(told)
    assert said in str(caught.value)


CROSSED = [
    (
        changed([*LANE, "right_lane_boundary"], at((5000, 2396), (5050, 2404))),
        "lane segment 1: its borders cross each other, segment 1 of 1",
    ),
    (changed(["drivable_areas", "9", "area_boundary"], at((0, 0), (9, 9), (9, 0), (0, 9))), "crosses itself"),
]


@pytest.mark.parametrize(("told", "said"), CROSSED, ids=[said for _, said in CROSSED])
def test_what_crosses_is_reported_and_strictly_refused(told: Any, said: str) -> None:
    found = read(told)
    assert len(found.features) == len(read(MAP).features)
    assert said in found.notes[0]
    with pytest.raises(errors.BadGeometry, match=said.split(",")[0]):
        read(told, strict=True)


def test_a_city_that_nobody_names_is_asked_for() -> None:
    assert city_of(NAME).zone == 17
    assert city_of("x.json", "ATX").zone == 14
    with pytest.raises(errors.NeedsGeoreference, match=r"x\.json: city '' is not known; say --city, one of ATX, DTW"):
        city_of("x.json")
