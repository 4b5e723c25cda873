"""Configuration of a fleet run: `deploy/fleet.toml` holds the defaults, options and `--config FILE` override them."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from math import radians
from pathlib import Path
from typing import Any

from gnd.deploy.errors import DeployError
from gnd.fleet_bus.settings_file import layers_of
from gnd.fleet_sim.families.names import FAMILY_NAMES
from gnd.gnd_map.settings import check_settings, from_settings, merged, setting
from gnd.schemas.feature_layer import LayerParameters, checked_layers

MAX_AGENTS = 200
MAX_SHARDS = 32
MAX_HEADWAY_S = 3600.0
VOXEL_LAYER = "ndt"
_WRONG_MOUNT = re.compile(r"(?P<vehicle>\d{1,3}):(?P<deg>[+-]?\d+(\.\d*)?)")
FEATURE_LAYERS = ("signs", "streetlights", "poles")
"""Those for which the fleet's vehicles have detectors."""


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """What a fleet run does."""

    agents: int = setting(8, "Number of vehicle agent processes.", least=1, most=MAX_AGENTS)
    shards: int = setting(2, "Number of merger shard processes.", least=1, most=MAX_SHARDS)
    link: str = setting("4g", "Link profile of every vehicle: 3g, 4g, 5g, none, or a TOML file.")
    headway_s: float = setting(
        4.0,
        "Time (of the drives) between the starts of two vehicles, so that later vehicles use the updates of "
        "earlier ones; 0: all start at once, and drive as fast as they can.",
        unit="s",
        least=0,
        most=MAX_HEADWAY_S,
    )
    world_seed: int = setting(7, "Seed of the simulated world and of its drives.")
    family: str = setting(
        "street", "Kind of place of the simulated world: street, suburb, avenue, ... (docs/worlds.md)."
    )
    parking: float | None = setting(
        None, "Share of parking slots that are taken on each drive; by default the family's usual one.", least=0, most=1
    )
    port: int = setting(0, "TCP port of the router on the loopback interface; 0 takes a free one.", least=0, most=65535)
    deadline_s: float = setting(1800.0, "A run that takes longer is ended with an error.", unit="s", above=0)
    wrong_mounts: tuple[str, ...] = setting(
        (),
        'Vehicles whose drives contain a wrong mount, such as "3:0.5": the mount of vehicle 3 is turned by 0.5 '
        "degrees (counter-clockwise seen from above) against the true one.",
    )
    layers: tuple[str, ...] = setting(
        (VOXEL_LAYER,),
        'Layers of the map that vehicles keep up to date; "ndt", on which they localise, is always among them.',
    )

    feature_layer: tuple[LayerParameters, ...] = setting(
        (), "Feature layers that the user declares, for agents and shards alike."
    )
    agent: Mapping[str, Any] = setting({}, "Settings of every agent, as `gnd agent --config` takes them.")
    merger: Mapping[str, Any] = setting({}, "Settings of every shard, as `gnd merger --config` takes them.")

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_settings(self, DeployError)
        _ = self.wrong_mounts_rad
        _require(self.family in FAMILY_NAMES, f"unknown family {self.family!r}, use one of {', '.join(FAMILY_NAMES)}")
        self._check_layers()

    def _check_layers(self) -> None:
        known = (VOXEL_LAYER, *FEATURE_LAYERS, *checked_layers(self.feature_layer))
        unfit = [layer for layer in self.layers if layer not in known]
        _require(
            not unfit, f"no vehicle of the fleet detects the layers {', '.join(unfit)}; it knows {', '.join(known)}"
        )
        _require(VOXEL_LAYER in self.layers, f"layers must hold {VOXEL_LAYER!r}, on which vehicles localise")
        _require(len(set(self.layers)) == len(self.layers), f"layers {', '.join(self.layers)}: one comes twice")

    def check_parts(self) -> None:
        """Refuse settings of agents and shards that there are not, before any process starts.

        Raises:
            ConfigError: with near names.
            GndError: a value out of its range.
        """
        if self.agent:
            from gnd.vehicle_agent.settings import agent_of

            agent_of(merged(self.agent, {"vehicle": "v", "drive": "d"}), where="fleet: agent")
        if self.merger:
            from gnd.cloud_merger.config import ShardConfig

            from_settings(ShardConfig, self.merger, where="fleet: merger")

    @property
    def wrong_mounts_rad(self) -> dict[int, float]:
        """Of each vehicle whose drive tells a wrong mount, what it is turned by."""
        found: dict[int, float] = {}
        for item in self.wrong_mounts:
            match = _WRONG_MOUNT.fullmatch(item)
            _require(match is not None, f"wrong_mounts holds VEHICLE:DEGREES, such as 3:0.5, got {item!r}")
            assert match is not None
            _require(int(match["vehicle"]) < self.agents, f"wrong mount {item!r}: there are {self.agents} vehicles")
            _require(abs(float(match["deg"])) <= 20.0, f"wrong mount {item!r}: at most 20 degrees")
            found[int(match["vehicle"])] = radians(float(match["deg"]))
        return found

    @property
    def feature_layers(self) -> tuple[str, ...]:
        """The layers that hold features."""
        return tuple(layer for layer in self.layers if layer != VOXEL_LAYER)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise DeployError(message)


def load_fleet_config(
    path: Path | None,
    overrides: dict[str, Any],
    changes: Sequence[str] = (),
    environment: Mapping[str, str] | None = None,
) -> FleetConfig:
    """Read the settings: the shipped defaults, then a file, the environment, --set, and the options that were given.

    Args:
        path: TOML file, or None for the shipped `deploy/fleet.toml`.
        overrides: values by field name, nested by group; None means not given.
        changes: NAME=VALUE, as of --set.
        environment: None: of this process (GND_FLEET__AGENTS=4).

    Returns:
        The checked settings; those of agents and shards, too.

    Raises:
        DeployError: a value is out of range.
        ConfigError: the file cannot be read, an unknown setting or a value of the wrong type.
    """
    said = layers_of(FleetConfig, "fleet", path, changes, overrides, environment)
    values = said if path is not None else merged(_shipped_defaults(), said)
    config = from_settings(FleetConfig, values, where=str(path or "deploy/fleet.toml"))
    config.check_parts()
    return config


def _shipped_defaults() -> dict[str, Any]:
    text = resources.files("gnd.deploy").joinpath("fleet.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)
