"""`gnd shards`: who merges a map, how many districts each has, and how old its queue is."""

from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from gnd.cloud_merger.ownership import owner_of, shared_out
from gnd.gnd_map.tile_id import District
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import json_option, show, to_read
from gnd.tile_store.store import Store
from gnd.tile_store.values import DirtyTile, ShardSeen


@click.command(short_help="Who merges a map: shards, their districts, the age of their queues.")
@click.argument("path", metavar="STORE", type=LOCATION)
@json_option
def shards(path: StoreLocation, as_json: bool) -> None:
    """The merger shards of STORE: who lives, how many districts of the map each answers for, what waits there.

    What waits is merged by whoever has time; districts say who receives reports, and whose merges come first.
    """
    with to_read(path) as store:
        values = shards_of(store)
    show(values, as_json, lambda console: _print(console, shown(path), values))


def shards_of(store: Store) -> dict[str, Any]:
    """The shards of a store with their districts and queues, in plain values.

    Returns:
        "shards": by name, each with its districts, tiles to merge there, report parts that wait, and for how long the
        oldest tile has been ready, s; "districts": of the map; "largest_share": against the mean, None without shards.
    """
    seen, districts, queue = store.shards(), store.districts(), store.dirty_tiles()
    living = {shard.owner for shard in seen if shard.is_alive}
    owners = shared_out(districts, living) if living else {}
    rows = [_row(shard, owners, [one for one in queue if _owner(one, owners, living) == shard.owner]) for shard in seen]
    largest = max((row["districts"] for row in rows), default=0)
    return {
        "shards": rows,
        "districts": len(districts),
        "largest_share": largest * len(living) / len(districts) if living and districts else None,
        "waiting_tiles": len(queue),
    }


def _owner(waiting: DirtyTile, owners: dict[District, str], living: set[str]) -> str:
    """Who answers for the district of a tile; "" where nobody lives."""
    district = waiting.tile.district
    return owners.get(district) or (owner_of(district, living) if living else "")


def _row(shard: ShardSeen, owners: dict[District, str], waiting: list[DirtyTile]) -> dict[str, Any]:
    return asdict(shard) | {
        "is_alive": shard.is_alive,
        "districts": sum(owner == shard.owner for owner in owners.values()),
        "tiles_to_merge": len(waiting),
        "report_parts": sum(one.reports for one in waiting),
        "overdue_s": max((one.overdue_s for one in waiting), default=0.0),
    }


def _print(console: Console, title: str, values: dict[str, Any]) -> None:
    table = Table("shard", "since", "", title=f"shards of {title}")
    for heading in ("districts", "tiles to merge", "report parts", "oldest ready for, s"):
        table.add_column(heading, justify="right")
    for one in values["shards"]:
        since = f"{datetime.fromtimestamp(one['since_ns'] / 1e9, UTC):%Y-%m-%d %H:%M:%S}"
        counts = (one["districts"], one["tiles_to_merge"], one["report_parts"])
        state = "alive" if one["is_alive"] else "silent"
        table.add_row(one["owner"], since, state, *map(str, counts), f"{one['overdue_s']:.1f}")
    console.print(table)
    if values["largest_share"] is None:
        console.print(f"{values['districts']} districts, {values['waiting_tiles']} tiles to merge, no shard lives")
        return
    console.print(f"{values['districts']} districts; the largest share is {values['largest_share']:.2f} of the mean")
