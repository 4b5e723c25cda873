"""`gnd doctor`: looks at all that programs need, and says what to do."""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import click

from gnd.deploy.doctor.finding import Finding, State, worst
from gnd.fleet_bus.identity.names import identity_of_environment
from gnd.fleet_bus.identity.options import identity_option
from gnd.fleet_bus.settings_file import read_toml
from gnd.gnd_map.errors import ConfigError
from gnd.tile_store.location import LOCATION, StoreLocation

PATH = click.Path(path_type=Path)
FAULT: Final = 1
"""Exit code where something will not work."""
_COLOURS: Final[dict[State, str]] = {"ok": "green", "warning": "yellow", "fault": "red"}


@click.command()
@click.option("--connect", multiple=True, help="Router to try, tcp/host:port or tls/host:port; repeatable.")
@click.option(
    "--config", "config_file", type=PATH, help="Settings of an agent or a shard (TOML): its routers are tried."
)
@click.option("--listen", multiple=True, help="Endpoint that a router of yours is to open here; repeatable.")
@click.option("--metrics", "pages", multiple=True, help="Pages of a part, http://host:port; repeatable.")
@click.option("--store", "stores", type=LOCATION, multiple=True, help="Store to look at; repeatable.")
@click.option("--folder", type=PATH, default=Path(), help="Where runs and stores are written.  [default: here]")
@click.option("--strict", is_flag=True, help="Warnings count as faults.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of lines.")
@identity_option
@click.pass_context
def doctor(
    context: click.Context,
    connect: tuple[str, ...],
    config_file: Path | None,
    listen: tuple[str, ...],
    pages: tuple[str, ...],
    stores: tuple[StoreLocation, ...],
    folder: Path,
    strict: bool,
    as_json: bool,
) -> None:
    """Look at what programs need: Python, libraries, cores, memory, disk, ports, clock, certificates, router, store.

    Each line is ok, a warning or a fault, and says what to do. Nothing is changed. The exit code is 1 if there is a
    fault (with --strict also a warning), else 0; 2 if the command line is wrong.
    """
    routers = (*connect, *_routers_of(config_file))
    found = []
    for one in _looked_at(routers, listen, pages, stores, folder):
        found.append(one)
        if not as_json:
            _print(one)
    state = worst(found)
    if as_json:
        told = {"state": state, "findings": [one.as_dict() for one in found]}
        click.echo(json.dumps(told, indent=1, ensure_ascii=False))
    else:
        counts = Counter(one.state for one in found)
        click.echo(f"{counts['ok']} ok, {counts['warning']} warnings, {counts['fault']} faults")
    if state == "fault" or (strict and state == "warning"):
        context.exit(FAULT)


def _looked_at(
    routers: tuple[str, ...],
    listen: tuple[str, ...],
    pages: tuple[str, ...],
    stores: tuple[StoreLocation, ...],
    folder: Path,
) -> Iterator[Finding]:
    from gnd.deploy.doctor.cloud import cloud
    from gnd.deploy.doctor.machine import machine
    from gnd.deploy.doctor.programs import programs
    from gnd.deploy.doctor.stores import store

    yield from programs()
    yield from machine(folder, listen)
    yield from cloud(routers, identity_of_environment(), pages)
    for one in stores:
        yield from store(one)


def _routers_of(file: Path | None) -> tuple[str, ...]:
    """The routers that a file of settings names.

    Raises:
        ConfigError: it cannot be read, or names none.
    """
    if file is None:
        return ()
    told = read_toml(file).get("connect")
    if not isinstance(told, list) or not all(isinstance(one, str) for one in told) or not told:
        raise ConfigError(f'{file} names no routers: connect = ["tcp/host:7447"]')
    return tuple(told)


def _print(one: Finding) -> None:
    state = click.style(f"{one.state:7}", fg=_COLOURS[one.state])
    click.echo(f"{state}  {one.what}: {one.says}")
    if one.do:
        click.echo(f"         {'→'} {one.do}")
