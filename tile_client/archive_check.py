"""Whether an index or the root of an archive is one that a publisher has signed, and no older state than was seen.

Tiles prove themselves; an index says which are there. A mirror that alters it, mixes states or goes back to an older
one is noticed and named. What nobody can notice alone is a mirror that shows a state that was good once to who has
never seen a newer one; but when it was signed is told.
"""

import json
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gnd.fleet_bus.errors import SealError
from gnd.fleet_bus.identity.lists import replace_file
from gnd.fleet_bus.publishers import Publishers
from gnd.schemas.archive import ROOT_NAME, ArchiveIndex, ArchiveRoot, index_name
from gnd.schemas.archive_seal import Sealed, SealNumber, digest_of_index
from gnd.tile_client.errors import ArchiveAway, ArchiveStale, ArchiveWrong, SeenDamaged

if TYPE_CHECKING:
    from gnd.tile_client.archive import Archive

SEEN_FILE: Final = "archives_seen.json"
CATALOGS_SEEN_FILE: Final = "catalogs_seen.json"
MOST_SEEN: Final = 65_536
MOST_SEEN_BYTES: Final = 8 * 1024 * 1024
"""128 of each state; JSON takes up to 20 times as much in memory."""
_LOG: Final = logging.getLogger(__name__)


class SeenStates:
    """The newest state of each object that was seen, in a file; safe in several threads.

    The file is replaced as a whole; several processes may have the same one. One that cannot be read, or was damaged,
    is laid aside, told of, and counts as none; one that cannot be written is told of once: neither stops anybody.

    Args:
        path: of the file; it need not be there. None: nothing outlives the process.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path, self._lock = path, threading.RLock()
        self._seen = OrderedDict[str, SealNumber]()
        self._together, self._is_new = 0, False
        if path is not None:
            self._read(path)

    def newest(self, name: str) -> SealNumber:
        """The newest state of an object; the earliest there is where none was seen."""
        with self._lock:
            return self._seen.get(name, SealNumber())

    def names(self, prefix: str) -> set[str]:
        """The objects that were seen whose names begin so."""
        with self._lock:
            return {name for name in self._seen if name.startswith(prefix)}

    def note(self, name: str, order: SealNumber) -> None:
        """This state was seen; nothing where a newer one was."""
        with self._lock:
            if order <= self._seen.get(name, SealNumber()):
                return
            self._take(name, order)
            self._is_new = True
            if not self._together:
                self._write()

    @contextmanager
    def together(self) -> Iterator[None]:
        """What is noted inside, in this thread or another, is written once, at the end."""
        with self._lock:
            self._together += 1
        try:
            yield
        finally:
            with self._lock:
                self._together -= 1
                if not self._together and self._is_new:
                    self._write()

    def _take(self, name: str, order: SealNumber) -> None:
        self._seen[name] = max(order, self._seen.get(name, SealNumber()))
        self._seen.move_to_end(name)
        while len(self._seen) > MOST_SEEN:
            self._seen.popitem(last=False)

    def _read(self, path: Path) -> None:
        try:
            for name, order in read_seen(path.read_bytes()).items():
                self._take(name, order)
        except FileNotFoundError:
            pass
        except SeenDamaged as error:
            aside = path.with_name(f"{path.name}.damaged")
            with suppress(OSError):
                path.replace(aside)
            _LOG.warning(
                "%s is not what was written: %s; it counts as nothing seen, so an older state that somebody shows now"
                " is not noticed; laid aside as %s",
                path,
                error,
                aside.name,
            )
        except OSError as error:
            _LOG.warning("%s is not read, so an older state is not noticed: %s", path, error)

    def _write(self) -> None:
        self._is_new, path = False, self._path
        if path is None:
            return
        self._read(path)  # what another process has seen meanwhile
        try:
            replace_file(path, bytes_of_seen(self._seen))
        except OSError as error:
            self._path = None
            _LOG.warning("which states were seen is not kept in %s: %s", path, error)


def seen_beside(identity: Path | None) -> SeenStates:
    """What programs with an identity remember of catalogs and lists of districts, next to it; without one: nothing."""
    return SeenStates(None if identity is None else identity / CATALOGS_SEEN_FILE)


def bytes_of_seen(seen: Mapping[str, SealNumber]) -> bytes:
    """The states as a file holds them: JSON, with a checksum."""
    told = {name: [one.signed_s, one.number] for name, one in seen.items()}
    return json.dumps({"sha256": _checksum(told), "states": told}).encode()


def read_seen(data: bytes) -> dict[str, SealNumber]:
    """The states in a file.

    Raises:
        SeenDamaged: it is none, or was changed.
    """
    if len(data) > MOST_SEEN_BYTES:
        raise SeenDamaged(f"{len(data)} bytes, at most {MOST_SEEN_BYTES}")
    try:
        told = json.loads(data)
        states = told["states"] if "sha256" in told else told  # releases before wrote the states alone
        found = {str(name): _state(*one) for name, one in states.items()}
        is_whole = states is told or told["sha256"] == _checksum(states)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise SeenDamaged(f"{len(data)} bytes are no states: {error}") from error
    if not is_whole:
        raise SeenDamaged(f"the checksum of its {len(found)} states does not fit")
    return found


def _state(signed_s: int, number: int) -> SealNumber:
    if not (type(signed_s) is type(number) is int and 0 <= signed_s < 2**48 and 0 <= number < 2**48):
        raise SeenDamaged(f"a state with time {str(signed_s)[:40]} and number {str(number)[:40]}: 0 .. {2**48 - 1}")
    return SealNumber(signed_s, number)


def _checksum(states: object) -> str:
    return sha256(json.dumps(states, sort_keys=True).encode()).hexdigest()


class ArchiveCheck:
    """Checks what an archive says of itself. Safe in several threads.

    Args:
        publishers: whose signature counts.
        seen: what was seen before.
        oldest_s: a root that was signed longer ago is refused, s; None: any age will do.
    """

    def __init__(self, publishers: Publishers, seen: SeenStates, oldest_s: float | None = None) -> None:
        self._publishers, self._seen, self._oldest_s = publishers, seen, oldest_s

    def root(self, archive: "Archive", root: ArchiveRoot) -> str:
        """Who has signed a root that came.

        Raises:
            ArchiveWrong: nobody who may, or it is an older one than was seen, or than is wanted.
        """
        where = f"{archive.url}{ROOT_NAME}"
        who = self._check(archive, where, ROOT_NAME, root.sealed)
        assert root.sealed is not None
        age_s = time.time() - root.sealed.seal.signed_s
        if self._oldest_s is not None and age_s > self._oldest_s:
            raise ArchiveWrong(
                f"{where}: signed {age_s / 3600:.1f} h ago, at most {self._oldest_s / 3600:.1f} h are wanted: an old"
                " mirror, or nobody has published since"
            )
        return who

    def index(self, archive: "Archive", index: ArchiveIndex, root: ArchiveRoot | None = None) -> None:
        """Whether an index that came is to be used.

        Args:
            archive: where from.
            index: which.
            root: of the same archive, checked; None: there is none at hand.

        Raises:
            ArchiveStale: the root names a newer one.
            ArchiveWrong: nobody who may has signed it, or it is an older one than was seen.
        """
        name = index_name(index.layer, index.district)
        where = f"{archive.url}{name}"
        self._check(archive, where, name, index.sealed)
        if root is None or root.sealed is None or index.sealed is None:
            return
        if digest_of_index(index.sealed.body_sha) == root.digest(index.layer, index.district):
            return
        came, held = index.sealed.seal, root.sealed.seal
        if came.archive != held.archive or came.signed_s < held.signed_s:
            raise ArchiveStale(
                f"{where}: not the index that the archive's root names, and signed {held.signed_s - came.signed_s} s"
                " before it: an older state"
            )

    def missing(self, archive: "Archive", name: str) -> ArchiveAway:
        """What to say of an object that a checked root names, and that is not there."""
        return ArchiveAway(f"{archive.url}{name}: not there, though the root names it: withheld, or removed")

    def _check(self, archive: "Archive", where: str, name: str, sealed: Sealed | None) -> str:
        if sealed is None:
            raise ArchiveWrong(
                f"{where}: nobody has signed it, and this client has an identity, so it takes signed archives only"
                " (`gnd map publish` with --identity FOLDER signs it)"
            )
        seal = sealed.seal
        try:
            if not self._publishers.knows(seal.signer):
                self._publishers.learn(archive.certificate(seal.signer))
            holder = self._publishers.check(seal.signer, seal.signed_s, sealed.text, seal.signature)
        except SealError as error:
            raise ArchiveWrong(f"{where}: {error}") from error
        object_seen = f"{seal.archive.hex()}/{name}"
        newest = self._seen.newest(object_seen)
        if seal.order < newest:
            raise ArchiveWrong(
                f"{where}: an older state: number {seal.number}, signed {newest.signed_s - seal.signed_s} s before"
                f" number {newest.number}, which was seen here"
            )
        self._seen.note(object_seen, seal.order)
        return str(holder)
