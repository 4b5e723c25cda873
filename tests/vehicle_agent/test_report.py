"""From evidence to the outbox: when tiles are decided, when districts are reported, and under which ids."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import GRID_FRAME, SENSOR, ground, look, tiles_of, wall

from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.schemas.doubt import DoubtReason
from gnd.schemas.keys import change_key
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays
from gnd.vehicle_agent.report import reporter as reporting
from gnd.vehicle_agent.report.reporter import Identity, Reporter
from gnd.vehicle_agent.segment import SegmentedScan
from gnd.vehicle_agent.waiting import MOST_WAITING, ScanRoom

START_NS = 1_570_838_400_000_000_000
WHO = Identity("vehicle-7", "drive-7", "VLP-16", "ndt")


@pytest.fixture(scope="module")
def tiles() -> dict[TileId, Tile]:
    return tiles_of(np.concatenate([ground(), wall(9.3)]))


@pytest.fixture(scope="module")
def hits() -> np.ndarray:
    return look([(14.3, -8.0, 8.0, 4.0)], np.random.default_rng(3))


@pytest.fixture
def outbox(tmp_path: Path) -> Outbox:
    return Outbox(tmp_path / "outbox.sqlite")


def reporter(tiles: dict[TileId, Tile], outbox: Outbox, **parameters: float) -> Reporter:
    """Without the shift test: its scenes are in test_pose_gate.py."""
    local_map = LocalMap(GRID_FRAME)
    for tile in tiles.values():
        local_map.set_tile(tile)
    return Reporter(ChangeDetector(local_map), outbox, WHO, START_NS, ReportParameters(check_poses=False, **parameters))


def estimate(x_m: float = 0.0, sigma_m: float = 0.03, health: str = "good", sigma_rad: float = 0.001) -> PoseEstimate:
    T = np.eye(4)
    T[:3, 3] = SENSOR + np.array([x_m, 0.0, 0.0])
    return PoseEstimate(START_NS, T, sigma_m, sigma_rad, 0.9, health)  # type: ignore[arg-type]


def scan(hits: np.ndarray, t_s: float = 0.0, **kwargs: float | str) -> SegmentedScan:
    pose = estimate(**kwargs)  # type: ignore[arg-type]
    refined = RefinedScan(START_NS + int(t_s * 1e9), PlacedRays(hits, np.broadcast_to(SENSOR, hits.shape)), pose)
    return SegmentedScan(refined, np.zeros(len(hits), np.bool_))


def reports(outbox: Outbox) -> list[ChangeReport]:
    return [ChangeReport.decode(letter.body) for letter in outbox.due(0, limit=100)]


def test_the_end_of_a_drive_reports_every_tile_once_a_district_in_one_message(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray
) -> None:
    drive = reporter(tiles, outbox)
    for t_s in (0.0, 0.1, 0.2):
        drive.add_scan(scan(hits, t_s))
    drive.report_all(20.0)
    found = reports(outbox)
    districts = {t.district for t in tiles}
    assert {r.district for r in found} == districts
    assert len(found) == len(districts)
    assert sorted(c.tile for r in found for c in r.tiles) == sorted(tiles)
    first = found[0]
    assert (first.vehicle, first.sensor_model, first.layer) == ("vehicle-7", "VLP-16", "ndt")
    assert (first.first_ns, first.last_ns) == (START_NS, START_NS + 200_000_000)
    assert first.tiles[0].pose_sigma_m == pytest.approx(0.03)
    assert outbox.due(0)[0].key == change_key("ndt", first.district)
    assert drive.counts["changed_voxels"] == sum(len(c.changed) for r in found for c in r.tiles) > 50
    assert drive.classes["deleted"] > 20
    assert drive.classes["new"] > 20


def test_each_tile_tells_the_poses_that_saw_it_not_those_of_the_whole_stretch(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray
) -> None:
    """A vehicle that knew its place well in the west and poorly in the east."""
    drive, west = reporter(tiles, outbox), hits[:, 0] < -5.0
    for t_s, part, sigma_m in ((0.0, west, 0.01), (0.1, ~west, 0.09)):
        drive.add_scan(scan(hits[part], t_s, sigma_m=sigma_m))
    drive.report_all(20.0)
    sigma_m = {c.tile: c.pose_sigma_m for r in reports(outbox) for c in r.tiles}
    assert min(sigma_m.values()) == pytest.approx(0.01)
    assert max(sigma_m.values()) == pytest.approx(0.09)


def moment(x_m: float, t_s: float) -> PoseEstimate:
    return replace(estimate(x_m=x_m), t_ns=START_NS + int(t_s * 1e9))


PATIENT = {
    "longest_s": 1000.0,
    "unchanged_s": 1000.0,
    "longest_m": 1e6,
    "unchanged_m": 1e6,
}


def test_only_tiles_left_behind_are_decided(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "SOON_VOXELS", 10**9)
    drive = reporter(tiles, outbox, **PATIENT)
    drive.add_scan(scan(hits))
    drive.leave_behind(estimate(x_m=0.0), 0.0)
    assert reports(outbox) == []
    drive.leave_behind(estimate(x_m=80.0), 80.0)  # the western tiles are behind, the eastern ones are not
    assert drive.classes["normal"] > 0
    assert reports(outbox) == []  # their districts still have tiles to decide
    drive.leave_behind(estimate(x_m=200.0), 200.0)
    assert sorted(c.tile for r in reports(outbox) for c in r.tiles) == sorted(tiles)
    drive.report_all(200.0)
    assert drive.counts["reports"] == len(reports(outbox))


def test_tiles_left_at_once_are_decided_scan_by_scan_and_later_while_the_vehicle_is_busy(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "VOXELS_AT_ONCE", 1)
    drive, decided = reporter(tiles, outbox, **PATIENT), [0]
    drive.add_scan(scan(hits))
    for busy in [True, False] * (len(tiles) + 2):
        drive.leave_behind(estimate(x_m=200.0), 200.0, ScanRoom(0.0 if busy else 1000.0))
        decided.append(sum(drive.classes.values()))
    steps = np.diff(decided)
    assert not steps[::2].any()  # those in which it was busy
    assert (steps > 0).sum() == len(tiles)
    assert sorted(c.tile for r in reports(outbox) for c in r.tiles) == sorted(tiles)


def test_where_there_is_never_room_tiles_are_decided_and_reported_all_the_same(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray
) -> None:
    drive, decided = reporter(tiles, outbox, **PATIENT), [0]
    drive.add_scan(scan(hits))
    for _ in range(3 * (MOST_WAITING + 1)):
        drive.leave_behind(estimate(x_m=200.0), 200.0, ScanRoom(0.0))
        decided.append(sum(drive.classes.values()))
    assert np.flatnonzero(np.diff(decided))[0] == MOST_WAITING
    assert sorted(c.tile for r in reports(outbox) for c in r.tiles) == sorted(tiles)


@pytest.mark.parametrize("at_once", [1, 10**9])
def test_what_is_doubtful_about_a_tile_is_told_however_long_it_waits_to_be_decided(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    monkeypatch.setattr(reporting, "VOXELS_AT_ONCE", at_once)
    drive, seen = reporter(tiles, outbox, **PATIENT), scan(hits)
    seen = replace(seen, scan=replace(seen.scan, estimate=replace(seen.scan.estimate, disagrees=True)))
    drive.add_scan(seen)
    for _ in range(len(tiles) + 1):
        drive.leave_behind(estimate(x_m=200.0), 200.0)
    changed = [c for r in reports(outbox) for c in r.tiles if len(c.changed)]
    assert changed
    assert changed[0].tile > min(tiles), "it is not decided first"
    for change in changed:
        assert change.doubt is not None
        assert DoubtReason.ESTIMATES_DISAGREE in change.doubt.reasons


def changed_in(found: list[ChangeReport]) -> int:
    return sum(len(c.changed) for r in found for c in r.tiles)


def test_changes_are_reported_in_mid_district_a_moment_after_their_tiles_were_left(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "SOON_VOXELS", 8)
    drive = reporter(tiles, outbox)
    drive.add_scan(scan(hits))
    drive.leave_behind(moment(74.0, 9.0), 74.0)  # the wall's tiles are left, others of their districts are not
    assert drive.classes["deleted"] >= 8
    assert reports(outbox) == []  # those of the next tiles may come along
    drive.leave_behind(moment(74.5, 9.2), 74.5)  # a few steps on: nothing is decided, but time passes
    assert reports(outbox) == []
    drive.leave_behind(moment(75.0, 9.4), 75.0)
    early = reports(outbox)
    assert changed_in(early) >= 8
    drive.report_all(140.0)
    assert sorted(c.tile for r in reports(outbox) for c in r.tiles) == sorted(tiles)
    assert len({r.report_id for r in reports(outbox)}) == len(reports(outbox)) > len(early)


@pytest.mark.parametrize(
    ("soon_voxels", "wall_x_m", "waits_s"), [(8, 14.3, 0.3), (10_000, 14.3, 40.0), (8, 9.3, 120.0)], ids=str
)
def test_few_changes_wait_for_more_and_ground_that_is_as_it_was_waits_longest(
    tiles: dict[TileId, Tile],
    outbox: Outbox,
    soon_voxels: int,
    wall_x_m: float,
    waits_s: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A wall that was moved; the same where that counts as little; and a wall that stands where it stood."""
    monkeypatch.setattr(reporting, "SOON_VOXELS", soon_voxels)
    drive = reporter(tiles, outbox)
    drive.add_scan(scan(look([(wall_x_m, -8.0, 8.0, 4.0)], np.random.default_rng(3))))
    drive.leave_behind(moment(74.0, 0.0), 74.0)
    pending = drive.classes["deleted"] + drive.classes["new"] + drive.classes["modified"]
    assert (pending >= 8) == (wall_x_m != 9.3)
    for t_s in (waits_s - 0.05, waits_s + 0.05):
        assert reports(outbox) == []
        drive.leave_behind(moment(74.0, t_s), 74.0)  # it stands: time passes, no tile is left
    assert reports(outbox)


