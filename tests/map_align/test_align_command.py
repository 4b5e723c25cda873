"""The command on drives: one that was moved comes back, one of another place is refused and nothing is written."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.deploy.map_cli import map_group
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.schemas.drive_mcap import load_track, read_header
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.map_align.candidates import about
from gnd.vehicle_agent.map_align.move import moved_drive
from gnd.vehicle_agent.map_align.sources import AlignError


def drive(path: Path, world_seed: int, seed: int) -> Path:
    config = DriveConfig("car", "VLP-16", "before", seed=seed, cruise_mps=12.0, errors=PERFECT)
    return simulate_drive(street(world_seed, StreetOptions(length_m=100.0)), config, path)


def align(*arguments: object) -> tuple[int, Any]:
    result = CliRunner().invoke(map_group, ["align", *map(str, arguments), "--json"])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, json.loads(result.stdout)


@pytest.mark.slow
def test_a_moved_drive_comes_back_and_another_place_is_refused(tmp_path: Path) -> None:
    first, second = drive(tmp_path / "a.mcap", 1011, 1), drive(tmp_path / "b.mcap", 1011, 2)
    frame = read_header(second).anchor
    T = about(load_track(second).reference.T_map_vehicle[:, :3, 3].mean(axis=0), np.radians(1.2))
    T[:3, 3] += 2.3, -1.4, 0.8
    away = tmp_path / "away.mcap"
    moved_drive(second, away, frame, T, "moved by a test")
    with SqliteStore(tmp_path / "a.sqlite") as store:
        build_map([first], store)

    picture, back = tmp_path / "overlap.png", tmp_path / "back.mcap"
    status, values = align(tmp_path / "a.sqlite", away, "--out", back, "--picture", picture)
    assert (status, values["fits"]) == (0, True), values["reasons"]
    assert values["heading_deg"] == pytest.approx(-1.2, abs=0.1)
    assert picture.stat().st_size > 10_000
    truth, found = load_track(second), load_track(back)
    error_m = np.linalg.norm((found.reference.T_map_vehicle - truth.reference.T_map_vehicle)[:, :3, 3], axis=1)
    assert error_m.max() < 0.15
    moved_m = frame.enu_from_geodetic(*found.gnss[1:4]) - frame.enu_from_geodetic(*truth.gnss[1:4])
    assert np.linalg.norm(moved_m, axis=1).max() < 0.15
    assert "moved onto a.sqlite by gnd map align" in read_header(back).source

    refused = tmp_path / "refused.mcap"
    status, values = align(tmp_path / "a.sqlite", drive(tmp_path / "c.mcap", 1012, 3), "--out", refused)
    assert status == 1
    assert values["reasons"]
    assert not refused.exists()


def test_what_is_no_map_and_what_is_there_already_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "notes.txt"
    other.write_text("no map")
    for arguments, says in (
        ([other, other], "neither a map"),
        ([tmp_path / "missing", other], "cannot be read"),
        ([other, other, "--out", other], "exists"),
    ):
        result = CliRunner().invoke(map_group, ["align", *map(str, arguments)])
        assert isinstance(result.exception, AlignError)
        assert says in str(result.exception)
