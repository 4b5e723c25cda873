"""Roads that the map does not have, in SQL: parts of surveys, the lease of who maps them, and what tiles became.

Each function runs inside the caller's transaction (`SqliteStore.transact`, `SqliteStore.look`).
"""

from dataclasses import replace
from typing import Any, Final

from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import sql_versions as versions
from gnd.tile_store.connection import SqlConnection, change, fetch
from gnd.tile_store.errors import IdTaken
from gnd.tile_store.roads import OpenRoads, RoadPart, RoadTile
from gnd.tile_store.signing import Signing
from gnd.tile_store.values import Content, PutStatus

_NS_PER_S: Final = 1_000_000_000


def put_part(c: SqlConnection, part: RoadPart) -> PutStatus:
    """Keep a part; one that is known is a "duplicate".

    Raises:
        IdTaken: its survey is another vehicle's or of another layer, or the part came with another report id.
    """
    for number, report_id, layer, vehicle in fetch(c, "heads_of_survey", {"survey_id": part.survey_id}):
        if (layer, vehicle) != (part.layer, part.vehicle):
            raise IdTaken(f"survey {part.survey_id} is of {vehicle} in layer {layer}, part {part.part} of "
                          f"{part.vehicle} in layer {part.layer}")  # fmt: skip
        if number == part.part and report_id != part.report_id:
            raise IdTaken(f"part {part.part} of survey {part.survey_id} is report {report_id}, not {part.report_id}")
    row = {name: getattr(part, name) for name in RoadPart.__slots__}
    return "stored" if change(c, "insert_road_part", row) else "duplicate"


def open_roads(c: SqlConnection) -> list[OpenRoads]:
    """The layers of which parts wait."""
    return [OpenRoads(*row) for row in fetch(c, "open_road_layers")]


def lease(c: SqlConnection, layer: str, owner: str, lease_s: float) -> bool:
    """Lease the roads of a layer to one shard; False: another has them."""
    now = c.clock.steady_ns()
    row = {"layer": layer, "owner": owner, "boot": c.clock.name, "now": now}
    return bool(change(c, "lease_roads", row | {"until": now + round(lease_s * _NS_PER_S)}))


def settle(c: SqlConnection, layer: str, owner: str, done: int | None) -> None:
    """Give a layer back; the parts up to arrival `done` are mapped, None: none of them."""
    if done is not None:
        change(c, "roads_done", {"layer": layer, "owner": owner, "done": done})
    change(c, "free_roads", {"layer": layer, "owner": owner})


def parts(c: SqlConnection, layer: str) -> list[tuple[int, bytes]]:
    """All parts of a layer, (arrival, body), in order of arrival."""
    return [(arrival, bytes(body)) for arrival, body in fetch(c, "road_parts", {"layer": layer})]


def report_ids(c: SqlConnection, layer: str) -> set[str]:
    """Of the reports that brought parts of a layer."""
    return {report_id for (report_id,) in fetch(c, "road_reports", {"layer": layer})}


def tiles(c: SqlConnection, layer: str) -> list[RoadTile]:
    """What surveys have made of the tiles of a layer, by tile."""
    found = []
    for row in fetch(c, "road_tiles", {"layer": layer}):
        name, tile, state, reason, drives, vehicles, *rest = row
        found.append(RoadTile(name, TileId(tile), state, reason, drives, tuple(vehicles.split()), *rest))
    return found


def put_tile(c: SqlConnection, tile: RoadTile, now: int) -> None:
    """Write what a tile has become."""
    row: dict[str, Any] = {name: getattr(tile, name) for name in RoadTile.__slots__}
    row |= {"tile": tile.tile.morton, "vehicles": " ".join(tile.vehicles), "updated_ns": now}
    change(c, "put_road_tile", row)


def publish(c: SqlConnection, road: RoadTile, tile: Tile, over: int, now: int, signing: Signing | None) -> int | None:
    """Publish a tile over version `over` (0: the map has none) as a new base, and write what it has become.

    Returns:
        Its version; None: the head has moved, or reports about the tile wait to be merged first. Nothing is written
        then.
    """
    place = {"layer": road.layer, "tile": tile.tile_id.morton}
    (head,) = versions.stored_heads(c, road.layer, [tile.tile_id])
    if (head.version if head else 0) != over or fetch(c, "waits_to_be_merged", place):
        return None
    content = Content.of(tile)
    result = versions.put_base(c, road.layer, tile.tile_id, content, "base", now, road.last_ns, signing=signing)
    if result.status == "published" and not over:  # a new tile is announced, too: vehicles wait for this road
        change(c, "insert_notice", place | {"version": result.version, "created_ns": now})
    put_tile(c, replace(road, version=result.version), now)
    return result.version
