"""`copy_store_online`: a store into another database while shards write to it, then a switch.

1. Triggers of the source note the key of each row that changes from now on.
2. All rows are copied by key, a batch a transaction of the target, which also remembers how far it has come.
3. What has changed meanwhile is copied again, in rounds, until little is left.
4. The fence: the source refuses writes and says where it has moved. The last notes are copied; the target is whole.
5. Both are compared, row by row, as they were at that instant, while the target is in use.

Every step may be interrupted, also by kill -9: a row that has changed since 1 has a note, and notes go only after the
target holds the row as it is now.
"""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from secrets import token_hex
from typing import Any, Final

from gnd.tile_store.copying.contents import ALL, Contents, Row
from gnd.tile_store.copying.ends import COPIED, LOG, MARK, MOVED, WHOLE, End
from gnd.tile_store.errors import StoreError

BATCH: Final = 500
"""Rows a transaction: some hundred kB, or the bodies of some hundred tiles."""
NOTES: Final = 2000
"""Notes a round."""
FEW: Final = 1000
"""So few notes may be left to the fence."""
ROUNDS_OF_PATIENCE: Final = 20
MOST_ROUNDS: Final = 10_000
_BY_TABLE: Final = {one.table: one for one in ALL}
Changed = tuple[Contents, tuple[str, ...], list[Row], list[Row]]
"""A table, its columns, rows that were written, keys of rows that were removed."""
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Copied:
    """What was done."""

    rows: int
    """Copied at first, those of an earlier attempt left out."""
    changes: int
    """Copied again, because they had changed."""
    rounds: int
    gap_s: float
    """From the first write that was refused until the target could be used."""
    digest: str
    """SHA-256 over all rows, the same of both; "": the copy was interrupted while they were compared."""
    tiles: int
    was_resumed: bool


def copy_store_online(source: End, target: End, progress: Progress) -> Copied:
    """Copy a store, then move to it.

    Raises:
        StoreError: the target holds another store, the source is being copied to another place or has moved already, or
            the two differ.
    """
    copy_id, was_resumed = _begin(source, target)
    if target.state() == WHOLE:
        return _finish(source, target, copy_id, Copied(0, 0, 0, 0.0, "", target.count("tile_head"), True))
    rows = _copy_rows(source, target, copy_id, progress)
    if not was_resumed or rows:
        target.analyse()
    changes, rounds = _catch_up(source, target, FEW, progress)
    began_s = time.monotonic()
    _fence(source, target)
    more, last = _catch_up(source, target, 0, progress)
    _require_same_counts(source, target)
    tiles = target.count("tile_head")
    with target.transaction():
        target.reveal()
        if target.count("district_owner"):
            target.guard()
        target.put_mark(copy_id, source.location, WHOLE, "")
    target.name_it()
    with source.reading(), target.reading():  # shards may write from here on: this is how both were at the switch
        gap_s = time.monotonic() - began_s
        digest = _require_same(source, target, progress)
    told = Copied(rows, changes + more, rounds + last, round(gap_s, 3), digest, tiles, was_resumed)
    return _finish(source, target, copy_id, told)


def _finish(source: End, target: End, copy_id: str, told: Copied) -> Copied:
    target.name_it()
    with source.transaction():
        source.put_mark(copy_id, target.location, MOVED, "")
    return told


def abandon(source: End) -> bool:
    """Forget a copy that was begun, or a move: the source notes and refuses nothing more. False: there was none."""
    if source.state() not in (COPIED, MOVED):
        return False
    with source.transaction(alone=True):
        source.stop_noting()
        source.allow()
        if source.columns(LOG):
            source.run(f"DROP TABLE {LOG}")
        source.run(f"DELETE FROM {MARK}")
    return True


def _begin(source: End, target: End) -> tuple[str, bool]:
    """The copy's id, and whether it goes on with one that was interrupted."""
    here, there = source.marked(), target.marked()
    if moving := source.run("SELECT path FROM district_owner WHERE state IN ('copying', 'leaving', 'arriving')"):
        raise StoreError(
            f"{source.location}: district {moving[0][0]} of it is moving; go on with that (`gnd regions move`), or"
            " --abandon it"
        )
    if here is not None and here[2] == WHOLE:  # it was a target itself, once
        here = None
    if here is not None and here[2] == MOVED:
        raise StoreError(f"{source.location}: has moved to {here[1]}; copy from there, or --abandon that move")
    if here is not None and here[1] != target.location:
        raise StoreError(f"{source.location}: is being copied to {here[1]}; go on with that, or --abandon it")
    if here is not None and there is not None and here[0] == there[0]:
        return here[0], True
    if (there is not None and there[1] != source.location) or not target.is_empty():
        raise StoreError(f"{target.location}: holds a store, or a part of another copy; choose an empty place")
    copy_id = token_hex(16)
    with target.transaction():
        target.hide()
        target.put_mark(copy_id, source.location, COPIED, "{}")
    with source.transaction(alone=True):
        if here is None:
            source.note_changes()
        source.put_mark(copy_id, target.location, COPIED, "")
    return copy_id, False


def _columns(source: End, target: End, contents: Contents) -> tuple[str, ...]:
    """The columns of a table, the same at both ends."""
    columns = source.columns(contents.table)
    if columns != target.columns(contents.table):
        raise StoreError(f"table {contents.table}: other columns in {target.location} than in {source.location}")
    return columns


