"""A store without a trace of who reported: what a vehicle has said stays in the map, that it was this vehicle does not.

Reports of a tile are votes on voxels or features; who sent them matters to the merge only as "the same as before". So
the rows of a vehicle stay, tile by tile, under an invented name, new ids in the same order, and times as coarse as
every stored version of the tile can still be computed from, to the bit. An invented name is of one tile alone, but
where the vehicle does not count (quarantine, shifted poses): that must be known of all its rows, so they share one.
"""

import json
import secrets
from bisect import bisect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Final, Literal, cast

import zstandard
from ulid import ULID

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.memory import TileMemory, mark_of
from gnd.cloud_merger.verify import Verifier
from gnd.gnd_map.bounded import json_value, zstd_unpacked
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.schemas.features import FeatureReport
from gnd.tile_store import sql_erase as erasing
from gnd.tile_store.connection import SqlConnection
from gnd.tile_store.marks import renamed
from gnd.tile_store.sql_erase import StoredRow
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.store import Store
from gnd.tile_store.values import Basis, ClosedWindow, ReportRow

TimesKept = Literal["hour", "minute", "exact"]
_STEP_NS: Final[dict[TimesKept, int]] = {"hour": 3_600_000_000_000, "minute": 60_000_000_000, "exact": 1}
_FORMS: Final[tuple[tuple[TimesKept, bool], ...]] = (
    ("hour", False), ("minute", False), ("exact", False), ("exact", True),
)  # fmt: skip
"""Times, and whether the course in the vehicle's own frame stays; the first that gives the same map is taken."""
_HOUR_OF_ULID: Final = 3_600_000 << 80
_ROOM: Final = 1 << 32
_MAX_MEMORY_BYTES: Final = 1 << 27
Tell = Callable[[str, int, int], object]


@dataclass(frozen=True, slots=True)
class ErasedTile:
    """What was done in one tile.

    Attributes:
        layer, tile: which.
        reports: rows of the vehicle.
        versions: of the tile that are computed from them to the bit, before and after.
        times: what is left of the times of its reports.
        has_course: whether the vehicle's own frame had to stay.
    """

    layer: str
    tile: TileId
    reports: int
    versions: int
    times: TimesKept
    has_course: bool


@dataclass(frozen=True, slots=True)
class Erased:
    """What was found of a vehicle, and removed or made nobody's."""

    vehicle: str
    tiles: tuple[ErasedTile, ...]
    removed: Mapping[str, int]
    """Rows of other tables, by table."""
    is_counted_out: bool
    """It does not count: its rows have one invented name in all tiles, so that they go on not to."""


def erase_vehicle(
    store: SqlStore, config: ShardConfig, vehicle: str, tell: Tell = lambda *_: None, *, dry_run: bool = False
) -> Erased:
    """Make all that a store has of a vehicle nobody's; killed on the way, it is simply begun again.

    Args:
        store: no shard works on it.
        config: parameters of what was merged before stores kept them.
        vehicle: as it stands in reports.
        tell: hears of the progress.
        dry_run: nothing is written.

    Raises:
        MergerError: a shard works on the store: it would write from memory what is erased here.
    """
    alive = sorted(shard.owner for shard in store.shards() if shard.is_alive)
    if alive and not dry_run:
        raise MergerError(f"{', '.join(alive)} works on {store.location}: end all mergers of the store first")
    counted_out = store.look(lambda c: erasing.is_counted_out(c, vehicle))
    shared = _invented() if counted_out else ""
    if shared and not dry_run:
        store.transact(lambda c, _now: erasing.count_out_too(c, vehicle, shared))
    places = store.look(lambda c: erasing.tiles_of(c, vehicle))
    done = []
    for number, (layer, tile) in enumerate(places, start=1):
        form = _anonymous(store, config, layer, tile, vehicle, shared or _invented())
        if not dry_run:
            store.transact(lambda c, _now, form=form: form.write(c))  # type: ignore[misc]
        done.append(form.told)
        tell("tiles", number, len(places))
    removed = store.look(lambda c: erasing.counts_of(c, vehicle))
    if not dry_run:
        store.transact(lambda c, _now: _rest(c, vehicle, shared or _invented()))
    return Erased(vehicle, tuple(done), removed, counted_out)


