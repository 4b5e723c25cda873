"""`gnd map publish` and `gnd map fetch`: a region as a static archive, and a store from one."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from gnd.deploy.archive_fetch import ArchiveFetcher
from gnd.fleet_bus.identity.names import identity_of_environment
from gnd.fleet_bus.identity.options import identity_option
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.region import Region, parse_region
from gnd.tile_client.archive import Archive
from gnd.tile_client.archive_check import SEEN_FILE, SeenStates
from gnd.tile_store import tables
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, file_of, open_store, shown
from gnd.tile_store.objects import open_objects
from gnd.tile_store.options import bars, json_option, show, to_read
from gnd.tile_store.publishing import PRUNED_AFTER_S, check_whole_districts
from gnd.tile_store.publishing import prune as prune_archive
from gnd.tile_store.publishing import publish as publish_archive
from gnd.tile_store.regions import morton_range
from gnd.tile_store.signing import Signing

_LAYERS_HELP = "Layer of the map; repeatable.  [default: all]"


@click.command(short_help="Write the map as a static archive for any web server.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.option("--out", "-o", required=True, help="A folder, or s3://BUCKET/PREFIX (keys come from AWS_… variables).")
@click.option("--region", "regions", multiple=True, help="Leading part of tile paths, whole districts; repeatable.")
@click.option("--layer", "layers", multiple=True, help=_LAYERS_HELP)
@click.option("--prune", is_flag=True, help=f"Then remove packs that no index has named for {PRUNED_AFTER_S:.0f} s.")
@json_option
@identity_option
def publish(
    path: StoreLocation, out: str, regions: tuple[str, ...], layers: tuple[str, ...], prune: bool, as_json: bool
) -> None:
    """Write the released versions of STORE as an archive that clients read with HTTP alone: `gnd map fetch`, and
    vehicles with --tiles-from.

    What is published already is not written again. Each district is switched as a whole; who is interrupted runs the
    same command again. Nothing is removed without --prune. Ends with 1 where a tile cannot be read; what was published
    of it stays.

    With --identity, of a shard or an operator, the archive is signed, with the time of now each time: clients with an
    identity take no other one. One that is signed stays so.
    """
    for region in regions:
        check_whole_districts(region)
    objects, signing = open_objects(out), Signing.of_environment()
    with to_read(path) as store, bars() as progress:
        done = publish_archive(store, objects, layers or store.layers(), regions or ("",), progress, signing)
    values: dict[str, Any] = asdict(done)
    if prune:
        values |= {f"pruned_{name}": n for name, n in asdict(prune_archive(objects)).items()}
    show(values, as_json, lambda console: _print(console, f"{objects.location}: published", values, "damaged"))
    if done.damaged:
        raise SystemExit(1)


@click.command(short_help="A store from an archive on a web server.")
@click.argument("url")
@click.option("--store", "-o", "path", required=True, type=LOCATION, help="The store; it is made when missing.")
@click.option("--region", "--tiles", "regions", multiple=True, help="As 13033/03021, a tile, or lat,lon,radius.")
@click.option("--layer", "layers", multiple=True, help=_LAYERS_HELP)
@click.option(
    "--not-older-than",
    "hours",
    type=click.FloatRange(min=0, min_open=True),
    metavar="HOURS",
    help="Refuse an archive that was signed longer ago (with --identity): an old mirror.",
)
@json_option
@identity_option
def fetch(
    url: str,
    path: StoreLocation,
    regions: tuple[str, ...],
    layers: tuple[str, ...],
    hours: float | None,
    as_json: bool,
) -> None:
    """Fill a store from the archive at URL, or bring it up to date: only what differs is read.

    Versions keep their numbers, and their signatures where --identity says whose authority is believed; without it
    nobody looks at signatures. With it the archive must be signed, too, and be no older state than was seen. What is
    wrong, or older than what is here, is named and left, and the command ends with 1. What has come stays: who is
    interrupted runs the same command again.
    """
    folder = identity_of_environment()
    if hours is not None and folder is None:
        raise click.UsageError("--not-older-than needs --identity: without one nobody looks at who has signed when")
    seen = SeenStates(None if folder is None else folder / SEEN_FILE)
    ledger = Ledger("fetch")
    with Archive(url, ledger) as archive:
        publishers = None if folder is None else Publishers(folder, archive.fetch_certificate)
        places = [_region(text) for text in regions] or [Region("")]
        archive.root()  # where there is none, no store is made
        _check_folder(path)
        with open_store(path) as store, bars() as progress:
            fetcher = ArchiveFetcher(archive, store, publishers, seen, None if hours is None else 3600 * hours)
            for place in places:
                fetcher.fetch(layers, place, progress)
    down = [line for line in ledger.totals() if line.direction == "down"]
    values = asdict(fetcher.done) | {
        "requests": sum(line.messages for line in down),
        "bytes": sum(line.app_bytes for line in down),
    }
    show(values, as_json, lambda console: _print(console, f"{shown(path)}: from {archive.url}", values, "wrong"))
    if fetcher.done.wrong:
        raise SystemExit(1)


def _region(text: str) -> Region:
    try:
        morton_range(text)
    except StoreError:
        return parse_region(text)
    return Region(text.rstrip("/"))


def _check_folder(path: StoreLocation) -> None:
    file = file_of(path)
    if file is not None and not Path(file).parent.is_dir():
        raise StoreError(f"{file}: the folder {file.parent} does not exist")


def _print(console: Console, title: str, values: dict[str, Any], named: str) -> None:
    wrong: dict[str, str] = values[named]
    console.print(tables.fields(title, values | {named: len(wrong)}))
    for place, why in list(wrong.items())[:20]:
        console.print(f"{place}: {why}", highlight=False, soft_wrap=True)
