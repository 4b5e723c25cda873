"""`gnd release`: tables and JSON over a store, and every step of steering written down."""

import json
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from gnd.deploy.cli import gnd
from gnd.gnd_map.errors import GndError
from gnd.tile_store.released import released
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

sys.path.append(str(Path(__file__).parents[1] / "cloud_merger"))

from merger_world import TILE, tile_of_states
from release_world import STATES, Listener, merge_all, on_trial, reported, worker_of


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store with a version on trial, of which two vehicles have told."""
    path = tmp_path / "map.sqlite"
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([tile_of_states(STATES)])
        reported(store, 1)
        merge_all(store, worker_of(store))
        Listener(store).hear_all(on_trial(store), "new", [800, 790])
    return path


def run(*args: object) -> str:
    result = CliRunner().invoke(gnd, ["release", *map(str, args)])
    if isinstance(result.exception, GndError):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def told(*args: object):
    return json.loads(run(*args, "--json"))


def test_list_and_show_tell_how_far_a_trial_is(path):
    (row,) = told("list", path)["trials"]
    assert (row["tile"], row["version"], row["base_version"], row["state"]) == (TILE.path, 2, 1, "trial")
    assert "1 → 2" in run("list", path)
    shown = told("show", path, TILE.path)
    assert [one["fit"] for one in shown["vehicles"]] == [800, 790]
    assert shown["doubted"] == shown["steered"] == []
    assert "vehicles" in run("show", path, TILE.path)


def test_pause_resume_and_advance_release_it_and_are_written_down(path):
    assert told("pause", path, TILE.path, "--why", "rain")["state"] == "paused"
    assert told("resume", path, TILE.path, "--why", "dry")["state"] == "trial"
    assert told("advance", path, TILE.path, "--why", "looked at it")["state"] == "released"
    steered = told("show", path, TILE.path)["steered"]
    assert [(one["action"], one["why"]) for one in steered] == [
        ("paused", "rain"),
        ("resumed", "dry"),
        ("released", "looked at it"),
    ]
    assert all("@" in one["who"] for one in steered)
    with SqliteStore(path) as store:
        assert released(store, "ndt", TILE).version == 2


def test_withdraw_and_clear(path):
    assert told("withdraw", path, TILE.morton, "--why", "a wall is off")["state"] == "withdrawn"
    (doubted,) = told("show", path, TILE.path)["doubted"]
    assert doubted["cleared_ns"] is None
    assert "withdrawn" in run("list", path)
    assert told("clear", path, TILE.path, "--why", "it is right")["cleared"] == 1
    assert told("show", path, TILE.path)["doubted"][0]["cleared_ns"] is not None
    with SqliteStore(path) as store:
        assert store.get("ndt", TILE).version == 3
        assert store.dirty_count() == 1


def test_what_cannot_be_steered_is_said(path):
    with pytest.raises(GndError, match="no report about tile"):
        run("clear", path, TILE.path, "--why", "x")
    run("advance", path, TILE.path, "--why", "x")
    with pytest.raises(GndError, match="is on trial"):
        run("withdraw", path, TILE.path, "--why", "x")
    with pytest.raises(GndError, match="was ever on trial"):
        run("show", path, TILE.morton + 1)
    result = CliRunner().invoke(gnd, ["release", "withdraw", str(path), TILE.path])
    assert "--why" in result.output
    assert result.exit_code == 2
