"""Reports that a shift explains do not vote, a shift that others see alike is none, and who shifts is named."""

import io
import itertools
from dataclasses import replace

import numpy as np
import pytest
from merger_world import TILE, gaussians_of, measured_anew, report_of, sha_of
from rich.console import Console
from street_corner import WALLS, displaced, mapped, seen_as, street

from gnd.cloud_merger.belief import believed
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.shift import shift_of
from gnd.cloud_merger.statements import Report
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import split
from gnd.schemas.course import Course
from gnd.schemas.doubt import Doubt, DoubtReason
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.status import named_vehicles, naming_line, print_status, status_of
from gnd.tile_store.values import ReportRow, StoreConfig, VehicleAccount

BASE = mapped(street(0))
OFF = displaced(street(1), 0.3, 0.1)
SHIFTED = seen_as(BASE, OFF)
HONEST = seen_as(BASE, street(2))
REBUILT = seen_as(BASE, street(3, (*WALLS, (0, -3.0), (1, 2.0))))


def sorted_out(*reports, named=frozenset()):
    shifts = {one.report_id: shift_of(one.change, BASE) for one in reports}
    return believed(reports, shifts, named)


def by(vehicle, change, number=1):
    return Report(f"{vehicle}{number:025d}", change, vehicle=vehicle)


def test_a_report_that_a_shift_explains_is_set_aside_and_entered():
    found = sorted_out(by("a", SHIFTED), by("b", HONEST))
    assert [one.vehicle for one in found.reports] == ["b"]
    (claim,) = found.set_aside
    assert (claim.vehicle, claim.voxels, claim.reason) == ("a", len(SHIFTED.changed), "shift")
    (test,) = found.tests  # of the honest one nothing can be told: it claims next to nothing
    assert (test.vehicle, test.is_explained, test.forward_m) == ("a", True, None)
    assert test.length_m == pytest.approx(np.hypot(0.3, 0.1), abs=0.04)


def test_a_shift_that_a_second_vehicle_claims_alike_is_the_maps():
    """The test alone may be wrong: then what is off is the map. Said twice, it is believed, but both accounts tell."""
    again = seen_as(BASE, displaced(street(4), 0.3, 0.1))
    found = sorted_out(by("a", SHIFTED), by("b", again))
    assert found.set_aside == ()
    assert len(found.reports) == 2
    assert [test.is_explained for test in found.tests] == [True, True]


def test_two_vehicles_that_are_shifted_again_and_again_do_not_vouch_for_each_other():
    again = seen_as(BASE, displaced(street(4), 0.3, 0.1))
    both = (by("a", SHIFTED), by("b", again))
    for named in ({"a"}, {"b"}, {"a", "b"}):
        assert sorted_out(*both, named=frozenset(named)).reports == ()
    third = by("c", seen_as(BASE, displaced(street(7), 0.3, 0.1)))
    assert [one.vehicle for one in sorted_out(*both, third, named=frozenset("a")).reports] == ["b", "c"]


def test_a_facade_that_two_vehicles_find_moved_has_moved():
    """To the test it is a shift, of either; the honest third that did not come by has no say."""
    moved = [seen_as(BASE, street(n, ((0, 5.6), *WALLS[1:]))) for n in (5, 6)]
    assert sorted_out(by("a", moved[0])).reports == ()
    assert len(sorted_out(by("a", moved[0]), by("b", moved[1])).reports) == 2
    assert len(sorted_out(by("a", moved[0]), by("a", moved[1], 2)).reports) == 0


def test_two_drives_of_one_vehicle_or_another_shift_do_not_help():
    twice = sorted_out(by("a", SHIFTED), by("a", SHIFTED, 2))
    assert twice.reports == ()
    other = sorted_out(by("a", SHIFTED), by("b", seen_as(BASE, displaced(street(4), -0.2, 0.3))))
    assert other.reports == ()
    assert [one.vehicle for one in other.set_aside] == ["a", "b"]


def test_a_real_change_is_tested_and_believed():
    found = sorted_out(by("a", REBUILT))
    assert len(found.reports) == 1
    assert [test.is_explained for test in found.tests] == [False]


def test_what_the_vehicle_itself_explains_by_a_shift_is_set_aside_along_its_own_axes():
    doubt = Doubt(DoubtReason.EXPLAINED_BY_SHIFT, forward_mm=20, left_mm=310, turn_10urad=873)
    found = sorted_out(by("a", replace(REBUILT, doubt=doubt)))
    assert found.reports == ()
    (test,) = found.tests
    assert (test.is_explained, test.forward_m, test.left_m) == (True, 0.02, 0.31)
    assert test.turn_rad == pytest.approx(0.00873)


