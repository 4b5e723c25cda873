"""`gnd store` and `gnd map`: thin commands over the library."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from types import FrameType

import click
from prometheus_client import CollectorRegistry

from gnd.ending import orderly
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.certificate_metrics import certificate_checks, register_certificate
from gnd.fleet_bus.config import DEFAULT_ENDPOINT, BusConfig
from gnd.fleet_bus.health import HealthServer
from gnd.fleet_bus.health_options import metrics_options
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.fleet_bus.identity.options import identity_option
from gnd.fleet_bus.router import wait_for_stop
from gnd.fleet_bus.settings_file import load_settings
from gnd.fleet_bus.settings_options import settings_options
from gnd.gnd_map.settings import check_settings, setting, settings_text
from gnd.schemas.feature_layer import LayerParameters, checked_layers
from gnd.tile_store import tables, upkeep_cli
from gnd.tile_store.arguments import parse_tile
from gnd.tile_store.bodies_cli import bodies
from gnd.tile_store.compare import layer_info, layer_totals
from gnd.tile_store.copy_cli import copy
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, file_of, open_store, shown
from gnd.tile_store.metrics import StoreCollector, store_checks
from gnd.tile_store.moving import run_following
from gnd.tile_store.options import PATH, existing, json_option, layer_option, region_option, show, to_read, wait_option
from gnd.tile_store.server import TileServer
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.tile_store.status import status
from gnd.tile_store.survey_cli import survey
from gnd.tile_store.waiting import wait_for_store

__all__ = ["PATH", "json_option", "layer_option", "map_group", "region_option", "show", "store", "store_to_fill"]


@dataclass(frozen=True, slots=True)
class TileServerConfig:
    """The tile server."""

    path: str | Path = setting(..., "The store, a file or a PostgreSQL URL; `gnd map build` makes one.")
    connect: tuple[str, ...] = setting((DEFAULT_ENDPOINT,), "Endpoints of routers, tried in order.")
    workers: int = setting(4, "Threads that answer.", least=1, most=64)

    feature_layer: tuple[LayerParameters, ...] = setting(
        (),
        "Feature layers, as agents and shards read them: checked here, so that one file serves all. The server answers"
        " for every layer that its store holds.",
    )

    def __post_init__(self) -> None:
        check_settings(self, StoreError)
        checked_layers(self.feature_layer)


@click.group(invoke_without_command=True)
@click.option("--path", type=LOCATION, help="The store, a file or a PostgreSQL URL; `gnd map build` makes one.")
@click.option("--connect", multiple=True, help=f"Endpoint of a router; repeatable.  [default: {DEFAULT_ENDPOINT}]")
@click.option("--follow", is_flag=True, help="When the store moves (`gnd store copy`), go on with the new one.")
@wait_option
@click.option("--workers", type=int, help="Threads that answer, 1 to 64.  [default: 4]")
@settings_options
@metrics_options
@identity_option
@click.pass_context
def store(
    context: click.Context,
    path: StoreLocation | None,
    connect: tuple[str, ...],
    follow: bool,
    wait_s: float,
    workers: int | None,
    config_file: Path | None,
    changes: tuple[str, ...],
    dump_config: bool,
    metrics_port: int | None,
    metrics_host: str,
) -> None:
    """Run the tile server until Ctrl-C: it answers the vehicles' tile and catalog queries."""
    if context.invoked_subcommand is not None:
        return
    options = {"path": None if path is None else str(path), "connect": list(connect) or None, "workers": workers}
    server = load_settings(TileServerConfig, "store", config_file, changes, options)
    if dump_config:
        click.echo(settings_text(server), nl=False)
        return
    stop = threading.Event()

    def end(_signal: int, _frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    metrics_at = None if metrics_port is None else (metrics_host, metrics_port)

    def serve(location: StoreLocation, ended: threading.Event) -> None:
        _serve(replace(server, path=location), metrics_at, ended)

    wait_for_store(server.path, wait_s, stop)
    with orderly():
        if follow:
            run_following(server.path, serve, stop)
        elif not stop.is_set():
            serve(server.path, stop)
    click.echo("tile server ended")


def _serve(server: TileServerConfig, metrics_at: tuple[str, int] | None, stop: threading.Event) -> None:
    """Answer from a store until the event is set."""
    config = BusConfig(connect=server.connect, patient=True)
    with (
        existing(server.path) as opened,
        open_bus(config, name="store") as bus,
        TileServer(opened, bus, workers=server.workers),
        ExitStack() as stack,
    ):
        follow_revoked(bus)
        if metrics_at is not None:
            registry = CollectorRegistry()
            registry.register(StoreCollector(opened))
            register_certificate(registry, bus.certificate)
            checks = {**store_checks(opened, bus), **certificate_checks(bus.certificate)}
            stack.enter_context(HealthServer(metrics_at[1], registry, checks, host=metrics_at[0]))
        counts = opened.counts()
        click.echo(
            f"tile server: {counts.tiles} tiles of {opened.location} at {', '.join(server.connect)}; Ctrl-C ends it"
        )
        wait_for_stop(stop)


store.add_command(copy)


@click.group(name="map")
def map_group() -> None:
    """Inspect, compare, export and roll back maps; `gnd map build` is in `deploy.map_cli`, above the segmentation."""


for _command in (status, survey, bodies, *upkeep_cli.COMMANDS):
    map_group.add_command(_command)


@map_group.command(short_help="What a store holds, in numbers.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.option("--deep", is_flag=True, help="Decode every tile: Gaussians, features, heights.")
@region_option
@layer_option
@json_option
def info(path: StoreLocation, deep: bool, region: str, layer: str, as_json: bool) -> None:
    """What STORE holds: its newest versions in numbers, its queue and its quarantine."""
    with to_read(path) as opened:
        totals = (layer_info if deep else layer_totals)(opened, layer=layer, prefix=region)
        values = {"layers": opened.layers()} | totals.as_dict()
        values["store"] = asdict(opened.counts())
    show(values, as_json, lambda console: console.print(tables.info(shown(path), values)))


@map_group.command(short_help="A tile's versions and their reports.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("tile")
@layer_option
@json_option
def history(path: StoreLocation, tile: str, layer: str, as_json: bool) -> None:
    """The versions of TILE (path, number, or lat,lon in degrees), and the reports that each comes from."""
    tile_id = parse_tile(tile)
    with to_read(path) as opened:
        lines = opened.history(layer, tile_id)
        if not lines:
            raise StoreError(f"tile {tile_id.path} of layer {layer} is not in {shown(path)}")
        rows = [
            asdict(line) | {"sha": line.sha.hex(), "reports": opened.provenance(layer, tile_id, line.version)}
            for line in lines
        ]
    values = {"layer": layer, "tile": tile_id.path, "morton": tile_id.morton, "versions": rows}
    show(values, as_json, lambda console: console.print(tables.history(values)))


@map_group.command(short_help="The messages that were refused, and why.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.option("--save", type=PATH, help="Write the refused bytes into this folder, a file each.")
@json_option
def quarantine(path: StoreLocation, save: Path | None, as_json: bool) -> None:
    """The messages that were refused, and why."""
    with to_read(path) as opened:
        found = opened.quarantined()
    rows = [
        {"received_ns": one.received_ns, "times": one.times, "bytes": len(one.body), "source": one.source}
        | {"reason": one.reason, "sha256": sha256(one.body).hexdigest()}
        for one in found
    ]
    if save is not None:
        _save({f"{row['sha256']}.bin": one.body for row, one in zip(rows, found, strict=True)}, save)
    show({"quarantined": rows}, as_json, lambda console: console.print(tables.quarantine(rows)))


def _save(files: dict[str, bytes], folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
        for name, body in files.items():
            (folder / name).write_bytes(body)
    except OSError as error:
        raise StoreError(f"{folder}: cannot write: {error.strerror}") from None


@contextmanager
def store_to_fill(location: StoreLocation) -> Iterator[SqlStore]:
    """The store at a location, to publish in; a new file gets its name only when it is filled."""
    path, signing = file_of(location), Signing.of_environment()
    if path is None or path.exists():
        with open_store(location, signing=signing) as opened:
            yield opened
        return
    if not path.parent.is_dir():
        raise StoreError(f"{path}: the folder {path.parent} does not exist")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with SqliteStore(partial, signing=signing) as opened:
            yield opened
        partial.rename(path)
    finally:
        for suffix in ("", "-wal", "-shm"):
            partial.with_name(partial.name + suffix).unlink(missing_ok=True)
