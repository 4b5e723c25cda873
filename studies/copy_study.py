"""How long writes are refused while a store moves: `gnd store copy` with writers at work.

    python -m studies.copy_study postgresql://…/empty_database --tiles 100000 --writers 2

Writers are processes that journal reports of eight tiles as fast as they can, until they are told where the store has
moved. It prints how many were acknowledged, and that the target holds all of them.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click
import numpy as np

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.errors import StoreMoved
from gnd.tile_store.location import open_store
from gnd.tile_store.values import ReportRow

FIRST = TileId(497353963154)
TILES_OF_REPORT = 8
AT_ONCE = 500
GAUSSIANS = 100
BODY_BYTES = 300


@click.command()
@click.argument("target")
@click.option("--source", default="", help="Where the store is made.  [default: a file]")
@click.option("--tiles", default=10_000, show_default=True, type=click.IntRange(1))
@click.option("--writers", default=2, show_default=True, type=click.IntRange(0))
@click.option("--write", default="", hidden=True)
@click.option("--number", default=0, hidden=True)
def main(target: str, source: str, tiles: int, writers: int, write: str, number: int) -> None:
    """Make a store of so many tiles, and move it to TARGET while it is written to."""
    if write:
        _write(write, number, tiles)
        return
    with tempfile.TemporaryDirectory() as folder:
        place = source or str(Path(folder) / "store.sqlite")
        _fill(place, tiles)
        command = [sys.executable, "-m", "studies.copy_study", target, "--tiles", str(tiles), "--write", place]
        running = [
            subprocess.Popen([*command, "--number", str(one)], stdout=subprocess.PIPE, text=True)  # noqa: S603
            for one in range(writers)
        ]
        time.sleep(3.0 if writers else 0.0)
        began_s = time.monotonic()
        copy = [sys.executable, "-m", "gnd.deploy.cli", "store", "copy", place, target, "--json"]
        done = subprocess.run(copy, check=True, capture_output=True, text=True)  # noqa: S603
        told = json.loads(done.stdout)
        told |= {"seconds": round(time.monotonic() - began_s, 1)}
        acknowledged = [int(one.communicate()[0]) for one in running]
        with open_store(target, create=False) as store:
            kept = {row.report_id for row in store.reports()}
        names = {_name(who, n) for who, many in enumerate(acknowledged) for n in range(many)}
        told |= {"acknowledged": len(names), "lost": len(names - kept)}
        click.echo(json.dumps({name: value for name, value in told.items() if name not in ("source", "target")}))


def _name(number: int, n: int) -> str:
    return deterministic_report_id(1_700_000_000_000 + n, f"writer-{number}")


def _fill(place: str, tiles: int) -> None:
    rng = np.random.default_rng(1)
    ids, many = np.arange(GAUSSIANS, dtype=np.int32), np.full(GAUSSIANS, 30, np.int32)
    cov_m2 = np.tile(np.array([0.01, 0, 0, 0.01, 0, 0.01], np.float32), (GAUSSIANS, 1))
    with open_store(place) as store:
        for first in range(0, tiles, AT_ONCE):
            some = range(first, min(tiles, first + AT_ONCE))
            means_m = rng.normal(0.0, 0.1, (len(some), GAUSSIANS, 3)).astype(np.float32)
            store.put_tiles(
                Tile(TileId(FIRST.morton + n), 0, Gaussians(ids, many, many, mean_m, cov_m2))
                for n, mean_m in zip(some, means_m, strict=True)
            )


def _write(place: str, number: int, tiles: int) -> None:
    rng, n = np.random.default_rng(number), 0
    with open_store(place, create=False) as store:
        while True:
            first = FIRST.morton + int(rng.integers(max(1, tiles - TILES_OF_REPORT)))
            rows = [
                ReportRow(_name(number, n), "ndt", TileId(first + k), f"v{number}", 1, rng.bytes(BODY_BYTES))
                for k in range(TILES_OF_REPORT)
            ]
            try:
                store.put_reports(rows)
            except StoreMoved:
                break
            n += 1
    click.echo(str(n))


if __name__ == "__main__":
    main()
