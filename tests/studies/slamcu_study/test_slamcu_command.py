"""`gnd reproduce slamcu` on a short motorway."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from gnd.deploy.cli import gnd
from gnd.fleet_sim.roads.drive import drive_route
from gnd.fleet_sim.roads.motorway import motorway
from gnd.gnd_map.errors import GndError
from studies.slamcu_study.driving import driven_by, pose_errors, sign_truth, verdicts_of
from studies.slamcu_study.scores import drive_summary
from studies.slamcu_study.signs import FULL

SHORT = ("--seeds", "14", "--km", "5", "--drives", "2", "--processes", "1", "--no-ablations")
Finished = tuple[Path, dict[str, Any]]


def run(out: Path, *options: str) -> Result:
    return CliRunner().invoke(gnd, ["reproduce", "slamcu", *options, "--out", str(out)])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Folder and JSON of a finished study."""
    out = tmp_path_factory.mktemp("slamcu") / "run"
    ran = run(out, *SHORT, "--json", "-")
    assert ran.exit_code == 0, f"{ran.output}{ran.exception!r}"
    return out, json.loads(ran.stdout)


@pytest.mark.slow
def test_json_has_the_keys_of_the_issue(finished: Finished) -> None:
    found = finished[1]["slamcu"]
    assert set(found["accuracy"]) == {"normal", "deleted", "new", "overall"}
    assert all(0.0 <= value <= 100.0 for value in found["accuracy"].values())
    assert {"mean", "std", "missed", "false", "nees"} <= set(found["position_error_m"])
    assert found["step_ms_median"] > 0.0
    assert {"std_over_seeds", "targets", "paper", "seeds", "parameters", "runtime_s"} <= set(finished[1])
    assert set(found["ablation"]) == {FULL}


@pytest.mark.slow
def test_every_sign_of_the_route_is_in_the_table(finished: Finished) -> None:
    found, features = finished[1]["slamcu"], motorway(14, 5000.0).features
    counts = [sum(state == name for state in features.states) for name in ("normal", "deleted", "new")]
    assert [sum(row) for row in found["confusion"]] == counts
    assert found["position_error_m"]["found"] + found["position_error_m"]["missed"] == counts[2]
    assert found["position_error_2_m"]["found"] + found["position_error_2_m"]["missed"] == counts[2]


@pytest.mark.slow
def test_with_the_lidars_poses_signs_settle_and_are_right() -> None:
    """Features settle by time and way: without them one place stands for several, and is far too certain."""
    route = motorway(11, 5000.0)
    drive = drive_route(route, 1)
    lidar = drive_summary(verdicts_of(drive, driven_by(drive, "lidar", 1, no_tick)), sign_truth(route))
    assert lidar["pose_rmse"]["longitudinal_m"] < 0.1
    assert lidar["accuracy"]["overall"] == 100.0
    assert lidar["position_error_m"]["mean"] < 0.4
    assert lidar["position_error_m"]["nees"]["mean"] < lidar["position_error_m"]["nees"]["band_high"]


def no_tick(*_: int) -> None:
    """Nobody wants to know how far it is."""


@pytest.mark.slow
def test_a_second_start_drives_no_more_shows_tables_and_draws(
    finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("a drive was made again")

    monkeypatch.setattr("studies.slamcu_study.study.run_drive", never)
    shown = run(finished[0], *SHORT, "--markdown", str(tmp_path / "tables.md"))
    assert shown.exit_code == 0, f"{shown.output}{shown.exception!r}"
    for text in ("Table 1", "Unclassified", "(96.12 %)", "what matters", "targets"):
        assert text in shown.stdout
    assert "**what matters: the first drive once more**" in (tmp_path / "tables.md").read_text()
    names = sorted(path.name for path in finished[0].glob("*.png"))
    assert names == ["slamcu_masses.png", "slamcu_position_errors.png"]
    again = json.loads((finished[0] / "result.json").read_text())
    assert again["slamcu"] == finished[1]["slamcu"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--seeds", "5,5"), "different integers"),
        (("--seeds", "one"), "expected numbers"),
        (("--seeds", ""), "got none"),
        (("--seeds", "-1"), ">= 0"),
        (("--drives", "0"), "--drives must be 1 … 100, got 0"),
        (("--km", "2"), "--km must be 5 … 100, got 2"),
        (("--processes", "0"), "at least one process is needed, got 0"),
    ],
)
def test_bad_options_are_refused_before_anything_runs(tmp_path: Path, options: tuple[str, ...], says: str) -> None:
    ran = run(tmp_path / "out", *options)
    assert ran.exit_code != 0
    assert says in ran.output + str(ran.exception)
    assert isinstance(ran.exception, (GndError, SystemExit))
    assert not (tmp_path / "out").exists()


def test_errors_of_poses_are_along_and_across_their_heading() -> None:
    facing_north = np.array([[0.0, 0.0, np.pi / 2]])
    errors = pose_errors(facing_north + np.array([1.0, 2.0, 6.3]), facing_north)
    np.testing.assert_allclose(errors, [[2.0, -1.0, 6.3 - 2 * np.pi]])