def test_where_much_has_changed_reports_keep_apart(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "SOON_VOXELS", 8)
    monkeypatch.setattr(reporting, "APART_S", 5.0)
    drive = reporter(tiles, outbox)
    drive.add_scan(scan(hits))
    for t_s in (9.0, 9.4):
        drive.leave_behind(moment(74.0, t_s), 74.0)
    first = len(reports(outbox))
    assert first > 0
    drive.add_scan(scan(hits, 10.0))
    drive.leave_behind(moment(0.0, 10.0), 74.0)
    for t_s in (10.5, 11.0, 14.3):  # left a second time: soon would be 10.8
        drive.leave_behind(moment(74.0, t_s), 74.0)
        assert len(reports(outbox)) == first
    drive.leave_behind(moment(74.0, 14.5), 74.0)
    assert len(reports(outbox)) > first


@pytest.mark.parametrize(("wall_x_m", "way_m"), [(14.3, 400.0), (9.3, 1000.0)])
def test_a_long_way_in_a_district_is_reported_before_its_end(
    tiles: dict[TileId, Tile], outbox: Outbox, wall_x_m: float, way_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "SOON_VOXELS", 10_000)
    drive = reporter(tiles, outbox)
    drive.add_scan(scan(look([(wall_x_m, -8.0, 8.0, 4.0)], np.random.default_rng(3))))
    for further_m, reported in ((0.0, False), (way_m - 1.0, False), (way_m + 1.0, True)):
        drive.leave_behind(estimate(x_m=74.0), 74.0 + further_m)  # up and down the same street
        assert bool(reports(outbox)) == reported


