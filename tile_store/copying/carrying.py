"""Rows of one district from store to store: by key, by what has changed, and compared."""

import json
from collections.abc import Iterator, Sequence
from typing import Any, Final

from gnd.gnd_map.tile_id import District
from gnd.tile_store.bodies import Bodies, bodies_at
from gnd.tile_store.copying.contents import OF_DISTRICT, DistrictPart, Row
from gnd.tile_store.copying.copy import key_as_json, key_of
from gnd.tile_store.copying.ends import End
from gnd.tile_store.errors import StoreError

BATCH: Final = 500
"""Rows a transaction."""
NOTES: Final = 2000
"""Notes a round."""
Changed = tuple[DistrictPart, list[Row], list[Row]]
"""A table, its rows that were written, keys of rows that were removed."""
_BY_TABLE: Final = {part.table: part for part in OF_DISTRICT}
_FREE: Final = {"owner": None, "token": None, "lease_ns": None}
_LATE: Final = {"dirty": _FREE | {"ready_ns": 0}, "upload": _FREE | {"lease_ns": 0}}
"""Leases and times of another clock: who has the district now begins anew."""
_LASTING: Final = {
    "tile_version": ("parent", "kind", "created_ns", "merger", "n_reports", "sha", "provenance"),
    "version_basis": ("window", "seq", "named", "parameters"),
    "report": ("vehicle", "received_ns", "seq", "base_sha", "body"),
}
"""What does not change while somebody works on the new store."""
_NUMBERED_PARAMETERS: Final = ("version_basis", "closed_window")


