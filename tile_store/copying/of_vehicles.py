"""What a store knows of vehicles beyond tiles, and tells the store to which a district moves."""

from collections.abc import Sequence
from typing import Final

from gnd.gnd_map.tile_id import District
from gnd.tile_store.copying.contents import ALL, Row
from gnd.tile_store.copying.ends import End

_BY_TABLE: Final = {one.table: one for one in ALL}
OF_VEHICLES: Final = ("quarantined_vehicle", "pardon", "shifted_vehicle", "vehicle_owner", "lone_word")
"""Words about vehicles. A store that has one of its own keeps it."""


def tell_of_vehicles(source: End, target: End, district: District) -> None:
    """Tell the target whose reports are left out, and why, of all vehicles that have reported about the district."""
    where = source.in_district("report", district)
    vehicles = source.run(f"SELECT DISTINCT vehicle FROM report WHERE {where}")
    for table in OF_VEHICLES:
        columns = source.columns(table)
        sql = f"SELECT {source.listed(columns)} FROM {table} WHERE vehicle = {source.mark}"
        rows = [row for found in source.find_each(sql, vehicles) for row in found]
        _insert_new(target, table, columns, rows)


def tell_publishers(source: End, target: End) -> None:
    """Certificates of who has signed versions: they stay checkable."""
    columns = source.columns("publisher")
    _insert_new(target, "publisher", columns, source.run(f"SELECT {source.listed(columns)} FROM publisher"))


def count_alone(end: End, district: District, sign: int) -> None:
    """What vehicles have changed alone in the district counts here from now on (+1), or not any more (-1)."""
    mark, where = end.mark, end.in_district("standing", district)
    rows = end.run(f"SELECT vehicle, day, SUM(alone), SUM(shared) FROM standing WHERE {where} GROUP BY vehicle, day")
    told = []
    for vehicle, day, alone, shared in rows:
        owners = end.run(
            f"SELECT owner FROM vehicle_owner WHERE vehicle = {mark} ORDER BY since_ns DESC LIMIT 1", (vehicle,)
        )
        told.append((vehicle, day, owners[0][0] if owners else "", sign * int(alone), sign * int(shared)))
    end.run_each(
        f"INSERT INTO alone_day (vehicle, day, owner, alone, shared) VALUES ({end.marks(5)})"
        " ON CONFLICT (vehicle, day) DO UPDATE"
        " SET alone = alone_day.alone + excluded.alone, shared = alone_day.shared + excluded.shared",
        told,
    )


def _insert_new(target: End, table: str, columns: Sequence[str], rows: Sequence[Row]) -> None:
    key = target.listed(_BY_TABLE[table].key)
    target.run_each(
        f"INSERT INTO {table} ({target.listed(columns)}) VALUES ({target.marks(len(columns))})"
        f" ON CONFLICT ({key}) DO NOTHING",
        rows,
    )
