"""A small export, made once: its files, what it hides, how it goes on, and our own submissions on it."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from gnd.deploy.cli import gnd
from gnd.fleet_sim.drives import DriveSimulation
from gnd.fleet_sim.street import street
from gnd.schemas.drive import ReferencePose, Scan
from gnd.schemas.drive_mcap import read_drive
from studies.benchmark import export as export_module
from studies.benchmark.errors import BenchmarkError
from studies.benchmark.export import with_error
from studies.benchmark.files import read_cloud, sha_of
from studies.benchmark.plan import PRESETS, ExportOptions, expected, planned_worlds
from studies.benchmark.run import WorldFolder, read_poses

SMALL = ("--families", "street", "--world-seeds", "5", "--vehicles", "2", "--scans", "25", "--length", "100")
OPTIONS = ExportOptions(families=("street",), world_seeds=(5,), vehicles=2, scans=25, length=100.0)


def command(*words: Any) -> Result:
    return CliRunner().invoke(gnd, ["benchmark", *map(str, words), "--jobs", "1"])


def export(folder: Path, *more: str) -> Result:
    return command("export", folder, *SMALL, *more)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("benchmark") / "out"
    ran = export(folder)
    assert ran.exit_code == 0, f"{ran.output}{ran.exception!r}"
    return folder


def copy_of(exported: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(exported, tmp_path / "copy"))


def times_of(folder: Path) -> dict[str, int]:
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in folder.rglob("*.bin")}


@pytest.mark.slow
def test_every_file_is_listed_with_its_hash(exported: Path) -> None:
    mark = json.loads((exported / "benchmark.json").read_text())
    there = {str(path.relative_to(exported)) for path in exported.rglob("*") if path.is_file()}
    assert set(mark["files"]) == there - {"benchmark.json"}
    assert all(sha_of(exported / name) == one["sha256"] for name, one in mark["files"].items())
    assert {"README.md", "LICENSE", "score.py", "example.py"} < there
    assert mark["worlds"] == [{"name": "street-5", "family": "street", "seed": 5, "length_m": 100.0,
                               "vehicles": ["vehicle-00", "vehicle-01"], "sensors": ["vlp16"] * 2}]  # fmt: skip


@pytest.mark.slow
def test_plain_files_hold_what_the_drive_holds_and_no_true_pose(exported: Path) -> None:
    drive = exported / "worlds" / "street-5" / "drives" / "vehicle-00"
    items = list(read_drive(drive / "drive.mcap"))
    assert not any(isinstance(item, ReferencePose) for item in items)
    scans = [item for item in items if isinstance(item, Scan)]
    table = np.loadtxt(drive / "scans.csv", delimiter=",", skiprows=1, dtype=np.int64)
    assert (table[:, 1] == [scan.t_ns for scan in scans]).all()
    assert len(scans) == len(list((drive / "scans").iterdir())) == 25
    for number in (0, 24):
        points = np.fromfile(drive / "scans" / f"{number:06d}.bin", "<f4").reshape(-1, 5)
        assert (points[:, :3] == scans[number].points_m).all()
        assert np.abs(points[:, 3] - scans[number].t_offset_ns * 1e-9).max() < 1e-8
        assert (points[:, 4] == scans[number].ring).all()


@pytest.mark.slow
def test_given_poses_are_off_as_the_page_says_and_the_truth_stands_apart(exported: Path) -> None:
    given = read_poses(exported / "worlds" / "street-5" / "drives" / "vehicle-00" / "poses.csv")
    true = read_poses(exported / "truth" / "street-5" / "poses" / "vehicle-00.csv")
    assert [one.t_ns for one in given] == [one.t_ns for one in true]
    off = np.stack([g.T_map_vehicle[:3, 3] - t.T_map_vehicle[:3, 3] for g, t in zip(given, true, strict=True)])
    assert 0.002 < np.abs(off[:, :2]).max() < 0.2
    planned = planned_worlds(OPTIONS)[0]
    simulation = DriveSimulation(street(5, planned.street), planned.drives[0].config)
    reference = [item for item in simulation.items() if isinstance(item, ReferencePose)]
    assert np.allclose(true[7].T_map_vehicle, reference[7].T_map_vehicle, atol=1e-4)


def test_the_error_of_given_poses_has_the_spread_that_is_promised() -> None:
    true = [ReferencePose(100_000_000 * n, np.eye(4)) for n in range(20_000)]
    T = np.stack([one.T_map_vehicle for one in with_error(true, 3)])
    assert T[:, :3, 3].std(axis=0) == pytest.approx([0.04, 0.04, 0.02], rel=0.1)
    assert np.degrees(T[:, 1, 0].std()) == pytest.approx(0.08, rel=0.1)


@pytest.mark.slow
def test_the_map_before_is_the_same_in_all_its_forms(exported: Path) -> None:
    home = exported / "worlds" / "street-5"
    world = WorldFolder(home, ("vehicle-00",))
    table = np.loadtxt(home / "map_before" / "gaussians.csv", delimiter=",", skiprows=1)
    frame, base = world.frame, world.base()
    assert len(table) == sum(len(gaussians) for gaussians in base.tiles.values())
    assert (np.floor(frame.grid.grid_of(table[:, 3:6])) - frame.first == table[:, :3]).mean() > 0.999
    points = read_cloud(home / "map_before" / "points.pcd").astype(np.float64)
    held = {tuple(one) for one in table[:, :3].astype(int).tolist()}
    voxels = np.floor(frame.grid.grid_of(points)).astype(int) - frame.first
    assert np.mean([tuple(one) in held for one in voxels[::97].tolist()]) > 0.9


@pytest.mark.slow
def test_a_second_start_makes_only_what_is_missing_and_to_the_same_bits(exported: Path, tmp_path: Path) -> None:
    copy = copy_of(exported, tmp_path)
    before, drives = times_of(copy), copy / "worlds" / "street-5" / "drives"
    shutil.rmtree(drives / "vehicle-01")
    assert export(copy).exit_code == 0
    after = times_of(copy)
    assert {n for n in before if before[n] != after[n]} == {n for n in before if "/vehicle-01/" in n}
    of_drive = [n for n in before if "/vehicle-01/" in n]
    assert all(sha_of(copy / name) == sha_of(exported / name) for name in of_drive)


@pytest.mark.slow
def test_an_interrupted_drive_leaves_nothing_that_looks_whole(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = copy_of(exported, tmp_path)
    shutil.rmtree(copy / "worlds" / "street-5" / "drives" / "vehicle-01")
    real = export_module.ticking

    def interrupted(items: Any, tick: Any, scans: int) -> Any:
        for number, item in enumerate(real(items, tick, scans)):
            if number > 40:
                raise KeyboardInterrupt
            yield item

    monkeypatch.setattr(export_module, "ticking", interrupted)
    assert export(copy).exit_code != 0
    assert not (copy / "worlds" / "street-5" / "drives" / "vehicle-01").exists()
    refused = command("run", copy, tmp_path / "s.csv")
    assert isinstance(refused.exception, BenchmarkError)
    assert "has not ended" in str(refused.exception)


@pytest.mark.slow
def test_other_options_and_strange_folders_are_refused(exported: Path, tmp_path: Path) -> None:
    other = command("export", exported, *SMALL[:-2], "--length", "120")
    assert "with other options" in str(other.exception)
    (tmp_path / "strange").mkdir()
    (tmp_path / "strange" / "file").touch()
    assert "is not empty and holds no export" in str(export(tmp_path / "strange").exception)


@pytest.mark.slow
def test_our_vehicles_the_baseline_and_the_example_beat_the_stale_map(exported: Path, tmp_path: Path) -> None:
    rows = {"gnd": ("--rules", "default"), "points": ("--rules", "points", "--poses", "given")}
    for name, words in rows.items():
        assert command("run", exported, tmp_path / f"{name}.csv", *words).exit_code == 0
    example = [sys.executable, "example.py", ".", str(tmp_path / "example.csv")]
    subprocess.run(example, cwd=exported, check=True)
    for name in (*rows, "example"):
        ran = CliRunner().invoke(gnd, ["benchmark", "score", str(exported), str(tmp_path / f"{name}.csv"), "--json"])
        found = json.loads(ran.stdout)
        assert found["missing"] == []
        for kind in ("single", "merged"):
            assert found[kind]["mean"]["observable"]["f1"] > found["stale"]["mean"]["observable"]["f1"] + 5.0, name


@pytest.mark.slow
def test_a_drive_that_was_run_is_not_run_again(exported: Path, tmp_path: Path) -> None:
    submission = tmp_path / "gnd.csv"
    assert command("run", exported, submission, "--poses", "given").exit_code == 0
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "drives").iterdir()}
    first = submission.read_bytes()
    assert command("run", exported, submission, "--poses", "given").exit_code == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "drives").iterdir()} == kept
    assert submission.read_bytes() == first
    assert len(kept) == 2


def test_no_seed_of_the_benchmark_is_one_that_anything_was_tuned_on() -> None:
    assert all(seed >= 1000 for preset in PRESETS.values() for seed in preset.world_seeds)


def test_the_size_that_is_announced_grows_with_what_is_asked_for() -> None:
    small, full = (expected(planned_worlds(ExportOptions(size=size))) for size in PRESETS)
    assert 0.6 < small.gigabytes < 1.0
    assert full.gigabytes > 10 * small.gigabytes
    assert full.core_minutes > 10 * small.core_minutes


@pytest.mark.parametrize(
    ("words", "what"),
    [(("--families", "moon"), "there is no moon"), (("--world-seeds", "5,5"), "each once"),
     (("--vehicles", "0"), "must be 1"), (("--length", "7"), "must be 100")],
)  # fmt: skip
def test_options_that_cannot_work_are_refused(tmp_path: Path, words: tuple[str, str], what: str) -> None:
    ran = command("export", tmp_path / "x", *words)
    assert ran.exit_code != 0
    assert what in str(ran.exception)
    assert not (tmp_path / "x").exists()
