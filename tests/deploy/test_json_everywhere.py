"""Every command that prints results prints them as JSON, too."""

import json
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from gnd.deploy.cli import gnd
from gnd.tile_store.sqlite_store import SqliteStore

WITHOUT = {
    "agent": "a vehicle; its results are in result.json",
    "completion": "a script for a shell",
    "merger": "runs until it is told to end",
    "play": "publishes until it is told to end",
    "regions relay": "runs until it is told to end",
    "router": "runs until it is told to end",
    "serve": "runs until it is told to end",
    "store": "runs until it is told to end",
    "view": "opens a viewer",
}


def commands(command: click.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    """Every command by its words."""
    context = click.Context(command)
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            yield from commands(found, (*path, name))
        if not command.invoke_without_command:
            return
    yield " ".join(path), command


@pytest.mark.slow
def test_every_command_has_json_or_a_reason_why_not() -> None:
    found = dict(commands(gnd))
    assert len(found) > 90
    options = {name: {word for one in command.params for word in one.opts} for name, command in found.items()}
    assert {name for name, words in options.items() if "--json" not in words} == set(WITHOUT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("json")
    for name in ("map", "other", "east"):
        SqliteStore(made / f"{name}.sqlite").close()
    (made / "fleet.toml").write_text("agents = 2\n")
    return made


LINES = """\
certs init
certs router r --host 127.0.0.1
certs operator anna
certs vehicle v-1
certs publish --to router.r
certs pseudonyms v-2 --count 2
certs whose v-2 --all
certs check operator.anna
certs renew operator.anna
certs revoke vehicle.v-1
certs list
config show fleet
config check fleet fleet.toml
config alerts
config alerts --rules
sim world write w.json --length 100
sim world inspect w.json
sim world features w.json layers.json
vehicles quarantine map.sqlite v-9 --why lies
vehicles list map.sqlite
vehicles why map.sqlite v-9
vehicles release map.sqlite v-9
map status map.sqlite
map check map.sqlite
map gc map.sqlite --keep-days 3
map quarantine map.sqlite
map retry map.sqlite
map backup map.sqlite copy.gnd
map restore copy.gnd again.sqlite
map verify map.sqlite
regions create east.sqlite east
regions list map.sqlite east.sqlite
release list map.sqlite
shards map.sqlite
status map.sqlite
features list map.sqlite
doctor
kernels status
"""


def test_what_commands_print_for_programs_can_be_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    for line in LINES.splitlines():
        done = CliRunner().invoke(gnd, [*line.split(), "--json"], catch_exceptions=False)
        assert done.exit_code in (0, 1), f"{line}: {done.output}"
        assert isinstance(json.loads(done.stdout), dict | list), line
