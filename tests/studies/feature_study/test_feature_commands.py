"""`gnd reproduce slamcu` and `new-feature-layer` on short roads: the commands, what they print, write and refuse."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from click.testing import CliRunner, Result

from gnd.deploy.cli import gnd
from gnd.fleet_sim.roads.motorway import motorway
from gnd.gnd_map.errors import GndError
from studies.slamcu_study.signs import FULL

SLAMCU, LAYER = "slamcu", "new-feature-layer"
SHORT = {
    SLAMCU: ("--seeds", "14", "--km", "5", "--drives", "2", "--processes", "1", "--no-ablations"),
    LAYER: (
        "--seeds", "14", "--lap", "150", "--km", "0.5", "--drives", "2", "--motorway-drives", "2", "--levels", "none",
        "--straight-seeds", "0", "--processes", "1",
    ),
}  # fmt: skip
SHOWN = {
    SLAMCU: ("Table 1", "Unclassified", "(96.12 %)", "what matters", "targets"),
    LAYER: ("Figure 6", "Figure 7", "Table 2", "5.2718 ± 0.6877", "Table 3", "targets"),
}
PICTURES = {
    SLAMCU: {"slamcu_masses.png", "slamcu_position_errors.png"},
    LAYER: {"new_layer_by_drives.png", "new_layer_lights_motorway.png"},
}
WORKERS = {
    SLAMCU: ("studies.slamcu_study.study.run_drive",),
    LAYER: ("studies.new_layer_study.study.map_drive", "studies.new_layer_study.study.localise_drive"),
}
BELOW = {SLAMCU: "slamcu", LAYER: "nfl"}


class Finished(NamedTuple):
    """A finished study: its command, its folder, its JSON, and what stands below the command's own key."""

    name: str
    out: Path
    all: dict[str, Any]
    found: dict[str, Any]


def run(name: str, out: Path, *options: str) -> Result:
    return CliRunner().invoke(gnd, ["reproduce", name, *options, "--out", str(out)])


@pytest.fixture(scope="module", params=[SLAMCU, LAYER])
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    name = request.param
    out = tmp_path_factory.mktemp(name) / "run"
    ran = run(name, out, *SHORT[name], "--json", "-")
    assert ran.exit_code == 0, f"{ran.output}{ran.exception!r}"
    found = json.loads(ran.stdout)
    return Finished(name, out, found, found[BELOW[name]])


@pytest.mark.slow
def test_json_has_the_keys_of_the_issue(finished: Finished) -> None:
    found = finished.found
    assert {"std_over_seeds", "targets", "paper", "seeds", "parameters", "runtime_s"} <= set(finished.all)
    if finished.name == SLAMCU:
        assert set(found["accuracy"]) == {"normal", "deleted", "new", "overall"}
        assert all(0.0 <= value <= 100.0 for value in found["accuracy"].values())
        assert {"mean", "std", "missed", "false", "nees"} <= set(found["position_error_m"])
        assert found["step_ms_median"] > 0.0
        assert set(found["ablation"]) == {FULL}
    else:
        assert set(found["integrated"]) == {"1", "2"}
        numbers = [found["single_without_map"], found["single_with_map"], *found["integrated"].values()]
        numbers += [found["motorway"][name] for name in ("euclidean", "lateral", "longitudinal")]
        numbers += [found["localisation"][name] for name in ("without", "with")]
        assert all(0.0 < number < 10.0 for number in numbers)


@pytest.mark.slow
def test_every_feature_of_a_route_is_found_or_missed(finished: Finished) -> None:
    found = finished.found
    if finished.name == SLAMCU:
        states = motorway(14, 5000.0).features.states
        counts = [sum(state == name for state in states) for name in ("normal", "deleted", "new")]
        assert [sum(row) for row in found["confusion"]] == counts
        for errors in (found["position_error_m"], found["position_error_2_m"]):
            assert errors["found"] + errors["missed"] == counts[2]
    else:
        assert found["beacons"] > found["single"]["with_map"]["missed"] > 0  # most of the lap was not driven
        for row in found["integrated_more"].values():
            assert row["euclidean"]["found"] + row["missed"] == found["beacons"]
        table = found["motorway"]["table2"]
        assert (
            table["integration"]["euclidean"]["found"] + table["integration"]["missed"] == found["motorway"]["lights"]
        )


@pytest.mark.slow
@pytest.mark.parametrize("finished", [LAYER], indirect=True)
def test_the_map_helps_across_the_road(finished: Finished) -> None:
    table = finished.found["motorway"]["table2"]
    assert table["with_map"]["lateral"]["mean"] < table["without_map"]["lateral"]["mean"]


@pytest.mark.slow
def test_a_second_start_drives_no_more_shows_tables_and_draws(
    finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError("a drive was made again")

    for worker in WORKERS[finished.name]:
        monkeypatch.setattr(worker, never)
    shown = run(finished.name, finished.out, *SHORT[finished.name], "--markdown", str(tmp_path / "tables.md"))
    assert shown.exit_code == 0, f"{shown.output}{shown.exception!r}"
    for text in SHOWN[finished.name]:
        assert text in shown.stdout
    assert "**targets" in (tmp_path / "tables.md").read_text()
    assert {path.name for path in finished.out.glob("*.png")} == PICTURES[finished.name]
    assert json.loads((finished.out / "result.json").read_text())[BELOW[finished.name]] == finished.found


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        (SLAMCU, ("--seeds", "5,5"), "different integers"),
        (SLAMCU, ("--seeds", "one"), "expected numbers"),
        (SLAMCU, ("--seeds", ""), "got none"),
        (SLAMCU, ("--seeds", "-1"), ">= 0"),
        (SLAMCU, ("--drives", "0"), "--drives must be 1 … 100, got 0"),
        (SLAMCU, ("--km", "2"), "--km must be 5 … 100, got 2"),
        (SLAMCU, ("--processes", "0"), "at least one process is needed, got 0"),
        (LAYER, ("--seeds", "5,5"), "different integers"),
        (LAYER, ("--drives", "0"), "--drives must be 1 … 60, got 0"),
        (LAYER, ("--motorway-drives", "99"), "--motorway-drives must be 1 … 60, got 99"),
        (LAYER, ("--levels", "0.5,0.5"), "--levels must be different numbers"),
        (LAYER, ("--levels", "loud"), "expected numbers"),
        (LAYER, ("--sweep-seeds", "-2"), "--sweep-seeds must be at least 0, got -2"),
        (LAYER, ("--gnss-bias", "-1"), "--gnss-bias must be 0"),
        (LAYER, ("--lap", "20"), "--lap must be 0 or 100"),
        (LAYER, ("--km", "0.2"), "--km must be 0.5 … 20, got 0.2"),
        (LAYER, ("--processes", "-1"), "at least one process is needed, got -1"),
    ],
)
def test_bad_options_are_refused_before_anything_runs(
    tmp_path: Path, name: str, options: tuple[str, ...], says: str
) -> None:
    ran = run(name, tmp_path / "out", *options)
    assert ran.exit_code != 0
    assert says in ran.output + str(ran.exception)
    assert isinstance(ran.exception, (GndError, SystemExit))
    assert not (tmp_path / "out").exists()
