"""What a published district costs in requests and bytes: one object a tile, one a district, or packs of what is new.

    python -m studies.archive_study --tiles 1000 --publishes 30 --changed 10

A real store is published again and again by `gnd.tile_store.publishing`; each time other tiles have changed, drawn from
a seed. Packs are what is written; the other two layouts are counted from the same tiles. Readers: a new client that
takes all, a vehicle that takes the tiles along a line, a client that was up to date and returns after one publishing.
"""

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path

import click
import numpy as np

from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.archive import ArchiveEntry, ArchiveIndex, Pack, index_name
from gnd.tile_client.archive import spans
from gnd.tile_store.objects import FolderObjects
from gnd.tile_store.publishing import publish
from gnd.tile_store.sqlite_store import SqliteStore

FIRST = TileId(497353963154 & ~1023)
GAUSSIANS = 450
"""Of a tile: some 2 kB, as of a street."""
ALONG = 30


@dataclass
class Layout:
    """Requests and bytes of one layout, over all publishings but the first, and of readers."""

    put_requests: int = 0
    put_bytes: int = 0
    returning: list[tuple[int, int]] = field(default_factory=list)
    vehicle: list[tuple[int, int]] = field(default_factory=list)
    new_client: list[tuple[int, int]] = field(default_factory=list)


@click.command()
@click.option("--tiles", default=1000, show_default=True, type=click.IntRange(ALONG, 1024))
@click.option("--publishes", default=30, show_default=True, type=click.IntRange(1))
@click.option("--changed", default=10, show_default=True, type=click.IntRange(1))
@click.option("--seed", default=701, show_default=True)
def main(tiles: int, publishes: int, changed: int, seed: int) -> None:
    """Publish a district again and again, and count."""
    rng = np.random.default_rng(seed)
    places = [TileId(FIRST.morton + int(k)) for k in np.sort(rng.choice(1024, tiles, replace=False))]
    layouts = {name: Layout() for name in ("object a tile", "object a district", "packs of what is new")}
    with tempfile.TemporaryDirectory() as folder, SqliteStore(Path(folder) / "map.sqlite") as store:
        objects = FolderObjects(Path(folder) / "archive")
        store.put_tiles([_content(tile, rng) for tile in places])
        first = publish(store, objects, ["ndt"])
        repacked = 0
        for _ in range(publishes):
            some = [places[k] for k in np.sort(rng.choice(tiles, changed, replace=False))]
            store.put_tiles([_content(tile, rng) for tile in some])
            done = publish(store, objects, ["ndt"])
            repacked += done.repacked
            data = objects.get(index_name("ndt", FIRST.district))
            assert data is not None
            _count(layouts, ArchiveIndex.decode(data), len(data), set(some), (done.objects, done.bytes))
    found = {name: _means(layout, publishes) for name, layout in layouts.items()}
    click.echo(json.dumps({"first_publishing_bytes": first.bytes, "repacked": repacked, "layouts": found}, indent=1))


def _content(tile: TileId, rng: np.random.Generator) -> Tile:
    """Random walls: bodies of a length that streets have."""
    ids = np.sort(rng.choice(12_000, GAUSSIANS, replace=False)).astype(np.int32)
    full = rng.integers(20, 60, GAUSSIANS).astype(np.int32)
    cov_m2 = np.tile(np.array([0.05, 0, 0, 0.05, 0, 0.0004], np.float32), (GAUSSIANS, 1))
    mean_m = rng.normal(0, 0.1, (GAUSSIANS, 3)).clip(-0.4, 0.4).astype(np.float32)
    return Tile(tile, 0, snap(Gaussians(ids, full, full, mean_m, cov_m2), LATTICES["standard"], new_map=True))


def _count(
    layouts: dict[str, Layout], index: ArchiveIndex, index_bytes: int, new: set[TileId], put: tuple[int, int]
) -> None:
    laid = {
        "object a tile": _apart(index.entries),
        "object a district": _in_one(index.entries),
        "packs of what is new": list(index.entries),
    }
    for name, entries in laid.items():
        news, layout = [entry for entry in entries if entry.tile in new], layouts[name]
        for wanted, counted in (
            (entries, layout.new_client), (_line(entries), layout.vehicle), (news, layout.returning)
        ):  # fmt: skip
            counted.append(_read(wanted, index_bytes))
        size = sum(entry.size for entry in (news if name == "object a tile" else entries)) + index_bytes
        requests = len(news) + 1 if name == "object a tile" else 2
        if name.startswith("packs"):
            requests, size = put
        layout.put_requests += requests
        layout.put_bytes += size


def _line(entries: Sequence[ArchiveEntry]) -> list[ArchiveEntry]:
    """The tiles along a street from west to east through the district's middle, and beside it."""
    middle = FIRST.lat_index + 16
    near = sorted(entries, key=lambda entry: (abs(entry.tile.lat_index - middle), entry.tile.lon_index))
    return near[:ALONG]


def _read(wanted: Sequence[ArchiveEntry], index_bytes: int) -> tuple[int, int]:
    """Requests and bytes of bodies and index; heads of HTTP are not counted."""
    groups = spans(wanted)
    return 1 + len(groups), index_bytes + sum(max(one.end for one in group) - group[0].start for group in groups)


def _in_one(entries: Sequence[ArchiveEntry]) -> list[ArchiveEntry]:
    """The same tiles in one pack, in order."""
    sizes = [entry.size for entry in entries]
    pack = Pack(bytes(32), sum(sizes))
    starts = [0, *accumulate(sizes)]
    return [replace(entry, pack=pack, start=start) for entry, start in zip(entries, starts, strict=False)]


def _apart(entries: Sequence[ArchiveEntry]) -> list[ArchiveEntry]:
    """The same tiles in an object each."""
    return [
        replace(entry, pack=Pack(number.to_bytes(32, "big"), entry.size), start=0)
        for number, entry in enumerate(entries)
    ]


def _means(layout: Layout, publishes: int) -> dict[str, object]:
    def of(counted: Sequence[tuple[int, int]]) -> dict[str, float]:
        return {
            "requests": round(float(np.mean([requests for requests, _ in counted])), 1),
            "requests_worst": max(requests for requests, _ in counted),
            "bytes": round(float(np.mean([size for _, size in counted]))),
        }

    put = {"requests": round(layout.put_requests / publishes, 1), "bytes": round(layout.put_bytes / publishes)}
    return {
        "publishing": put,
        "new client": of(layout.new_client),
        "vehicle of 30 tiles": of(layout.vehicle),
        "returning": of(layout.returning),
    }


if __name__ == "__main__":
    main()
