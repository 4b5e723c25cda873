"""What waits for confirmation, and the account of each vehicle, in SQLite: inside the caller's transaction."""

from collections.abc import Iterable
from statistics import fmean, pstdev
from typing import Any, Final

import apsw

from gnd_map.tile_id import TileId
from tile_store.sqlite_connection import Row, change, fetch
from tile_store.values import ShiftTest, Unconfirmed, VehicleAccount, WaitingChange

NEWEST_TESTS: Final = 40
"""So many of a vehicle's newest tests count: a vehicle that was repaired is trusted again."""
NAMED_TESTS: Final = 3
"""A vehicle is named after so many explained tests, ..."""
NAMED_SHARE: Final = 0.5
"""... if they are so many of all that could be made. Honest vehicles have one here and there, where a facade moved."""


def keep(c: apsw.Connection, layer: str, tile: TileId, waiting: Iterable[Unconfirmed]) -> None:
    """Of this tile, this waits now and nothing else."""
    place: dict[str, Any] = {"layer": layer, "tile": tile.morton}
    change(c, "delete_waiting", place)
    for one in waiting:
        told = {"vehicle": one.vehicle, "reason": one.reason, "voxels": one.voxels, "seen": one.seen}
        since_ns = min(_received_ns(c, place | {"report_id": report_id}) for report_id in one.report_ids)
        change(c, "insert_waiting", place | told | {"since_ns": since_ns})


def _received_ns(c: apsw.Connection, place: dict[str, Any]) -> int:
    return int(fetch(c, "received", place)[0][0])


def waiting_changes(c: apsw.Connection) -> list[WaitingChange]:
    """All that waits, by layer, tile, vehicle and reason."""
    rows = fetch(c, "waiting_changes")
    return [WaitingChange(layer, TileId(tile), *rest) for layer, tile, *rest in rows]


def put_tests(c: apsw.Connection, layer: str, tile: TileId, tests: Iterable[ShiftTest], timing: dict[str, Any]) -> None:
    """Enter the tests of a tile into the accounts of their vehicles. Where that names a vehicle, or clears one, all
    tiles that it has reported about are merged again.
    """
    vehicles = set()
    for test in tests:
        told = {name: getattr(test, name) for name in ShiftTest.__slots__ if name != "is_explained"}
        change(c, "put_shift_test", told | {"layer": layer, "tile": tile.morton, "explained": int(test.is_explained)})
        vehicles.add(test.vehicle)
    named = named_vehicles(c)
    for vehicle in sorted(vehicles):
        if account(c, vehicle).is_named != (vehicle in named):
            change(c, "unname_vehicle" if vehicle in named else "name_vehicle", _naming(vehicle, timing))
            for one_layer, one_tile in fetch(c, "tiles_of_vehicle", {"vehicle": vehicle}):
                change(c, "mark_dirty", {"layer": one_layer, "tile": one_tile} | timing)


def _naming(vehicle: str, timing: dict[str, Any]) -> dict[str, Any]:
    return {"vehicle": vehicle, "since_ns": timing["now"]}


def named_vehicles(c: apsw.Connection) -> frozenset[str]:
    """The vehicles whose reports are shifted again and again."""
    return frozenset(vehicle for (vehicle,) in fetch(c, "named_vehicles"))


def accounts(c: apsw.Connection) -> list[VehicleAccount]:
    """Of all vehicles of which anything could be tested."""
    return [account(c, vehicle) for (vehicle,) in fetch(c, "tested_vehicles")]


def account(c: apsw.Connection, vehicle: str) -> VehicleAccount:
    """What the newest tests of a vehicle say."""
    rows = fetch(c, "shift_tests_of_vehicle", {"vehicle": vehicle, "n": NEWEST_TESTS})
    shifts = [row[1:] for row in rows if row[0]]
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
        is_named=len(shifts) >= NAMED_TESTS and len(shifts) >= NAMED_SHARE * len(rows),
    )


def _mean(rows: Iterable[Row], column: int) -> float | None:
    values = [row[column] for row in rows]
    return fmean(values) if values else None
