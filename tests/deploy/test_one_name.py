"""What is installed lies under one name: a user's own folders break nothing (decision 120)."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OURS = (
    "gnd_map",
    "schemas",
    "fleet_bus",
    "tile_store",
    "tile_client",
    "vehicle_agent",
    "cloud_merger",
    "fleet_sim",
    "deploy",
    "studies",
)


def test_a_users_own_folders_of_our_names_break_nothing(tmp_path: Path) -> None:
    for name in OURS:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('a folder of the user was imported')\n")
    program = (
        "import gnd.schemas.updates, gnd.tile_store.store, gnd.deploy.cli; from gnd.deploy.reproduce import reproduce"
    )
    for command in (["-c", program], ["-m", "gnd.deploy.cli", "map", "--help"]):
        done = subprocess.run(
            [sys.executable, *command],
            cwd=tmp_path,
            env={"PYTHONPATH": f"{tmp_path}:{ROOT / 'src'}"}
            if command[0] == "-m"
            else {"PYTHONPATH": str(ROOT / "src")},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_wheel_holds_one_name_and_every_table(tmp_path: Path) -> None:
    sources = tmp_path / "sources"
    sources.mkdir()
    for name in (*OURS[:-1], "src"):
        shutil.copytree(
            ROOT / name, sources / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
        )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    built = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path), str(sources)],
        capture_output=True,
        text=True,
        check=False,
    )
    if "No matching distribution found for setuptools" in built.stderr:
        pytest.skip("no package index in reach: the build backend cannot be had")
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"gnd"}
    for name in OURS[:-1]:
        held = {n.removeprefix("gnd/") for n in names if n.startswith(f"gnd/{name}/")}
        there = {str(p.relative_to(ROOT)) for p in (ROOT / name).rglob("*.py")}
        assert there <= held, sorted(there - held)[:5]
    for table in (
        "gnd_map/codec/priors.bin",
        "gnd_map/codec/prior_sets.bin",
        "gnd_map/codec/rans_tables.bin",
        "deploy/fleet.toml",
        "tile_store/sql/sqlite.sql",
    ):
        assert f"gnd/{table}" in names
