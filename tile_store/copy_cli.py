"""`gnd store copy`: a store into another database, while it is in use."""

from dataclasses import asdict

import click

from gnd.tile_store.copying.copy import Copied, abandon, closing, copy_store_online
from gnd.tile_store.copying.ends import End
from gnd.tile_store.copying.sqlite_end import SqliteEnd
from gnd.tile_store.errors import StoreUnavailable
from gnd.tile_store.location import LOCATION, StoreLocation, conninfo_of, file_of, shown
from gnd.tile_store.options import bars, json_option, show


@click.command(short_help="Move a store to another database while it is in use.")
@click.argument("source", metavar="SOURCE", type=LOCATION)
@click.argument("target", metavar="TARGET", type=LOCATION)
@click.option("--abandon", "is_abandoned", is_flag=True, help="Forget a copy to TARGET that was begun, or the move.")
@json_option
def copy(source: StoreLocation, target: StoreLocation, is_abandoned: bool, as_json: bool) -> None:
    """Copy store SOURCE to TARGET, a file or a PostgreSQL URL, and move to it. Shards may go on writing.

    First everything is copied, then what has changed meanwhile. Then SOURCE refuses writes ("moved to ..."), the rest
    is copied, and TARGET can be used: start shards and tile servers with it. At last both are compared, row by row.

    After Ctrl-C or a crash the same command goes on where it was. TARGET must be empty.
    """
    here = end_of(source, is_target=False)
    if is_abandoned:
        with closing(here):
            was_there = abandon(here)
        line = "nothing is noted or refused any more" if was_there else "no copy of it was begun"
        show({"abandoned": was_there}, as_json, lambda console: console.print(f"{shown(source)}: {line}"))
        return
    with closing(here):
        there = end_of(target, is_target=True)
        with closing(there), bars() as progress:
            told = copy_store_online(here, there, progress)
    show(
        asdict(told) | {"source": shown(source), "target": shown(target)},
        as_json,
        lambda console: console.print(_line(source, target, told), highlight=False, soft_wrap=True),
    )


def _line(source: StoreLocation, target: StoreLocation, told: Copied) -> str:
    same = f"the same in both (sha256 {told.digest[:16]}…)" if told.digest else "not compared: see `gnd map verify`"
    return (
        f"{shown(source)} moved to {shown(target)}: {told.tiles} tiles, {told.rows} rows copied,"
        f" {told.changes} changes in {told.rounds} rounds; writes were refused for {told.gap_s:.2f} s; all rows {same}"
    )


def end_of(location: StoreLocation, *, is_target: bool) -> End:
    """An end of a copy.

    Raises:
        StoreUnavailable: it cannot be opened, or PostgreSQL is asked for and its library is not installed.
        StoreError: a target is not empty.
    """
    file = file_of(location)
    if file is not None:
        return SqliteEnd(file, is_target=is_target)
    try:
        from gnd.tile_store.copying.postgres_end import PostgresEnd
    except ImportError as error:
        raise StoreUnavailable(
            f"{shown(location)}: a store in PostgreSQL needs psycopg ({error}): pip install 'gnd-fleet[postgres]'"
        ) from None
    return PostgresEnd(conninfo_of(location), is_target=is_target)
