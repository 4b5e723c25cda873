"""Configuration from mappings: defaults run, typing errors do not pass."""

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Literal

import pytest

from gnd.gnd_map.config import from_mapping, to_mapping
from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.evidence import MassParameters


class Colour(Enum):
    RED = 1
    BLUE = 2


@dataclass(frozen=True, slots=True)
class Link:
    rate_bps: float = 1e6
    name: str = "4g"


@dataclass(frozen=True, slots=True)
class Agent:
    vehicle: str
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    window_m: tuple[float, float] = (100.0, 20.0)
    link: str | Link = "none"
    mode: Literal["paper", "default"] = "default"
    masses: MassParameters = field(default_factory=MassParameters)
    seed: int | None = None
    drive: Path = Path("drive.mcap")
    colour: Colour = Colour.RED
    verbose: bool = False
    limits: dict[str, int] = field(default_factory=dict)
    extra: Any = None


def test_defaults_run() -> None:
    assert from_mapping(Agent, {"vehicle": "a"}) == Agent("a")


def test_every_kind_of_value() -> None:
    agent = from_mapping(
        Agent,
        {
            "vehicle": "a",
            "connect": ["tcp/r:1", "tcp/s:2"],
            "window_m": [50, 10.5],
            "link": {"rate_bps": 5, "name": "own"},
            "mode": "paper",
            "masses": {"lambda_c_pass": 0.01},
            "seed": 3,
            "drive": "x/y.mcap",
            "colour": "BLUE",
            "verbose": True,
            "limits": {"tiles": 4},
            "extra": [1, "two"],
        },
    )
    assert agent.connect == ("tcp/r:1", "tcp/s:2")
    assert agent.window_m == (50.0, 10.5)
    assert agent.link == Link(5.0, "own")
    assert agent.masses == MassParameters(lambda_c_pass=0.01)
    assert agent.drive == Path("x/y.mcap")
    assert agent.colour is Colour.BLUE
    assert from_mapping(Agent, to_mapping(agent)) == agent


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"vehicle": "a", "vehcle": "b"}, r"Agent: unknown key vehcle; known keys: vehicle, connect"),
        ({"vehicle": "a", "masses": {"lambda_x": 1}}, r"masses: unknown key lambda_x; known keys: lambda_s_block"),
        ({"vehicle": "a", "link": {"rate_bps": 10**400}}, r"link\.rate_bps: a number of 1329 bits is too large"),
        ({"vehicle": "a", "link": {"rate": 1}}, r"link: unknown key rate; known keys: rate_bps, name"),
        ({}, "missing key vehicle"),
        ({"vehicle": 5}, "vehicle: expected str, got int 5"),
        ({"vehicle": "a", "seed": "x"}, "seed: expected int, got str 'x'"),
        ({"vehicle": "a", "seed": True}, "seed: expected int, got bool"),
        ({"vehicle": "a", "verbose": 1}, "verbose: expected bool, got int 1"),
        ({"vehicle": "a", "connect": "tcp/r:1"}, "connect: expected a list, got str"),
        ({"vehicle": "a", "connect": ["x", 2]}, r"connect\[1\]: expected str, got int 2"),
        ({"vehicle": "a", "window_m": [1.0]}, "window_m: expected 2 items, got 1"),
        ({"vehicle": "a", "mode": "fast"}, "mode: expected one of 'paper', 'default', got str 'fast'"),
        ({"vehicle": "a", "colour": "GREEN"}, "colour: expected one of RED, BLUE"),
        ({"vehicle": "a", "masses": 3}, "masses: expected a table of MassParameters, got int 3"),
        ({"vehicle": "a", "link": 3}, "link: expected one of str, Link"),
        ({"vehicle": "a", "limits": {"tiles": "x"}}, "limits.tiles: expected int"),
        ({"vehicle": "a", "masses": {"lambda_s_block": 2.0}}, "lambda_s_block = 2.0 lies outside ≥ 0 and < 1"),
    ],
)
def test_errors_name_the_place_and_what_is_known(mapping: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_mapping(Agent, mapping)


def test_the_place_in_the_whole_configuration_is_part_of_the_message() -> None:
    with pytest.raises(ConfigError, match=r"fleet\.agent\.vehicle: expected str"):
        from_mapping(Agent, {"vehicle": 1}, where="fleet.agent")


def test_only_dataclasses_are_configurations() -> None:
    with pytest.raises(TypeError, match="no dataclass"):
        from_mapping(int, {})
    with pytest.raises(TypeError, match="no dataclass"):
        to_mapping(Agent)