def test_what_the_vehicle_holds_back_is_entered_though_it_names_no_voxel():
    doubt = Doubt(DoubtReason.EXPLAINED_BY_SHIFT, withheld=500, left_mm=310)
    nothing = np.zeros(0, np.int32)
    silent = replace(
        REBUILT,
        observed=nothing,
        changed=gaussians_of({}),
        change_class=np.zeros(0, np.uint8),
        evidence=np.zeros((0, 4), np.int32),
        doubt=doubt,
    )
    found = sorted_out(by("a", silent))
    assert [(one.voxels, one.reason) for one in found.set_aside] == [(500, "shift")]
    assert [test.is_explained for test in found.tests] == [True]


def test_other_doubts_do_not_set_aside():
    doubt = Doubt(DoubtReason.IMPLAUSIBLE_SHARE, changed_permille=300)
    assert len(sorted_out(by("a", replace(REBUILT, doubt=doubt))).reports) == 1


# In the store


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([Tile(TILE, 1, BASE)])
        yield store


def put(store, *reports):
    for report in reports:
        for change, (tile, body) in zip(report.tiles, split(report), strict=True):
            row = ReportRow(
                report.report_id, "ndt", tile, report.vehicle, report.last_ns, body, base_sha=change.base_sha
            )
            store.put_reports([row])


def merge_all(store):
    worker = Worker(store, ShardConfig(store_path=store.path))
    while claims := store.claim("one", 1, 30.0):
        store.publish(worker.merge(claims))


def test_a_shifted_vehicle_among_four_honest_ones_changes_nothing(store):
    names = [f"honest-{n}" for n in range(4)]
    honest = [report_of(n, measured_anew(name, REBUILT), vehicle=name) for n, name in enumerate(names)]
    put(store, *honest)
    merge_all(store)
    before = store.get("ndt", TILE).sha
    put(store, report_of(9, SHIFTED, vehicle="shifted"))
    merge_all(store)
    assert store.get("ndt", TILE).sha == before
    assert [(one.vehicle, one.reason) for one in store.waiting_changes()] == [("shifted", "shift")]
    accounts = {one.vehicle: (one.explained, one.tested) for one in store.vehicle_accounts()}
    assert accounts == {f"honest-{n}": (0, 1) for n in range(4)} | {"shifted": (1, 1)}


def few_changes(number, vehicle):
    """A report of seven new voxels, which of an honest vehicle are published at once."""
    changed = gaussians_of({int(BASE.voxel_id[-1]) + 10 + k: (0.0, 0.0, 0.0, 0.1, 0.1, 0.1) for k in range(7)})
    observed = np.union1d(HONEST.observed, changed.voxel_id).astype(np.int32)
    classes, evidence = np.ones(7, np.uint8), np.zeros((7, 4), np.int32)
    change = replace(HONEST, observed=observed, changed=changed, change_class=classes, evidence=evidence)
    return report_of(number, change, vehicle=vehicle)


def test_who_shifts_again_and_again_is_named_and_what_it_alone_claims_is_taken_back(store):
    put(store, few_changes(1, "car"))
    merge_all(store)
    assert store.get("ndt", TILE).version == 2
    assert store.shifted_vehicles() == frozenset()
    for number in (2, 3, 4):
        assert store.shifted_vehicles() == frozenset()
        put(store, report_of(number, SHIFTED, vehicle="car"))
        merge_all(store)
    assert store.shifted_vehicles() == {"car"}
    assert store.dirty_count() == 0
    assert store.get("ndt", TILE).sha == sha_of(BASE)  # its tiles were merged again with what is known now
    assert {one.reason for one in store.waiting_changes()} == {"shift", "named"}
    (account,) = store.vehicle_accounts()
    assert (account.explained, account.tested, account.is_shifted) == (3, 3, True)
    assert account.length_m == pytest.approx(np.hypot(0.3, 0.1), abs=0.04)
    put(store, few_changes(7, "another"))
    merge_all(store)
    assert len(store.get("ndt", TILE).decode_gaussians().gaussians) == len(BASE) + 7


