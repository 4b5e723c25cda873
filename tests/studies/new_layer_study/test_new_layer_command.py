"""`gnd reproduce new-feature-layer` on short roads."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from gnd.deploy.cli import gnd
from gnd.gnd_map.errors import GndError
from studies.new_layer_study.driving import STRAIGHT, TRACK, RouteTask, along_and_across, drive_of, layer_truth
from studies.new_layer_study.study import NewLayerOptions, noisy_tracks, tasks_of

SHORT = (
    "--seeds", "14", "--lap", "150", "--km", "0.5", "--drives", "2", "--motorway-drives", "2", "--levels", "none",
    "--straight-seeds", "0", "--processes", "1",
)  # fmt: skip
Finished = tuple[Path, dict[str, Any]]


def run(out: Path, *options: str) -> Result:
    return CliRunner().invoke(gnd, ["reproduce", "new-feature-layer", *options, "--out", str(out)])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Folder and JSON of a finished study."""
    out = tmp_path_factory.mktemp("new-layer") / "run"
    ran = run(out, *SHORT, "--json", "-")
    assert ran.exit_code == 0, f"{ran.output}{ran.exception!r}"
    return out, json.loads(ran.stdout)


@pytest.mark.slow
def test_json_has_the_keys_of_the_issue(finished: Finished) -> None:
    found = finished[1]["nfl"]
    assert set(found["integrated"]) == {"1", "2"}
    numbers = [found["single_without_map"], found["single_with_map"], *found["integrated"].values()]
    numbers += [found["motorway"][name] for name in ("euclidean", "lateral", "longitudinal")]
    numbers += [found["localisation"][name] for name in ("without", "with")]
    assert all(0.0 < number < 10.0 for number in numbers)
    assert {"std_over_seeds", "targets", "paper", "seeds", "parameters", "runtime_s"} <= set(finished[1])


@pytest.mark.slow
def test_every_feature_of_a_route_is_found_or_missed(finished: Finished) -> None:
    found = finished[1]["nfl"]
    assert found["beacons"] > found["single"]["with_map"]["missed"] > 0  # most of the lap was not driven
    for row in found["integrated_more"].values():
        assert row["euclidean"]["found"] + row["missed"] == found["beacons"]
    lights = found["motorway"]
    assert (
        lights["table2"]["integration"]["euclidean"]["found"] + lights["table2"]["integration"]["missed"]
        == (lights["lights"])
    )


@pytest.mark.slow
def test_the_map_helps_across_the_road(finished: Finished) -> None:
    table = finished[1]["nfl"]["motorway"]["table2"]
    assert table["with_map"]["lateral"]["mean"] < table["without_map"]["lateral"]["mean"]


@pytest.mark.slow
def test_a_second_start_drives_no_more_shows_tables_and_draws(
    finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("something was made again")

    monkeypatch.setattr("studies.new_layer_study.study.map_drive", never)
    monkeypatch.setattr("studies.new_layer_study.study.localise_drive", never)
    shown = run(finished[0], *SHORT)
    assert shown.exit_code == 0, f"{shown.output}{shown.exception!r}"
    for text in ("Figure 6", "Figure 7", "Table 2", "5.2718 ± 0.6877", "Table 3", "targets"):
        assert text in shown.stdout
    names = {path.name for path in finished[0].glob("*.png")}
    assert names == {
        "new_layer_by_drives.png",
        "new_layer_lights_motorway.png",
    }
    assert json.loads((finished[0] / "result.json").read_text())["nfl"] == finished[1]["nfl"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--seeds", "5,5"), "different integers"),
        (("--drives", "0"), "--drives must be 1 … 60, got 0"),
        (("--motorway-drives", "99"), "--motorway-drives must be 1 … 60, got 99"),
        (("--levels", "0.5,0.5"), "--levels must be different numbers"),
        (("--levels", "loud"), "expected numbers"),
        (("--sweep-seeds", "-2"), "--sweep-seeds must be at least 0, got -2"),
        (("--gnss-bias", "-1"), "--gnss-bias must be 0"),
        (("--lap", "20"), "--lap must be 0 or 100"),
        (("--km", "0.2"), "--km must be 0.5 … 20, got 0.2"),
        (("--processes", "-1"), "at least one process is needed, got -1"),
    ],
)
def test_bad_options_are_refused_before_anything_runs(tmp_path: Path, options: tuple[str, ...], says: str) -> None:
    ran = run(tmp_path / "out", *options)
    assert ran.exit_code != 0
    assert says in ran.output + str(ran.exception)
    assert isinstance(ran.exception, (GndError, SystemExit))
    assert not (tmp_path / "out").exists()


def test_the_sweep_shares_its_middle_with_the_usual_drives(tmp_path: Path) -> None:
    options = NewLayerOptions(seeds=(14, 15), levels=(1.0, 0.5, 2.0), drives=3)
    tracks = noisy_tracks(options, 14)
    assert list(tracks["beacon"]) == [0.5, 1.0, 2.0]
    assert tracks["beacon"][1.0] == tracks["lane"][1.0] == RouteTask(TRACK, 14, 0.0)
    assert noisy_tracks(options, 15) == {}
    plan = tasks_of(options, 14, tmp_path / "run")
    assert sum(task.kind == TRACK for task in plan.routes) == 5
    assert sum(len(drives) for task, drives in plan.routes.items() if task.kind == TRACK) == 15
    keys = {drive.key for drives in plan.routes.values() for drive in drives}
    assert len(keys) == 15 + 2 * options.motorway_drives
    assert noisy_tracks(NewLayerOptions(levels=()), 11) == {}


def test_a_noisier_drive_goes_the_same_way_with_the_same_luck() -> None:
    usual, noisy = (drive_of(RouteTask(TRACK, 14, 0.15, beacon=level), 1) for level in (1.0, 2.0))
    np.testing.assert_array_equal(usual.truth.poses, noisy.truth.poses)
    np.testing.assert_array_equal(usual.gnss.xy_m, noisy.gnss.xy_m)
    assert len(usual.looks[3].kinds) == len(noisy.looks[3].kinds) > 0
    assert noisy.looks[3].sigma_range_m[0] == 2.0 * usual.looks[3].sigma_range_m[0]


def test_directions_along_a_straight_road_are_its_heading() -> None:
    task = RouteTask(STRAIGHT, 14, 0.5)
    truth, drive = layer_truth(task.route), drive_of(task, 1)
    heading = float(drive.truth.poses[0, 2])
    np.testing.assert_allclose(
        truth.along, np.tile([np.cos(heading), np.sin(heading)], (len(truth.xy_m), 1)), atol=0.02
    )
    ahead = drive.truth.poses + np.array([np.cos(heading), np.sin(heading), 0.0])
    np.testing.assert_allclose(along_and_across(ahead, drive.truth.poses)[0], [1.0, 0.0], atol=1e-9)
