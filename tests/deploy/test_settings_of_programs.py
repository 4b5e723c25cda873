"""The settings of the real programs: written, read again, refused, documented."""

import json
import tomllib
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from gnd.cloud_merger.config import ShardConfig
from gnd.deploy.cli import gnd
from gnd.deploy.configuration_page import page, settings_class
from gnd.deploy.fleet_config import FleetConfig, load_fleet_config
from gnd.fleet_bus.settings_file import layers_of, load_settings, read_toml, write_settings
from gnd.gnd_map.errors import ConfigError, GndError
from gnd.gnd_map.settings import described, from_settings, settings_sha256, settings_text
from gnd.schemas.feature_layer import LAYERS
from gnd.tile_store.cli import TileServerConfig
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.settings import agent_of, load_agent

BARE: dict[str, Any] = {
    "agent": AgentConfig("v", Path("drive.mcap"), Path("work")),
    "fleet": FleetConfig(),
    "merger": ShardConfig(),
    "store": TileServerConfig("map.sqlite"),
}
WORDS = {
    "store_path": "other.sqlite", "path": "other.sqlite",
    "shard_id": "merger-7", "codec": "float", "link": "3g", "layer": "ndt2", "vehicle": "w", "localise_by": "lidar",
    "wrong_mounts": ("3:0.5",), "connect": ("tcp/10.0.0.1:7448",),
    "layers": ("ndt", "signs"), "passing_rule": "ahead", "protocol": "full", "mode": "paper",
    "tiles_from": "https://tiles.example.org/map",
    "source": "",  # another needs that there is no recording
    "points": "/a/points", "gnss": "/a/fix", "speed": "/a/odometry", "imu": "/a/imu", "vehicle_frame": "base",
    "mount": (0.5, 0.0, 1.5, 0.0, 0.0, 90.0), "family": "suburb",
}  # fmt: skip


def other(config: Any) -> Any:
    """A configuration in which every setting has another value than its default, as far as one alone may."""
    changed = config
    for each in fields(config):
        if "setting" not in each.metadata:
            continue
        for value in candidates(each.name, getattr(config, each.name), each.metadata["setting"]):
            try:
                changed = replace(changed, **{each.name: value})
            except (GndError, ValueError):
                continue
            break
        else:
            raise AssertionError(f"no other value of {type(config).__name__}.{each.name} is taken")
    return changed


def candidates(name: str, value: Any, told: Any) -> list[Any]:
    if is_dataclass(value):
        return [other(value)]
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value - 1]
    if isinstance(value, float):
        return [value * 0.999 or 0.25, value * 1.001, value + 0.25, value - 0.01]
    if name == "parking":
        return [0.35]
    if isinstance(value, Path) or value is None:
        return [Path("other/place")]
    if isinstance(value, dict):
        return [{"Ouster": 0.75} if name == "sensor_weights" else {"poll_s" if name == "merger" else "pace": 0.75}]
    if isinstance(value, tuple) and value and isinstance(value[0], float):
        return [tuple(1.5 * item for item in value)]
    if name in ("layers", "feature_layer") and not value:
        return [(LAYERS["signs"], replace(LAYERS["poles"], range_m=12.0))]
    return [WORDS[name]]


@pytest.mark.parametrize("program", list(BARE))
@pytest.mark.parametrize("every_value_changed", [False, True])
def test_what_is_dumped_is_read_again(program: str, every_value_changed: bool, tmp_path: Path) -> None:
    config = other(BARE[program]) if every_value_changed else BARE[program]
    sha = write_settings(config, tmp_path)
    said = read_toml(tmp_path / "settings.toml")
    again = agent_of(said) if program == "agent" else from_settings(type(config), said, where="file")
    assert again == config
    assert sha == settings_sha256(again)
    assert settings_text(again) == settings_text(config)


