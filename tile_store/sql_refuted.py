"""Reports that other vehicles contradict, in SQL: inside the caller's transaction, derived from `shift_test`."""

from collections.abc import Iterable, Mapping
from typing import Any

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import sql_inbox as inbox
from gnd.tile_store.connection import SqlConnection, fetch
from gnd.tile_store.values import REFUTED_SHARE, REFUTED_TESTS


def refuted(c: SqlConnection, layer: str, vehicles: Iterable[str]) -> dict[str, str]:
    """The refuted reports that some vehicles have made about a layer, and whose each is."""
    limits = {"layer": layer, "least": REFUTED_TESTS, "share": REFUTED_SHARE}
    return {
        str(report): vehicle
        for vehicle in sorted(set(vehicles))
        for (report,) in fetch(c, "refuted_reports", limits | {"vehicle": vehicle})
    }


def merge_again(
    c: SqlConnection, layer: str, before: Mapping[str, str], now: Mapping[str, str], timing: dict[str, Any]
) -> None:
    """Where a report is refuted now that was not before, or the reverse, all tiles that its vehicle speaks of wait to
    be merged again.
    """
    for vehicle in sorted({vehicle for _, vehicle in before.items() ^ now.items()}):
        for of_layer, tile in fetch(c, "tiles_of_vehicle", {"vehicle": vehicle}):
            if of_layer == layer:
                inbox.merge_again(c, layer, TileId(tile), timing)
