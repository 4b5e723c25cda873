"""The map as it is for everybody: where a version is on trial, the one before it. Trials are read after heads, so a
version that comes in between is not given away.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from gnd.gnd_map.tile_id import TileId
from gnd.schemas.tiles import CatalogEntry
from gnd.schemas.tiles_batch import TilesRequest
from gnd.tile_store.store import Store
from gnd.tile_store.trials import VersionTrial
from gnd.tile_store.values import StoredTile

READ_AT_ONCE: Final = 64
"""Versions with their bodies, of a region that is sent whole."""


def released_heads(store: Store, layer: str, prefix: str) -> list[CatalogEntry]:
    """The newest released versions of a region's tiles, by tile."""
    heads = store.heads(layer, prefix)
    trials = store.trials(layer, prefix)
    return [_before(trials[head.tile]) if head.tile in trials else head for head in heads] if trials else heads


def released(store: Store, layer: str, tile: TileId) -> StoredTile | None:
    """The newest released version of a tile; None: there is none."""
    stored = store.get(layer, tile)
    trial = store.trials(layer, tile.path).get(tile)
    return stored if trial is None else store.get(layer, tile, trial.base_version)


def released_each(
    store: Store, layer: str, tiles: Sequence[TileId], prefix: str
) -> Iterator[tuple[TileId, StoredTile | None]]:
    """The newest released versions of many tiles of a region, read some at a time; None: there is none."""
    for first in range(0, len(tiles), READ_AT_ONCE):
        some = tiles[first : first + READ_AT_ONCE]
        newest = store.get_each(layer, some)
        trials = store.trials(layer, prefix)
        for tile, stored in zip(some, newest, strict=True):
            trial = trials.get(tile)
            yield tile, stored if trial is None else store.get(layer, tile, trial.base_version)


def heads_for(
    request: TilesRequest,
    heads: Mapping[TileId, CatalogEntry],
    trials: Mapping[TileId, VersionTrial],
    held: Mapping[TileId, bytes | None],
) -> dict[TileId, CatalogEntry]:
    """The versions that a client gets.

    Who holds a version on trial keeps it until it is settled, whatever its ticket is by then: no client's version goes
    back without a notice.

    Args:
        request: of the client.
        heads: the newest versions of a district, by tile.
        trials: the open ones there.
        held: hashes of what the client holds; None: it has yet to say.
    """
    if request.newest:
        return dict(heads)
    before = {
        tile: _before(trial)
        for tile, trial in trials.items()
        if tile in heads and held.get(tile) != trial.sha and not trial.is_among_first(request.ticket)
    }
    return dict(heads) | before


def _before(trial: VersionTrial) -> CatalogEntry:
    return CatalogEntry(trial.tile, trial.base_version, trial.base_sha)
