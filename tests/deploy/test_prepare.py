"""Folders of simulated worlds that are used again, and forgotten when the programs have changed."""

from dataclasses import replace
from pathlib import Path

import pytest
from rich.progress import Progress

from gnd.deploy import prepare
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.run_folder import create_run_folder
from gnd.deploy.source import Source

pytestmark = pytest.mark.slow


def test_a_kept_world_is_used_again_until_the_programs_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = FleetConfig(agents=1, world_seed=302)
    source, home = Source(worlds=tmp_path / "worlds"), tmp_path / "worlds" / "seed-302"
    few = prepare.prepare_fleet_run
    monkeypatch.setattr(prepare, "prepare_fleet_run", lambda *a, **k: few(*a, **k, scans=30))

    def made(name: str) -> dict[str, int]:
        folder = create_run_folder(tmp_path / name)
        prepared = prepare.prepare(config, folder, source, Progress(disable=True))
        assert prepared.truth == home / "truth.npz"
        assert folder.store.exists()
        files = [*prepared.agent_drives, home / "base.sqlite", home / "truth.npz"]
        return {file.name: file.stat().st_mtime_ns for file in files}

    first = made("first")
    assert made("second") == first
    config = replace(config, headway_s=7.0)
    third = made("third")  # its vehicles are stamped for another headway, its map is not
    assert {name for name in third if third[name] != first[name]} == {"vehicle-0.mcap"}
    (home / "made_by.txt").write_text("another program")
    prepare.forget_if_stale(home)
    assert sorted(path.name for path in home.iterdir()) == [
        "features.json", "headway_s.txt", "made_by.txt", "truth.npz", "world.json",
    ]  # fmt: skip
