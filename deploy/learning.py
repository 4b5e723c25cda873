"""What vehicles had from each other: the map that they drove on, and which changes it knew before they came.

A change is a scored voxel of the truth whose class is new, modified or deleted. A vehicle knew it when the version of
its tile in use when the vehicle's first ray fell into the tile (the base of its first statement about it) already had
the voxel's new state. Counted are the changes that a vehicle observed, since only of these it can be said that it
came there.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from deploy.map_use import Versions, Ways, map_use, read_ways
from deploy.run_folder import RunFolder
from fleet_sim.evaluate import Tiles, classes_of_maps, voxel_rows
from fleet_sim.truth import Truth
from gnd_map.arrays import F64
from gnd_map.classes import CHANGED
from gnd_map.gaussian import Gaussians
from gnd_map.grid import VoxelGrid
from gnd_map.tile_id import TileId
from schemas.changes import ChangeReport, TileChange
from tile_store.sqlite_store import SqliteStore
from tile_store.values import DEFAULT_LAYER
from vehicle_agent.detect.parameters import DetectParameters
from vehicle_agent.way import Milestone

_NS_PER_S: Final = 1e9

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class FirstStatement:
    """What a vehicle first said about a tile, and the version that it had of it.

    Attributes:
        change: the statement.
        held: Gaussians of the version.
        is_merged: whether that version is one that other vehicles' reports have made.
    """

    change: TileChange
    held: Gaussians
    is_merged: bool


def first_statements(store: SqliteStore) -> dict[str, dict[TileId, FirstStatement]]:
    """Return by vehicle and tile what each vehicle first said about each."""
    reports: dict[str, ChangeReport] = {}
    for row in store.reports():
        if row.report_id not in reports:
            reports[row.report_id] = ChangeReport.decode(row.body)
    found: dict[str, dict[TileId, FirstStatement]] = {}
    for report in sorted(reports.values(), key=lambda one: (one.last_ns, one.report_id)):
        tiles = found.setdefault(report.vehicle, {})
        for change in report.tiles:
            if change.tile not in tiles:
                tiles[change.tile] = _statement(store, change)
    return found


def _statement(store: SqliteStore, change: TileChange) -> FirstStatement:
    stored = store.by_sha(DEFAULT_LAYER, change.tile, change.base_sha) if change.base_sha else None
    if stored is None:
        return FirstStatement(change, Gaussians.empty(), is_merged=False)
    kinds = {info.sha: info.kind for info in store.history(DEFAULT_LAYER, change.tile)}
    return FirstStatement(change, stored.decode_gaussians().gaussians, kinds.get(change.base_sha) == "merged")


@dataclass(slots=True)
class Learned:
    """What one vehicle met, and what of it it already knew.

    Attributes:
        met: rows of the truth: the changes that it observed.
        known: (len(met),) bool, those that its map already had.
    """

    met: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    known: BoolArray = field(default_factory=lambda: np.empty(0, np.bool_))

    @property
    def share(self) -> float | None:
        """Share of the changes met that were known; None: it met none."""
        return float(self.known.mean()) if len(self.met) else None


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


def left_at(truth: Truth, rows: NDArray[np.int64], way: list[Milestone]) -> F64:
    """Return when a vehicle came out of its LiDAR's reach of changes, and stayed so.

    Args:
        truth: of the world.
        rows: (K,) the changes.
        way: the vehicle's milestones.

    Returns:
        (K, 2) time of the drive and of the machine, s; inf where it never left.
    """
    at_m = truth.frame.enu_from_geodetic([one.lat_rad for one in way], [one.lon_rad for one in way], np.zeros(len(way)))
    times_s = np.array([(one.t_ns, one.wall_ns) for one in way]) / _NS_PER_S
    found = np.full((len(rows), 2), np.inf)
    reach_m = DetectParameters().range_max_m
    for n, row in enumerate(rows):
        grid = VoxelGrid.of(TileId(int(truth.morton[row])))
        place_m = truth.frame.enu_from_geodetic(*grid.centre_geodetic(truth.voxel_id[[row]]))[0]
        away_m = np.hypot(*(at_m - place_m)[:, :2].T)
        near = np.flatnonzero(away_m <= reach_m)
        if len(near) and near[-1] + 1 < len(way):
            last = near[-1]
            share = (reach_m - away_m[last]) / (away_m[last + 1] - away_m[last])
            found[n] = times_s[last] + share * (times_s[last + 1] - times_s[last])
    return found


def first_update_after(
    truth: Truth, of_first: Learned, way: list[Milestone], updates: Iterable[Mapping[str, Any]]
) -> dict[str, float | None]:
    """Return how long after the first vehicle left the first change a subscriber had the first update of its like.

    Args:
        truth: of the world.
        of_first: what the first vehicle met.
        way: its milestones.
        updates: what the watcher received.

    Returns:
        Seconds of the machine and of the drives (`drive_s`); None where nothing was left, or nothing came.
    """
    left = left_at(truth, of_first.met, way)
    tiles = {int(morton) for morton in truth.morton[of_first.met]}
    came_s = [
        one["received_ns"] / _NS_PER_S for one in updates if one["tile"] in tiles and one["layer"] == DEFAULT_LAYER
    ]
    if not came_s or not np.isfinite(left).any():
        return {"wall_s": None, "drive_s": None}
    left_drive_s, left_wall_s = left[np.argmin(left[:, 0])]
    wall_s = min(came_s)
    walls = np.array([one.wall_ns for one in way]) / _NS_PER_S
    drive_s = np.interp(wall_s, walls, np.array([one.t_ns for one in way]) / _NS_PER_S)
    return {"wall_s": round(wall_s - left_wall_s, 2), "drive_s": round(float(drive_s - left_drive_s), 2)}


def account_learning(folder: RunFolder, store: SqliteStore, truth: Truth | None, base: Tiles) -> dict[str, Any]:
    """Return what the vehicles of a finished run had from each other.

    Args:
        folder: the run.
        store: its store.
        truth: of a simulated world.
        base: the map before.
    """
    ways, statements, versions = read_ways(folder), first_statements(store), Versions(store)
    on_found = sorted(v for v, said in statements.items() if any(one.is_merged for one in said.values()))
    uses = {vehicle: map_use(way, versions) for vehicle, way in ways.items()}
    ages = [age for way in ways.values() for one in way if (age := versions.age_s(one)) is not None]
    result: dict[str, Any] = {
        "vehicles": len(ways),
        "drove_on_found": len(on_found),
        "map_age_s": round(float(np.median(ages)), 1) if ages else None,
        "by_vehicle": {v: asdict(use) if use is not None else {} for v, use in uses.items()},
    }
    for vehicle, own in result["by_vehicle"].items():
        own["drove_on_found"] = vehicle in on_found
    return result | _against_truth(folder, truth, base, statements, ways, result["by_vehicle"])


def _against_truth(
    folder: RunFolder,
    truth: Truth | None,
    base: Tiles,
    statements: Mapping[str, Mapping[TileId, FirstStatement]],
    ways: Ways,
    by_vehicle: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    """What only the truth can tell; the vehicles' own part goes into `by_vehicle`."""
    if truth is None or not ways:
        return {"known_share": None, "first_update_after_s": None, "first_update_after_drive_s": None}
    found = {vehicle: learned(truth, base, statements.get(vehicle, {})) for vehicle in ways}
    for vehicle, one in found.items():
        by_vehicle[vehicle] |= {"changes_met": len(one.met), "known_share": one.share}
    first = min(ways, key=lambda vehicle: ways[vehicle][0].wall_ns)
    lines = folder.updates.read_text(encoding="utf-8").splitlines() if folder.updates.exists() else []
    first_update = first_update_after(truth, found[first], ways[first], map(json.loads, lines))
    known = np.concatenate([one.known for vehicle, one in found.items() if vehicle != first] or [np.empty(0, np.bool_)])
    return {
        "known_share": round(float(known.mean()), 4) if len(known) else None,
        "first_update_after_s": first_update["wall_s"],
        "first_update_after_drive_s": first_update["drive_s"],
    }


def learning_lines(learning: Mapping[str, Any]) -> list[str]:
    """Return what vehicles had from each other as lines for people; nothing where they had nothing."""
    if not learning["drove_on_found"]:
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
            f"({learning['first_update_after_drive_s']:.1f} s of its drive)"
        )
    return lines
