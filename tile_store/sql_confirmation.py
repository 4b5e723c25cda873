"""What waits for confirmation in SQL: each function runs inside the caller's transaction."""

from collections.abc import Iterable
from typing import Any

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.connection import SqlConnection, fetch, post
from gnd.tile_store.values import Unconfirmed, WaitingChange


def keep(c: SqlConnection, layer: str, tile: TileId, waiting: Iterable[Unconfirmed]) -> None:
    """Of this tile, this waits now and nothing else."""
    place: dict[str, Any] = {"layer": layer, "tile": tile.morton}
    known = {(row[2], row[3]): row[6] for row in fetch(c, "waiting_changes_of_tile", place)}
    post(c, "delete_waiting", place)
    for one in waiting:
        told = {"vehicle": one.vehicle, "reason": one.reason, "voxels": one.voxels, "seen": one.seen}
        times = [fetch(c, "received", place | {"report_id": report_id})[0][0] for report_id in one.report_ids]
        times.append(known.get((one.vehicle, one.reason)))  # the reports may have been removed since
        since_ns = min((at_ns for at_ns in times if at_ns is not None), default=0)
        post(c, "insert_waiting", place | told | {"since_ns": since_ns})


def waiting_changes(c: SqlConnection) -> list[WaitingChange]:
    """All that waits, by layer, tile, vehicle and reason."""
    rows = fetch(c, "waiting_changes")
    return [WaitingChange(layer, TileId(tile), *rest) for layer, tile, *rest in rows]
