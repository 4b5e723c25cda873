"""A map without what one vehicle has said: the tiles that it spoke of, computed anew from the journal of the others."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.verify import Verifier
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.store import Store


@dataclass(frozen=True, slots=True)
class Expelled:
    """What becomes of one tile.

    Attributes:
        tile: of which the vehicle has spoken.
        reports: of it there since the tile's epoch, and since the time asked for.
        voxels: that differ without them; features in a feature layer.
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
) -> Iterator[tuple[Expelled, AnyTile | None]]:
    """Every tile that a vehicle has reported about since its epoch, and its content without that (None: it stays).

    Args:
        store: only read.
        config: parameters of what was merged before stores kept them.
        layer: of Gaussians or features.
        vehicle: its pseudonym.
        since_ns: what it said before, by receipt, stays; int ns UTC.
    """
    verifier = Verifier(store, config)
    tiles = sorted({row.tile for row in store.reports(layer, vehicle) if row.received_ns >= since_ns})
    for tile in tiles:
        head = store.get(layer, tile)
        if head is None:
            continue
        if head.kind != "merged":
            yield Expelled(tile, 0, 0, "same"), None  # nothing that anybody said since has changed it
            continue
        n, reason, new = verifier.without(
            layer, tile, head.version, lambda row: row.vehicle == vehicle and row.received_ns >= since_ns
        )
        if new is None:
            yield Expelled(tile, n, 0, "unknown", reason), None
        elif n == 0 or new.sha == head.sha:
            yield Expelled(tile, n, 0, "same"), None
        else:
            yield Expelled(tile, n, differing(head.decode(), new), "changes"), _next(new, head.version + 1)


def _next(content: AnyTile, version: int) -> AnyTile:
    if isinstance(content, FeatureTile):
        return FeatureTile(content.tile_id, version, content.features)
    return Tile(content.tile_id, version, content.gaussians)


def differing(old: AnyTile, new: AnyTile) -> int:
    """How many voxels, or features, of two versions differ."""
    if isinstance(old, FeatureTile) or isinstance(new, FeatureTile):
        assert isinstance(old, FeatureTile)
        assert isinstance(new, FeatureTile)
        return len({one.key for one in set(old.features) ^ set(new.features)})
    delta = diff(old.gaussians, new.gaussians)
    return len(delta.removed) + len(delta.put)