@pytest.mark.parametrize("program", list(BARE))
def test_every_value_changed_means_every_value(program: str) -> None:
    def flat(table: Any, prefix: str = "") -> dict[str, Any]:
        if not isinstance(table, dict):
            return {prefix: table}
        return {k: v for key, value in table.items() for k, v in flat(value, f"{prefix}.{key}").items()}

    old, new = (flat(tomllib.loads(settings_text(c))) for c in (BARE[program], other(BARE[program])))
    same = {path for path in old if old[path] == new.get(path)}
    # "graph" asks for feature layers and no LiDAR; another source than a recording for no recording.
    assert same <= {".localise_by", ".live.source"}, same


@pytest.mark.parametrize("program", list(BARE))
def test_every_setting_is_explained(program: str) -> None:
    for row in described(settings_class(program)):
        assert row.setting.effect[:1].isupper() or row.setting.effect.startswith(("...", "…", "`", '"', "λ", "η")), row
        assert row.setting.effect.rstrip().endswith((".", "...", "…")), row
        lengths = {"_m": "m", "_s": "s", "_rad": "rad", "_deg": "deg", "_ms": "ms"}
        ends = [unit for end, unit in lengths.items() if row.path.endswith(end)]
        assert not ends or row.setting.unit in ends, row


def test_the_page_is_what_the_code_says() -> None:
    shipped = Path(__file__).parents[2] / "docs" / "configuration.md"
    assert shipped.read_text(encoding="utf-8") == page(), "run python -m gnd.deploy.configuration_page"


def test_precedence(tmp_path: Path) -> None:
    file = tmp_path / "agent.toml"
    file.write_text('drive = "d"\npace = 1\nlink = "3g"\nvehicle = "file"\nopen_timeout_s = 1\n')
    variables = {"GND_AGENT__LINK": "4g", "GND_AGENT__VEHICLE": "environment", "GND_AGENT__OPEN_TIMEOUT_S": "2"}
    changes = ["vehicle=set", "open_timeout_s=3"]
    config = load_agent(file, changes, {"open_timeout_s": 4.0, "layer": None}, variables)
    assert (config.pace, config.link, config.vehicle, config.open_timeout_s) == (1.0, "4g", "set", 4.0)
    assert config.work_dir == Path("runs/set")
    assert config.layer == "ndt"


def test_the_mode_of_detection_chooses_its_defaults_and_a_setting_still_wins() -> None:
    paper = agent_of({"drive": "d", "detect": {"mode": "paper", "new_cells": 25}})
    assert (paper.detect.rules.passing_rule, paper.detect.rules.soft, paper.detect.new_cells) == ("ml", False, 25)
    assert agent_of({"drive": "d"}).detect.rules.passing_rule == "plane"


def test_layers_are_named_or_described() -> None:
    own = {"name": "hydrants", "sensor": "camera", "kinds": ["hydrant"]}
    layers = agent_of({"drive": "d", "features": {"layers": ["signs", own]}}).features.layers
    assert (layers[0], layers[1].name, layers[1].kinds) == (LAYERS["signs"], "hydrants", ("hydrant",))


HYDRANTS = """
[[feature_layer]]
name = "hydrants"
kinds = ["hydrant"]
sensor = "camera"
reach_m = 4.0
"""


def test_one_table_declares_a_layer_to_every_program(tmp_path: Path) -> None:
    file = tmp_path / "hydrants.toml"
    file.write_text(HYDRANTS)
    agent = load_agent(file, (), {"drive": "d", "features": {"layers": ["hydrants", "signs"]}}, {})
    assert [layer.name for layer in agent.features.layers] == ["hydrants", "signs"]
    shard = load_settings(ShardConfig, "merger", file, (), {}, {})
    assert shard.feature_layer == agent.feature_layer == agent.features.layers[:1]
    assert (shard.merge_of("hydrants").reach_m, shard.merge_of("signs").reach_m) == (4.0, shard.features.reach_m)
    assert load_settings(TileServerConfig, "store", file, (), {"path": "m"}, {}).feature_layer == shard.feature_layer
    fleet = load_fleet_config(file, {"layers": ["ndt", "hydrants"]}, (), {})
    assert fleet.feature_layer == shard.feature_layer


