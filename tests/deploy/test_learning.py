"""What vehicles had from each other: against a truth of four voxels, real stores and ways with known times."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from change_testing import TILE, at, change, report_of

from gnd.deploy.evaluation import maps_of_vehicles
from gnd.deploy.learning import (
    account_learning,
    clock_of,
    first_left_s,
    first_statements,
    first_update_after,
    learned,
    learning_lines,
    left_at_s,
)
from gnd.deploy.map_use import Versions, map_use
from gnd.deploy.run_folder import RunFolder
from gnd.fleet_sim.dense_rays import ScanPlan
from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile import Tile
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow
from gnd.vehicle_agent.way import Milestone

BASE, HEALED = at([1, 3, 4]), concat([at([1, 2]), at([3], up_m=0.3)])
T0_NS, WALL_NS = 1_570_838_400 * 10**9, 1_800_000_000 * 10**9


@pytest.fixture
def truth() -> Truth:
    """Voxel 1 stands, 2 is new, 3 is modified, 4 is gone; of 5, gone as well, nobody can tell."""
    gone = ChangeClass.DELETED
    classes = np.array([ChangeClass.NORMAL, ChangeClass.NEW, ChangeClass.MODIFIED, gone, gone])
    clear = np.array([True, True, True, True, False])
    return Truth(
        world_sha="", plan=ScanPlan(), frame=LocalFrame.of_tile(TILE), morton=np.full(5, TILE.morton, np.int64),
        voxel_id=np.arange(1, 6, dtype=np.int32), change_class=classes.astype(np.uint8), clear=clear,
        observable=np.ones(5, np.bool_), seasonal=np.zeros(5, np.bool_), before={TILE: BASE}, after={TILE: HEALED},
    )  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SqliteStore]:
    """Version 1 is the base map, version 2 what others found."""
    with SqliteStore(tmp_path / "store.sqlite") as opened:
        opened.put_tiles([Tile(TILE, 1, BASE)])
        opened.put_tiles([Tile(TILE, 2, HEALED)], reason="merged")
        yield opened


def says(store: SqliteStore, vehicle: str, version: int, last_s: float, observed: list[int]) -> None:
    """A vehicle's report about the tile: all that it saw is as in the version that it held."""
    held = store.get("ndt", TILE, version)
    assert held is not None
    said = replace(change(observed, Gaussians.empty()), base_version=version, base_sha=held.sha)
    report = report_of(vehicle, said, T0_NS + int(last_s * 1e9))
    store.put_reports([ReportRow(report.report_id, "ndt", TILE, vehicle, WALL_NS, report.encode(), held.sha)])


def milestones(*places: tuple[float, float, float, int | None]) -> list[Milestone]:
    """(drive s, machine s, metres east of the tile's middle, version)."""
    lat, lon, _ = LocalFrame.of_tile(TILE).geodetic_from_enu(np.array([[x_m, 0.0, 0.0] for _, _, x_m, _ in places]))
    return [
        Milestone(T0_NS + int(t * 1e9), WALL_NS + int(w * 1e9), max(x, 0.0), a, o, TILE.morton, v)
        for (t, w, x, v), a, o in zip(places, lat.tolist(), lon.tolist(), strict=True)
    ]


def test_a_change_is_known_when_the_version_in_use_at_the_first_ray_had_it(truth: Truth, store: SqliteStore) -> None:
    says(store, "first", 1, 10.0, [1, 2, 3, 4, 5])
    says(store, "behind", 2, 20.0, [1, 2, 3])
    says(store, "back-again", 1, 5.0, [2, 3])
    says(
        store, "back-again", 2, 30.0, [1, 2, 3, 4]
    )  # that it saw it again on a better map does not make it know before
    found = {v: learned(truth, {TILE: BASE}, said) for v, said in first_statements(store).items()}
    assert {v: (len(one.met), int(one.known.sum())) for v, one in found.items()} == {
        "first": (3, 0), "behind": (2, 2), "back-again": (2, 0),
    }  # fmt: skip
    assert {v: said[TILE].is_merged for v, said in first_statements(store).items()} == {
        "first": False, "behind": True, "back-again": False,
    }  # fmt: skip


def test_a_version_that_errs_is_not_known_for_right(truth: Truth, store: SqliteStore) -> None:
    """It took voxel 1, which stands, deleted 3, which has another shape, and kept 4, which is gone."""
    store.put_tiles([Tile(TILE, 3, at([4]))], reason="merged")
    says(store, "misled", 3, 20.0, [1, 2, 3, 4])
    one = learned(truth, {TILE: BASE}, first_statements(store)["misled"])
    assert (len(one.met), int(one.known.sum())) == (3, 0)


