"""`gnd regions`: several stores that share a map, and districts that move between them."""

import json
import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, Final

import click
from rich.console import Console
from rich.table import Table

from gnd.gnd_map.errors import TileError
from gnd.gnd_map.tile_id import District
from gnd.tile_store.borders import carry
from gnd.tile_store.borders import count as count_border_rows
from gnd.tile_store.copy_cli import end_of
from gnd.tile_store.copying.copy import closing
from gnd.tile_store.copying.district import MovedDistrict, abandon_district, move_district, state_at
from gnd.tile_store.copying.ends import End
from gnd.tile_store.districts import WRITTEN, number_of
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, open_store, shown
from gnd.tile_store.options import bars, json_option, show, to_read

CARRY_EVERY_S: Final = 0.5
"""What waits at borders is looked for so often."""


class _DistrictType(click.ParamType):  # type: ignore[type-arg]  # generic only in newer releases
    name = "district"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> District:
        try:
            return value if isinstance(value, District) else District(str(value))
        except TileError as error:
            self.fail(str(error), param, ctx)


@click.group(short_help="Stores that share a map: whose districts are, and moving them.")
def regions() -> None:
    """Several stores share a map, each with its own shards and tile servers: whose a district is, and moving it."""


@regions.command("create", short_help="Make a store that owns what is moved to it.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("name", metavar="NAME")
@json_option
def create(path: StoreLocation, name: str, as_json: bool) -> None:
    """Make STORE, a file or a PostgreSQL URL, the store of a region called NAME.

    It owns no district until one is moved to it, so its shards and tile servers can run beside those of other stores.
    A store that has tiles keeps what it has; then only its region gets the name.
    """
    if not name.isidentifier():
        raise click.BadParameter("a word of letters, digits and _, please", param_hint="NAME")
    with open_store(path) as store:
        is_empty = not store.layers()
        owners = store.district_owners()
        rest = "moved" if is_empty and not owners.are_several else owners.rest
        store.set_region(name, rest)
    with closing(end := end_of(path, is_target=False)), end.transaction(alone=True):
        end.guard()
    owns = "owns every district that it has not given away" if rest == "owned" else "owns what is moved to it"
    told = {"store": shown(path), "region": name, "rest": rest}
    show(told, as_json, lambda console: console.print(f"{shown(path)}: region {name}, {owns}", highlight=False))


@regions.command("list", short_help="Which store owns which districts.")
@click.argument("paths", metavar="STORE...", nargs=-1, required=True, type=LOCATION)
@json_option
def list_(paths: tuple[StoreLocation, ...], as_json: bool) -> None:
    """What each STORE says of its districts: those that were moved, and whether all others are its own."""
    told = [_told(path) for path in paths]
    show({"stores": told}, as_json, lambda console: _print(console, told))


@regions.command("show", short_help="A district in a store.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("district", metavar="DISTRICT", type=_DistrictType())
@json_option
def show_(path: StoreLocation, district: District, as_json: bool) -> None:
    """What STORE holds of DISTRICT (13033/03021/23031), and what it says of it."""
    with to_read(path) as store:
        owners = store.district_owners()
        row = owners.by_path.get(district.path)
        told = {
            "store": shown(path),
            "district": district.path,
            "state": owners.state(district),
            "other": "" if row is None else row.other,
            "epoch": 0 if row is None else row.epoch,
            "tiles": {layer: len(store.heads(layer, district.path)) for layer in store.layers()},
        }
    show(told, as_json, lambda console: console.print_json(json.dumps(told)))


@regions.command("move", short_help="Move districts to another store while vehicles drive there.")
@click.argument("districts", metavar="DISTRICT...", nargs=-1, type=_DistrictType())
@click.option("--from", "source", required=True, type=LOCATION, help="The store that has them.")
@click.option("--to", "target", required=True, type=LOCATION, help="The store that gets them.")
@click.option("--all", "are_all", is_flag=True, help="All districts that the store owns and has tiles of.")
@click.option("--dry-run", is_flag=True, help="Say what would move, and change nothing.")
@click.option("--abandon", "is_abandoned", is_flag=True, help="Forget a move that was begun and has not switched.")
@json_option
def move(
    districts: tuple[District, ...],
    source: StoreLocation,
    target: StoreLocation,
    are_all: bool,
    dry_run: bool,
    is_abandoned: bool,
    as_json: bool,
) -> None:
    """Move DISTRICT... (13033/03021/23031) from one store to another, one after the other. Shards may go on writing.

    A district's rows are copied, then what has changed meanwhile. Then the old store refuses reports about it for a
    moment, the rest is copied, and the other store has it: its shards and tile servers answer from then on. At last
    both are compared, and the old store removes its rows.

    After Ctrl-C or a crash the same command goes on where it was. Where it failed, vehicles are told to try again until
    it goes on, or until --abandon.
    """
    if bool(districts) == are_all:
        raise click.UsageError("name districts, or --all of them")
    wanted = _all_of(source) if are_all else districts
    here = end_of(source, is_target=False)
    with closing(here):
        there = end_of(target, is_target=False)
        with closing(there):
            if here.location == there.location:
                raise StoreError(f"{shown(source)}: is both ends")
            if dry_run:
                rows = [_planned(here, there, one) for one in wanted]
            elif is_abandoned:
                rows = [{"path": one.path, "abandoned": abandon_district(here, there, one)} for one in wanted]
            else:
                with bars() as progress:
                    rows = [asdict(move_district(here, there, one, progress)) for one in wanted]
    told = {"from": shown(source), "to": shown(target), "districts": rows}
    show(told, as_json, lambda console: _print_moved(console, told))


@regions.command("relay", short_help="Carry what features near a border say to the other store.")
@click.argument("paths", metavar="STORE...", nargs=-1, required=True, type=LOCATION)
@click.option("--once", is_flag=True, help="Carry what waits, and end.")
def relay(paths: tuple[StoreLocation, ...], once: bool) -> None:
    """Carry reports about features near the border of a district to the STORE that owns the other side, until Ctrl-C.

    Give all stores of the map. What waits is kept in the store that received it, so this may be stopped at any time.
    """
    with ExitStack() as stack:
        stores = [stack.enter_context(open_store(path, create=False)) for path in paths]
        while True:
            done = carry(stores)
            if once and not done:
                break
            if not done:
                time.sleep(CARRY_EVERY_S)
        left = sum(len(store.border_rows(1)) for store in stores)
    click.echo("some wait for a district that none of these stores owns" if left else "nothing waits")


def _all_of(location: StoreLocation) -> Iterable[District]:
    with to_read(location) as store:
        owners = store.district_owners()
        unfinished = [District(one.path) for one in owners.by_path.values() if one.path and one.state == "leaving"]
        return sorted({*unfinished, *(one for one in store.districts() if owners.takes(one))}, key=lambda one: one.path)


def _planned(here: End, there: End, district: District) -> dict[str, Any]:
    count = "SELECT COUNT(*) FROM {} WHERE {}"
    state, state_there = state_at(here, district), state_at(there, district)
    return {
        "path": district.path,
        "state": state,
        "state_there": state_there,
        "moves": state in (*WRITTEN, "leaving") and state_there in ("moved", "arriving"),
        "tiles": here.run(count.format("tile_head", here.in_district("tile_head", district)))[0][0],
        "reports": here.run(count.format("report", here.in_district("report", district)))[0][0],
        "uploads": here.run(count.format("upload", here.in_district("upload", district)))[0][0],
    }


def _told(path: StoreLocation) -> dict[str, Any]:
    with to_read(path) as store:
        owners = store.district_owners()
        held = {number_of(one) for one in store.districts()}
        at_borders = store.look(count_border_rows)
    return {
        "store": shown(path),
        "region": owners.region,
        "rest": owners.rest,
        "districts_with_tiles": len(held),
        "rows_to_carry": at_borders,
        "districts": [asdict(one) | {"has_tiles": one.number in held} for one in owners.by_path.values() if one.path],
    }


def _print(console: Console, stores: list[dict[str, Any]]) -> None:
    for one in stores:
        rest = "all others are its own" if one["rest"] == "owned" else "no other is its own"
        table = Table("district", "", "region", "other store", "since", title=f"{one['store']}: region {one['region']}")
        table.add_column("moves", justify="right")
        for row in one["districts"]:
            since = f"{datetime.fromtimestamp(row['since_ns'] / 1e9, UTC):%Y-%m-%d %H:%M:%S}"
            table.add_row(row["path"], row["state"], row["region"], row["other"], since, str(row["epoch"]))
        console.print(table)
        waits = f"; {one['rows_to_carry']} rows wait for `gnd regions relay`" if one["rows_to_carry"] else ""
        console.print(f"{one['districts_with_tiles']} districts with tiles; {rest}{waits}")


def _print_moved(console: Console, told: dict[str, Any]) -> None:
    for row in told["districts"]:
        console.print(_line(row), highlight=False, soft_wrap=True)


def _line(row: dict[str, Any]) -> str:
    name = f"district {row['path']}"
    if "abandoned" in row:
        return f"{name}: {'stays where it is' if row['abandoned'] else 'no move of it was begun'}"
    if "moves" in row:
        does = "would move" if row["moves"] else f"does not move (here {row['state']}, there {row['state_there']})"
        return f"{name}: {row['tiles']} tiles, {row['reports']} reports, {row['uploads']} uploads; {does}"
    one = MovedDistrict(**row)
    gap = f"writes were refused for {one.gap_s:.2f} s" if one.gap_s else "it had moved before"
    same = f"; the same in both (sha256 {one.digest[:16]}…)" if one.digest else ""
    copied = f"{one.rows} rows copied, {one.changes} changes in {one.rounds} rounds"
    return f"{name}: {one.tiles} tiles, {copied}; {gap}{same}"
