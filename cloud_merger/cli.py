"""`gnd merger`: one merger shard alone."""

import logging
import signal
import threading
import tomllib
from pathlib import Path
from typing import Any

import click

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.merger import run_shard
from gnd.fleet_bus.health_options import metrics_options


@click.command()
@click.option("--id", "shard_id", help="Name of this shard; each running shard needs its own.  [default: merger-1]")
@click.option("--store", "store_path", help="File of the store that the shards share.  [default: map.sqlite]")
@click.option("--connect", multiple=True, help="Endpoint of a router, tcp/host:port; may be repeated.")
@click.option("--mode", type=click.Choice(["default", "paper"]), help="How votes are counted.  [default: default]")
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="TOML file; options go before it.")
@metrics_options
def merger(
    shard_id: str | None,
    store_path: str | None,
    connect: tuple[str, ...],
    mode: str | None,
    config_path: Path | None,
    metrics_port: int | None,
    metrics_host: str,
) -> None:
    """Run one merger shard: takes reports, merges tiles, publishes versions. Ctrl-C ends it cleanly."""
    options = {"shard_id": shard_id, "store_path": store_path, "connect": list(connect) or None}
    config = read_config(config_path, {name: value for name, value in options.items() if value is not None}, mode)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    click.echo(f"merger {config.shard_id}: store {config.store_path}, mode {config.merge.mode}", err=True)
    run_shard(config, stop, None if metrics_port is None else (metrics_host, metrics_port))


def read_config(path: Path | None, options: dict[str, Any], mode: str | None = None) -> ShardConfig:
    """The configuration of a TOML file (None: the defaults) with `options` put over it.

    Raises:
        MergerError: the file cannot be read.
        ConfigError: an unknown key or a wrong value.
    """
    mapping = {**({} if path is None else _read_toml(path)), **options}
    if mode is not None:
        mapping["merge"] = {**mapping.get("merge", {}), "mode": mode}
    return ShardConfig.from_mapping(mapping)


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise MergerError(f"cannot read the configuration {path}: {error}") from error
