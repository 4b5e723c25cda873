"""`move_district`: a district into another store while vehicles drive there.

1. The target enters the district as arriving, the source as being copied; both refuse from now on what is written to
   districts that are not theirs. Triggers of the source note the key of each row of the district that changes.
2. Its rows are copied by key, a batch a transaction of the target, which also remembers how far it has come; then what
   has changed meanwhile, until little is left. Nothing of it acts there yet: heads, queue and marks come last.
3. The fence: the source refuses writes to the district. The last changes are copied.
4. The switch: one transaction of the target enters heads, journals, queue, notices and waiting reports, and owns the
   district from then on.
5. The source says where it has moved. What no version may lose is compared, row by row; then the source removes it.

Every step may be interrupted, also by kill -9: the same call goes on. Until 4 it may be abandoned.
"""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from secrets import token_hex
from typing import Any, Final

from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District
from gnd.tile_store.copying.carrying import Carrier
from gnd.tile_store.copying.contents import OF_DISTRICT, DistrictPart, Row
from gnd.tile_store.copying.copy import Progress
from gnd.tile_store.copying.ends import COPIED, LOG, MOVED, End
from gnd.tile_store.copying.of_vehicles import count_alone, tell_of_vehicles, tell_publishers
from gnd.tile_store.districts import READ, REST, WRITTEN, DistrictState, number_of
from gnd.tile_store.errors import StoreError

FEW: Final = 200
"""So few notes may be left to the fence."""
ROUNDS_OF_PATIENCE: Final = 20
MOST_ROUNDS: Final = 10_000
NOTICED_S: Final = 1.0
"""Shards and tile servers that run have seen within so long that a district begins to move, or has moved."""
REMOVED_AT_ONCE: Final = 32
"""Tiles that the source removes in one transaction."""
UPLOADS_AT_ONCE: Final = 500
_FIELDS: Final = ("region", "state", "other", "since_ns", "epoch", "move_id", "place")


@dataclass(frozen=True, slots=True)
class MovedDistrict:
    """What was done.

    Attributes:
        path: of the district.
        rows: copied at first, those of an earlier attempt left out.
        changes: rows copied again, because they had changed.
        rounds: in which that was done.
        late: rows of the switch.
        gap_s: from the first write that was refused until the target takes writes; 0: that was in an earlier attempt.
        tiles: heads that have moved.
        digest: SHA-256 over versions, what they were made of, and reports; the same in both.
        epoch: how often the district has moved.
        was_resumed: whether it went on with an earlier attempt.
    """

    path: str
    rows: int = 0
    changes: int = 0
    rounds: int = 0
    late: int = 0
    gap_s: float = 0.0
    tiles: int = 0
    digest: str = ""
    epoch: int = 0
    was_resumed: bool = False


@dataclass(frozen=True, slots=True)
class _OwnerRow:
    """A row of `district_owner`."""

    region: str
    state: DistrictState
    other: str
    since_ns: int
    epoch: int
    move_id: str
    place: str

    @property
    def before(self) -> "_OwnerRow | None":
        """What was said before the move began."""
        told = json.loads(self.place or "{}").get("before")
        return None if told is None else _OwnerRow(*told)

    @property
    def copied(self) -> dict[str, Any]:
        """How far each table has come."""
        copied: dict[str, Any] = json.loads(self.place or "{}").get("tables", {})
        return copied


def move_district(source: End, target: End, district: District, progress: Progress) -> MovedDistrict:
    """Move a district from one store to another; see the module.

    Raises:
        StoreError: the source does not own it, the target does or is another's, a version there is on trial, another
            move or copy is going on, or the two differ at the end.
    """
    here, there = _said(source, district), _said(target, district)
    if here is not None and there is not None and here.move_id == there.move_id and there.state == "owned":
        return _finished(source, target, district, progress, MovedDistrict(district.path, was_resumed=True))
    here, was_resumed = _begun(source, target, district, here, there)
    carrier = Carrier(source, target, district)
    rows = _copy_early(carrier, progress)
    changes, rounds = _catch_up(carrier, FEW, progress)
    _wait_until_noticed(here)
    began_s = time.monotonic()
    with source.transaction(alone=True):
        _put(source, district, replace(here, state="leaving", since_ns=time.time_ns()))
    with _fence_lifted_on_failure(carrier, here):
        more, last = _behind_the_fence(carrier, progress)
        late, tiles = _switch(carrier, here)
    gap_s = round(time.monotonic() - began_s, 3)
    told = MovedDistrict(
        district.path, rows, changes + more, rounds + last, late, gap_s, tiles, was_resumed=was_resumed
    )
    return _finished(source, target, district, progress, told)


