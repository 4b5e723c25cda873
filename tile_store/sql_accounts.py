"""The accounts of vehicles in SQL: each function runs inside the caller's transaction."""

import json
from collections.abc import Iterable, Sequence
from math import radians
from statistics import fmean, pstdev
from typing import Any, Final

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.connection import Row, SqlConnection, change, fetch, post
from gnd.tile_store.sql_inbox import merge_again
from gnd.tile_store.values import CourseSaid, ShiftTest, VehicleAccount

NEWEST_TESTS: Final = 40
"""So many of a vehicle's newest tests count: a vehicle that was repaired is trusted again."""
NAMED_TESTS: Final = 3
"""A vehicle counts as shifted after so many explained tests, ..."""
NAMED_SHARE: Final = 0.5
"""... if they are so many of all that could be made. Honest vehicles have one here and there, where a facade moved."""
TURNED_RAD: Final = radians(0.2)
"""A course that runs so much beside the heading is a mount that is off, ..."""
TURNED_SIGMAS: Final = 4.0
"""... if it is so many of its standard deviations."""


def put_courses(c: SqlConnection, layer: str, tile: TileId, courses: Iterable[CourseSaid]) -> None:
    """Enter what the reports of a tile say of their vehicles' courses."""
    all_said, place = list(courses), {"layer": layer, "tile": tile.morton}
    wanted = place | ids_of(said.report_id for said in all_said)
    before = {report_id for (report_id,) in fetch(c, "courses_of_tile", wanted)}
    for said in all_said:
        if said.report_id in before:
            continue
        told = {name: getattr(said, name) for name in CourseSaid.__slots__}
        post(c, "put_course", told | place)


def put_tests(c: SqlConnection, layer: str, tile: TileId, tests: Iterable[ShiftTest], timing: dict[str, Any]) -> None:
    """Enter the tests of a tile into the accounts of their vehicles. Where that puts a vehicle
    among the shifted ones, or takes it out, all tiles that it has reported about are merged again.
    """
    made, vehicles = list(tests), set()
    place = {"layer": layer, "tile": tile.morton}
    before: dict[str, int] = dict(fetch(c, "shift_tests_of_tile", place | ids_of(one.report_id for one in made)))
    for test in made:
        if before.get(test.report_id) == int(test.is_explained):
            continue  # a tile's tests come with each of its merges
        told = {name: getattr(test, name) for name in ShiftTest.__slots__ if name != "is_explained"}
        post(c, "put_shift_test", told | place | {"explained": int(test.is_explained)})
        vehicles.add(test.vehicle)
    known = shifted_vehicles(c) if vehicles else frozenset()
    for vehicle in sorted(vehicles):
        explained = [row[0] for row in fetch(c, "shift_tests_of_vehicle", {"vehicle": vehicle, "n": NEWEST_TESTS})]
        if _is_shifted(sum(map(bool, explained)), len(explained)) != (vehicle in known):
            what = "trust_vehicle" if vehicle in known else "distrust_vehicle"
            change(c, what, {"vehicle": vehicle, "since_ns": timing["now"]})
            for one_layer, one_tile in fetch(c, "tiles_of_vehicle", {"vehicle": vehicle}):
                merge_again(c, one_layer, TileId(one_tile), timing)


def shifted_vehicles(c: SqlConnection) -> frozenset[str]:
    """The vehicles whose reports are shifted again and again."""
    return frozenset(vehicle for (vehicle,) in fetch(c, "shifted_vehicles"))


def accounts(c: SqlConnection) -> list[VehicleAccount]:
    """Of all vehicles of which there is anything to tell."""
    return [account(c, vehicle) for (vehicle,) in fetch(c, "accounted_vehicles")]


def account(c: SqlConnection, vehicle: str) -> VehicleAccount:
    """What the newest tests of a vehicle say."""
    rows = fetch(c, "shift_tests_of_vehicle", {"vehicle": vehicle, "n": NEWEST_TESTS})
    shifts = [row[1:] for row in rows if row[0]]
    courses = fetch(c, "courses_of_vehicle", {"vehicle": vehicle, "n": NEWEST_TESTS})
    along = [row for row in shifts if row[2] is not None]
    return VehicleAccount(
        vehicle=vehicle,
        tested=len(rows),
        explained=len(shifts),
        length_m=_mean(shifts, 0) or 0.0,
        length_sd_m=pstdev([row[0] for row in shifts]) if shifts else 0.0,
        turn_rad=_mean(shifts, 1) or 0.0,
        forward_m=_mean(along, 2),
        left_m=_mean(along, 3),
        course_tiles=len(courses),
        course_rad=_mean(courses, 0) or 0.0,
        course_sigma_rad=_mean(courses, 1) or 0.0,
        is_turned=_is_turned(courses),
        is_shifted=_is_shifted(len(shifts), len(rows)),
    )


def ids_of(report_ids: Iterable[str]) -> dict[str, str]:
    """Some report ids as a statement takes them."""
    return {"ids": json.dumps(list(report_ids))}


def _is_shifted(explained: int, tested: int) -> bool:
    return explained >= NAMED_TESTS and explained >= NAMED_SHARE * tested


def _is_turned(courses: Sequence[Row]) -> bool:
    """Whether the course runs beside the heading by more than any mount is off that was ever set right."""
    turn_rad, sigma_rad = _mean(courses, 0) or 0.0, _mean(courses, 1) or 0.0
    return abs(turn_rad) > max(TURNED_RAD, TURNED_SIGMAS * sigma_rad)


def _mean(rows: Iterable[Row], column: int) -> float | None:
    values = [row[column] for row in rows]
    return fmean(values) if values else None
