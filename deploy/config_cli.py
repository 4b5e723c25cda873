"""`gnd config`: show and check settings without running anything."""

import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from gnd.answers import json_option, tell
from gnd.deploy.configuration_page import PROGRAMS, settings_class
from gnd.deploy.errors import DeployError
from gnd.gnd_map.settings import described, settings_text

_PROGRAM = click.argument("program", type=click.Choice(list(PROGRAMS)))


@click.group()
def config() -> None:
    """Settings of the programs; docs/configuration.md has them all."""


@config.command(short_help="Name, default, unit, range and effect of settings.")
@_PROGRAM
@click.argument("part", default="")
@json_option
def show(program: str, part: str, as_json: bool) -> None:
    """The settings of PROGRAM whose names contain PART."""
    rows = [row for row in described(settings_class(program)) if part in row.path]
    if not rows:
        raise DeployError(f"no setting of gnd {program} holds {part!r}")
    lines = []
    for row in rows:
        told = row.setting
        unit = f" {told.unit}" if told.unit else ""
        lines.append(f"{row.path} = {row.default or '(must be given)'}{unit}  [{told.range or row.kind}]")
        lines.append(f"    {told.effect}")
    tell({"program": program, "settings": [asdict(row) for row in rows]}, as_json, *lines)


@config.command(short_help="Check a file of settings.")
@_PROGRAM
@click.argument("file", type=click.Path(path_type=Path))
@json_option
def check(program: str, file: Path, as_json: bool) -> None:
    """Check FILE as `gnd PROGRAM --config FILE` would, and print the effective settings."""
    text = settings_text(_loaded(program, file))
    tell(tomllib.loads(text), as_json, text.rstrip("\n"))


@config.command(short_help="Thresholds of alerts, and the rules of Prometheus made from them.")
@click.argument("file", type=click.Path(path_type=Path), required=False)
@click.option("--rules", is_flag=True, help="Print the rules of Prometheus instead.")
@json_option
def alerts(file: Path | None, rules: bool, as_json: bool) -> None:
    """The thresholds of FILE (TOML; without one the defaults), as `gnd status --alerts` takes them.

    An unknown name or a value out of range is an error. With --rules: what Prometheus is to be given.
    """
    from gnd.deploy.status.alert_rules import alert_rules
    from gnd.deploy.status.thresholds import load_thresholds

    thresholds = load_thresholds(file)
    text = alert_rules(thresholds) if rules else settings_text(thresholds)
    tell(asdict(thresholds), as_json, text.rstrip("\n"))


def _loaded(program: str, file: Path) -> Any:
    from gnd.deploy.fleet_config import load_fleet_config
    from gnd.fleet_bus.settings_file import load_settings, read_toml

    if program == "fleet":
        return load_fleet_config(file, {})
    if program == "agent":
        from gnd.vehicle_agent.settings import agent_of

        return agent_of({"drive": "drive.mcap"} | read_toml(file), where=str(file))
    needed = {"path": "map.sqlite"} if program == "store" and "path" not in read_toml(file) else {}
    return load_settings(settings_class(program), program, file, (), needed, {})