def _copy_rows(source: End, target: End, copy_id: str, progress: Progress) -> int:
    """Copy what an earlier attempt has not; how many rows."""
    mark = target.marked()
    assert mark is not None
    places: dict[str, Any] = json.loads(mark[3])
    done = sum(target.count(table) for table in places)
    total = sum(source.count(one.table) for one in ALL)
    copied = 0
    for one in ALL:
        place = places.get(one.table)
        if place is not None and place["is_done"]:
            continue
        columns = _columns(source, target, one)
        after = key_of(one, place["after"]) if place is not None else ()
        at = [columns.index(name) for name in one.key]
        rows = source.page(one, columns, after, BATCH)
        while True:
            is_done = len(rows) < BATCH
            after = tuple(rows[-1][i] for i in at) if rows else after
            places[one.table] = {"after": key_as_json(after), "is_done": is_done}
            with target.transaction():
                target.fill(one, columns, rows)
                target.put_mark(copy_id, source.location, COPIED, json.dumps(places))
            copied += len(rows)
            progress("copy", done + copied, max(total, done + copied))
            if is_done:
                break
            rows = source.page(one, columns, after, BATCH)
    return copied


def key_as_json(key: Row) -> list[Any]:
    """A key as it is kept; bytes in hexadecimal."""
    return [one.hex() if isinstance(one, bytes) else one for one in key]


def key_of(contents: Contents, told: list[Any]) -> Row:
    """The key that was kept so."""
    pairs = zip(contents.key, told, strict=False)
    return tuple(bytes.fromhex(value) if name in contents.hashes else value for name, value in pairs)


def _catch_up(source: End, target: End, enough: int, progress: Progress) -> tuple[int, int]:
    """Copy what has changed, until at most so many notes are left; how many rows in how many rounds. Where many rounds
    have not been enough, writers are as fast as the copy: then they wait while a round is made.
    """
    changes = 0
    for number in range(MOST_ROUNDS):
        is_alone = number >= ROUNDS_OF_PATIENCE
        with source.transaction(alone=True) if is_alone else source.reading():
            left = source.count(LOG)
            if left <= enough:
                return changes, number
            notes = source.changed(NOTES)
            seen = [one for one, _, _ in notes]
            changed = _changed_rows(source, target, notes)
            if is_alone:
                _apply(target, changed)
                source.forget(seen)
        if not is_alone:  # writers go on while the target is written
            _apply(target, changed)
            with source.transaction():
                source.forget(seen)
        changes += sum(len(rows) + len(gone) for _, _, rows, gone in changed)
        progress("catch up", changes, changes + max(0, left - len(notes)))
    raise StoreError(f"{source.location}: changes faster than it can be copied; {changes} changes were copied")


def _apply(target: End, changed: list[Changed]) -> None:
    """Write rows as they are now; then their notes may go."""
    with target.transaction():
        for one, _, _, gone in reversed(changed):
            target.remove(one, gone)
        for one, columns, rows, _ in changed:
            target.put(one, columns, rows)


def _changed_rows(source: End, target: End, notes: list[Row]) -> list[Changed]:
    """The rows that notes speak of, as they are now, and the keys of those that are gone, by table in their order."""
    keys: dict[str, set[Row]] = {}
    for _, table, key in notes:
        keys.setdefault(table, set()).add(key_of(_BY_TABLE[table], json.loads(key)))
    changed = []
    for one in ALL:
        if one.table not in keys:
            continue
        columns = _columns(source, target, one)
        wanted = sorted(keys[one.table])
        found = list(zip(wanted, source.rows(one, columns, wanted), strict=True))
        rows = [row for _, row in found if row is not None]
        changed.append((one, columns, rows, [key for key, row in found if row is None]))
    return changed


def _fence(source: End, target: End) -> None:
    """Refuse writes to the source from now on; after an interruption it may do so already."""
    with source.transaction(alone=True):
        source.stop_noting()
        source.allow()
        source.refuse(target.location)


def _require_same_counts(source: End, target: End) -> None:
    for one in ALL:
        here, there = source.count(one.table), target.count(one.table)
        if here != there:
            raise StoreError(f"table {one.table}: {there} rows in {target.location}, {here} in {source.location}")


def _require_same(source: End, target: End, progress: Progress) -> str:
    """The SHA-256 over all rows."""
    whole, done, total = sha256(), 0, sum(source.count(one.table) for one in ALL)
    for one in ALL:
        columns = source.columns(one.table)
        for here, there in zip(_pages(source, one, columns), _pages(target, one, columns), strict=True):
            if here != there:
                raise StoreError(_first_difference(one, columns, here, there))
            whole.update(repr(here).encode())
            done += len(here)
            progress("compare", done, total)
    return whole.hexdigest()


def _first_difference(contents: Contents, columns: tuple[str, ...], here: list[Row], there: list[Row]) -> str:
    row = next((row for row, other in zip(here, there, strict=False) if row != other), (here or there)[-1])
    key = ", ".join(f"{name} {row[columns.index(name)]!r}" for name in contents.key)
    return f"table {contents.table}: a row is not the same in both, the first one with {key}"


def _pages(end: End, contents: Contents, columns: tuple[str, ...]) -> Iterator[list[Row]]:
    at, after = [columns.index(name) for name in contents.key], ()
    while True:
        rows = end.page(contents, columns, after, BATCH)
        yield rows
        if len(rows) < BATCH:
            return
        after = tuple(rows[-1][i] for i in at)


@contextmanager
def closing(*ends: End) -> Iterator[None]:
    """Close ends in any case."""
    try:
        yield
    finally:
        for end in ends:
            end.close()