def abandon_district(source: End, target: End, district: District) -> bool:
    """Forget a move that was begun: the district stays where it is. False: there was none.

    Raises:
        StoreError: it has moved already.
    """
    here, there = _said(source, district), _said(target, district)
    if here is not None and there is not None and here.move_id == there.move_id and there.state == "owned":
        raise StoreError(f"district {district} has moved to {target.location} already: move it back instead")
    if here is not None and not (here.state in ("copying", "leaving") and here.other == target.location):
        here = None
    is_arriving = there is not None and there.state == "arriving" and there.other == source.location
    if here is None and not is_arriving:
        return False
    if there is not None and is_arriving:
        _remove(target, district)
        with target.transaction(alone=True):
            _put(target, district, there.before)
    if here is not None:
        with source.transaction(alone=True):
            _put(source, district, here.before)
        _stop_noting(source)
    return True


def state_at(end: End, district: District) -> str:
    """What a store says of a district, whether it has a row of its own or not."""
    said = _said(end, district)
    return _rest(end).state if said is None else said.state


def _said(end: End, district: District | None) -> _OwnerRow | None:
    number = REST if district is None else number_of(district)
    rows = end.run(f"SELECT {', '.join(_FIELDS)} FROM district_owner WHERE district = {number}")
    return _OwnerRow(*rows[0]) if rows else None


def _rest(end: End) -> _OwnerRow:
    return _said(end, None) or _OwnerRow("main", "owned", "", 0, 0, "", "")


def _put(end: End, district: District, said: _OwnerRow | None) -> None:
    """Write what a store says of a district; None: nothing."""
    number = number_of(district)
    end.run(f"DELETE FROM district_owner WHERE district = {number}")
    if said is not None:
        values = (number, district.path, *(getattr(said, name) for name in _FIELDS))
        columns = ", ".join(("district", "path", *_FIELDS))
        end.run(f"INSERT INTO district_owner ({columns}) VALUES ({end.marks(len(values))})", values)


def _begun(
    source: End, target: End, district: District, here: _OwnerRow | None, there: _OwnerRow | None
) -> tuple[_OwnerRow, bool]:
    """What the source says of the district from now on, and whether that goes on with an earlier attempt."""
    if here is not None and here.state in ("copying", "leaving"):
        if here.other != target.location:
            raise StoreError(
                f"{source.location}: district {district} is moving to {here.other}; go on with that, or --abandon it"
            )
        if there is None or there.state != "arriving" or there.move_id != here.move_id:
            raise StoreError(f"{target.location}: knows nothing of the move of district {district}; --abandon it")
        return here, True
    _require_apart(source, target, district, here, there)
    move_id = there.move_id if there is not None and there.state == "arriving" else token_hex(16)
    now_ns = time.time_ns()
    if there is None or there.state != "arriving":
        epoch = max(0 if one is None else one.epoch for one in (here, there))
        arriving = _OwnerRow(
            _rest(target).region, "arriving", source.location, now_ns, epoch, move_id, _place(there, {})
        )
        with target.transaction(alone=True):
            _put(target, district, arriving)
            target.guard()
    rest = _rest(source)
    epoch = 0 if here is None else here.epoch
    leaves = _OwnerRow(rest.region, "copying", target.location, now_ns, epoch, move_id, _place(here, {}))
    with source.transaction(alone=True):
        _put(source, district, leaves)
        source.guard()
        source.note_changes([part.contents for part in _early()], district)
    return leaves, False


