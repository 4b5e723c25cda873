"""Where the bytes went: the tiles of a run as a small map."""

import math
from collections.abc import Sequence
from typing import Final

from gnd.deploy.live_traffic import size_text
from gnd.fleet_bus.traffic import TileTraffic
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import TileId

_SIZE: Final = 420.0
_LEAST_PX: Final = 2.0
_FAINTEST: Final = 0.12
_MOST_ROWS: Final = 200


def tile_map(tiles: Sequence[TileTraffic]) -> str:
    """A square a tile, north up, the darker the more bytes came down for it (square root of the wire bytes)."""
    placed = [(tile, place) for tile in tiles if (place := _tile_id(tile.tile)) is not None]
    if not placed:
        return '<p class="note">No message of this run was about a tile.</p>'
    return _figure(placed) + _table([tile for tile, _ in placed])


def _tile_id(path: str) -> TileId | None:
    """None for a tile path that is none: a damaged ledger must not spoil the page."""
    try:
        return TileId.from_path(path)
    except (GndError, ValueError):
        return None


def _figure(placed: list[tuple[TileTraffic, TileId]]) -> str:
    corners = [(*place.south_west_rad, *place.north_east_rad) for _, place in placed]
    south, west = min(c[0] for c in corners), min(c[1] for c in corners)
    north, east = max(c[2] for c in corners), max(c[3] for c in corners)
    squash = math.cos((south + north) / 2)
    scale = _SIZE / max(north - south, (east - west) * squash)
    most = max((tile.down_wire_bytes for tile, _ in placed), default=0) or 1
    rectangles = []
    for (tile, _), (s, w, n, e) in zip(placed, corners, strict=True):
        x, y = (w - west) * squash * scale, (north - n) * scale
        width, height = max((e - w) * squash * scale, _LEAST_PX), max((n - s) * scale, _LEAST_PX)
        shade = _FAINTEST + (1 - _FAINTEST) * math.sqrt(tile.down_wire_bytes / most)
        rectangles.append(
            f'<rect class="tile" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" '
            f'fill-opacity="{shade:.2f}"><title>{_title(tile)}</title></rect>'
        )
    wide, high = (east - west) * squash * scale, (north - south) * scale
    return _drawing("".join(rectangles), wide, high, [tile for tile, _ in placed])


def _table(tiles: list[TileTraffic]) -> str:
    """The same in figures, for readers who cannot hover: the tiles with the most bytes."""
    most = sorted(tiles, key=lambda tile: (-tile.down_wire_bytes, tile.tile))[:_MOST_ROWS]
    rows = "".join(
        f'<tr><td class="t">{tile.tile}</td><td>{tile.down_bytes / 1000:.1f}</td>'
        f"<td>{tile.down_wire_bytes / 1000:.1f}</td><td>{tile.up_wire_bytes / 1000:.1f}</td></tr>"
        for tile in most
    )
    head = '<tr><th class="t">tile</th><th>down kB</th><th>wire down kB</th><th>wire up kB</th></tr>'
    which = "The tiles" if len(most) == len(tiles) else f"The {len(most)} tiles with the most bytes, of {len(tiles)}"
    table = f'<div class="wide"><table><thead>{head}</thead><tbody>{rows}</tbody></table></div>'
    return f"<details><summary>{which} in figures</summary>{table}</details>"


def _drawing(content: str, wide: float, high: float, tiles: list[TileTraffic]) -> str:
    sizes = sorted(tile.down_wire_bytes for tile in tiles)
    text = (
        f"{len(tiles)} tiles, north up. Down on the wire, all vehicles together: {size_text(sizes[0])} (faint) to "
        f"{size_text(sizes[-1])} (full), {size_text(sizes[len(sizes) // 2])} in the middle."
    )
    return (
        f'<figure><svg class="map" viewBox="-2 -2 {wide + 4:.0f} {high + 4:.0f}" role="img" aria-label="map of tiles">'
        f"{content}</svg><figcaption>{text}</figcaption></figure>"
    )


def _title(tile: TileTraffic) -> str:
    return f"{tile.tile}: {size_text(tile.down_wire_bytes)} down, {size_text(tile.up_wire_bytes)} up"
