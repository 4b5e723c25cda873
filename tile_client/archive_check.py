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
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gnd.fleet_bus.errors import SealError
from gnd.fleet_bus.identity.lists import replace_file
from gnd.fleet_bus.publishers import Publishers
from gnd.schemas.archive import ROOT_NAME, ArchiveIndex, ArchiveRoot, index_name
from gnd.schemas.archive_seal import Sealed, SealNumber, digest_of_index
from gnd.tile_client.errors import ArchiveAway, ArchiveStale, ArchiveWrong

if TYPE_CHECKING:
    from gnd.tile_client.archive import Archive

SEEN_FILE: Final = "archives_seen.json"
MOST_SEEN: Final = 4096
_LOG: Final = logging.getLogger(__name__)


class SeenStates:
    """The newest state of each object that was seen, in a file; safe in several threads.

    A file that cannot be read counts as none, one that cannot be written is told of once: neither stops anybody.

    Args:
        path: of the file; it need not be there. None: nothing outlives the process.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._path, self._lock = path, threading.Lock()
        self._seen = OrderedDict[str, SealNumber]()
        if path is None:
            return
        try:
            told = json.loads(path.read_bytes())
            self._seen.update((str(name), SealNumber(int(at_s), int(number))) for name, (at_s, number) in told.items())
        except FileNotFoundError:
            pass
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            _LOG.warning("%s is not read, so an older state of an archive is not noticed: %s", path, error)

    def newest(self, name: str) -> SealNumber:
        """The newest state of an object; the earliest there is where none was seen."""
        with self._lock:
            return self._seen.get(name, SealNumber())

    def note(self, name: str, order: SealNumber) -> None:
        """This state was seen; nothing where a newer one was."""
        with self._lock:
            if order <= self._seen.get(name, SealNumber()):
                return
            self._seen[name] = order
            self._seen.move_to_end(name)
            while len(self._seen) > MOST_SEEN:
                self._seen.popitem(last=False)
            if self._path is not None:
                self._write(self._path)

    def _write(self, path: Path) -> None:
        told = {name: (one.signed_s, one.number) for name, one in self._seen.items()}
        try:
            replace_file(path, json.dumps(told).encode())
        except OSError as error:
            self._path = None
            _LOG.warning("which states of archives were seen is not kept in %s: %s", path, error)


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