@dataclass(frozen=True, slots=True)
class _Form:
    """A tile as it will be: what is to be written, and what it keeps."""

    told: ErasedTile
    vehicle: str
    name: str
    rows: tuple[StoredRow, ...]
    ids: Mapping[str, str]
    step_ns: int

    def write(self, c: SqlConnection) -> None:
        place = (self.told.layer, self.told.tile)
        for row in self.rows:
            erasing.put_row(c, row)
        erasing.rename_in_tile(c, *place, self.vehicle, self.name, self.ids)
        erasing.own_too(c, self.vehicle, self.name)
        for memory in erasing.memories(c, *place):
            erasing.put_memory(c, *place, self.of_memory(memory))

    def of_memory(self, body: bytes) -> bytes:
        if is_feature_layer(self.told.layer):
            return _renamed_layer(body, {self.vehicle: self.name} | dict(self.ids))
        return _renamed_memory(TileMemory.decode(body), self.vehicle, self.name, self.ids, self.step_ns).encode()


def _anonymous(store: SqlStore, config: ShardConfig, layer: str, tile: TileId, vehicle: str, name: str) -> _Form:
    """The most anonymous form of a tile from which all its versions can be computed that can be now."""
    rows, all_ids = store.look(
        lambda c: (erasing.rows_of(c, layer, tile, vehicle), erasing.ids_of_tile(c, layer, tile))
    )
    ids = new_ids(all_ids, {row.row.report_id for row in rows})
    before = _statuses(Verifier(store, config), layer, tile)
    versions = sum(status == "same" for _, status in before)
    for times, has_course in _FORMS:
        step_ns = _STEP_NS[times]
        made = tuple(StoredRow(one.arrival, _nobodys(one.row, name, ids, step_ns, has_course)) for one in rows)
        told = ErasedTile(layer, tile, len(rows), versions, times, has_course)
        form = _Form(told, vehicle, name, made, ids, step_ns)
        by_key = {(old.row.report_id, old.row.part): new.row for old, new in zip(rows, made, strict=True)}
        seen = cast("Store", _Seen(store, by_key, vehicle, name, ids))
        if _statuses(Verifier(seen, config), layer, tile) == before:
            return form
    raise MergerError(f"tile {tile.path} of layer {layer}: its versions would change; nothing is erased there")


def _statuses(verifier: Verifier, layer: str, tile: TileId) -> list[tuple[int, str]]:
    return [(one.version, one.status) for one in verifier.history(layer, tile)]


def _nobodys(row: ReportRow, name: str, ids: Mapping[str, str], step_ns: int, has_course: bool) -> ReportRow:
    report_id = ids[row.report_id]
    said: ChangeReport | FeatureReport
    if is_feature_layer(row.layer):
        said = FeatureReport.decode(row.body)
    else:
        said = ChangeReport.decode(row.body)
        said = said if has_course else replace(said, course=None)
    first_ns, last_ns = (t_ns - t_ns % step_ns for t_ns in (said.first_ns, said.last_ns))
    body = replace(said, report_id=report_id, vehicle=name, software="-", first_ns=first_ns, last_ns=last_ns).encode()
    received_ns = row.received_ns - row.received_ns % step_ns
    return replace(row, report_id=report_id, vehicle=name, received_ns=received_ns, body=body)


def new_ids(all_ids: Sequence[str], own: set[str]) -> dict[str, str]:
    """Other ids for some of a tile's reports, at random within an hour, in the same order among all: the merge goes by
    it.
    """
    others = sorted(_number(one) for one in all_ids if one not in own)
    found: dict[str, str] = {}
    for seat, group in groupby(sorted(own), key=lambda one: bisect(others, _number(one))):
        run = list(group)
        low = max(others[seat - 1] if seat else 0, _number(run[0]) - _HOUR_OF_ULID, 0)
        high = min(others[seat] if seat < len(others) else (1 << 128) - 1, _number(run[-1]) + _HOUR_OF_ULID)
        drawn: set[int] = set()
        if high - low < _ROOM:  # ids of others so near that there are no others between: chance alone makes none
            drawn = {_number(one) for one in run}
        while len(drawn) < len(run):
            drawn.add(low + 1 + secrets.randbelow(high - low - 1))
        found |= {old: str(ULID(new.to_bytes(16, "big"))) for old, new in zip(run, sorted(drawn), strict=True)}
    return found