def test_what_a_single_drive_finds_is_told_of_those_that_had_nothing_from_others(store: SqliteStore) -> None:
    says(store, "first", 1, 10.0, [1, 2])
    says(store, "behind", 2, 20.0, [1, 2, 3])
    maps, helped = maps_of_vehicles(store, {TILE: BASE}, {TILE: HEALED})
    assert helped == {"behind"}
    assert maps["first"][TILE] == BASE
    assert maps["behind"][TILE] != BASE  # it has in it what others found: this is no single drive


def test_places_are_left_when_they_come_out_of_reach_for_good() -> None:
    way_m = np.array([[0.0, 0.0], [60.0, 0.0], [20.0, 0.0], [100.0, 0.0], [200.0, 0.0]])
    times_s = np.array([[0.0], [6.0], [10.0], [18.0], [28.0]])
    places_m = np.array([[0.0, 0.0], [160.0, 0.0], [0.0, 300.0]])
    # Seen at 50 m; left for the first time at 5 s, for good on the way from 20 m to 100 m.
    assert left_at_s(places_m, way_m, times_s)[:, 0].tolist() == pytest.approx([13.0, np.inf, np.inf])


def test_the_first_update_is_timed_from_when_the_last_of_the_first_change_was_left(truth: Truth) -> None:
    way = milestones((0.0, 0.0, 0.0, 1), (5.0, 10.0, 50.0, 1), (10.0, 30.0, 100.0, 1))
    rows = np.array([1, 2, 3])
    left_s = first_left_s(truth, rows, way)
    assert 5.0 < left_s[0] - T0_NS * 1e-9 < 8.0  # the voxels lie up to 20 m off the tile's middle
    of_first = learned(truth, {TILE: BASE}, {})
    of_first.met = rows

    def update(tile: int, wall_s: float, layer: str = "ndt") -> dict[str, Any]:
        return {"tile": tile, "layer": layer, "received_ns": WALL_NS + int(wall_s * 1e9)}

    updates = [update(7, 1.0), update(TILE.morton, 2.0, "signs"), update(TILE.morton, 40.0), update(TILE.morton, 35.0)]
    behind = milestones((8.0, 12.0, 0.0, 1), (14.0, 36.0, 50.0, 1))
    wall_s, drive_s = first_update_after(truth, of_first, way, clock_of([way, behind]), updates)
    assert wall_s == pytest.approx(WALL_NS * 1e-9 + 35.0 - left_s[1], abs=0.02)
    assert drive_s is not None
    assert 5.0 < drive_s < 14.0 - 5.0
    assert first_update_after(truth, of_first, way, clock_of([way]), updates[:2]) == (None, None)
    of_first.met = rows[:0]
    assert first_update_after(truth, of_first, way, clock_of([way]), updates) == (None, None)


def test_the_age_of_the_map_under_the_wheels_counts_what_a_run_has_merged(store: SqliteStore) -> None:
    made_ns = {info.version: info.created_ns for info in store.history("ndt", TILE)}
    way = [
        replace(one, wall_ns=made_ns[2] + n * 10**9)
        for n, one in enumerate(milestones((0, 0, 0, None), (1, 0, 5, 1), (2, 0, 10, 2), (3, 0, 15, 2), (4, 0, 20, 0)))
    ]
    use = map_use(way, Versions(store))
    assert use is not None
    assert (use.renewed_share, use.age_s, use.newest_age_s) == (0.5, 2.5, None)
    assert map_use(way[:1], Versions(store)) is None


def test_a_run_tells_how_many_drove_on_what_others_found(truth: Truth, store: SqliteStore, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    for vehicle, version, wall_s in (("first", 1, 0.0), ("behind", 2, 5.0)):
        says(store, vehicle, version, 10.0 + wall_s, [1, 2, 3, 4])
        folder.way(vehicle).parent.mkdir(parents=True)
        way = milestones((wall_s, wall_s, 0.0, version), (wall_s + 10.0, wall_s + 10.0, 100.0, version))
        lines = [json.dumps({name: getattr(one, name) for name in Milestone.__slots__}) + "\n" for one in way]
        folder.way(vehicle).write_text("".join(lines))
    found = account_learning(folder, store, truth, {TILE: BASE})
    assert (found["vehicles"], found["drove_on_found"], found["known_share"]) == (2, 1, 1.0)
    assert found["by_vehicle"]["first"] | {"map_age_s": None} == {
        "renewed_share": 0.0, "map_age_s": None, "drove_on_found": False, "changes_met": 3, "changes_known": 0,
    }  # fmt: skip
    assert learning_lines(found)[0].startswith(
        "learning: 1 of 1 vehicles behind the first drove on what others found; they knew 100 % of the changes"
    )
    without = account_learning(folder, store, None, {TILE: BASE})
    assert (without["drove_on_found"], without["known_share"]) == (1, None)
    assert learning_lines({}) == []
