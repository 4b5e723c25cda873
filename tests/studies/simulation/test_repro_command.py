import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from repro_world import PLAIN, STREET, copy_world, reproduce, result_of, without_times

from gnd.deploy.cli import gnd
from gnd.gnd_map.errors import GndError
from studies.simulation import vehicle as vehicle_module

Finished = tuple[Path, dict[str, Any]]
LEVELS = {"all", "observable", "scored"}


def test_json_has_the_keys_of_the_issue(finished: Finished) -> None:
    _, found = finished
    assert set(found["stale"]["f1"]) == LEVELS
    assert set(found["single"]) == {"vlp16", "rs16"}
    assert all(set(stage["f1"]) == LEVELS for stage in found["single"].values())
    assert set(found["fleet"]) == {"1", "2"}
    assert all(set(stage["f1"]) == LEVELS for stage in found["fleet"].values())
    assert {"confusion", "parameters", "seeds", "runtime_s", "upload_bytes"} <= set(found)
    assert set(found["kept"]) == {"observable", "scored"}
    for level in found["kept"]:
        assert set(found["kept"][level]) == {"new", "modified", "deleted"}
    assert all(found["kept"]["observable"][c] >= found["kept"]["scored"][c] > 0.0 for c in found["kept"]["scored"])
    assert set(found["false_per_1000"]) == {"new", "modified", "deleted"}
    assert found["false_on_parking"] == found["fleet"]["2"]["false_on_parking"] >= 0
    assert found["seeds"] == [5]
    assert np.array(found["confusion"]["fleet"]["2"]["scored"]).shape == (5, 5)
    assert found["parameters"]["method"]["detect"]["mode"] == "default"


def test_vehicles_make_the_map_better(finished: Finished) -> None:
    _, found = finished
    stale, fleet = found["stale"]["f1"]["scored"], found["fleet"]["2"]["f1"]["scored"]
    assert stale < min(stage["f1"]["scored"] for stage in found["single"].values())
    assert stale + 10.0 < fleet <= 100.0


def test_the_confusion_matrix_is_that_of_the_f1(finished: Finished) -> None:
    _, found = finished
    matrix = np.array(found["confusion"]["fleet"]["2"]["scored"], float)
    hits, truth, predicted = np.diag(matrix), matrix.sum(axis=1), matrix.sum(axis=0)
    f1 = 100 * 2 * hits / (truth + predicted)
    assert found["fleet"]["2"]["f1"]["scored"] == pytest.approx(f1.mean(), abs=1e-3)


def test_what_a_level_keeps_and_calls_false_is_that_of_the_confusion(finished: Finished) -> None:
    _, found = finished
    matrices = {level: np.array(found["confusion"]["fleet"]["2"][level], float) for level in LEVELS}
    names = found["confusion"]["classes"]
    for level, kept in found["kept"].items():
        for name, share in kept.items():
            row = names.index(name)
            assert share == pytest.approx(100 * matrices[level][row].sum() / matrices["all"][row].sum(), abs=1e-3)
    seen = matrices["observable"]
    holding = seen.sum() - seen[names.index("empty")].sum()
    for name, count in found["false_per_1000"].items():
        false = seen[[names.index("normal"), names.index("empty")], names.index(name)].sum()
        assert count == pytest.approx(1000 * false / holding, abs=1e-3)
    f1 = [found["fleet"]["2"]["classes"]["observable"][name]["f1"] for name in ("new", "modified", "deleted")]
    assert found["fleet"]["2"]["changes_f1"]["observable"] == pytest.approx(np.mean(f1), abs=1e-3)


