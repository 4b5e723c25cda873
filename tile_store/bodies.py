"""Bodies of versions as objects: the database keeps heads, versions and journal, and which bodies lie elsewhere.

An object is named by the hash of its content and its codec, created once, and never changed. It is put there before
the transaction that names it, so a version whose row can be read has its body. It is removed by `collect` alone, which
says in the database first what it is about to remove (`body_going`), and for how long after: whoever publishes such a
body meanwhile keeps it in the database. So neither needs to know of the other, and the clock of the bucket decides
nothing but how young an object is left alone.
"""

import logging
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

from gnd.tile_store.connection import SqlConnection, change, fetch
from gnd.tile_store.errors import ObjectsAway, StoreDamaged, StoreError, StoreUnavailable
from gnd.tile_store.memory import Memory
from gnd.tile_store.objects import NamedObjects, ObjectSeen, check_creates, open_objects
from gnd.tile_store.values import NS_PER_S, Content

FOLDER: Final = "body/"
GRACE_S: Final = 3600.0
"""What nothing names and is younger stays; and so long it is remembered that a body was removed, ..."""
COMMITTED_WITHIN_S: Final = GRACE_S / 4
"""... longer than any publisher may take from putting a body there to naming it; a slower one keeps it itself."""
REMEMBERED_BYTES: Final = 64 * 1024 * 1024
AT_ONCE: Final = 8
TOGETHER: Final = 128
_LOG: Final = logging.getLogger(__name__)
_NAME: Final = re.compile(r"body/[0-9a-f]{2}/([0-9a-f]{64})\.(\d{1,4})")


def body_name(sha: bytes, codec_id: int) -> str:
    """Name of a body, by the hash of its content and its codec."""
    return f"{FOLDER}{sha.hex()[:2]}/{sha.hex()}.{codec_id}"


class Bodies:
    """Puts bodies among objects, and reads them. Safe in several threads.

    Args:
        objects: where they lie.
        is_checked: whether they are known to be created once (`check_creates`); if not, that is looked at before the
            first one is put there.
    """

    def __init__(self, objects: NamedObjects, *, is_checked: bool = True) -> None:
        self.objects = objects
        self._is_checked = is_checked
        self._memory: Memory[bytes] = Memory(REMEMBERED_BYTES, len)

    def keep(self, contents: Sequence[Content]) -> list[Content]:
        """Put bodies there; the same contents, which say since when they are.

        Raises:
            ObjectsAway: the objects cannot be written.
        """

        def put(content: Content) -> Content:
            began_s = time.monotonic()
            with _away():
                self.objects.put_new(body_name(content.sha, content.codec_id), content.body)
            return replace(content, kept_s=began_s)

        if not self._is_checked:
            with _away():
                check_creates(self.objects)
            self._is_checked = True
        if len(contents) < 2:
            return [put(one) for one in contents]
        with ThreadPoolExecutor(AT_ONCE) as threads:
            return list(threads.map(put, contents))

    def read(self, sha: bytes, codec_id: int) -> bytes:
        """A body.

        Raises:
            StoreDamaged: there is none.
            ObjectsAway: the objects cannot be read.
        """
        name = body_name(sha, codec_id)

        def from_objects() -> bytes:
            with _away():
                body = self.objects.get(name)
            if body is None:
                raise StoreDamaged(f"{self.objects.location}: {name}, the body of a version, is not there")
            return body

        return self._memory.get(name, from_objects)


@contextmanager
def _away() -> Iterator[None]:
    try:
        yield
    except StoreUnavailable as error:
        raise ObjectsAway(str(error)) from error


def place_of_bodies(c: SqlConnection) -> str | None:
    """Where the bodies of a store lie that are not in it; None: nobody has said a place."""
    rows = fetch(c, "place_of_bodies")
    return str(rows[0][0]) if rows else None


def bodies_at(location: str, *, to_write: bool) -> Bodies:
    """The bodies at a place.

    Raises:
        ObjectsAway: `to_write`, and nobody answers there.
        StoreUnavailable: it cannot be used; or `to_write`, and it creates objects twice.
    """
    objects = open_objects(location)
    if to_write:
        check_creates(objects)
    return Bodies(objects)


def bodies_at_start(location: str) -> Bodies:
    """The bodies of a store that is opened. Where nobody answers there now, who only takes reports or serves what it
    remembers can work all the same: then it is checked before the first body is put there.

    Raises:
        StoreUnavailable: it cannot be used, or creates objects twice.
    """
    try:
        return bodies_at(location, to_write=True)
    except ObjectsAway as error:
        _LOG.warning("bodies of tiles cannot be read or written now: %s", error)
        return Bodies(open_objects(location), is_checked=False)


def lies_elsewhere(c: SqlConnection, content: Content) -> bool:
    """Whether a version may be written without its body: it was put among the objects, and nobody removes it."""
    if not content.body:
        return True
    if content.kept_s is None or time.monotonic() - content.kept_s > COMMITTED_WITHIN_S:
        return False
    takes = fetch(c, "takes_bodies")
    return bool(takes) and not fetch(c, "body_going", {"sha": content.sha, "codec_id": content.codec_id})


