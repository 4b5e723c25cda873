"""A map without what one vehicle has said: the tiles that it spoke of, computed anew from the journal of the others."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from cloud_merger.config import ShardConfig
from cloud_merger.verify import Verifier
from gnd_map.features import is_feature_layer
from gnd_map.tile import Tile, diff
from gnd_map.tile_id import TileId
from tile_store.store import Store


@dataclass(frozen=True, slots=True)
class Expelled:
    """What becomes of one tile.

    Attributes:
        tile: of which the vehicle has spoken.
        reports: of it there since the tile's epoch, and since the time asked for.
        voxels: that differ without them.
        status: "changes"; "same": the others say the same; "unknown": it cannot be computed any more.
        reason: why it is unknown.
    """

    tile: TileId
    reports: int
    voxels: int
    status: Literal["changes", "same", "unknown"]
    reason: str = ""


def without_vehicle(
    store: Store, config: ShardConfig, layer: str, vehicle: str, since_ns: int = 0
) -> Iterator[tuple[Expelled, Tile | None]]:
    """Every tile that a vehicle has reported about since its epoch, and its content without that (None: it stays).

    Args:
        store: only read.
        config: parameters of the shards that published.
        layer: of Gaussians.
        vehicle: its pseudonym.
        since_ns: what it said before, by receipt, stays; int ns UTC.

    Feature layers are left out: their merges are not kept as windows.
    """
    verifier = Verifier(store, config)
    tiles = sorted({row.tile for row in store.reports(layer, vehicle) if row.received_ns >= since_ns})
    for tile in tiles:
        head = store.get(layer, tile)
        if head is None or is_feature_layer(layer):
            continue
        if head.kind != "merged":
            yield Expelled(tile, 0, 0, "same"), None  # nothing that anybody said since has changed it
            continue
        n, reason, gaussians = verifier.without(
            layer, tile, head.version, lambda row: row.vehicle == vehicle and row.received_ns >= since_ns
        )
        if gaussians is None:
            yield Expelled(tile, n, 0, "unknown", reason), None
            continue
        new, old = Tile(tile, head.version + 1, gaussians), head.decode_gaussians()
        if n == 0 or new.sha == old.sha:
            yield Expelled(tile, n, 0, "same"), None
        else:
            yield Expelled(tile, n, differing(old, new), "changes"), new


def differing(old: Tile, new: Tile) -> int:
    """How many voxels of two versions differ."""
    delta = diff(old.gaussians, new.gaussians)
    return len(delta.removed) + len(delta.put)
