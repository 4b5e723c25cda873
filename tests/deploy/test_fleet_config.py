from dataclasses import replace
from pathlib import Path

import pytest
from test_wrong_mounts import write_drive

from gnd.deploy.errors import DeployError
from gnd.deploy.fleet import for_drives, shard_config
from gnd.deploy.fleet_cli import by_part
from gnd.deploy.fleet_config import FleetConfig, load_fleet_config
from gnd.deploy.prepare import prepare_recorded
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.source import Source
from gnd.gnd_map.errors import ConfigError, GndError


def test_the_shipped_file_holds_the_defaults() -> None:
    assert load_fleet_config(None, {}) == FleetConfig()


def test_options_override_the_file(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text('agents = 3\nlink = "3g"\n')
    config = load_fleet_config(path, {"agents": 5, "link": None})
    assert (config.agents, config.link) == (5, "3g")


def test_an_unknown_key_is_named(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text("agentz = 3\n")
    with pytest.raises(GndError, match="agentz"):
        load_fleet_config(path, {})


@pytest.mark.parametrize(
    "overrides",
    [
        {"agents": 0},
        {"agents": 100_000},
        {"shards": 0},
        {"port": 70_000},
        {"layers": ["ndt", "ndt"]},
        {"deadline_s": 0.0},
        {"headway_s": -1.0},
        {"headway_s": float("nan")},
        {"family": "mars"},
        {"parking": 1.5},
    ],
)
def test_values_out_of_range_are_refused(overrides: dict[str, object]) -> None:
    with pytest.raises(DeployError):
        load_fleet_config(None, overrides)


def test_a_broken_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fleet.toml"
    path.write_text("agents = = 3")
    with pytest.raises(ConfigError, match="no valid TOML"):
        load_fleet_config(path, {})
    with pytest.raises(ConfigError, match="cannot read"):
        load_fleet_config(tmp_path / "missing.toml", {})


def test_layers_are_those_that_vehicles_detect_with_ndt_among_them() -> None:
    assert load_fleet_config(None, {"layers": ["ndt", "signs", "streetlights"]}).feature_layers == (
        "signs",
        "streetlights",
    )
    for layers, message in ((["signs"], "must hold 'ndt'"), (["ndt", "trees"], "trees"), (["ndt", "ndt"], "twice")):
        with pytest.raises(DeployError, match=message):
            load_fleet_config(None, {"layers": layers})


@pytest.mark.parametrize(("agents", "believes"), [(None, False), (1, False), (2, True)])
def test_vehicles_that_drive_one_recording_confirm_each_other(
    tmp_path: Path, agents: int | None, believes: bool
) -> None:
    """What one drive gives twice is one witness's word elsewhere."""
    drive = write_drive(tmp_path / "a.mcap")
    config = FleetConfig(agents=agents or 1)
    prepared = prepare_recorded(config, RunFolder(tmp_path / "run"), Source(drives=(drive,), agents=agents))
    shard = shard_config(for_drives(config, prepared), "shard-0", Path("map.sqlite"), "tcp/127.0.0.1:7447")
    assert shard.confirmation.copies is not believes
    told = replace(config, merger={"confirmation": {"copies": True}})
    assert shard_config(for_drives(told, prepared), "shard-0", Path("map.sqlite"), "").confirmation.copies


def test_the_modes_are_settings_of_agents_and_shards() -> None:
    options = {"agents": 3, "detect_mode": "paper", "merge_mode": None}
    config = load_fleet_config(None, by_part(options), ["merger.store.merge_delay_s=2.5"])
    assert (config.agents, config.agent) == (3, {"detect": {"mode": "paper"}})
    shard = shard_config(config, "shard-0", Path("map.sqlite"), "tcp/127.0.0.1:7447")
    assert (shard.merge.mode, shard.store.merge_delay_s, shard.store.merge_after_reports) == ("default", 2.5, 16)
    with pytest.raises(GndError, match="magic"):
        load_fleet_config(None, {"merger": {"merge": {"mode": "magic"}}})
