"""Begins and ends of trips: nothing is told of them, wherever the trip goes and however often."""

import json
import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_report import START_NS, WHO, scan
from vehicle_scene import GRID_FRAME, ground, look, tiles_of, wall

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.course import Course
from gnd.schemas.drive import GnssFix
from gnd.schemas.features import FeatureChange, FeatureReport
from gnd.schemas.health import HealthReport, TileHealth
from gnd.schemas.keys import change_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.survey import SurveyFix, SurveyMotion, SurveyReport, SurveySubmap
from gnd.vehicle_agent.config import PRIVATE_OFF, PRIVATE_SEEN_M, ReportParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.private_places import DRAWN_OFF, Circle, Circles, PrivatePlaces
from gnd.vehicle_agent.report.feature_report import FeatureReporter
from gnd.vehicle_agent.report.reporter import Identity, Reporter
from gnd.vehicle_agent.report.sink import OutgoingReport, ReportList
from gnd.vehicle_agent.surroundings import TileRectangles, tile_distance_m

RADIUS_M = 100.0
LEAST_M = (1 - PRIVATE_OFF) * RADIUS_M + PRIVATE_SEEN_M
"""Nothing nearer than this to the true begin or end may ever be told."""
HOLD_M = ReportParameters(private_m=RADIUS_M).hold_m
HOME = TileId.from_geodetic(math.radians(52.2), math.radians(8.05))
FRAME = LocalFrame.of_tile(HOME)


def fix_at(x_m: float, y_m: float) -> GnssFix:
    lat, lon, height = FRAME.geodetic_from_enu(np.array([[x_m, y_m, 0.0]]))
    return GnssFix(START_NS, float(lat[0]), float(lon[0]), float(height[0]), 2.0)


def tile_at(x_m: float, y_m: float) -> TileId:
    fix = fix_at(x_m, y_m)
    return TileId.from_geodetic(fix.lat_rad, fix.lon_rad)


def place_at(x_m: float, y_m: float) -> Place:
    return Place(FRAME, fix_at(x_m, y_m))


def report_about(tile: TileId, number: int) -> OutgoingReport:
    ids = np.arange(3, dtype=np.int32)
    none = Gaussians.empty()
    said = TileChange(tile, 0, b"", ids, none, np.zeros(0, np.uint8), np.zeros((0, 4), np.int32), 0.05, 0.001)
    report_id = deterministic_report_id(START_NS // 1_000_000, str(number))
    report = ChangeReport(report_id, "p", "VLP-16", "test", tile.district, START_NS, START_NS, (said,))
    return OutgoingReport(report_id, change_key("ndt", tile.district), report.encode())


def put(places: PrivatePlaces, one: OutgoingReport) -> bool:
    return places.put(one.report_id, one.key, one.body, one.packed, one.bases)


def told(sink: ReportList) -> set[TileId]:
    return {change.tile for one in sink.reports for change in read(one.body).tiles}


read = lru_cache(ChangeReport.decode)


class Trip:
    """A vehicle that reports the tile under its wheels every 20 m."""

    def __init__(self, circles: Circles, start: tuple[float, float] = (0.0, 0.0)) -> None:
        self.sink, self.begun, self.at, self.seen = ReportList(), start, start, set[TileId]()
        self.places = PrivatePlaces(circles, HOLD_M, fix_at(*start), self.sink)

    def drive_to(self, x_m: float, y_m: float) -> None:
        """In a straight line; whatever has been told by then was far enough when it was told."""
        steps = max(1, math.ceil(math.dist(self.at, (x_m, y_m)) / 20.0))
        for x, y in np.linspace(self.at, (x_m, y_m), steps + 1)[1:]:
            self.at = float(x), float(y)
            before = told(self.sink)
            self.places.move(place_at(*self.at))
            tile = tile_at(*self.at)
            if tile not in self.seen:
                self.seen.add(tile)
                put(self.places, report_about(tile, len(self.seen)))
            here = np.array([*self.at, 0.0])
            assert all(tile_distance_m(FRAME, one, here) > HOLD_M - 10.0 for one in told(self.sink) - before)

    def end(self) -> set[TileId]:
        self.places.end()
        return told(self.sink)

    def distance_m(self, tile: TileId, place: tuple[float, float]) -> float:
        return tile_distance_m(FRAME, tile, np.array([*place, 0.0]))


@pytest.fixture
def circles(tmp_path: Path) -> Circles:
    return Circles(tmp_path / "private_places.json", RADIUS_M)


far = st.floats(-900.0, 900.0, allow_nan=False)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(far, far), min_size=1, max_size=4))
def test_nothing_is_told_of_begin_and_end_wherever_a_trip_goes(
    tmp_path_factory: pytest.TempPathFactory, ways: list[tuple[float, float]]
) -> None:
    trip = Trip(Circles(tmp_path_factory.mktemp("trip") / "circles.json", RADIUS_M))
    for way in ways:
        trip.drive_to(*way)
    passing_by = told(trip.sink)  # while it was under way, and could not know
    said = trip.end()
    assert all(trip.distance_m(tile, trip.begun) > LEAST_M for tile in said)
    assert all(trip.distance_m(tile, trip.at) > LEAST_M for tile in said - passing_by)
    both = (trip.begun, trip.at)
    surely = {tile for tile in trip.seen if all(trip.distance_m(tile, one) > HOLD_M for one in both)}
    assert surely <= said, "what is far from both is told"
    assert trip.places.counts["passed"] == len(said)
    assert trip.places.counts["kept_back"] == len(trip.seen) - len(said)


