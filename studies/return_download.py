"""What a vehicle that comes back downloads: bytes a tile for a map of which it holds an older version.

A simulated street is mapped before and after its changes. The vehicle holds all tiles as they were; in each tile so
many voxels are then as they are after the changes, those nearest to one place. Questions and answers go through the
tile server's own code, keys included; a district is one question.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Final

import numpy as np

from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.world import State
from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import batch_key
from gnd.schemas.tiles_batch import HeldVersion, TilesRequest
from gnd.tile_store.answers import TileAnswers
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import DEFAULT_CODEC, DEFAULT_LAYER
from studies.codec_scenes import LENGTH_M, SEED
from studies.frame.measure import Figure
from studies.frame.options import check, option
from studies.simulation.base_map import BaseMap, driven, read_base

Tiles = dict[TileId, Gaussians]


@dataclass(frozen=True, slots=True)
class ReturnDownloadOptions:
    """A simulated street and how much of it has changed."""

    seed: int = option(SEED, "World of the simulated street.")
    before: Path | None = option(None, "Its map before the changes, a file of `write_base`.  [default: make it]")
    after: Path | None = option(None, "Its map after the changes, a file of `write_base`.  [default: make it]")
    codec: str = option(DEFAULT_CODEC, "How finely it is rounded.", known=LATTICES)
    changed: float = option(0.02, "Share of changed voxels.", span=(0, 1))

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = ReturnDownloadOptions


def run(chosen: ReturnDownloadOptions | None = None) -> list[Figure]:
    """Measure the first download, the one after changes, and the one when nothing has changed."""
    chosen = chosen or ReturnDownloadOptions()
    before = _map(chosen, chosen.before, "before")
    after = _map(chosen, chosen.after, "after")
    new = partly_changed(before, after, chosen.changed, np.random.default_rng(chosen.seed))
    changed = sum(len(diff(before[tile], new[tile])) for tile in before) / len(before)
    voxels = sum(map(len, before.values())) / len(before)
    with tempfile.TemporaryDirectory() as folder, SqliteStore(Path(folder) / "map.sqlite") as store:
        held = _put(store, before)
        first = _exchanged(store, [HeldVersion(one.tile) for one in held])
        now = _put(store, new)
        returned, again = _exchanged(store, held), _exchanged(store, now)
    detail = f"{len(before)} tiles of {voxels:.0f} voxels, {chosen.codec}"
    return [
        *_figures("first", first, detail),
        *_figures("return", returned, f"{detail}, {changed:.1f} changed voxels a tile"),
        *_figures("nothing changed", again, detail),
    ]


def partly_changed(before: Tiles, after: Tiles, share: float, rng: np.random.Generator) -> Tiles:
    """The tiles in which `share` of all voxels are as after the changes, in each tile those nearest to one place."""
    edited = {tile: _edited(g, after.get(tile, Gaussians.empty())) for tile, g in before.items()}
    counts = _shared_out(
        np.array([len(ids) for ids in edited.values()]), share * np.array([len(g) for g in before.values()])
    )
    return {
        tile: _with_edits(g, after.get(tile, Gaussians.empty()), _near(tile, edited[tile], int(count), rng))
        for (tile, g), count in zip(before.items(), counts, strict=True)
    }


def _edited(before: Gaussians, after: Gaussians) -> I32:
    """The voxels that differ."""
    delta = diff(before, after)
    return np.union1d(delta.removed, delta.put.voxel_id).astype(np.int32)


def _shared_out(there: I64, wanted: F64) -> I64:
    """So many of what is `there` in each tile that all together are as many as `wanted`, where that can be.

    A tile in which less has changed than is wanted gives all; the others give more, in proportion.
    """
    factor = 1.0
    for _ in range(50):
        factor *= wanted.sum() / max(np.minimum(there, factor * wanted).sum(), 1.0)
    return np.minimum(there, np.round(factor * wanted)).astype(np.int64)


def _near(tile: TileId, voxel_ids: I32, count: int, rng: np.random.Generator) -> I32:
    """The `count` of these voxels that lie nearest to one of them."""
    if count == 0:
        return voxel_ids[:0]
    centre_m = VoxelGrid.of(tile).centre_m(voxel_ids)
    far_m = np.linalg.norm(centre_m - centre_m[rng.integers(len(voxel_ids))], axis=1)
    return voxel_ids[np.argsort(far_m, kind="stable")[:count]]


def _with_edits(before: Gaussians, after: Gaussians, voxel_ids: I32) -> Gaussians:
    return concat([before.take(~np.isin(before.voxel_id, voxel_ids)), after.select(voxel_ids)])


def _map(chosen: ReturnDownloadOptions, path: Path | None, state: State) -> Tiles:
    """The street's map on the lattice; tiles without a Gaussian are left out."""
    base = _driven(chosen.seed, state) if path is None else read_base(path)
    return {tile: snap(g, LATTICES[chosen.codec]) for tile, g in sorted(base.tiles.items()) if len(g)}


def _driven(seed: int, state: State) -> BaseMap:
    return driven(street(seed, StreetOptions(length_m=LENGTH_M, site="wangsimni")), state)


def _put(store: SqliteStore, tiles: Tiles) -> list[HeldVersion]:
    """Publish the tiles; what a vehicle holds that has them."""
    made = [Tile(tile, 0, gaussians) for tile, gaussians in tiles.items()]
    results = store.put_tiles(made)
    return [HeldVersion(one.tile_id, result.version, one.sha) for one, result in zip(made, results, strict=True)]


def _exchanged(store: SqliteStore, held: Sequence[HeldVersion]) -> tuple[float, float]:
    """Bytes up and down a tile when a vehicle that holds this asks for all of it."""
    sizes = np.array(list(_questions(TileAnswers(store), held)))
    up, down = sizes.sum(axis=0) / len(held)
    return float(up), float(down)


def _questions(answers: TileAnswers, held: Sequence[HeldVersion]) -> Iterator[tuple[int, int]]:
    for district, tiles in groupby(sorted(held, key=lambda one: one.tile), lambda one: one.tile.district):
        request = TilesRequest.of(tiles)
        reply = answers.many(DEFAULT_LAYER, district, request)
        key = len(batch_key(DEFAULT_LAYER, district))
        yield key + len(request.encode()), key + len(reply.encode())


def _figures(name: str, up_down: tuple[float, float], detail: str) -> list[Figure]:
    up, down = up_down
    return [Figure(f"{name}: download", down, "B/tile", detail), Figure(f"{name}: question", up, "B/tile")]
