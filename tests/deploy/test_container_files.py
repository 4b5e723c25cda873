"""Every command line in the container files, the systemd units and the READMEs is one that `gnd` understands."""

import re
import shlex
import tomllib
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
    names = ("README.md", "docs/operations.md", "docs/commands.md")
    text = "\n".join((DEPLOY.parent / name).read_text() for name in names)
    lines = re.findall(r"^gnd ([^#\n]*)", text, re.M) + re.findall(r"`gnd ([a-z][^`]* [^`]*)`", text)
    return [shlex.split(line.replace("[", "").replace("]", "")) for line in lines]


@pytest.mark.parametrize("words", _compose_commands() + _systemd_commands() + _documented_commands(), ids=" ".join)
def test_the_command_line_parses(words: list[str]) -> None:
    context = click.Context(gnd)
    command: click.Command | None = gnd
    while isinstance(command, click.Group) and not (command.invoke_without_command and words[0].startswith("-")):
        name, words = words[0], words[1:]
        command = command.get_command(context, name)
    assert command is not None
    command.make_context(name, words, parent=context)


def test_there_are_commands_to_check() -> None:
    assert len(_compose_commands()) >= 6
    assert len(_systemd_commands()) >= 3
    assert len(_documented_commands()) >= 8


def pins(path: Path) -> dict[str, str]:
    """Version by name of `name==version` lines."""
    found = re.findall(r"^([A-Za-z0-9._-]+)==([^\s\\]+)", path.read_text(), re.M)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def test_the_lock_is_that_of_the_pinned_versions() -> None:
    lock, constraints = pins(DEPLOY / "requirements.lock"), pins(DEPLOY.parent / "constraints.txt")
    assert {name: version for name, version in lock.items() if constraints.get(name, version) != version} == {}
    assert set(lock) - set(constraints) <= {"setuptools"}, "a package of the image is not pinned"
    text = (DEPLOY.parent / "pyproject.toml").read_text()
    wanted = tomllib.loads(text)["project"]
    extras = [wanted["optional-dependencies"][name] for name in ("vehicle", "cloud", "sim")]
    for requirement in sum(extras, wanted["dependencies"]):
        name = re.match(r"[A-Za-z0-9._-]+", requirement)
        assert name is not None
        assert re.sub(r"[-_.]+", "-", name.group()).lower() in lock, f"{requirement}: run `make lock`"


def test_every_package_of_the_lock_has_hashes() -> None:
    entries = re.split(r"\n(?=[A-Za-z])", (DEPLOY / "requirements.lock").read_text())
    assert len(entries) >= 40
    assert [entry.splitlines()[0] for entry in entries if "==" in entry and "--hash=sha256:" not in entry] == []


def test_the_image_holds_every_folder_and_no_root() -> None:
    text = (DEPLOY / "Dockerfile").read_text()
    for folder in (DEPLOY.parent / "src" / "gnd").iterdir():
        if folder.is_symlink():
            assert f"COPY {folder.name} {folder.name}\n" in text
    assert re.search(r"^USER 10001", text, re.M)
    assert "--require-hashes" in text


def test_no_container_has_more_rights_than_it_needs() -> None:
    services: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    for name, service in services.items():
        assert service["user"] == "10001:10001", name
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert "no-new-privileges:true" in service["security_opt"], name
        is_secure = any(str(word).startswith("tls/0.0.0.0") for word in service.get("command", []))
        assert is_secure or all(port.startswith("127.0.0.1:") for port in service.get("ports", [])), name