def test_a_tile_seen_again_later_is_stated_in_a_report_of_its_own(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray
) -> None:
    drive = reporter(tiles, outbox)
    drive.add_scan(scan(hits))
    drive.report_all(10.0)
    first = {r.report_id for r in reports(outbox)}
    drive.add_scan(scan(hits, t_s=60.0))
    drive.report_all(600.0)
    assert len(reports(outbox)) == 2 * len(first)


def test_a_restarted_agent_makes_the_same_ids_and_its_first_statement_stands(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray
) -> None:
    before = reporter(tiles, outbox)
    before.add_scan(scan(hits))
    before.report_all(10.0)
    bodies = [letter.body for letter in outbox.due(0, limit=100)]
    again = reporter(tiles, outbox)
    again.add_scan(scan(hits))
    again.add_scan(scan(hits, t_s=0.1))
    again.report_all(10.0)
    assert [letter.body for letter in outbox.due(0, limit=100)] == bodies
    assert again.counts["reports"] == 0
    assert again.counts["reports_known"] == len(bodies)


@pytest.mark.parametrize(("first_stops", "again_stops"), [((74.0,), ()), ((), (74.0,)), ((74.0,), (74.0, 84.0))])
def test_a_restarted_agent_that_puts_other_tiles_together_states_each_tile_once_all_the_same(
    tiles: dict[TileId, Tile],
    outbox: Outbox,
    hits: np.ndarray,
    first_stops: tuple[float, ...],
    again_stops: tuple[float, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It was killed on the way; its map is another by now, so it decides and reports at other moments."""
    monkeypatch.setattr(reporting, "SOON_VOXELS", 8)
    monkeypatch.setattr(reporting, "APART_S", 0.0)
    for stops, ends in ((first_stops, not first_stops), (again_stops, True)):
        drive = reporter(tiles, outbox)
        drive.add_scan(scan(hits))
        for x_m in stops:
            drive.leave_behind(moment(x_m, x_m), x_m)
            drive.leave_behind(moment(x_m, x_m + 1.0), x_m)
        if ends:
            drive.report_all(200.0)
        else:
            assert 0 < len({c.tile for r in reports(outbox) for c in r.tiles}) < len(tiles)
    stated = sorted(c.tile for r in reports(outbox) for c in r.tiles)
    assert stated == sorted(tiles)


@pytest.mark.parametrize("bad", [{"longest_s": 150.0}, {"longest_s": -1.0}, {"longest_m": 2000.0}])
def test_waiting_times_that_contradict_each_other_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(AgentConfigError):
        ReportParameters(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("bad", [{"health": "degraded"}, {"health": "lost"}, {"sigma_m": 0.3}, {"sigma_rad": 0.03}])
def test_an_uncertain_pose_makes_no_statement(
    tiles: dict[TileId, Tile], outbox: Outbox, hits: np.ndarray, bad: dict[str, float | str]
) -> None:
    drive = reporter(tiles, outbox)
    drive.add_scan(scan(hits, **bad))
    drive.report_all(10.0)
    assert reports(outbox) == []
    assert drive.counts["scans_uncertain"] == 1
