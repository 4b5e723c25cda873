"""Runs with poses of several sources beside each other: what each loses, and where its files lie."""

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from repro_world import copy_world, reproduce, without_times

from gnd.deploy.cli import gnd
from studies.frame.errors import OptionError
from studies.frame.folder import StudyFolder
from studies.simulation.options import PoseSource
from studies.simulation.scores import comparison_of, rows_of, worst_loss

NOISY = "noisy:30cm:0.5deg"


def run_of(**scored: float) -> dict[str, Any]:
    """A result with these F1 among observable voxels, rows `single_<sensor>` and `fleet_<n>`; of all 10 less."""
    stages: dict[str, dict[str, Any]] = {"single": {}, "fleet": {}}
    for name, f1 in scored.items():
        kind, _, which = name.partition("_")
        stages[kind][which] = {"f1": {"observable": f1, "all": f1 - 10.0, "scored": f1 + 2.0}}
    return stages


def test_the_loss_of_each_row_is_the_difference_of_its_f1() -> None:
    exact = run_of(single_vlp16=94.0, single_scala=52.0, fleet_1=94.0, fleet_5=98.5)
    other = run_of(single_vlp16=93.25, single_scala=50.5, fleet_1=93.25, fleet_5=98.625)
    found = comparison_of({"true": exact, "estimated": other})
    assert found["against"] == "true"
    loss = found["loss"]["estimated"]
    assert {row: by_level["observable"] for row, by_level in loss.items()} == {
        "single.vlp16": 0.75, "single.scala": 1.5, "single": 0.75, "fleet.1": 0.75, "fleet.5": -0.125,
    }  # fmt: skip
    assert loss["single.scala"] == {"observable": 1.5, "all": 1.5, "scored": 1.5}
    assert found["worst"]["estimated"] == {"row": "single.scala", "loss": 1.5, "must": 1.0, "met": False}
    assert found["poses"] == {"true": exact, "estimated": other}


def test_a_loss_of_exactly_one_point_is_allowed() -> None:
    assert worst_loss({"fleet.5": {"observable": 1.0}})["met"]
    assert not worst_loss({"fleet.5": {"observable": 1.0001}, "fleet.1": {"observable": -3.0}})["met"]


def test_the_row_of_16_and_32_layers_is_their_mean() -> None:
    rows = rows_of(run_of(single_vlp16=90.0, single_hdl32e=94.0, single_scala=50.0))
    assert rows["single"]["observable"] == 92.0


def test_sources_of_poses_are_read_in_their_order_and_each_once() -> None:
    assert PoseSource.several("true, noisy:4cm:0.08deg") == (PoseSource("true", 0.0, 0.0), PoseSource())
    with pytest.raises(OptionError, match="each source of poses once"):
        PoseSource.several("noisy:4cm:0.08deg,noisy:40mm:0.08deg")
    with pytest.raises(OptionError, match="poses are true, estimated"):
        PoseSource.several("true,")


@pytest.mark.slow
def test_one_command_tells_what_bad_poses_lose(finished: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    root = StudyFolder.begun(tmp_path / "compared").root
    copy_world(finished[0], root / "true")
    ran = reproduce(root, "--poses", f"true,{NOISY}", "--json", "-")
    assert ran.exit_code == 0, ran.output
    found = json.loads(ran.stdout)
    assert found["against"] == "true"
    assert list(found["poses"]) == ["true", NOISY]
    assert found["worst"][NOISY]["loss"] > 1.0
    assert not found["worst"][NOISY]["met"]
    for row, by_level in found["loss"][NOISY].items():
        kind, _, which = row.partition(".")
        if which:
            exact, other = (found["poses"][name][kind][which]["f1"] for name in ("true", NOISY))
            assert by_level["all"] == pytest.approx(exact["all"] - other["all"], abs=1e-3)

    table = reproduce(root, "--poses", f"true,{NOISY}")  # everything is there: this only prints
    assert "2 vehicles" in table.output
    assert "points lost" in table.output
    assert "missed" in table.output

    alone = json.loads((root / "true" / "result.json").read_text())
    assert without_times(alone) == without_times(found["poses"]["true"])
    refused = CliRunner().invoke(gnd, ["reproduce", "errors", str(root)])
    assert "choose one of its folders noisy-30cm-0.5deg, true" in str(refused.exception)
    both = ["reproduce", "errors", str(root / "noisy-30cm-0.5deg"), "--true-poses", str(root / "true"), "--json"]
    assert CliRunner().invoke(gnd, both).exit_code == 0
