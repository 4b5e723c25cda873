"""How the vehicles of a run fare on its page: from their ways, their samples, and the results that end their drives."""

import json
import os
from pathlib import Path

import pytest

from gnd.deploy.run_folder import RunFolder
from gnd.deploy.serve.page_vehicles import PageVehicles
from gnd.schemas.traffic import TrafficSample

NAME = "vehicle-00"


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    folder = RunFolder(tmp_path)
    folder.way(NAME).parent.mkdir(parents=True)
    return folder


@pytest.fixture
def vehicles(run: RunFolder) -> PageVehicles:
    return PageVehicles(run, lambda lat, lon: (1e6 * lat, 1e6 * lon), lambda east, north: 0.0)


def drive(run: RunFolder, *healths: str, from_m: float = 0.0) -> None:
    with run.way(NAME).open("a", encoding="utf-8") as file:
        for n, health in enumerate(healths):
            at = {"t_ns": n, "wall_ns": 10**15 + n, "odometer_m": from_m + 5.0 * n, "lat_rad": 1e-5 * n, "lon_rad": 0.1}
            line = at | {"tile": 5, "version": 1} | ({"health": health} if health else {})
            print(json.dumps(line), file=file)


def end(run: RunFolder, after_s: float = 1.0) -> None:
    run.result(NAME).write_text("{}")
    way_ns = run.way(NAME).stat().st_mtime_ns
    os.utime(run.result(NAME), ns=(way_ns, way_ns + int(after_s * 1e9)))


def state(vehicles: PageVehicles) -> tuple[str, bool]:
    (one,) = vehicles.all()
    return one["health"], one["ended"]


def test_health_comes_with_the_way_and_stays_when_the_drive_has_ended(run: RunFolder, vehicles: PageVehicles) -> None:
    drive(run, "lost", "good", "degraded")
    assert len(vehicles.look()) == 1
    assert state(vehicles) == ("degraded", False)
    assert vehicles.look() == []
    end(run)
    (told,) = vehicles.look()
    assert (told["health"], told["ended"], told["odometer_m"]) == ("degraded", True, 10.0)
    assert vehicles.look() == [], "an end is told once"


def test_a_vehicle_that_drives_again_has_not_ended(run: RunFolder, vehicles: PageVehicles) -> None:
    drive(run, "good", "good")
    end(run, after_s=-1.0)  # of an earlier life
    vehicles.look()
    assert state(vehicles) == ("good", False)


def test_a_sample_counts_once_and_the_way_goes_on_from_it(run: RunFolder, vehicles: PageVehicles) -> None:
    drive(run, "good")
    vehicles.look()
    sample = TrafficSample(NAME, 1, 1.0, (), 0, 0, 0.0, 0.1, "lost", tiles=3, reports=1)
    vehicles.on_sample(sample, 10**9)
    vehicles.look()
    assert state(vehicles) == ("lost", False)
    drive(run, "good", from_m=5.0)
    vehicles.look()
    assert state(vehicles) == ("good", False)
    assert vehicles.look() == []
    assert vehicles.all()[0]["tiles"] == 3


def test_ways_of_before_tell_no_health_and_bad_lines_are_left_out(run: RunFolder, vehicles: PageVehicles) -> None:
    drive(run, "", "")
    with run.way(NAME).open("a", encoding="utf-8") as file:
        file.write('[1]\n{"wall_ns": 1}\n"health"\n')
    vehicles.look()
    assert state(vehicles) == ("", False)
    drive(run, "x" * 1000, from_m=10.0)
    vehicles.look()
    assert len(vehicles.all()[0]["health"]) <= 16
