"""`gnd map bodies`: where the bodies of a store's versions lie."""

from dataclasses import asdict
from typing import Any

import click

from gnd.tile_store import tables
from gnd.tile_store.bodies import bodies_at, collect, move_back, move_out, place_of_bodies
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import existing, json_option, show


@click.command(short_help="Keep bodies of tiles in a bucket, or take them back.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.option("--to", "place", help="Move them to s3://BUCKET/PREFIX, or a folder that all hosts share.")
@click.option("--back", is_flag=True, help="Take them into the database again.")
@click.option("--collect", "is_collecting", is_flag=True, help="Remove those that no version names any more.")
@json_option
def bodies(path: StoreLocation, place: str | None, back: bool, is_collecting: bool, as_json: bool) -> None:
    """Say where the bodies of STORE's versions lie, or move them; the database keeps versions, heads and journal.

    The cloud may be running: what was started before goes on writing into the database until it is started again, and
    reads from both. Who is interrupted runs the same command again. A place that creates an object twice is refused.
    """
    if sum((place is not None, back, is_collecting)) > 1:
        raise StoreError("one of --to, --back and --collect at a time")
    with existing(path) as store:
        done: dict[str, Any] = {}
        if place is not None:
            done = {f"moved_{name}": n for name, n in asdict(move_out(store, place)).items()}
        elif back:
            done = {f"moved_{name}": n for name, n in asdict(move_back(store)).items()}
        elif is_collecting:
            there = store.look(place_of_bodies)
            if there is None:
                raise StoreError(f"{shown(path)}: all bodies are in the database")
            done = {
                f"removed_{name}": n for name, n in asdict(collect(store, bodies_at(there, to_write=False))).items()
            }
        values = {"bodies": store.look(place_of_bodies) or "in the database"} | done
    show(values, as_json, lambda console: console.print(tables.fields(shown(path), values)))
