"""Every command line in the container files, the systemd units and the READMEs is one that `gnd` understands."""

import re
import shlex
import tomllib
from pathlib import Path

import click
import pytest
import yaml
from manifests import unit_environment, unit_words

from gnd.deploy.cli import gnd

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"


def _compose_commands() -> list[list[str]]:
    files = [yaml.safe_load(path.read_text())["services"] for path in sorted(DEPLOY.glob("compose*.yaml"))]
    services = [service for services in files for service in services.values() if "postgres:" not in service["image"]]
    return [[str(word) for word in service["command"]] for service in services if "command" in service]


def _kubernetes_commands() -> list[list[str]]:
    objects = [
        one for path in (DEPLOY / "kubernetes" / "base").glob("*.yaml") for one in yaml.safe_load_all(path.read_text())
    ]
    pods = [one["spec"]["template"]["spec"] for one in objects if one["kind"] in ("StatefulSet", "Deployment")]
    return [container["args"] for pod in pods for container in pod["containers"]]


def _systemd_commands() -> list[list[str]]:
    units = [path.read_text() for path in (DEPLOY / "systemd").glob("*.service")]
    return [unit_words(unit, "0", unit_environment(unit, "0", "/run/credentials")) for unit in units]


def _documented_commands() -> list[list[str]]:
    """`gnd …` in code blocks and tables; what only a reader can fill in is replaced by something that parses."""
    names = ("README.md", "docs/operations.md", "docs/commands.md", "docs/how_to/deploy.md", "docs/how_to/regions.md")
    text = "\n".join((DEPLOY.parent / name).read_text() for name in names)
    lines = re.findall(r"^gnd ([^#\n]*)", text, re.M) + re.findall(r"`gnd ([a-z][^`]* [^`]*)`", text)
    return [shlex.split(line.replace("[", "").replace("]", "")) for line in lines]


@pytest.mark.parametrize(
    "words", _compose_commands() + _kubernetes_commands() + _systemd_commands() + _documented_commands(), ids=" ".join
)
def test_the_command_line_parses(words: list[str]) -> None:
    context = click.Context(gnd)
    command: click.Command | None = gnd
    while isinstance(command, click.Group) and not (command.invoke_without_command and words[0].startswith("-")):
        name, words = words[0], words[1:]
        command = command.get_command(context, name)
    assert command is not None
    command.make_context(name, words, parent=context)


def test_there_are_commands_to_check() -> None:
    assert len(_compose_commands()) >= 11
    assert len(_kubernetes_commands()) == 3
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
    extras = [
        wanted["optional-dependencies"][name] for name in ("vehicle", "cloud", "sim", "postgres", "objects", "lanes")
    ]
    for requirement in sum(extras, wanted["dependencies"]):
        name = re.match(r"[A-Za-z0-9._-]+", requirement)
        assert name is not None
        assert re.sub(r"[-_.]+", "-", name.group()).lower() in lock, f"{requirement}: run `make lock`"


def test_every_package_of_the_lock_has_hashes() -> None:
    entries = re.split(r"\n(?=[A-Za-z])", (DEPLOY / "requirements.lock").read_text())
    assert len(entries) >= 40
    assert [entry.splitlines()[0] for entry in entries if "==" in entry and "--hash=sha256:" not in entry] == []


def test_what_the_image_copies_is_sent_to_the_builder_and_nothing_else() -> None:
    """No environment, run, drive or identity, and no machine code that was compiled for the building machine."""
    lines = (DEPLOY.parent / ".dockerignore").read_text().splitlines()
    rules = [line for line in lines if line and not line.startswith("#")]
    assert rules[0] == "*"
    sent = {line.removeprefix("!") for line in rules if line.startswith("!")}
    copies = re.findall(r"^COPY (?!--from)(.+) \S+$", (DEPLOY / "Dockerfile").read_text(), re.M)
    assert {Path(name).parts[0] for words in copies for name in words.split()} == sent
    assert {"**/__pycache__", "src/gnd/ahead/_kernels.*.so", "deploy/identities", "deploy/drives"} <= set(rules)


def test_what_programs_keep_lies_where_every_manifest_lets_them_write() -> None:
    text = (DEPLOY / "Dockerfile").read_text()
    for variable in ("NUMBA_CACHE_DIR", "MPLCONFIGDIR"):
        assert f"{variable}=/tmp/" in text
    services = [yaml.safe_load((DEPLOY / name).read_text())["x-gnd"] for name in ("compose.yaml", "compose.cloud.yaml")]
    assert all(one["tmpfs"][0].startswith("/tmp:") for one in services)
    for name in ("router", "tiles", "shard"):
        assert "mountPath: /tmp}" in (DEPLOY / "kubernetes" / "base" / f"{name}.yaml").read_text()


def test_the_image_holds_every_folder_and_no_root() -> None:
    text = (DEPLOY / "Dockerfile").read_text()
    for folder in (DEPLOY.parent / "src" / "gnd").iterdir():
        if folder.is_symlink():
            assert f"COPY {folder.name} {folder.name}\n" in text
    assert re.search(r"^USER 10001", text, re.M)
    assert "--require-hashes" in text
    assert "SETUPTOOLS_SCM_PRETEND_VERSION_FOR_GND_FLEET=${VERSION}" in text, "there is no git in the image"
    assert "--build-arg VERSION=" in (DEPLOY.parent / "Makefile").read_text()
