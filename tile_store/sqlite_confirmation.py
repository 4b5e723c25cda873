"""What waits for confirmation in SQLite: each function runs inside the caller's transaction."""

from collections.abc import Iterable
from typing import Any

import apsw

from gnd_map.tile_id import TileId
from tile_store.sqlite_connection import change, fetch
from tile_store.values import Unconfirmed, WaitingChange


def keep(c: apsw.Connection, layer: str, tile: TileId, waiting: Iterable[Unconfirmed]) -> None:
    """Of this tile, this waits now and nothing else."""
    place: dict[str, Any] = {"layer": layer, "tile": tile.morton}
    change(c, "delete_waiting", place)
    for one in waiting:
        told = {"vehicle": one.vehicle, "reason": one.reason, "voxels": one.voxels, "seen": one.seen}
        since_ns = min(_received_ns(c, place | {"report_id": report_id}) for report_id in one.report_ids)
        change(c, "insert_waiting", place | told | {"since_ns": since_ns})


def _received_ns(c: apsw.Connection, place: dict[str, Any]) -> int:
    return int(fetch(c, "received", place)[0][0])


def waiting_changes(c: apsw.Connection) -> list[WaitingChange]:
    """All that waits, by layer, tile, vehicle and reason."""
    rows = fetch(c, "waiting_changes")
    return [WaitingChange(layer, TileId(tile), *rest) for layer, tile, *rest in rows]
