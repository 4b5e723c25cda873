"""Whether a catalog goes back behind what its reader has seen: signed versions, and notices that a shard has sealed.

A catalog is sealed by the tile server that answers, and bound to the question, so neither router nor cache can forge or
keep one. A tile server that was broken into can: what it names and nobody has signed is refused when the tile comes
(`checking`), and what it leaves out or sets back is noticed here.
"""

import logging
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Final

from gnd.fleet_bus.refusals import counted
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.tiles import CatalogEntry

_SELDOM: Final = Seldom(logging.getLogger(__name__))


def set_back(
    layer: str, seen: Mapping[TileId, int], entries: Iterable[CatalogEntry], *, newest: bool
) -> dict[TileId, int | None]:
    """The tiles of which a catalog names an older version than was seen, with that version; None: no version at all.

    Each is told in the log and counted. Two good reasons look the same, and pass: a store that was built anew counts
    from 1 until its tiles are fetched, and tiles are missing while the tile server of their region does not answer.

    Args:
        layer: of the catalog.
        seen: newest version of each tile that was seen before the catalog was asked for.
        entries: of the catalog.
        newest: versions on trial were seen, too, which a catalog does not name: numbers say nothing then.
    """
    named = {entry.tile: entry.version for entry in entries}
    found: dict[TileId, int | None] = {
        tile: named.get(tile)
        for tile, version in seen.items()
        if tile not in named or (named[tile] < version and not newest)
    }
    for reason, n in Counter("left out" if version is None else "older" for version in found.values()).items():
        counted("catalog", reason, n)
    if found:
        tile, version = next(iter(found.items()))
        what = "no version" if version is None else f"version {version}"
        _SELDOM.warning(
            "the catalog of layer %s goes back behind what was seen of %d tiles: %s of tile %s, of which version %d was"
            " seen. Either the map was built anew, or its tile server is away, or it withholds versions",
            layer,
            len(found),
            what,
            tile,
            seen[tile],
        )
    return found