class StoreOfBodies(Protocol):
    """What moving and collecting need of a store."""

    location: str

    def transact(self, work: Any) -> Any:
        """See `SqlStore.transact`."""

    def look(self, work: Any) -> Any:
        """See `SqlStore.look`."""


@dataclass(frozen=True, slots=True)
class Moved:
    """Versions whose bodies were moved, and their bytes."""

    versions: int
    bytes: int


@dataclass(frozen=True, slots=True)
class Collected:
    """Objects that were removed, and their bytes."""

    objects: int
    bytes: int


def move_out(store: StoreOfBodies, location: str) -> Moved:
    """Put all bodies of a store among objects, and those that come; who is interrupted moves again.

    Raises:
        StoreError: bodies lie at another place already, or the place cannot be used.
    """
    bodies = bodies_at(location, to_write=True)

    def begin(c: SqlConnection, _now: int) -> None:
        before = place_of_bodies(c)
        if before is not None and before != location:
            raise StoreError(f"{store.location}: its bodies lie at {before}; move them back first (--back)")
        change(c, "put_place_of_bodies", {"location": location, "takes": 1})

    store.transact(begin)
    versions = size = 0
    for rows in _pages(store, "bodies_here"):
        kept = bodies.keep([Content(sha, codec_id, body) for _, _, _, sha, codec_id, body in rows])

        def empty(c: SqlConnection, _now: int, rows: Any = rows, kept: Any = kept) -> list[int]:
            return [
                change(c, "set_body", {"layer": layer, "tile": tile, "version": version, "body": b""})
                for (layer, tile, version, *_), content in zip(rows, kept, strict=True)
                if lies_elsewhere(c, content)
            ]

        versions += sum(store.transact(empty))
        size += sum(len(content.body) for content in kept)
    return Moved(versions, size)


def move_back(store: StoreOfBodies) -> Moved:
    """Take all bodies of a store into its database; the objects stay until they are collected or removed by hand.

    Raises:
        StoreError: no place is said; a body is missing.
    """

    def begin(c: SqlConnection, _now: int) -> str:
        place = place_of_bodies(c)
        if place is None:
            raise StoreError(f"{store.location}: all bodies are in the database")
        change(c, "put_place_of_bodies", {"location": place, "takes": 0})  # from now on new ones stay
        return place

    bodies = bodies_at(store.transact(begin), to_write=False)
    versions = size = 0
    for rows in _pages(store, "bodies_elsewhere"):
        read: list[bytes] = [bodies.read(sha, codec_id) for _, _, _, sha, codec_id in rows]

        def fill(c: SqlConnection, _now: int, rows: Any = rows, read: list[bytes] = read) -> None:
            for (layer, tile, version, *_), body in zip(rows, read, strict=True):
                change(c, "set_body", {"layer": layer, "tile": tile, "version": version, "body": body})

        store.transact(fill)
        versions, size = versions + len(rows), size + sum(map(len, read))
    store.transact(lambda c, _now: change(c, "forget_place_of_bodies", {}))
    return Moved(versions, size)


def collect(store: StoreOfBodies, bodies: Bodies, grace_s: float = GRACE_S) -> Collected:
    """Remove the bodies that no version names and that are older. Others may publish meanwhile.

    Raises:
        StoreError: the store or the objects fail. What was not removed is removed the next time.
    """
    before_ns = time.time_ns() - round(grace_s * NS_PER_S)
    removed = size = 0
    for some in _old(bodies.objects, before_ns):
        going = store.transact(lambda c, now, some=some: [one for one in some if _condemn(c, one, now)])
        bodies.objects.remove(one.name for one in going)
        removed, size = removed + len(going), size + sum(one.size_bytes for one in going)
    store.transact(lambda c, now: change(c, "forget_bodies_going", {"before": now - round(GRACE_S * NS_PER_S)}))
    return Collected(removed, size)


def _old(objects: NamedObjects, before_ns: int) -> Iterator[list[ObjectSeen]]:
    some = list[ObjectSeen]()
    for one in objects.each(FOLDER):
        if one.written_ns < before_ns and _NAME.fullmatch(one.name):
            some.append(one)
        if len(some) == TOGETHER:
            yield some
            some = []
    if some:
        yield some


def _condemn(c: SqlConnection, one: ObjectSeen, now: int) -> bool:
    """Say that a body is about to go, unless a version names it."""
    match = _NAME.fullmatch(one.name)
    assert match is not None
    row = {"sha": bytes.fromhex(match[1]), "codec_id": int(match[2])}
    if fetch(c, "names_body", row):
        return False
    change(c, "put_body_going", row | {"since_ns": now})
    return True


def _pages(store: StoreOfBodies, statement: str) -> Iterable[list[Any]]:
    """Rows of a statement in the order of their keys, some at a time, each page read anew."""
    after: dict[str, Any] = {"layer": "", "tile": -1, "version": 0}
    while rows := store.look(lambda c, after=after: fetch(c, statement, after | {"n": TOGETHER})):
        yield rows
        after = dict(zip(("layer", "tile", "version"), rows[-1][:3], strict=True))