def _require_apart(
    source: End, target: End, district: District, here: _OwnerRow | None, there: _OwnerRow | None
) -> None:
    """StoreError unless the district can move from the one to the other."""
    state = _rest(source).state if here is None else here.state
    if state not in WRITTEN:
        where = f": it has moved to {here.other}" if here is not None and here.state == "moved" else ""
        raise StoreError(f"{source.location}: does not own district {district}{where}")
    if there is not None and there.state == "arriving" and there.other != source.location:
        raise StoreError(
            f"{target.location}: district {district} is arriving from {there.other}; finish or --abandon that"
        )
    if (_rest(target).state if there is None else there.state) in READ:
        raise StoreError(
            f"{target.location}: owns district {district}, too: a store that has said nothing owns all; make that of"
            " another region with `gnd regions create`"
        )
    for end in (source, target):
        if end.state() in (COPIED, MOVED):
            raise StoreError(f"{end.location}: is being copied as a whole, or has moved (`gnd store copy`)")
    if rows := source.run("SELECT path, other FROM district_owner WHERE state IN ('copying', 'leaving')"):
        raise StoreError(
            f"{source.location}: district {rows[0][0]} of it is moving to {rows[0][1]}; go on with that first, or"
            " --abandon it"
        )
    _stop_noting(source)  # left by a move that was interrupted at its very end
    _require_no_trial(source, district)


def _require_no_trial(source: End, district: District) -> None:
    where = source.in_district("trial", district)
    found = source.run(f"SELECT layer, version FROM trial WHERE state IN ('trial', 'paused') AND {where}")
    if found:
        raise StoreError(
            f"{source.location}: {len(found)} versions in district {district} are on trial (layer {found[0][0]},"
            f" version {found[0][1]}): who gets them depends on this store; settle them first (`gnd release`)"
        )


def _place(before: _OwnerRow | None, tables: dict[str, Any]) -> str:
    told = None if before is None else [getattr(before, name) for name in _FIELDS]
    return json.dumps({"before": told, "tables": tables})


def _early() -> list[DistrictPart]:
    return [part for part in OF_DISTRICT if part.kind != "late"]


def _copy_early(carrier: Carrier, progress: Progress) -> int:
    """Copy what an earlier attempt has not; how many rows."""
    source, target, district = carrier.source, carrier.target, carrier.district
    said = _said(target, district)
    assert said is not None
    tables, copied, total = said.copied, 0, sum(carrier.count(source, part) for part in _early())
    with target.transaction():
        tell_publishers(source, target)
    for part in _early():
        for layer in carrier.layers(part):
            name = f"{part.table} {layer}"
            while not tables.get(name, {}).get("is_done"):
                after = tables.get(name, {}).get("after")
                rows, after, is_done = carrier.page(part, layer, after)
                tables[name] = {"after": after, "is_done": is_done}
                with target.transaction():
                    carrier.fill(part, rows)
                    _put(target, district, replace(said, place=_place(said.before, tables)))
                copied += len(rows)
                progress(f"copy {district}", copied, max(total, copied))
    return copied


def _catch_up(carrier: Carrier, enough: int, progress: Progress) -> tuple[int, int]:
    """Copy what has changed until at most so many notes are left; how many rows in how many rounds. Where many rounds
    have not been enough, writers are as fast as the copy: then they wait while a round is made.
    """
    changes, source = 0, carrier.source
    for number in range(MOST_ROUNDS):
        is_alone = number >= ROUNDS_OF_PATIENCE
        with source.transaction(alone=True) if is_alone else source.reading():
            left = source.count(LOG)
            if left <= enough:
                return changes, number
            seen, changed = carrier.changed()
            if is_alone:
                carrier.apply(changed)
                source.forget(seen)
        if not is_alone:  # writers go on while the target is written
            carrier.apply(changed)
            with source.transaction():
                source.forget(seen)
        changes += sum(len(rows) + len(gone) for _, rows, gone in changed)
        progress(f"catch up {carrier.district}", changes, changes + max(0, left - len(seen)))
    raise StoreError(f"{source.location}: changes faster than it can be copied; {changes} changes were copied")


def _wait_until_noticed(here: _OwnerRow) -> None:
    since_s = (time.time_ns() - here.since_ns) / 1e9
    if 0.0 <= since_s < NOTICED_S:  # a clock that was set back makes nobody wait
        time.sleep(NOTICED_S - since_s)


@contextmanager
def _fence_lifted_on_failure(carrier: Carrier, here: _OwnerRow) -> Iterator[None]:
    """What fails before the switch lets the source go on as before; where nobody can tell, the fence stays."""
    try:
        yield
    except BaseException:
        said = _said(carrier.target, carrier.district)
        if said is not None and said.state == "arriving":
            with carrier.source.transaction(alone=True):
                _put(carrier.source, carrier.district, here)
        raise


