"""Every command line in the container files, the systemd units and the READMEs is one that `gnd` understands."""

import re
import shlex
from pathlib import Path
from typing import Any

import click
import pytest
import yaml

from gnd.deploy.cli import gnd

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"


def _compose_commands() -> list[list[str]]:
    services: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    return [[str(word) for word in service["command"]] for service in services.values() if "command" in service]


def _systemd_commands() -> list[list[str]]:
    lines = [re.search(r"^ExecStart=(.*)$", path.read_text(), re.M) for path in (DEPLOY / "systemd").glob("*.service")]
    return [shlex.split(line.group(1).replace("%i", "0"))[1:] for line in lines if line]


def _documented_commands() -> list[list[str]]:
    """`gnd …` in code blocks and tables; what only a reader can fill in is replaced by something that parses."""
    text = "\n".join((DEPLOY.parent / name).read_text() for name in ("README.md", "docs/operations.md", "docs/commands.md"))
    lines = re.findall(r"^gnd ([^#\n]*)", text, re.M) + re.findall(r"`gnd ([a-z][^`]* [^`]*)`", text)
    return [shlex.split(line.replace("[", "").replace("]", "")) for line in lines]


@pytest.mark.parametrize("words", _compose_commands() + _systemd_commands() + _documented_commands(), ids=" ".join)
def test_the_command_line_parses(words: list[str]) -> None:
    context = click.Context(gnd)
    command: click.Command | None = gnd
    while isinstance(command, click.Group):
        name, words = words[0], words[1:]
        command = command.get_command(context, name)
    assert command is not None
    command.make_context(name, words, parent=context)


def test_there_are_commands_to_check() -> None:
    assert len(_compose_commands()) >= 6
    assert len(_systemd_commands()) >= 3
    assert len(_documented_commands()) >= 8