def test_two_vehicles_with_one_error_change_the_map_until_they_are_found_out_and_then_no_more(store):
    again = seen_as(BASE, displaced(street(4), 0.3, 0.1))
    for number in (1, 2):
        put(store, report_of(number, SHIFTED, vehicle="a"), report_of(10 + number, again, vehicle="b"))
        merge_all(store)
        assert store.get("ndt", TILE).sha != sha_of(BASE)
    put(store, report_of(3, SHIFTED, vehicle="a"), report_of(13, again, vehicle="b"))
    merge_all(store)
    assert store.shifted_vehicles() == {"a", "b"}
    assert store.get("ndt", TILE).sha == sha_of(BASE)
    assert {(one.vehicle, one.reason) for one in store.waiting_changes()} == {("a", "shift"), ("b", "shift")}


def test_a_vehicle_that_was_repaired_is_named_no_more(store):
    put(store, *(report_of(n, SHIFTED, vehicle="car") for n in range(3)))
    merge_all(store)
    assert store.shifted_vehicles() == {"car"}
    put(store, *(report_of(n, REBUILT, vehicle="car") for n in range(10, 14)))
    merge_all(store)
    assert store.shifted_vehicles() == frozenset()


def test_the_order_of_reports_decides_nothing_in_the_end(tmp_path):
    reports = [
        few_changes(1, "car"),
        *(report_of(n, SHIFTED, vehicle="car") for n in (2, 3, 4)),
        report_of(5, REBUILT, vehicle="a"),
        report_of(6, REBUILT, vehicle="b"),
    ]
    ends = []
    for k, order in enumerate((reports, reports[::-1], reports[3:] + reports[:3])):
        for cuts in ([], [1, 2, 3, 4, 5]):
            path = tmp_path / f"{k}-{len(cuts)}.sqlite"
            with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
                store.put_tiles([Tile(TILE, 1, BASE)])
                for first, end in itertools.pairwise([0, *cuts, len(order)]):
                    put(store, *order[first:end])
                    merge_all(store)
                ends.append((store.get("ndt", TILE).sha, store.waiting_changes(), store.vehicle_accounts()))
    assert all(end == ends[0] for end in ends)


def with_course(number, turn_deg, vehicle, sigma_rad=2e-4):
    course = Course.of(np.radians(turn_deg), sigma_rad)
    return replace(report_of(number, HONEST, vehicle=vehicle), course=course)


def test_who_drives_beside_its_heading_is_named_and_believed_all_the_same(store):
    put(store, with_course(1, 0.52, "turned"), with_course(2, 0.04, "straight"), with_course(3, 0.52, "unsure", 3e-3))
    put(store, replace(few_changes(4, "turned"), course=Course.of(np.radians(0.52), 2e-4)))
    merge_all(store)
    named = {one.vehicle for one in store.vehicle_accounts() if one.is_named}
    assert named == {"turned"}
    (told,) = named_vehicles(store)
    assert (told["is_turned"], told["is_shifted"], told["course_tiles"]) == (True, False, 2)
    assert told["says"] == (
        "vehicle turned: drives 0.52 ± 0.01° to the left of its own heading, by its reports about 2 tiles: "
        "check its mount"
    )
    assert store.shifted_vehicles() == frozenset()


def test_the_line_about_a_shifted_vehicle_tells_how_far_and_where_to():
    account = VehicleAccount("v3", 20, 17, 0.31, 0.02, np.radians(0.5), 0.02, 0.309, True)
    assert naming_line(account) == (
        "vehicle v3: 17 of 20 tiles explained by a shift of 0.31 ± 0.02 m (0.02 m forward, 0.31 m left), 0.5°: "
        "check its mount"
    )
    assert "(" not in naming_line(replace(account, forward_m=None, left_m=None))
    assert naming_line(replace(account, is_shifted=False)) == ""


def test_status_tells_why_the_vehicle_itself_doubts(store):
    doubt = Doubt(DoubtReason.IMPLAUSIBLE_SHARE | DoubtReason.HEALTH_NOT_GOOD, changed_permille=700)
    put(store, report_of(1, replace(REBUILT, doubt=doubt), vehicle="car"))
    merge_all(store)
    (claim,) = status_of(store)["waiting_for_confirmation"]["claims"]
    assert (claim["reason"], claim["doubts"]) == ("doubtful", ["implausible_share", "health_not_good"])
    console = Console(width=200, record=True, file=io.StringIO())
    print_status(console, "map", status_of(store))
    assert "the vehicle doubts it itself: implausible share, health not good" in console.export_text()
