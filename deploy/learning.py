"""What vehicles had from each other: the map that they drove on, and which changes it knew before they came.

A change is a scored voxel of the truth whose class is new, modified or deleted. A vehicle knew it when the version of
its tile in use when the vehicle's first ray fell into the tile (the base of its first statement about it) already had
the voxel's new state. Counted are the changes that a vehicle observed, since only of these it can be said that it
came there.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.deploy.map_use import Versions, Ways, map_use, read_ways
from gnd.deploy.run_folder import RunFolder
from gnd.fleet_sim.evaluate import Tiles, classes_of_maps, voxel_rows
from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import CHANGED
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import DEFAULT_LAYER
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.way import Milestone

_NS_PER_S: Final = 1e9
NO_TRUTH: Final = {"known_share": None, "first_update_after_s": None, "first_update_after_drive_s": None}

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class FirstStatement:
    """The first report of a vehicle about a tile, and the version of the tile that it had.

    Attributes:
        change: the statement.
        held: Gaussians of the version.
        is_merged: whether that version is one that other vehicles' reports have made.
    """

    change: TileChange
    held: Gaussians
    is_merged: bool


def first_statements(store: SqlStore) -> dict[str, dict[TileId, FirstStatement]]:
    """Return the first report of each vehicle about each tile, by vehicle and tile."""
    said: list[tuple[int, str, str, TileChange]] = []
    for row in store.reports():
        report = ChangeReport.decode(row.body)
        said += [(report.last_ns, row.report_id, row.vehicle, one) for one in report.tiles if one.tile == row.tile]
    found: dict[str, dict[TileId, FirstStatement]] = {}
    for _, _, vehicle, change in sorted(said, key=lambda one: one[:2]):
        tiles = found.setdefault(vehicle, {})
        if change.tile not in tiles:
            tiles[change.tile] = _statement(store, change)
    return found


def _statement(store: SqlStore, change: TileChange) -> FirstStatement:
    stored = store.by_sha(DEFAULT_LAYER, change.tile, change.base_sha) if change.base_sha else None
    if stored is None:
        return FirstStatement(change, Gaussians.empty(), is_merged=False)
    kinds = {info.version: info.kind for info in store.history(DEFAULT_LAYER, change.tile)}
    return FirstStatement(change, stored.decode_gaussians().gaussians, kinds.get(change.base_version) == "merged")


@dataclass(slots=True)
class Learned:
    """What one vehicle met, and what of it it already knew.

    Attributes:
        met: rows of the truth: the changes that it observed.
        known: (len(met),) bool, those that its map already had.
    """

    met: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    known: BoolArray = field(default_factory=lambda: np.empty(0, np.bool_))


def learned(truth: Truth, base: Tiles, statements: Mapping[TileId, FirstStatement]) -> Learned:
    """Return which changes of the world a vehicle met, and which of them the map that it had already knew.

    Args:
        truth: of the world.
        base: the map before the run.
        statements: the vehicle's first about each tile.
    """
    counts = truth.mask("scored") & np.isin(truth.change_class, [int(one) for one in CHANGED])
    met, known = [np.empty(0, np.int64)], [np.empty(0, np.bool_)]
    for tile, said in statements.items():
        rows = voxel_rows(truth, tile, said.change.observed)
        rows = rows[rows >= 0]
        rows = rows[counts[rows]]
        has = classes_of_maps(truth, {tile: base.get(tile, Gaussians.empty())}, {tile: said.held})
        met.append(rows)
        known.append(has[rows] == truth.change_class[rows])
    return Learned(np.concatenate(met), np.concatenate(known))


def left_at_s(places_m: F64, way_m: F64, times_s: F64) -> F64:
    """Return when a vehicle came out of its LiDAR's reach of places, and stayed so.

    Args:
        places_m: (K, 2) horizontally in some frame.
        way_m: (M, 2) the vehicle, in the order of time.
        times_s: (M, T) when it was there, by T clocks.

    Returns:
        (K, T); inf where it never left, or never came.
    """
    found = np.full((len(places_m), times_s.shape[1]), np.inf)
    reach_m = DetectParameters().range_max_m
    for n, place_m in enumerate(places_m):
        away_m = np.linalg.norm(way_m - place_m, axis=1)
        near = np.flatnonzero(away_m <= reach_m)
        if len(near) and near[-1] + 1 < len(way_m):
            last = near[-1]
            share = (reach_m - away_m[last]) / (away_m[last + 1] - away_m[last])
            found[n] = times_s[last] + share * (times_s[last + 1] - times_s[last])
    return found


def first_left_s(truth: Truth, rows: NDArray[np.int64], way: list[Milestone]) -> F64:
    """Return when a vehicle left the first change: what has changed in one tile, down to its last voxel.

    Args:
        truth: of the world.
        rows: (K,) the changed voxels that the vehicle met.
        way: its milestones.

    Returns:
        (2,) time of the drive and of the machine, s; inf where it left none.
    """
    way_m = truth.frame.enu_from_geodetic(
        [one.lat_rad for one in way], [one.lon_rad for one in way], np.zeros(len(way))
    )
    times_s = np.array([(one.t_ns, one.wall_ns) for one in way]) / _NS_PER_S
    of_tiles = [np.full(2, np.inf)]
    for morton in np.unique(truth.morton[rows]):
        voxel_id = truth.voxel_id[rows[truth.morton[rows] == morton]]
        centres = VoxelGrid.of(TileId(int(morton))).centre_geodetic(voxel_id)
        places_m = truth.frame.enu_from_geodetic(*centres)[:, :2]
        of_tiles.append(left_at_s(places_m, way_m[:, :2], times_s).max(axis=0))
    return min(of_tiles, key=lambda left_s: float(left_s[0]))


def first_update_after(
    truth: Truth, of_first: Learned, way: list[Milestone], clock: F64, updates: Iterable[Mapping[str, Any]]
) -> tuple[float | None, float | None]:
    """Return how long after the first vehicle left the first change a subscriber had the first update that counts.

    It counts if it is about a tile in which that vehicle met a change.

    Args:
        truth: of the world.
        of_first: what the first vehicle met.
        way: its milestones.
        clock: (M, 2) of `clock_of`.
        updates: what the watcher received.

    Returns:
        Seconds of the machine, and of the drives; None where nothing was left, or nothing came.
    """
    left_drive_s, left_wall_s = first_left_s(truth, of_first.met, way)
    tiles = {int(morton) for morton in truth.morton[of_first.met]}
    of_them = (one for one in updates if one["layer"] == DEFAULT_LAYER and one["tile"] in tiles)
    came_s = [one["received_ns"] / _NS_PER_S for one in of_them]
    if not came_s or not np.isfinite(left_wall_s):
        return None, None
    came_drive_s = float(np.interp(min(came_s), clock[:, 0], clock[:, 1]))
    return round(min(came_s) - float(left_wall_s), 2), round(came_drive_s - float(left_drive_s), 2)


def clock_of(ways: Iterable[list[Milestone]]) -> F64:
    """Return the times of machine and drives, (M, 2) s, by the milestones of vehicles that drive in one time."""
    marks = sorted((one.wall_ns, one.t_ns) for way in ways for one in way)
    times_s = np.array(marks).reshape(-1, 2) / _NS_PER_S
    return np.stack([times_s[:, 0], np.maximum.accumulate(times_s[:, 1])], axis=1)


def account_learning(folder: RunFolder, store: SqlStore, truth: Truth | None, base: Tiles) -> dict[str, Any]:
    """Return what the vehicles of a finished run had from each other.

    Args:
        folder: the run.
        store: its store.
        truth: of a simulated world.
        base: the map before.
    """
    ways, statements, versions = read_ways(folder), first_statements(store), Versions(store)
    vehicles = {vehicle: _map_of(way, versions) for vehicle, way in ways.items()}
    for vehicle, own in vehicles.items():
        own["drove_on_found"] = any(one.is_merged for one in statements.get(vehicle, {}).values())
    ages = [age for way in ways.values() for one in way if (age := versions.age_s(one)) is not None]
    result = _against_truth(folder, truth, base, statements, ways, vehicles) if truth is not None and ways else NO_TRUTH
    return {
        "vehicles": len(ways),
        "drove_on_found": sum(own["drove_on_found"] for own in vehicles.values()),
        "map_age_s": round(float(np.median(ages)), 1) if ages else None,
        **result,
        "by_vehicle": vehicles,
    }


def _map_of(way: list[Milestone], versions: Versions) -> dict[str, Any]:
    use = map_use(way, versions)
    if use is None:
        return {"renewed_share": None, "map_age_s": None}
    return {
        "renewed_share": round(use.renewed_share, 3),
        "map_age_s": None if use.age_s is None else round(use.age_s, 1),
    }


def _against_truth(
    folder: RunFolder,
    truth: Truth,
    base: Tiles,
    statements: Mapping[str, Mapping[TileId, FirstStatement]],
    ways: Ways,
    vehicles: dict[str, dict[str, Any]],
) -> dict[str, float | None]:
    """What only the truth can tell; each vehicle's own part goes to what is known of it.

    Only who knew a change of the world has driven on what others found; a version may also hold what nobody should.
    """
    found = {vehicle: learned(truth, base, statements.get(vehicle, {})) for vehicle in ways}
    for vehicle, one in found.items():
        n_known = int(one.known.sum())
        vehicles[vehicle] |= {"changes_met": len(one.met), "changes_known": n_known, "drove_on_found": n_known > 0}
    first = min(ways, key=lambda vehicle: ways[vehicle][0].wall_ns)
    behind = [one.known for vehicle, one in found.items() if vehicle != first]
    known = np.concatenate([*behind, np.empty(0, np.bool_)])
    lines = folder.updates.read_text(encoding="utf-8").splitlines() if folder.updates.exists() else []
    clock = clock_of(ways.values() if folder.clock.exists() else [ways[first]])
    wall_s, drive_s = first_update_after(truth, found[first], ways[first], clock, map(json.loads, lines))
    return {
        "known_share": round(float(known.mean()), 4) if len(known) else None,
        "first_update_after_s": wall_s,
        "first_update_after_drive_s": drive_s,
    }


def learning_lines(learning: Mapping[str, Any]) -> list[str]:
    """Return what vehicles had from each other as lines for people; nothing where they had nothing."""
    if not learning.get("drove_on_found"):
        return []
    behind = learning["vehicles"] - 1
    line = f"learning: {learning['drove_on_found']} of {behind} vehicles behind the first drove on what others found"
    if learning["known_share"] is not None:
        line += f"; they knew {learning['known_share'] * 100:.0f} % of the changes that they came to"
    if learning["map_age_s"] is not None:
        line += f"; renewed map under the wheels {learning['map_age_s']:.0f} s old (median)"
    lines = [line]
    if learning["first_update_after_s"] is not None:
        lines.append(
            f"first update {learning['first_update_after_s']:.1f} s after the first vehicle left the first change "
            f"({learning['first_update_after_drive_s']:.1f} s in the time of the drives)"
        )
    return lines