def _number(report_id: str) -> int:
    return int.from_bytes(ULID.from_str(report_id).bytes, "big")


def _invented() -> str:
    return "gone-" + secrets.token_hex(6)


class _Seen:
    """A store as it will be when a tile is rewritten; everything else is the store's own."""

    def __init__(
        self,
        store: SqlStore,
        rows: Mapping[tuple[str, int], ReportRow],
        vehicle: str,
        name: str,
        ids: Mapping[str, str],
    ) -> None:
        self._store, self._rows, self._ids = store, rows, ids
        self._vehicle, self._name = vehicle, name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)

    def reports_of_windows(self, *where: Any) -> tuple[ReportRow, ...]:
        return tuple(self._rows.get((row.report_id, row.part), row) for row in self._store.reports_of_windows(*where))

    def basis(self, *where: Any) -> Basis | None:
        found = self._store.basis(*where)
        return None if found is None else replace(found, named=self._named(found.named))

    def closed_windows(self, *where: Any) -> dict[int, ClosedWindow]:
        found = self._store.closed_windows(*where)
        return {window: replace(how, named=self._named(how.named)) for window, how in found.items()}

    def provenance(self, *where: Any) -> tuple[str, ...]:
        return tuple(self._ids.get(one, one) for one in self._store.provenance(*where))

    def owners_of(self, vehicles: Iterable[str]) -> dict[str, tuple[tuple[int, str], ...]]:
        found = self._store.owners_of({self._vehicle if one == self._name else one for one in vehicles})
        of_it = found.pop(self._vehicle, ())
        return found | ({self._name: ((0, of_it[0][1]), *of_it[1:])} if of_it else {})

    def _named(self, named: frozenset[str]) -> frozenset[str]:
        return frozenset(renamed(one, self._vehicle, self._name) for one in named)


def _renamed_memory(memory: TileMemory, vehicle: str, name: str, ids: Mapping[str, str], step_ns: int) -> TileMemory:
    voxels = memory.voxels.copy()
    voxels["last"][voxels["last"] == mark_of(vehicle)] = mark_of(name)
    witnesses = tuple(
        replace(
            one,
            report_id=ids.get(one.report_id, str(ULID(secrets.token_bytes(16)))),
            vehicle=name,
            **{key: getattr(one, key) - getattr(one, key) % step_ns for key in ("first_ns", "last_ns", "received_ns")},
        )
        if one.vehicle == vehicle
        else one
        for one in memory.witnesses
    )
    voters = {
        name if one == vehicle else one: t_ns - t_ns % step_ns if one == vehicle else t_ns
        for one, t_ns in memory.voters.items()
    }
    return replace(memory, voxels=voxels, witnesses=witnesses, voters=voters)


def _renamed_layer(body: bytes, names: Mapping[str, str]) -> bytes:
    """A layer's memory is JSON: names and ids stand in it as texts of their own."""

    def walk(value: Any) -> Any:
        if isinstance(value, str):
            return names.get(value, value)
        if isinstance(value, list):
            return [walk(one) for one in value]
        if isinstance(value, dict):
            return {key: walk(one) for key, one in value.items()}
        return value

    told = walk(json_value(zstd_unpacked(body, _MAX_MEMORY_BYTES)))
    return zstandard.ZstdCompressor(level=3).compress(json.dumps(told, separators=(",", ":")).encode())


def _rest(c: SqlConnection, vehicle: str, name: str) -> None:
    """What is not of one tile's reports; memories of tiles of which retention has removed the reports."""
    for layer, tile, body in erasing.all_memories(c):
        if is_feature_layer(layer):
            new = _renamed_layer(body, {vehicle: name})
        else:
            memory = TileMemory.decode(body)
            if vehicle not in memory.voters and all(one.vehicle != vehicle for one in memory.witnesses):
                continue
            new = _renamed_memory(memory, vehicle, name, {}, _STEP_NS["hour"]).encode()
        if new != body:
            erasing.put_memory(c, layer, tile, new)
    erasing.remove_rest(c, vehicle, name)