def _behind_the_fence(carrier: Carrier, progress: Progress) -> tuple[int, int]:
    """The last changes, after which both hold as many rows."""
    _require_no_trial(carrier.source, carrier.district)
    done = _catch_up(carrier, 0, progress)
    for part in _early():
        n, m = carrier.count(carrier.source, part), carrier.count(carrier.target, part)
        if n != m:
            raise StoreError(
                f"table {part.table}: {m} rows of district {carrier.district} in {carrier.target.location}, {n} in"
                f" {carrier.source.location}"
            )
    return done


def _switch(carrier: Carrier, here: _OwnerRow) -> tuple[int, int]:
    """From here on the target owns the district; how many rows came with that, and of how many tiles."""
    source, target, district = carrier.source, carrier.target, carrier.district
    said, rows = _said(target, district), dict[str, int]()
    assert said is not None
    owned = replace(
        said, state="owned", since_ns=time.time_ns(), epoch=max(here.epoch, said.epoch) + 1, place=_place(None, {})
    )
    with target.transaction(alone=True):
        _put(target, district, owned)
        tell_publishers(source, target)
        tell_of_vehicles(source, target, district)
        for part in OF_DISTRICT:
            if part.kind != "early":
                rows[part.table] = carrier.copy_late(part)
        count_alone(target, district, +1)
    return sum(rows.values()), rows["tile_head"]


def _finished(source: End, target: End, district: District, progress: Progress, told: MovedDistrict) -> MovedDistrict:
    """The source says where the district is, both are compared, and the source removes it."""
    here, there = _said(source, district), _said(target, district)
    assert here is not None
    assert there is not None
    if here.state == "leaving":
        here = replace(
            here, region=there.region, state="moved", since_ns=time.time_ns(), epoch=there.epoch, place=_place(None, {})
        )
        with source.transaction(alone=True):
            count_alone(source, district, -1)
            _put(source, district, here)
    if not here.place:
        return replace(told, epoch=there.epoch)
    _stop_noting(source)
    time.sleep(NOTICED_S)  # whoever reads the old rows has ended
    digest = _require_same(Carrier(source, target, district), progress, may_lack=not told.gap_s)
    _remove(source, district)
    for end, said in ((source, here), (target, there)):
        with end.transaction():
            _put(end, district, replace(said, place=""))
    return replace(told, digest=digest, epoch=there.epoch)


def _stop_noting(source: End) -> None:
    """Table by table: readers of one never wait for those of another."""
    if source.columns(LOG):
        source.stop_noting()
        source.run(f"DROP TABLE {LOG}")


def _require_same(carrier: Carrier, progress: Progress, *, may_lack: bool) -> str:
    """The SHA-256 over what never changes: versions, what they were made of, reports."""
    whole, done = sha256(), 0
    with carrier.source.reading():
        for part in OF_DISTRICT:
            for rows in carrier.lasting(part, may_lack=may_lack):
                whole.update(repr(rows).encode())
                done += len(rows)
                progress(f"compare {carrier.district}", done, done)
    return whole.hexdigest()


def _remove(end: End, district: District) -> None:
    """Remove what a store holds of a district, some tiles a transaction."""
    first = district.first_morton
    parts = [part for part in reversed(OF_DISTRICT) if part.kind != "upload"]
    where = {part.table: end.in_district(part.table, district) for part in parts}
    for start in range(first, first + TILES_OF_DISTRICT, REMOVED_AT_ONCE):
        some = f"tile >= {start} AND tile < {start + REMOVED_AT_ONCE}"
        with end.transaction():
            for table, of_district in where.items():
                end.run(f"DELETE FROM {table} WHERE {of_district} AND {some}")
    for numbers in _uploads(end, district):
        with end.transaction():
            end.run_each(f"DELETE FROM upload WHERE upload = {end.mark}", numbers)


def _uploads(end: End, district: District) -> Iterator[list[Row]]:
    where, after = end.in_district("upload", district), 0
    while rows := end.run(
        f"SELECT upload FROM upload WHERE upload > {end.mark} AND {where} ORDER BY upload LIMIT {UPLOADS_AT_ONCE}",
        (after,),
    ):
        yield rows
        after = rows[-1][0]
