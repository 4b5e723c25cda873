"""What the killed processes of `test_store_processes` do: `python store_process.py reporter|merger STORE NAME FIRST`.

Each says on its standard output what was confirmed to it, one line a fact, at once.
"""

import random
import sys
import time
from contextlib import suppress

import numpy as np
from store_helpers import TILE, report

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import open_store
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.store import Store
from gnd.tile_store.values import Basis, Publication, ReportRow, StoreConfig, TileWork

TILES = (TILE, *TILE.neighbours()[:3])
HURRY = StoreConfig(merge_delay_s=0.02, merge_after_reports=5, window_reports=1_000_000)


def merged_tile(tile: TileId, reports: tuple[ReportRow, ...]) -> Tile:
    """A merge that counts: the Gaussian of voxel k has one point for each report whose number ends in k."""
    numbers = np.array([row.received_ns % 1_000_000 for row in reports])
    ids, counts = np.unique(numbers % 50, return_counts=True)
    n = len(ids)
    zeros = np.zeros((n, 3), dtype=np.float32), np.zeros((n, 6), dtype=np.float32)
    return Tile(tile, 0, Gaussians(ids.astype(np.int32), counts.astype(np.int32), np.ones(n, np.int32), *zeros))


def publication_of(work: TileWork) -> Publication:
    ids = tuple(row.report_id for row in work.reports)
    content, basis = merged_tile(work.claim.tile, work.reports), Basis(work.journal.window, work.journal.seq)
    return Publication(work.claim, work.base_version, content, report_ids=ids, basis=basis)


def run_reporter(store: Store, name: str, number: int) -> None:
    """Sends the reports of this vehicle from `number` on; the same number is the same report after a kill."""
    while True:
        rows = [report(number + i, TILES[(number + i) % 4], name) for i in range(3)]
        try:
            told = store.put_reports(rows)
        except StoreError:  # the server has gone: nothing is acknowledged, and what was sent is sent again
            time.sleep(0.05)
            continue
        for row, status in zip(rows, told, strict=True):
            print(status, row.tile.morton, row.report_id, flush=True)
        number += 3
        time.sleep(0.002)


def run_merger(store: Store, name: str, _first: int) -> None:
    """Merges what it can, with leases so short that they run out now and then."""
    generator = random.Random()
    store.release(name)
    while True:
        with suppress(StoreError):
            for claim in store.claim(name, 2, lease_s=0.05):
                work = store.load(claim)
                time.sleep(generator.uniform(0.0, 0.08))
                (result,) = store.publish([publication_of(work)])
                print(result.status, claim.tile.morton, result.version, flush=True)
        time.sleep(0.005)


def opened_at_last(path: str) -> SqlStore:
    """The store, once its server is there."""
    while True:
        try:
            return open_store(path, HURRY)
        except StoreError:
            time.sleep(0.05)


if __name__ == "__main__":
    role, path, name, first = sys.argv[1:]
    with opened_at_last(path) as opened:
        print("ready", flush=True)
        {"reporter": run_reporter, "merger": run_merger}[role](opened, name, int(first))
