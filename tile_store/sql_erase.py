"""Taking a vehicle's name out of a store: each function but `compact` runs inside the caller's transaction."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import apsw

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.connection import SqlConnection, change, fetch
from gnd.tile_store.marks import renamed
from gnd.tile_store.provenance import Provenance, decode_provenance, encode_provenance
from gnd.tile_store.sqlite_connection import as_store_error
from gnd.tile_store.values import ReportRow

WHY: Final = "its name was erased while it did not count"
_REMOVED: Final = (
    "uploads", "quarantined_messages", "shift_tests", "courses", "agreement_tests", "trial_health", "road_parts",
    "standings", "days_alone", "coincidences", "pairs_of_groups", "places", "impossible",
    "border_rows",
)  # fmt: skip
"""What is removed, as `counts_of` and the statements `erase_<name>` name it."""


@dataclass(frozen=True, slots=True)
class StoredRow:
    """A row of the journal and its number in the file."""

    arrival: int
    row: ReportRow


def is_counted_out(c: SqlConnection, vehicle: str) -> bool:
    """Whether a vehicle does not count, or its poses are not believed."""
    return bool(fetch(c, "is_counted_out", {"vehicle": vehicle}))


def own_too(c: SqlConnection, vehicle: str, name: str) -> None:
    """Whose a vehicle is holds for another name, too; from the beginning, for its times become coarse."""
    change(c, "owner_too", {"vehicle": vehicle, "name": name})


def count_out_too(c: SqlConnection, vehicle: str, name: str) -> None:
    """What is said of a vehicle that does not count holds for another name, too; an operator's word lasts."""
    change(c, "count_out_too", {"vehicle": vehicle, "name": name, "why": WHY})
    change(c, "shift_too", {"vehicle": vehicle, "name": name})
    change(c, "lone_word_too", {"vehicle": vehicle, "name": name})


def tiles_of(c: SqlConnection, vehicle: str) -> list[tuple[str, TileId]]:
    """The layers and tiles of which the journal holds reports of it."""
    return [(layer, TileId(tile)) for layer, tile in fetch(c, "tiles_to_erase", {"vehicle": vehicle})]


def rows_of(c: SqlConnection, layer: str, tile: TileId, vehicle: str) -> list[StoredRow]:
    """Its rows about a tile."""
    found = []
    for arrival, *values in fetch(c, "rows_to_erase", {"layer": layer, "tile": tile.morton, "vehicle": vehicle}):
        report_id, received_ns, body, base_sha, part, window, seq = values
        row = ReportRow(report_id, layer, tile, vehicle, received_ns, body, base_sha, part, window=window, seq=seq)
        found.append(StoredRow(arrival, row))
    return found


def ids_of_tile(c: SqlConnection, layer: str, tile: TileId) -> list[str]:
    """All report ids of a tile, and those that its versions cite of reports that are gone."""
    place = {"layer": layer, "tile": tile.morton}
    found = {report_id for (report_id,) in fetch(c, "report_ids_of_tile", place)}
    for _, body in fetch(c, "provenances_of_tile", place):
        found.update(decode_provenance(body).report_ids)
    return sorted(found)


def put_row(c: SqlConnection, one: StoredRow) -> None:
    """Write a row in the place of what it was."""
    row = one.row
    told = {"arrival": one.arrival, "report_id": row.report_id, "vehicle": row.vehicle}
    change(c, "put_erased_row", told | {"received_ns": row.received_ns, "body": row.body})


def rename_in_tile(c: SqlConnection, layer: str, tile: TileId, vehicle: str, name: str, ids: Mapping[str, str]) -> None:
    """Other names and ids in all else that stands beside the reports of a tile."""
    place: dict[str, str | int] = {"layer": layer, "tile": tile.morton}
    for version, body in fetch(c, "provenances_of_tile", place):
        old = decode_provenance(body)
        new = Provenance(tuple(ids.get(one, one) for one in old.report_ids), old.voxels)
        if new != old:
            change(c, "put_provenance", place | {"version": version, "provenance": encode_provenance(new)})
    _rename_named(c, "of_tile", place, vehicle, name)
    change(c, "rename_waiting_change", place | {"vehicle": vehicle, "name": name})
    for old_id, new_id in ids.items():
        told = place | {"vehicle": vehicle, "name": name, "report_id": old_id, "new_id": new_id}
        change(c, "rename_doubted_report", told)


def memories(c: SqlConnection, layer: str, tile: TileId) -> list[bytes]:
    """What the tile remembers of its closed windows: one or none."""
    return [memory for (memory,) in fetch(c, "memory_of_tile", {"layer": layer, "tile": tile.morton})]


def all_memories(c: SqlConnection) -> Iterator[tuple[str, TileId, bytes]]:
    """The memories of all tiles."""
    for layer, morton in fetch(c, "tiles_with_memory"):
        for memory in memories(c, layer, TileId(morton)):
            yield layer, TileId(morton), memory


def put_memory(c: SqlConnection, layer: str, tile: TileId, memory: bytes) -> None:
    """Write a memory in the place of what it was."""
    change(c, "put_erased_memory", {"layer": layer, "tile": tile.morton, "memory": memory})


def counts_of(c: SqlConnection, vehicle: str) -> dict[str, int]:
    """How many rows of other tables are of a vehicle, by table."""
    return {what: int(fetch(c, f"count_{what}", _told(what, vehicle))[0][0]) for what in _REMOVED}


def remove_rest(c: SqlConnection, vehicle: str, name: str) -> None:
    """Remove what is not of one tile's reports."""
    for what in _REMOVED:
        change(c, f"erase_{what}", _told(what, vehicle))
    for what in ("pardon", "quarantined", "shifted", "lone_words", "owner"):
        change(c, f"erase_{what}", {"vehicle": vehicle})
    for what in ("left_waiting", "left_doubted"):
        change(c, f"erase_{what}", {"vehicle": vehicle, "other": name})
    for layer, tile, vehicles in fetch(c, "road_tiles_of_vehicles"):
        if vehicle in vehicles.split():
            new = " ".join(sorted({name if one == vehicle else one for one in vehicles.split()}))
            change(c, "put_road_vehicles", {"layer": layer, "tile": tile, "vehicles": new})
    _rename_named(c, "of_store", {}, vehicle, name)


def compact(path: Path) -> None:
    """Write the file anew, and empty its log: no free page holds what was there before.

    Raises:
        StoreError: another process uses the store.
    """
    try:
        connection = apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READWRITE)
        try:
            connection.set_busy_timeout(10_000)
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            connection.execute("VACUUM")
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        finally:
            connection.close()
    except apsw.Error as error:
        raise as_store_error(error, path) from None


def _told(what: str, vehicle: str) -> dict[str, str | bytes]:
    """A message that was refused may hold the name anywhere."""
    return {"vehicle": vehicle} | ({"name": vehicle.encode()} if what == "quarantined_messages" else {})


def _rename_named(c: SqlConnection, where: str, place: Mapping[str, str | int], vehicle: str, name: str) -> None:
    for table in ("basis", "closed"):
        for layer, tile, number, named in fetch(c, f"named_{table}_{where}", {**place, "vehicle": vehicle}):
            new = " ".join(sorted(renamed(one, vehicle, name) for one in named.split()))
            if new != named:
                change(c, f"put_named_{table}", {"layer": layer, "tile": tile, "number": number, "named": new})