def test_a_dozen_trips_from_one_street_show_one_circle_around_another_place(circles: Circles, tmp_path: Path) -> None:
    """Whoever lays all gaps over each other learns no more than from one of them."""
    rng, gaps = np.random.default_rng(4), []
    spread_m = (PRIVATE_OFF - DRAWN_OFF) * RADIUS_M / (2 * math.sqrt(2))  # so that any circle of one stands for all
    for _ in range(12):
        trip = Trip(Circles(tmp_path / "private_places.json", RADIUS_M), tuple(rng.uniform(-spread_m, spread_m, 2)))
        angle = rng.uniform(0, 2 * math.pi)
        trip.drive_to(700.0 * math.cos(angle), 700.0 * math.sin(angle))
        trip.drive_to(700.0, 0.0)
        said = trip.end()
        gaps.append({tile for tile in trip.seen - said if trip.distance_m(tile, trip.begun) < 350.0})
    (home, _end) = [Circle(**one) for one in json.loads((tmp_path / "private_places.json").read_text())]
    assert all(home.hides(FRAME, TileRectangles.of(FRAME, [tile])) for gap in gaps for tile in gap), (
        "every gap is of the same circle"
    )


def test_the_place_is_not_the_centre_of_its_circle(tmp_path: Path) -> None:
    away_m = []
    for n in range(200):
        circle = Circles(tmp_path / f"{n}.json", RADIUS_M).at(FRAME, np.zeros(3))
        away_m.append(math.dist(circle.centre_m(FRAME)[:2], (0.0, 0.0)))
    assert max(away_m) <= DRAWN_OFF * RADIUS_M + 1e-3
    assert np.mean(away_m) == pytest.approx(DRAWN_OFF * RADIUS_M * 2 / 3, rel=0.1), "as likely at each spot"


def test_a_trip_that_never_leaves_its_circle_tells_nothing(circles: Circles) -> None:
    trip = Trip(circles)
    trip.drive_to(80.0, 0.0)
    trip.drive_to(0.0, 0.0)
    assert trip.end() == set()


def test_a_report_is_taken_once_whether_it_waits_or_has_gone_on(circles: Circles) -> None:
    trip, one = Trip(circles), report_about(tile_at(600.0, 0.0), 1)
    trip.places.move(place_at(650.0, 0.0))
    assert put(trip.places, one)
    assert trip.places.body_of(one.report_id) == one.body
    assert not put(trip.places, one)
    trip.places.move(place_at(1200.0, 0.0))
    assert trip.sink.body_of(one.report_id) == one.body
    assert not put(trip.places, one)
    assert trip.places.counts == {"passed": 1}


def test_features_and_words_on_trials_wait_like_voxels(circles: Circles) -> None:
    trip, near, away = Trip(circles), tile_at(10.0, 0.0), tile_at(600.0, 0.0)
    trip.places.move(place_at(650.0, 0.0))
    for number, tile in enumerate((near, away)):
        change = FeatureChange(tile, 0, b"", 2**64 - 1, (), ())
        report_id = deterministic_report_id(0, str(number))
        report = FeatureReport(report_id, "p", "cam", "test", "signs", tile.district, START_NS, START_NS, (change,))
        trip.places.put(report.report_id, change_key("signs", tile.district), report.encode())
    words = [HealthReport("ndt", tile.district, START_NS, (TileHealth(tile, 3),)) for tile in (near, away)]
    assert trip.places.say(words) == []
    assert trip.sink.reports == ()
    trip.places.move(place_at(1500.0, 0.0))
    assert trip.places.say([]) == [words[1]]
    assert [FeatureReport.decode(one.body).tiles[0].tile for one in trip.sink.reports] == [away]
    trip.places.end()
    assert trip.places.counts == {"passed": 2, "kept_back": 2}


def survey_part(part: int, x_m: float | None, *, survey: str = "s") -> OutgoingReport:
    survey_id = deterministic_report_id(1, survey)
    report_id = deterministic_report_id(1, survey, str(part)) if part else survey_id
    fixes = ()
    if x_m is not None:
        fix = fix_at(x_m, 0.0)
        fixes = (SurveyFix(part, np.zeros(3), fix.lat_rad, fix.lon_rad, fix.height_m, 2.0),)
    submap = SurveySubmap(part, START_NS, SurveyMotion(np.eye(4), 1e-4 * np.eye(6)) if part else None, {})
    district = HOME.district
    body = SurveyReport(
        report_id, survey_id, part, part == 2, "p", "VLP-16", "test", "ndt", district, START_NS, START_NS,
        (submap,), fixes, (),
    ).encode()  # fmt: skip
    return OutgoingReport(report_id, change_key("ndt", district), body)


