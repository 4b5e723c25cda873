"""`gnd reproduce hard-cases`: its options, its files, its JSON."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.fleet_sim.courses.places import PLACES, place_of
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from studies.cli import reproduce
from studies.frame.errors import FolderError, OptionError
from studies.hard_cases.cases import CASES
from studies.hard_cases.localising import _displaced
from studies.hard_cases.scores import CaseResult
from studies.hard_cases.study import HardOptions, task_of

ASKED = (
    "platoon_van", "lorries", "traffic_jam", "stop_and_go", "clock_m50", "clock_m20", "clock_m10", "clock_p10",
    "clock_p20", "clock_p50", "clock_drift", "open_field", "tunnel", "hill", "roundabout", "car_park", "avenue",
    "mount_yaw", "wheels", "gnss_jumps", "gnss_outage", "kidnap_near", "kidnap_far", "missing_scans", "blocked_sector",
    "rebuilt",
)  # fmt: skip


def run(*arguments):
    return CliRunner().invoke(reproduce, ["hard-cases", *map(str, arguments)], catch_exceptions=True)


def test_every_case_that_was_asked_for_is_there():
    assert set(ASKED) <= set(CASES)
    assert {case.place for case in CASES.values()} <= set(PLACES)


@pytest.mark.parametrize("name", CASES)
def test_every_case_makes_a_course_the_same_each_time(name):
    case = CASES[name]
    place = place_of(case.place, 3, case.length_m)
    first, again = (case.course(place, 3) for _ in range(2))
    assert first.faults == again.faults
    assert 8.0 < first.ride.duration_s < 80.0
    t_s = np.linspace(0.0, first.ride.duration_s, 50)
    assert np.array_equal(first.ride.way_m(t_s), again.ride.way_m(t_s))
    assert first.ride.way_m(t_s).max() < place.lane.length_m


def test_cases_do_to_the_sensors_what_they_say():
    place = place_of("street", 3)
    faults = {name: CASES[name].course(place, 3).faults for name in ("clock_m50", "clock_p20", "wheels", "mount_yaw")}
    assert faults["clock_m50"].clock_s == -0.05
    assert faults["clock_p20"].clock_s == 0.02
    assert abs(faults["wheels"].wheel_scale) == pytest.approx(0.03)
    assert abs(np.degrees(faults["mount_yaw"].mount_rad[2])) == pytest.approx(1.0)
    outage = CASES["gnss_outage"]
    course = outage.course(place_of(outage.place, 3, outage.length_m), 3)
    begin, end = course.faults.no_gnss_s
    assert end - begin == 60.0
    assert course.ride.duration_s > end


def test_a_wrong_start_is_as_far_off_as_the_case_says():
    off = [
        np.linalg.norm(_displaced(np.eye(4), CASES[name].kidnap, seed)[:2, 3])
        for name in ("kidnap_near", "kidnap_far")
        for seed in range(20)
    ]
    assert all(4.0 <= one <= 10.0 for one in off[:20])
    assert all(30.0 <= one <= 60.0 for one in off[20:])


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ({"cases": ("no_such",)}, "--cases"),
        ({"sensors": ("vlp16", "vlp16")}, "--sensors"),
        ({"seeds": (-1,)}, "--seeds"),
        ({"shorter": 0.1}, "--shorter"),
    ],
)
def test_options_that_cannot_be_are_refused(what, message):
    chosen = {"seeds": (1,), "sensors": ("vlp16",), **what}
    with pytest.raises(OptionError, match=message):
        HardOptions(**chosen)


def test_a_changed_parameter_is_another_result_and_cases_of_one_place_share_its_map(tmp_path):
    plain = LocaliserParameters()
    changed = replace(plain, refine=replace(plain.refine, enabled=False))
    task = task_of(tmp_path, "street", "vlp16", 3, plain)
    other = task_of(tmp_path, "street", "vlp16", 3, changed)
    assert task.kept.path != other.kept.path
    assert task.base == other.base == task_of(tmp_path, "rebuilt", "scala", 3, plain).base
    assert task.base != task_of(tmp_path, "street", "vlp16", 4, plain).base
    with pytest.raises(FolderError):
        task.kept.read(CaseResult)


@pytest.mark.slow
def test_two_cases_give_the_json_that_was_promised_and_a_second_start_continues(tmp_path: Path):
    out, found = tmp_path / "out", tmp_path / "found.json"
    options = ("--seeds", 3, "--sensors", "vlp16", "--cases", "platoon_van,clock_p50", "--shorter", 0.65, "--jobs", 1)
    first = run(*options, "--out", out, "--json", found, "--keep-drives")
    assert first.exit_code == 0, first.output
    result = json.loads(found.read_text())
    assert set(result["cases"]) == {"platoon_van", "clock_p50"}
    for case in result["cases"].values():
        sensor = case["vlp16"]
        for poses in (sensor["refined"], sensor["online"], sensor["without_submaps"]["refined"]):
            for name in ("longitudinal_m", "lateral_m", "heading_deg"):
                assert 0.0 <= poses[name]["p95"] <= poses[name]["max"]
            assert {"wrong_called_good", "right_called_bad", "poses", "nees"} <= set(poses)
            assert poses["poses"] > 50
            assert set(poses["nees"]) == {"place", "heading", "joint", "poses"}
        assert sensor["worst_seed"] == 3
        assert [row["seed"] for row in sensor["seeds"]] == [3]
        assert sensor["seeds"][0]["refined"]["poses"] == sensor["refined"]["poses"]
    assert len(list((out / "maps").iterdir())) == 1
    recording = out / "drives" / "platoon_van-vlp16-3.mcap"
    assert read_header(recording).sensor_model == "VLP-16"
    scans = sum(isinstance(item, Scan) for item in read_drive(recording))
    assert scans == result["cases"]["platoon_van"]["vlp16"]["refined"]["scans"]
    written = {path: path.stat().st_mtime_ns for path in (out / "runs").iterdir()}
    again = run(*options, "--out", out, "--markdown", "-")
    assert again.exit_code == 0
    assert sum(line.startswith("| ") for line in again.output.splitlines()) == 4
    assert {path: path.stat().st_mtime_ns for path in (out / "runs").iterdir()} == written
