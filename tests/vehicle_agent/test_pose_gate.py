"""The gate before the outbox: nothing of a wrong pose is told, and that something was held back is told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gate_scene import START_NS, WALLS, map_of, scan, seen, shift

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.day import UNKNOWN_DAY, day_of
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.doubt import DoubtReason
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.report.reporter import Identity, Reporter
from gnd.vehicle_agent.result import HealthTimeline
from gnd.vehicle_agent.segment import SegmentedScan

WHO = Identity("vehicle-7", "drive-7", "VLP-16", "ndt", software="test 1")
NEW_WALL = ((-9.0, -3.2), (-2.0, -3.2))


@pytest.fixture(scope="module")
def yard() -> LocalMap:
    return map_of()


def driven(folder: Path, yard: LocalMap, scans: list[SegmentedScan]) -> tuple[Reporter, list[TileChange], list[bytes]]:
    """The reporter, what it told of each tile, and the short forms of its reports."""
    folder.mkdir(exist_ok=True)
    outbox = Outbox(folder / "outbox.sqlite")
    reporter = Reporter(ChangeDetector(yard), outbox, WHO, START_NS, ReportParameters())
    for one in scans:
        reporter.add_scan(one)
    reporter.report_all(20.0)
    letters = outbox.due(0, limit=100)
    told = [change for letter in letters for change in ChangeReport.decode(letter.body).tiles]
    return reporter, told, [letter.packed for letter in letters]


def scans(
    error: np.ndarray | None, *, new: bool = False, first: int = 0, n: int = 20, **pose: float
) -> list[SegmentedScan]:
    walls = [*WALLS, NEW_WALL] if new else list(WALLS)
    return [scan(seen(walls, first + k, 6.0), first + k, error, **pose) for k in range(n)]  # type: ignore[arg-type]


def test_a_right_pose_in_an_unchanged_yard_tells_nothing_and_doubts_nothing(tmp_path: Path, yard: LocalMap) -> None:
    reporter, told, _ = driven(tmp_path, yard, scans(None))
    observed = sum(len(change.observed) for change in told)
    assert observed > 1000
    assert sum(len(change.changed) for change in told) <= 0.002 * observed
    assert {change.doubt for change in told} == {None}
    assert reporter.account() == {"tiles": {}, "largest_shift_m": 0.0, "largest_turn_deg": 0.0}


def test_a_new_wall_is_told(tmp_path: Path, yard: LocalMap) -> None:
    reporter, told, packed = driven(tmp_path, yard, scans(None, new=True))
    new = sum(int((change.change_class == ChangeClass.NEW).sum()) for change in told)
    assert new >= 10
    assert {change.doubt for change in told} == {None}
    assert all(packed)
    assert reporter.counts["tiles_held_back"] == 0


@pytest.mark.parametrize("error", [shift(0.1), shift(0.0, 0.5), shift(-1.0), shift(yaw_deg=0.5)], ids=str)
@pytest.mark.parametrize("new", [False, True], ids=["unchanged", "changed"])
def test_from_a_wrong_pose_nothing_is_told_but_the_shift(
    tmp_path: Path, yard: LocalMap, error: np.ndarray, new: bool
) -> None:
    reporter, told, packed = driven(tmp_path, yard, scans(error, new=new))
    assert told
    assert sum(len(change.observed) for change in told) == 0
    assert packed == [b""] * len(packed)  # the short form would call its voxels observed
    for change in told:
        assert change.doubt is not None
        assert change.doubt.reasons == DoubtReason.EXPLAINED_BY_SHIFT
        assert change.doubt.withheld >= 5
        assert np.allclose(change.doubt.shift_m, np.linalg.inv(error)[:3, 3], atol=0.03)
        assert change.doubt.turn_rad == pytest.approx(-np.arctan2(error[1, 0], error[0, 0]), abs=0.002)
    assert reporter.counts["scans_used"] == 0
    assert reporter.counts["tiles_held_back"] == len(told) == reporter.doubts["explained_by_shift"]
    assert reporter.counts["changes_held_back"] == sum(c.doubt.withheld for c in told if c.doubt is not None)
    assert reporter.account()["largest_shift_m"] == pytest.approx(np.linalg.norm(error[:3, 3]), abs=0.03)


def test_a_wrong_third_is_left_out_and_the_rest_is_told_with_the_shift(tmp_path: Path, yard: LocalMap) -> None:
    parts = [*scans(None, new=True), *scans(shift(0.0, 0.5), new=True, first=20), *scans(None, new=True, first=40)]
    reporter, told, packed = driven(tmp_path, yard, parts)
    _, honest, _ = driven(tmp_path / "honest", yard, scans(None, new=True, n=60))
    changed = {(change.tile, int(v)) for change in told for v in change.changed.voxel_id}
    right = {(change.tile, int(v)) for change in honest for v in change.changed.voxel_id}
    assert len(changed & right) >= 0.9 * len(right)
    assert len(changed - right) <= 2
    doubts = [change.doubt for change in told if change.doubt is not None]
    assert doubts
    assert all(doubt.reasons & DoubtReason.HEALTH_NOT_GOOD and not doubt.withheld for doubt in doubts)
    assert all(doubt.left_mm == pytest.approx(-500, abs=30) for doubt in doubts)
    assert reporter.counts["scans_shifted"] >= 15
    assert all(packed)


def test_poor_health_near_a_tile_is_told(tmp_path: Path, yard: LocalMap) -> None:
    poor = [scan(seen(WALLS, 90 + k, 6.0), 20 + k, health="degraded") for k in range(5)]
    reporter, told, _ = driven(tmp_path, yard, [*scans(None, new=True), *poor])
    doubts = [change.doubt for change in told if len(change.changed)]
    assert doubts
    for doubt in doubts:
        assert doubt is not None
        assert doubt.words == ("health_not_good",)
        assert 100 <= doubt.uncertain_permille <= 300
    assert reporter.counts["scans_uncertain"] == 5


def test_a_yard_rebuilt_all_over_is_told_with_doubt(tmp_path: Path, yard: LocalMap) -> None:
    """Ground and all walls 3 m elsewhere: no pose error, but no plausible change either."""
    raised = [scan(seen(WALLS, k, 6.0) + np.array([0.0, 0.0, 3.0]), k) for k in range(20)]
    _, told, _ = driven(tmp_path, yard, raised)
    doubts = [change.doubt for change in told if len(change.changed) > 50]
    assert doubts
    assert all(doubt is not None and doubt.reasons & DoubtReason.IMPLAUSIBLE_SHARE for doubt in doubts)
    assert all(doubt.changed_permille > 600 for doubt in doubts if doubt is not None)


def dated(yard: LocalMap, day: int) -> LocalMap:
    """The same yard, surveyed on a day."""
    found = LocalMap(yard.grid_frame)
    for tile_id in yard.tiles:
        tile = yard.tile(tile_id)
        assert tile is not None
        found.set_tile(replace(tile, day=day)) if tile.version else found.set_absent(tile_id)
    return found


@pytest.mark.parametrize(
    ("age_days", "is_doubted"), [(0, True), (60, True), (600, False), (-1, False), (None, False)], ids=str
)
def test_how_much_may_have_changed_depends_on_the_age_of_the_map(
    tmp_path: Path, yard: LocalMap, age_days: int | None, is_doubted: bool
) -> None:
    """Half of what stands in a tile is new: too much for a map of last week, not for one of last year. A map that
    is younger than the drive means a wrong clock, one without a day says nothing: both are judged as before.
    """
    day = UNKNOWN_DAY if age_days is None else day_of(START_NS) - age_days
    rows = [((-17.0, float(y)), (17.0, float(y))) for y in np.arange(-11.0, 11.0, 1.3)]
    walls = [*WALLS, *rows]
    moved = [scan(seen(walls, k, 6.0), k) for k in range(20)]
    _, told, _ = driven(tmp_path, dated(yard, day), moved)
    doubts = {change.doubt.reasons for change in told if change.doubt is not None}
    assert doubts == ({DoubtReason.IMPLAUSIBLE_SHARE} if is_doubted else set())


def test_what_waits_is_taken_back_when_the_pose_is_lost(tmp_path: Path, yard: LocalMap) -> None:
    outbox = Outbox(tmp_path / "outbox.sqlite")
    reporter = Reporter(ChangeDetector(yard), outbox, WHO, START_NS, ReportParameters())
    for one in scans(None, n=8):
        reporter.add_scan(one)
    reporter.take_back(START_NS + 10 * 100_000_000)
    reporter.report_all(20.0)
    assert outbox.due(0) == []
    assert (reporter.counts["scans_taken_back"], reporter.counts["scans_used"]) == (8, 0)


def test_without_the_gate_the_same_wrong_pose_would_be_told(tmp_path: Path, yard: LocalMap) -> None:
    """What the gate is for."""
    outbox = Outbox(tmp_path / "outbox.sqlite")
    reporter = Reporter(ChangeDetector(yard), outbox, WHO, START_NS, ReportParameters(check_poses=False))
    for one in scans(shift(0.0, 0.5)):
        reporter.add_scan(one)
    reporter.report_all(20.0)
    assert reporter.counts["changed_voxels"] > 100


def test_a_small_error_that_all_scans_of_a_tile_share_is_found_in_what_adds_up(tmp_path: Path, yard: LocalMap) -> None:
    """The vehicle says that it knows its place to 5 cm only, so no single stretch is wrong; what is real is told."""
    error = shift(0.0, 0.13)
    reporter, told, _ = driven(tmp_path, yard, scans(error, new=True, n=30, sigma_m=0.05))
    _, honest, _ = driven(tmp_path / "honest", yard, scans(None, new=True, n=30))
    assert reporter.counts["scans_shifted"] == 0
    assert reporter.counts["changes_held_back"] >= 5
    right = sum(len(change.changed) for change in honest)
    assert sum(len(change.changed) for change in told) <= 1.3 * right
    assert reporter.account()["largest_shift_m"] == pytest.approx(0.13, abs=0.02)
    assert any(change.doubt is not None for change in told)


def test_a_pose_counts_as_lost_only_where_it_was_known() -> None:
    """At the start of a drive there is nothing to take back."""
    timeline = HealthTimeline()
    told = [
        timeline.note(k, health)
        for k, health in enumerate(["lost", "good", "degraded", "lost", "lost", "good", "lost"])
    ]
    assert told == [False, False, False, True, False, False, True]
    assert [change["health"] for change in timeline.as_json()] == ["lost", "good", "degraded", "lost", "good", "lost"]