@pytest.mark.parametrize(
    ("fixes_m", "passes"),
    [((600.0, 700.0, 800.0), True), ((10.0, 700.0, 800.0), False), ((600.0, 700.0, 1490.0), False),
     ((600.0, None, 800.0), False)],
)  # fmt: skip
def test_a_survey_goes_whole_or_not_at_all(circles: Circles, fixes_m: tuple[float | None, ...], passes: bool) -> None:
    trip = Trip(circles)
    for part, x_m in enumerate(fixes_m):
        put(trip.places, survey_part(part, x_m))
    trip.places.move(place_at(1500.0, 0.0))
    assert trip.sink.reports == (), "where it ends is not known yet"
    trip.places.end()
    assert len(trip.sink.reports) == (3 if passes else 0)


def test_circles_outlive_the_process_and_a_damaged_file_is_an_error(circles: Circles, tmp_path: Path) -> None:
    path = tmp_path / "private_places.json"
    first = circles.at(FRAME, np.zeros(3))
    assert Circles(path, RADIUS_M).at(FRAME, np.array([2.0, 1.0, 0.0])) == first
    assert path.stat().st_mode & 0o777 == 0o600
    assert Circles(path, RADIUS_M).at(FRAME, np.array([3 * RADIUS_M, 0.0, 0.0])) != first
    for damaged in (b"[", b'[{"lat_rad": 9, "lon_rad": 0, "radius_m": 1}]', b'[{"x": 1}]', b"7", b"\xff"):
        path.write_bytes(damaged)
        with pytest.raises(VehicleError, match="private"):
            Circles(path, RADIUS_M)


def test_the_reporter_leaves_out_hidden_tiles_alone(tmp_path: Path) -> None:
    """A report of a district that the circle cuts says what lies outside of it."""
    tiles = tiles_of(np.concatenate([ground(), wall(9.3)]))
    private = {sorted(tiles)[0]}

    class Sink(ReportList):
        def hides(self, tile: TileId) -> bool:
            return tile in private

    sink, local_map = Sink(), LocalMap(GRID_FRAME)
    for tile in tiles.values():
        local_map.set_tile(tile)
    who = replace(WHO, is_private=True)
    drive = Reporter(ChangeDetector(local_map), sink, who, START_NS, ReportParameters(check_poses=False))
    for t_s in (0.0, 0.1, 0.2):
        drive.add_scan(scan(look([(14.3, -8.0, 8.0, 4.0)], np.random.default_rng(3)), t_s))
    drive.report_all(20.0)
    assert told(sink) == set(tiles) - private
    hour_ns = 3_600_000_000_000
    assert all(ChangeReport.decode(one.body).first_ns % hour_ns == 0 for one in sink.reports)


def test_a_feature_report_about_hidden_tiles_alone_is_none() -> None:
    class Sink(ReportList):
        def hides(self, tile: TileId) -> bool:
            return tile == HOME

    sink = Sink()
    reporter = FeatureReporter(sink, Identity("p", "d", "cam", "signs", is_private=True), START_NS, 1000.0)
    reporter.add(FeatureChange(HOME, 0, b"", 2**64 - 1, (), ()), START_NS, 0.0)
    reporter.report_all(START_NS)
    assert sink.reports == ()


def test_reports_of_an_earlier_name_are_forgotten(tmp_path: Path) -> None:
    outbox = Outbox(tmp_path / "outbox.sqlite")
    old, new = report_about(HOME, 1), report_about(HOME, 2)
    named = replace(ChangeReport.decode(new.body), vehicle="q").encode()
    outbox.put(old.report_id, old.key, old.body)
    outbox.put(new.report_id, new.key, named)
    assert outbox.forget_others("q") == 1
    assert outbox.states() == {new.report_id: "pending"}
    assert outbox.forget_others("q") == 0


@given(st.lists(st.tuples(far, far), max_size=5), far, far)
def test_rectangles_give_the_distances_of_tiles(corners: list[tuple[float, float]], x_m: float, y_m: float) -> None:
    tiles, here = [tile_at(*one) for one in corners], np.array([x_m, y_m, 0.0])
    found = TileRectangles.of(FRAME, tiles).distances_m(here)
    assert found == pytest.approx([tile_distance_m(FRAME, one, here) for one in tiles], abs=1e-9)


@given(st.floats(-0.5, 0.5), st.floats(1e-4, 0.5))
def test_a_private_course_is_one_of_few(turn_rad: float, sigma_rad: float) -> None:
    said, told = Course.of(turn_rad, sigma_rad), replace(WHO, is_private=True).course_as_told
    found = told(said)
    assert found is not None
    assert abs(found.turn_rad - turn_rad) <= 1.01e-3
    assert found.turn_10urad % 200 == 0
    assert found.sigma_rad >= max(said.sigma_rad, 2e-3)
    assert WHO.course_as_told(said) == said
    assert told(None) is None
