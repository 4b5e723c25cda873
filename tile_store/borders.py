"""Reports about features near the border of a district that another store owns.

What is found near a border is told to the tiles on both sides (`cloud_merger.features.spread`). Where the other side is
another store's, its rows are kept in the transaction that settles the report, and carried over later: in the other
store a row enters the journal once, however often it is carried. So neither half is lost when a process dies.
"""

from collections.abc import Sequence
from typing import Any, Final, Protocol

from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.connection import SqlConnection, fetch, post
from gnd.tile_store.districts import DistrictOwners, is_owned
from gnd.tile_store.uploads import UploadForm
from gnd.tile_store.values import PutStatus, ReportRow

AT_ONCE: Final = 1024
"""Rows that are carried together."""
ANYBODY: Final = ""
"""Rows of all vehicles are counted."""
_FIELDS: Final = ("layer", "report_id", "part", "vehicle", "received_ns", "base_sha", "body")


class Bordering(Protocol):
    """What carrying needs of a store."""

    def district_owners(self) -> DistrictOwners:
        """See `Store.district_owners`."""

    def put_reports(self, rows: Sequence[ReportRow]) -> list[PutStatus]:
        """See `Store.put_reports`."""

    def border_rows(self, n: int) -> list[ReportRow]:
        """See `SqlStore.border_rows`."""

    def forget_border_rows(self, rows: Sequence[ReportRow]) -> None:
        """See `SqlStore.forget_border_rows`."""


def apart(
    c: SqlConnection, form: UploadForm, rows: Sequence[ReportRow]
) -> tuple[Sequence[ReportRow], Sequence[ReportRow]]:
    """Of a report's rows those for this store, and those about districts of others; inside the caller's transaction.

    Reports about Gaussians speak of one district; so do those about features that are not near a border.
    """
    districts = {row.tile.district for row in rows}
    if form != "features" or len(districts) < 2:
        return rows, ()
    owned = {district: is_owned(c, district) for district in districts}
    return [row for row in rows if owned[row.tile.district]], [row for row in rows if not owned[row.tile.district]]


def keep(c: SqlConnection, rows: Sequence[ReportRow]) -> None:
    """Keep rows until they are carried to the store that owns their districts."""
    for row in rows:
        post(c, "put_border_row", _columns(row))


def waiting(c: SqlConnection, n: int) -> list[ReportRow]:
    """The oldest rows that are to be carried."""
    found = fetch(c, "border_rows", {"n": n})
    return [ReportRow(row[0], row[1], TileId(row[2]), *row[3:]) for row in found]


def forget(c: SqlConnection, rows: Sequence[ReportRow]) -> None:
    """Remove rows that another store has."""
    for row in rows:
        post(c, "forget_border_row", _key(row))


def count(c: SqlConnection) -> int:
    """Rows that wait to be carried."""
    return int(fetch(c, "count_border_rows", {"vehicle": ANYBODY})[0][0])


def carry(stores: Sequence[Bordering]) -> int:
    """Carry what waits in each store to the one that owns its district; how many rows. What nobody owns waits."""
    owners, done = [store.district_owners() for store in stores], 0
    for store in stores:
        rows = store.border_rows(AT_ONCE)
        for target, of_target in zip(stores, owners, strict=True):
            some = [row for row in rows if of_target.takes(row.tile.district)]
            if some:
                target.put_reports(some)
                store.forget_border_rows(some)
                rows = [row for row in rows if row not in some]
                done += len(some)
    return done


def _key(row: ReportRow) -> dict[str, Any]:
    return {"layer": row.layer, "tile": row.tile.morton, "report_id": row.report_id, "part": row.part}


def _columns(row: ReportRow) -> dict[str, Any]:
    return {"tile": row.tile.morton, **{name: getattr(row, name) for name in _FIELDS}}
