"""Configuration of a fleet run: `deploy/fleet.toml` holds the defaults, options and `--config FILE` override them."""

import re
import tomllib
from dataclasses import dataclass
from importlib import resources
from math import radians
from pathlib import Path
from typing import Any

from gnd.deploy.errors import DeployError
from gnd.gnd_map.config import from_mapping

MAX_AGENTS = 200
MAX_SHARDS = 32
MAX_HEADWAY_S = 3600.0
VOXEL_LAYER = "ndt"
_WRONG_MOUNT = re.compile(r"(?P<vehicle>\d{1,3}):(?P<deg>[+-]?\d+(\.\d*)?)")
FEATURE_LAYERS = ("signs", "streetlights", "poles")
"""Those for which the fleet's vehicles have detectors."""


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """What a fleet run does.

    Attributes:
        agents: number of vehicle agent processes.
        shards: number of merger shard processes.
        link: link profile of every vehicle: 3g, 4g, 5g, none, or a TOML file.
        headway_s: time of the drives between the starts of two vehicles, so that those behind drive on what those
            ahead have found; 0: all start at once, and drive as fast as they can.
        world_seed: seed of the simulated world and of its drives.
        port: TCP port of the router on the loopback interface; 0 takes a free one.
        detect_mode: rules of change detection, `default` or `paper`.
        merge_mode: rules of merging and publishing, `default` or `paper`.
        merge_delay_s: a tile is merged this long after its first unmerged report ...
        merge_after_reports: ... or as soon as this many reports wait.
        deadline_s: a run that takes longer is ended with an error.
        wrong_mounts: vehicles whose drives tell a wrong mount, such as "3:0.5": that of vehicle 3 is turned by 0.5
            degrees (counter-clockwise seen from above) against the one that it was driven with.
        layers: layers of the map that vehicles keep up to date; "ndt", on which they localise, is always among them.
    """

    agents: int = 8
    shards: int = 2
    link: str = "4g"
    headway_s: float = 4.0
    world_seed: int = 7
    port: int = 0
    detect_mode: str = "default"
    merge_mode: str = "default"
    merge_delay_s: float = 0.5
    merge_after_reports: int = 16
    deadline_s: float = 1800.0
    wrong_mounts: tuple[str, ...] = ()
    layers: tuple[str, ...] = (VOXEL_LAYER,)

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        _require(1 <= self.agents <= MAX_AGENTS, f"agents must be 1 to {MAX_AGENTS}, got {self.agents}")
        _require(1 <= self.shards <= MAX_SHARDS, f"shards must be 1 to {MAX_SHARDS}, got {self.shards}")
        _require(0 <= self.port <= 65535, f"port must be 0 to 65535, got {self.port}")
        for name in ("detect_mode", "merge_mode"):
            value = getattr(self, name)
            _require(value in ("default", "paper"), f"{name} must be default or paper, got {value!r}")
        longest_s = MAX_HEADWAY_S
        _require(0 <= self.headway_s <= longest_s, f"headway_s must be 0 to {longest_s:g} s, got {self.headway_s}")
        _require(self.merge_delay_s >= 0, f"merge_delay_s must not be negative, got {self.merge_delay_s}")
        _require(self.merge_after_reports >= 1, f"merge_after_reports must be >= 1, got {self.merge_after_reports}")
        _require(self.deadline_s > 0, f"deadline_s must be positive, got {self.deadline_s}")
        _ = self.wrong_mounts_rad
        self._check_layers()

    def _check_layers(self) -> None:
        unfit = [layer for layer in self.layers if layer != VOXEL_LAYER and layer not in FEATURE_LAYERS]
        known = ", ".join((VOXEL_LAYER, *FEATURE_LAYERS))
        _require(not unfit, f"no vehicle of the fleet detects the layers {', '.join(unfit)}; it knows {known}")
        _require(VOXEL_LAYER in self.layers, f"layers must hold {VOXEL_LAYER!r}, on which vehicles localise")
        _require(len(set(self.layers)) == len(self.layers), f"layers {', '.join(self.layers)}: one comes twice")

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


def load_fleet_config(path: Path | None, overrides: dict[str, Any]) -> FleetConfig:
    """Read the configuration: the shipped defaults, then a file, then the options that were given.

    Args:
        path: TOML file, or None for the shipped `deploy/fleet.toml`.
        overrides: values by field name; None means not given.

    Returns:
        The checked configuration.

    Raises:
        DeployError: the file cannot be read or a value is out of range.
        ConfigError: an unknown key or a value of the wrong type.
    """
    values = _read_toml(path) if path is not None else _shipped_defaults()
    values |= {key: value for key, value in overrides.items() if value is not None}
    return from_mapping(FleetConfig, values, where=str(path or "deploy/fleet.toml"))


def _shipped_defaults() -> dict[str, Any]:
    text = resources.files("gnd.deploy").joinpath("fleet.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DeployError(f"cannot read the configuration {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DeployError(f"{path} is no valid TOML: {error}") from error
