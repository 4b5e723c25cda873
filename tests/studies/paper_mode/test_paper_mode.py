"""`gnd reproduce paper-mode`: the readings share vehicles and differ in the merge alone."""

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from gnd.deploy.cli import gnd
from gnd.schemas.changes import ChangeReport
from studies.paper_mode.study import READINGS, PaperModeOptions, changes_alone
from studies.simulation.result import read_result

SMALL = (
    "--world-seed",
    "5",
    "--length",
    "100",
    "--scans",
    "25",
    "--sensors",
    "vlp16",
    "--vehicles",
    "1,3",
    "--poses",
    "true",
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("paper_mode") / "run"
    ran = CliRunner().invoke(gnd, ["reproduce", "paper-mode", *SMALL, "--jobs", "1", "--out", str(out), "--json", "-"])
    assert ran.exit_code == 0, f"{ran.output}{ran.exception!r}"
    return out, json.loads(ran.stdout)


def test_the_readings_are_named_and_differ_in_the_merge_alone() -> None:
    assert dict(READINGS) == {"as printed": "paper", "observers as denominator": "paper-observers"}
    printed, observers = (PaperModeOptions().run(mode).method for mode in READINGS.values())
    assert (printed.merge.mode, observers.merge.mode) == ("paper", "paper-observers")
    for group in ("localise", "segment", "detect", "report"):
        assert getattr(printed, group) == getattr(observers, group)
    assert (printed.merge.xi, printed.merge.eps) == (observers.merge.xi, observers.merge.eps)


@pytest.mark.slow
def test_a_single_vehicle_is_the_same_in_both_and_a_fleet_is_not(finished: tuple[Path, dict[str, Any]]) -> None:
    _, found = finished
    printed, observers = (found[name] for name in READINGS)
    assert printed["single"] == observers["single"]
    assert printed["fleet"]["1"]["f1"] == observers["fleet"]["1"]["f1"]
    one, other = (sum(stage["fleet"]["3"]["false_per_1000"].values()) for stage in (printed, observers))
    assert one > other  # what a single vehicle met has all uploads, but not all observers


@pytest.mark.slow
def test_as_printed_the_upload_holds_the_changes_alone(finished: tuple[Path, dict[str, Any]]) -> None:
    out, found = finished
    result = read_result(next(iter(sorted(out.glob("seed-*/vehicles/vehicle-00-*.npz")))))
    for body in result.reports:
        whole = ChangeReport.decode(body)
        alone = changes_alone(whole)
        changed = [tile for tile in whole.tiles if len(tile.changed)]
        assert [tile.tile for tile in alone.tiles] == [tile.tile for tile in changed]
        assert all((tile.observed == tile.changed.voxel_id).all() for tile in alone.tiles)
        assert ChangeReport.decode(alone.encode()) == alone
    upload = found["upload"]
    assert 0 < upload["as printed"][0] < upload["observers as denominator"][0]


@pytest.mark.slow
def test_it_localises_on_the_map_of_each_reading_and_draws_all_figures(finished: tuple[Path, dict[str, Any]]) -> None:
    out, found = finished
    assert set(found["localisation"]) == {"stale map", *(f"healed, {name}" for name in READINGS)}
    assert all(row["n"] > 0 for row in found["localisation"].values())
    drawn = {str(path.relative_to(out)) for path in out.rglob("*.png")}
    of_reading = {
        f"{name.replace(' ', '-')}/{which}.png" for name in READINGS for which in ("single", "merged", "truth")
    }
    assert drawn == {"paper_mode_f1.png", "paper_mode_localisation.png", "paper_mode_upload.png", *of_reading}
