"""`gnd merger`: one merger shard alone."""

import logging
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import get_args

import click

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.merger import run_shard
from gnd.cloud_merger.statements import Mode
from gnd.ending import orderly
from gnd.extras import need_shard
from gnd.fleet_bus.health_options import metrics_options
from gnd.fleet_bus.identity.options import identity_option
from gnd.fleet_bus.settings_file import load_settings
from gnd.fleet_bus.settings_options import settings_options
from gnd.gnd_map.settings import settings_text
from gnd.tile_store.location import shown
from gnd.tile_store.moving import run_following
from gnd.tile_store.options import wait_option
from gnd.tile_store.waiting import wait_for_store


@click.command()
@click.option("--id", "shard_id", help="Name of this shard; each running shard needs its own.  [default: merger-1]")
@click.option(
    "--store", "store_path", help="The store that the shards share, a file or a PostgreSQL URL.  [default: map.sqlite]"
)
@click.option("--connect", multiple=True, help="Endpoint of a router, tcp/host:port; may be repeated.")
@click.option("--follow", is_flag=True, help="When the store moves (`gnd store copy`), go on with the new one.")
@wait_option
@click.option("--mode", type=click.Choice(get_args(Mode)), help="How votes are counted.  [default: default]")
@settings_options
@metrics_options
@identity_option
def merger(
    shard_id: str | None,
    store_path: str | None,
    connect: tuple[str, ...],
    follow: bool,
    wait_s: float,
    mode: str | None,
    config_file: Path | None,
    changes: tuple[str, ...],
    dump_config: bool,
    metrics_port: int | None,
    metrics_host: str,
) -> None:
    """Run one merger shard: takes reports, merges tiles, publishes versions. Ctrl-C ends it cleanly."""
    options = {
        "shard_id": shard_id,
        "store_path": store_path,
        "connect": list(connect) or None,
        "merge": {"mode": mode},
    }
    config = load_settings(ShardConfig, "merger", config_file, changes, options)
    if dump_config:
        click.echo(settings_text(config), nl=False)
        return
    need_shard()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    click.echo(f"merger {config.shard_id}: store {shown(config.store_path)}, mode {config.merge.mode}", err=True)
    metrics_at = None if metrics_port is None else (metrics_host, metrics_port)
    wait_for_store(config.store_path, wait_s, stop)
    with orderly():
        if follow:
            run_following(
                config.store_path, lambda at, ended: run_shard(replace(config, store_path=at), ended, metrics_at), stop
            )
        elif not stop.is_set():
            run_shard(config, stop, metrics_at)