def test_a_layer_that_nobody_declared_is_an_error_that_says_what_to_write(tmp_path: Path) -> None:
    file = tmp_path / "hydrants.toml"
    file.write_text(HYDRANTS)
    with pytest.raises(
        GndError, match=r"no layer 'hydrant'; known are .*hydrants.*\[\[feature_layer\]\] name = \"hydrant\""
    ):
        load_agent(file, (), {"drive": "d", "features": {"layers": ["hydrant"]}}, {})
    for wrong, message in (
        ('geometry = "line"', "holds lines"),
        ('geometry = "area"', "'point', 'line'"),
        ("reach_m = 200", "reach_m = 200.0 lies outside"),
        ("reech_m = 2", "unknown key reech_m"),
    ):
        file.write_text(HYDRANTS.replace("reach_m = 4.0", wrong))
        with pytest.raises(GndError, match=message):
            load_agent(file, (), {"drive": "d", "features": {"layers": ["hydrants"]}}, {})
    file.write_text(HYDRANTS.replace("camera", "lidar"))
    with pytest.raises(GndError, match="finds pole, trunk, traffic_sign, streetlight, no hydrant"):
        load_agent(file, (), {"drive": "d", "features": {"layers": ["hydrants"]}}, {})


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ("[report]\nlonest_s = 3", r"no setting report\.lonest_s; did you mean report\.longest_s"),
        ("[report]\nlongest_s = -3", r"longest_s = -3\.0 lies outside ≥ 0"),
        ("[localise.refine]\nlag_m = 'far'", r"localise\.refine\.lag_m: expected float"),
        ("[departure]\nstart_s = 1", "no setting departure"),
    ],
)
def test_a_bad_file_is_one_clear_error(said: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "agent.toml"
    file.write_text(said)
    with pytest.raises(GndError, match=message):
        load_agent(file, (), {"drive": "d"}, {})


def test_the_fleet_hands_settings_to_agents_and_shards(tmp_path: Path) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text("agents = 2\n[agent.report]\nlongest_s = 30.0\n[merger]\npoll_s = 0.5\n")
    config = load_fleet_config(file, {"shards": 1}, ["agent.report.longest_m=300", "merger.store.window_s=60"], {})
    assert config.agent == {"report": {"longest_s": 30.0, "longest_m": 300}}
    assert config.merger == {"poll_s": 0.5, "store": {"window_s": 60}}
    assert (config.agents, config.shards) == (2, 1)
    for change, message in (
        ("agent.report.longest=3", r"fleet: agent: there is no setting report\.longest"),
        ("merger.pol_s=1", r"fleet: merger: there is no setting pol_s; did you mean poll_s"),
        ("agent.report.longest_s=-1", "lies outside"),
    ):
        with pytest.raises(GndError, match=message):
            load_fleet_config(None, {}, [change], {})


def test_the_commands_print_what_they_take(tmp_path: Path) -> None:
    run = CliRunner().invoke
    commands = {"agent": ["--drive", "d"], "fleet": [], "merger": [], "store": ["--path", "p"]}
    for program, needed in commands.items():
        first = run(gnd, [program, *needed, "--dump-config"])
        assert first.exit_code == 0, first.output
        file = tmp_path / f"{program}.toml"
        file.write_text(first.stdout)
        assert run(gnd, [program, "--config", str(file), "--dump-config"]).stdout == first.stdout
        assert run(gnd, ["config", "check", program, str(file)]).stdout == first.stdout
    shown = run(gnd, ["config", "show", "agent", "report.longest_s"])
    assert "report.longest_s = 40.0 s  [≥ 0]" in shown.stdout


def test_layers_of_reads_this_process_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GND_MERGER__POLL_S", "0.75")
    assert layers_of(ShardConfig, "merger", None, (), {}) == {"poll_s": 0.75}
    assert load_settings(ShardConfig, "merger", None, (), {}).poll_s == 0.75
    with pytest.raises(ConfigError, match="cannot read"):
        read_toml(Path("no such file.toml"))


def test_json_of_values_is_plain() -> None:
    json.dumps(tomllib.loads(settings_text(BARE["agent"])))