def test_an_interrupted_run_continues_to_the_same_bits(
    finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, found = finished
    other = copy_world(out, tmp_path / "interrupted")
    real, calls = vehicle_module.ticking, []

    def ticking_once(items: Any, tick: Any, scans: int) -> Any:
        calls.append(scans)
        for item in real(items, tick, scans):
            yield item
            if len(calls) == 2:
                raise KeyboardInterrupt

    monkeypatch.setattr(vehicle_module, "ticking", ticking_once)
    assert reproduce(other).exit_code != 0
    done = {path: path.stat().st_mtime_ns for path in other.glob("seed-*/vehicles/*.npz")}
    assert len(done) == 1
    monkeypatch.setattr(vehicle_module, "ticking", real)
    assert without_times(result_of(other)) == without_times(found)
    assert all(path.stat().st_mtime_ns == at for path, at in done.items())


@pytest.mark.slow
def test_a_killed_run_continues_to_the_same_bits(finished: Finished, tmp_path: Path) -> None:
    out, found = finished
    other = copy_world(out, tmp_path / "killed")
    command = [sys.executable, "-m", "gnd.deploy.cli", "reproduce", "simulation", *STREET, *PLAIN, "--out", str(other)]
    with subprocess.Popen([*command, "--jobs", "2"], stderr=subprocess.DEVNULL, start_new_session=True) as process:
        deadline = time.monotonic() + 120.0
        while not (done := list(other.glob("seed-*/vehicles/vehicle-*.npz"))):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        os.kill(process.pid, signal.SIGKILL)
    assert without_times(result_of(other)) == without_times(found)
    assert done


def test_a_damaged_result_is_made_again(finished: Finished, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    out, found = finished
    other = copy_world(out, tmp_path / "damaged")
    for path in out.glob("seed-*/vehicles/*.npz"):
        body = bytearray(path.read_bytes())
        if "vehicle-00" in path.name:
            body[len(body) // 2] ^= 0xFF
        (other / path.relative_to(out)).write_bytes(body)
    assert without_times(result_of(other)) == without_times(found)
    assert [record for record in caplog.records if "it is made again" in record.message]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--sensors", "vlp17"), "there is no vlp17"),
        (("--vehicles", "0"), "--vehicles must be 1 … 200, got 0"),
        (("--vehicles", "one"), "expected numbers"),
        (("--poses", "noisy:xx"), "noisy:4cm:0.08deg"),
        (("--parking", "1.5"), "0 … 1"),
        (("--set", "detect.new_cellz=3"), "detect.new_cellz"),
        (("--set", "detect.new_cells=many"), "new_cells"),
        (("--length", "7"), "100"),
        (("--jobs", "0"), "at least one process"),
        (("--scans", "0"), "--scans must be at least 1"),
        (("--world-seed", "-1"), "--seeds must be different integers"),
    ],
)
def test_bad_options_are_refused(tmp_path: Path, options: tuple[str, ...], says: str) -> None:
    ran = CliRunner().invoke(gnd, ["reproduce", "simulation", "--out", str(tmp_path / "out"), *options])
    assert ran.exit_code != 0
    assert says in ran.output + str(ran.exception)
    assert isinstance(ran.exception, (GndError, SystemExit))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("option", "value"), [("--sensors", "vlp17"), ("--jobs", "0")])
def test_refusals_are_one_line(tmp_path: Path, option: str, value: str) -> None:
    command = [sys.executable, "-m", "gnd.deploy.cli", "reproduce", "simulation", "--out", str(tmp_path), option, value]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 2
    assert "Traceback" not in ran.stderr
    assert value in ran.stderr.splitlines()[-1]


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    ran = reproduce(tmp_path)
    assert ran.exit_code != 0
    assert "holds no run of this command" in str(ran.exception)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_mark_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps({"config": {}}))
    assert "of another kind" in str(reproduce(tmp_path).exception)


def test_losses_are_the_voxels_off_the_diagonal(finished: Finished) -> None:
    out, found = finished
    ran = CliRunner().invoke(gnd, ["reproduce", "errors", str(out), "--json"])
    assert ran.exit_code == 0, ran.output
    losses = json.loads(ran.stdout)
    assert set(losses) == {"single.rs16", "single.vlp16", "1", "2"}
    matrix = np.array(found["confusion"]["fleet"]["2"]["scored"])
    assert sum(loss["voxels"] for loss in losses["2"]["scored"]) == matrix.sum() - np.trace(matrix)
    for loss in losses["2"]["all"]:
        assert loss["true"] != loss["predicted"]
        assert sum(loss["by_cause"].values()) == loss["voxels"]


def test_losses_need_a_finished_run(tmp_path: Path) -> None:
    ran = CliRunner().invoke(gnd, ["reproduce", "errors", str(tmp_path)])
    assert "holds no run" in str(ran.exception)
    ran = CliRunner().invoke(gnd, ["reproduce", "errors", str(tmp_path), "--stage", "x"])
    assert ran.exit_code != 0


@pytest.mark.slow
def test_the_baseline_sees_the_same_drives_and_pictures_are_drawn(finished: Finished, tmp_path: Path) -> None:
    out, _ = finished
    other = copy_world(out, tmp_path / "baseline")
    found = result_of(other, "--pcd", "--pictures", "--sensors", "rs16", "--vehicles", "2")
    assert found["pcd"]["fleet"]["2"]["f1"]["scored"] > found["stale"]["f1"]["scored"] + 5.0
    assert set(found["pcd"]["single"]["rs16"]["f1"]) == LEVELS
    bytes_of_clouds = found["pcd"]["upload_bytes"]["single"]["rs16"]["points"]
    assert 0 < found["upload_bytes"]["single"]["rs16"] < 0.2 * bytes_of_clouds
    for name in ("single", "merged", "truth", "f1_by_vehicles"):
        assert (other / f"{name}.png").read_bytes().startswith(b"\x89PNG")