class Carrier:
    """Reads rows of a district in one store and writes them to another.

    Args:
        source, target: the ends.
        district: whose rows.
    """

    def __init__(self, source: End, target: End, district: District) -> None:
        self.source, self.target, self.district = source, target, district
        self._columns: dict[str, tuple[str, ...]] = {}
        self._parameters: dict[int, int] = {}
        self._bodies: Bodies | None = None

    def columns(self, part: DistrictPart) -> tuple[str, ...]:
        """The columns that travel, the same at both ends."""
        if part.table not in self._columns:
            here, there = self.source.columns(part.table), self.target.columns(part.table)
            if here != there:
                raise StoreError(
                    f"table {part.table}: other columns in {self.target.location} than in {self.source.location}"
                )
            self._columns[part.table] = tuple(one for one in here if one != part.numbered)
        return self._columns[part.table]

    def layers(self, part: DistrictPart) -> list[str]:
        """The layers of which a table holds rows; of reports as they came, "" stands for all."""
        return [""] if part.kind == "upload" else self.source.layers(part.table)

    def count(self, end: End, part: DistrictPart) -> int:
        """Rows of a table that come early."""
        where = end.in_district(part.table, self.district)
        return int(end.run(f"SELECT COUNT(*) FROM {part.table} WHERE {where}{_only(part)}")[0][0])

    def page(self, part: DistrictPart, layer: str, after: list[Any] | None) -> tuple[list[Row], list[Any] | None, bool]:
        """The next rows of a table and layer: they, where to go on, and whether that were all."""
        columns, mark = self.columns(part), self.source.mark
        order = (part.numbered,) if part.kind == "upload" else part.contents.key[1:]
        beyond, values = [self.source.of_district(part.table, self.district) + _only(part)], list[Any]()
        if part.kind != "upload":
            beyond.append(f"layer = {mark}")
            values.append(layer)
        if after:
            beyond.append(f"({self.source.listed(order)}) > ({self.source.marks(len(order))})")
            values += after
        listed = self.source.listed([*columns, *order])
        rows = self.source.run(
            f"SELECT {listed} FROM {part.table} WHERE {' AND '.join(beyond)} ORDER BY {self.source.listed(order)}"
            f" LIMIT {BATCH}",
            values,
        )
        is_done = len(rows) < BATCH
        last = key_as_json(rows[-1][len(columns) :]) if rows else after
        return [row[: len(columns)] for row in rows], last, is_done

    def fill(self, part: DistrictPart, rows: Sequence[Row]) -> None:
        """Write rows to the target, over those with the same keys."""
        self.target.put(part.contents, self.columns(part), [self._as_there(part, row) for row in rows])

    def _as_there(self, part: DistrictPart, row: Row) -> Row:
        """A row as the target has it: parameters by its own numbers, bodies in the database, early uploads free."""
        values = dict(zip(self.columns(part), row, strict=True))
        if part.table in _NUMBERED_PARAMETERS and values["parameters"] is not None:
            values["parameters"] = self._number_there(values["parameters"])
        if part.table == "tile_version" and not values["body"] and values["size_bytes"]:
            values["body"] = self._body(values["sha"], values["codec_id"])
        values |= _LATE.get(part.table, {})
        return tuple(values.values())

    def _number_there(self, number: int) -> int:
        if number not in self._parameters:
            mark, there = self.target.mark, self.target
            found = self.source.run(
                f"SELECT digest, body FROM merge_parameters WHERE number = {self.source.mark}", (number,)
            )
            if not found:
                raise StoreError(f"{self.source.location}: merge parameters {number} are named and not in the store")
            there.run(
                f"INSERT INTO merge_parameters (digest, body) VALUES ({mark}, {mark}) ON CONFLICT (digest) DO NOTHING",
                found[0],
            )
            rows = there.run(f"SELECT number FROM merge_parameters WHERE digest = {mark}", (found[0][0],))
            self._parameters[number] = int(rows[0][0])
        return self._parameters[number]

    def _body(self, sha: bytes, codec_id: int) -> bytes:
        if self._bodies is None:
            found = self.source.run("SELECT location FROM body_place")
            if not found:
                raise StoreError(f"{self.source.location}: bodies lie among objects, and it does not say where")
            self._bodies = bodies_at(str(found[0][0]), to_write=False)
        return self._bodies.read(bytes(sha), codec_id)

    def changed(self) -> tuple[list[int], list[Changed]]:
        """The oldest notes: their numbers, and the rows that they speak of, as they are now."""
        notes, keys = self.source.changed(NOTES), dict[str, set[Row]]()
        for _, table, key in notes:
            keys.setdefault(table, set()).add(key_of(_BY_TABLE[table].contents, json.loads(key)))
        changed = []
        for part in OF_DISTRICT:
            wanted = sorted(keys.get(part.table, ()))
            if not wanted:
                continue
            columns = self.columns(part)
            found = list(zip(wanted, self.source.rows(part.contents, columns, wanted), strict=True))
            rows = [row for _, row in found if row is not None and not self._is_late(part, row)]
            changed.append((part, rows, [key for key, row in found if row is None]))
        return [number for number, _, _ in notes], changed

    def _is_late(self, part: DistrictPart, row: Row) -> bool:
        return part.kind == "upload" and row[self.columns(part).index("state")] == "waiting"

    def apply(self, changed: Sequence[Changed]) -> None:
        """Write rows as they are now; then their notes may go."""
        try:
            with self.target.transaction():
                for part, _, gone in reversed(changed):
                    self.target.remove(part.contents, gone)
                for part, rows, _ in changed:
                    self.fill(part, rows)
        except BaseException:
            self._parameters.clear()  # numbers that were given may not be there
            raise

    def copy_late(self, part: DistrictPart) -> int:
        """Copy what comes with the switch, inside a transaction of the target; how many rows."""
        columns = self.columns(part)
        where = self.source.in_district(part.table, self.district) + _only(part, is_late=True)
        order = f" ORDER BY {part.numbered}" if part.numbered else ""
        rows = self.source.run(f"SELECT {self.source.listed(columns)} FROM {part.table} WHERE {where}{order}")
        self.fill(part, rows)
        return len(rows)

    def lasting(self, part: DistrictPart, *, may_lack: bool) -> Iterator[list[Row]]:
        """What of a table's rows never changes, a page at a time.

        Args:
            part: the table.
            may_lack: the target has been in use for long, and may have removed rows.

        Raises:
            StoreError: the target has a row otherwise, or has it not.
        """
        if part.table not in _LASTING:
            return
        names = (*part.contents.key, *_LASTING[part.table])
        at = [self.columns(part).index(name) for name in names]
        for layer in self.layers(part):
            after, is_done = None, False
            while not is_done:
                rows, after, is_done = self.page(part, layer, after)
                here = [self._told(part, row, at) for row in rows]
                keys = [row[: len(part.contents.key)] for row in here]
                found = self.target.rows(part.contents, self.columns(part), keys)
                for row, there in zip(here, found, strict=True):
                    if not may_lack if there is None else tuple(there[i] for i in at) != row:
                        raise StoreError(
                            f"table {part.table}: a row is not the same in {self.target.location}, or not there:"
                            f" {row[: len(part.contents.key)]}; nothing was removed from {self.source.location}"
                        )
                yield here

    def _told(self, part: DistrictPart, row: Row, at: Sequence[int]) -> Row:
        if part.table in _NUMBERED_PARAMETERS:
            row = self._as_there(part, row)
        return tuple(row[i] for i in at)


def _only(part: DistrictPart, *, is_late: bool = False) -> str:
    return "" if part.kind != "upload" else f" AND state {'=' if is_late else '<>'} 'waiting'"
