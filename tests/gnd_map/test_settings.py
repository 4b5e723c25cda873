"""Settings: declared once; read from files, environment and --set; written down so that they can be read again."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.settings import (
    changed,
    check_settings,
    described,
    from_settings,
    known_paths,
    merged,
    of_changes,
    of_environment,
    plain_settings,
    setting,
    settings_sha256,
    settings_text,
)


@dataclass(frozen=True, slots=True)
class Report:
    longest_s: float = setting(40.0, "At the latest.", unit="s", least=0, most=600)
    longest_m: float = setting(400.0, "The same as a way.", unit="m", above=0)
    protocol: Literal["packed", "full"] = setting("packed", "How.")

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class Layer:
    name: str = setting(..., "Its name.")
    sigmas: tuple[float, ...] = setting((1.0, 2.0), "Of it.", above=0)

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True, slots=True)
class Agent:
    vehicle: str = setting(..., "Its name.")
    work_dir: Path = setting(Path("runs"), "Where it writes.")
    on: bool = setting(True, "Whether.")
    ledger: Path | None = setting(None, "Or none.")
    weights: Mapping[str, float] = setting({"Scala": 0.5}, "By sensor.")
    report: Report = setting(Report, "Reports.")
    layers: tuple[Layer, ...] = setting((), "Layers.")
    clock: int = 3  # no setting


def test_a_setting_is_described_by_its_declaration() -> None:
    rows = {row.path: row for row in described(Agent)}
    assert (rows["report.longest_s"].default, rows["report.longest_s"].setting.unit) == ("40.0", "s")
    assert rows["report.longest_s"].setting.range == "0 … 600"
    assert rows["report.longest_m"].setting.range == "> 0"
    assert rows["report.protocol"].kind == '"packed" or "full"'
    assert rows["ledger"].kind == "path"
    assert rows["weights"].default == "{Scala = 0.5}"
    assert "layers[].sigmas" in rows
    assert "clock" not in rows


@pytest.mark.parametrize("value", [-1.0, 601.0, float("nan"), float("inf")])
def test_a_value_outside_its_range_is_named_with_the_range(value: float) -> None:
    with pytest.raises(ValueError, match=r"longest_s = .* lies outside 0 … 600"):
        Report(longest_s=value)
    with pytest.raises(ValueError, match="sigmas"):
        Layer("a", (1.0, -1.0))


def test_the_later_layer_wins_key_by_key() -> None:
    first, second = {"a": 1, "report": {"x": 1, "y": 2}}, {"report": {"y": 3}}
    assert merged(first, second) == {"a": 1, "report": {"x": 1, "y": 3}}
    assert first["report"] == {"x": 1, "y": 2}


def test_changes_are_read_as_json_or_words() -> None:
    said = of_changes(Agent, ["report.longest_s=30", "vehicle=a b", "on=false", "weights.Ouster=0.7", "layers=[]"])
    assert said == {
        "report": {"longest_s": 30},
        "vehicle": "a b",
        "on": False,
        "weights": {"Ouster": 0.7},
        "layers": [],
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("report.longest=30", r"no setting report\.longest; did you mean report\.longest_"),
        ("longest_s=30", r"did you mean report\.longest_s"),
        ("report.xyzzy=1", "known here: longest_s, longest_m, protocol|did you mean"),
        ("clock=4", "no setting clock"),
        ("vehicle", "NAME=VALUE"),
        ("vehicle.name=3", None),
    ],
)
def test_an_unknown_setting_names_near_ones(change: str, message: str | None) -> None:
    with pytest.raises(ConfigError, match=message):
        from_settings(Agent, merged({"vehicle": "a"}, of_changes(Agent, [change])), where="agent")


def test_the_environment_is_read_by_program() -> None:
    variables = {"GND_AGENT__REPORT__LONGEST_S": "30", "GND_FLEET__AGENTS": "3", "GND_AGENTS": "no", "HOME": "x"}
    assert of_environment(Agent, "GND_AGENT", variables) == {"report": {"longest_s": 30}}
    with pytest.raises(ConfigError, match=r"GND_AGENT__REPORT__LONGEST: there is no setting report\.longest; did you"):
        of_environment(Agent, "GND_AGENT", {"GND_AGENT__REPORT__LONGEST": "30"})


def test_what_is_written_can_be_read_again() -> None:
    agent = Agent(
        'a "quoted"\\ name\n', Path("a/b"), False, Path("c"), {"Scala": 0.25, "a b": 1.0}, Report(1e-5, 3e22, "full"),
        (Layer("x", (0.5,)), Layer("y")),
    )  # fmt: skip
    text = settings_text(agent)
    assert "longest_s = 1e-05  # s, 0 … 600" in text
    assert from_settings(Agent, tomllib.loads(text), where="file") == agent
    assert settings_sha256(from_settings(Agent, tomllib.loads(text), where="file")) == settings_sha256(agent)
    assert settings_sha256(Agent("a")) != settings_sha256(agent)


def test_changed_keeps_the_rest() -> None:
    agent = changed(Agent("a", on=False), ["report.protocol=full"])
    assert agent == Agent("a", on=False, report=Report(protocol="full"))
    with pytest.raises(ConfigError, match=r"--set report\.protocol: expected one of"):
        changed(agent, ["report.protocol=morse"])


def test_known_paths_and_plain_settings_agree() -> None:
    plain = plain_settings(Agent("a", ledger=Path("x"), layers=(Layer("x"),)))
    flat = {
        f"{k}.{n}" if isinstance(v, dict) and k == "report" else k
        for k, v in plain.items()
        for n in (v if isinstance(v, dict) else [0])
    }
    assert flat == {path for path in known_paths(Agent) if "[]" not in path}
