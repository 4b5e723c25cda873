"""Objects by name in a folder or a bucket: whole, never half; what archives are published to, and bodies may lie in."""

import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from gnd.tile_store.errors import StoreBusy, StoreError, StoreUnavailable

S3: Final = "s3://"
_NAME: Final = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*(/[A-Za-z0-9_-][A-Za-z0-9_.-]*)*")
_BUCKET: Final = re.compile(r"[a-z0-9][a-z0-9.-]{1,62}")
_PARTIAL: Final = ".partial"


@dataclass(frozen=True, slots=True)
class ObjectSeen:
    """An object: its name, its bytes, and when it was written last, ns UTC by the clock of who keeps it."""

    name: str
    size_bytes: int
    written_ns: int


class NamedObjects(Protocol):
    """Objects by name. Safe in several threads and processes; errors are `StoreUnavailable`."""

    @property
    def location(self) -> str:
        """What messages call it; without credentials."""

    def put_new(self, name: str, data: bytes) -> bool:
        """Write an object that is not there; False, and nothing is written, where one of this name is."""

    def put(self, name: str, data: bytes, *, changes: bool = False) -> None:
        """Write an object, or replace it: readers see the old one or the new one. `changes`: caches must ask again."""

    def get(self, name: str, start: int = 0, length: int | None = None) -> bytes | None:
        """The bytes of an object, or `length` of them from `start` on; None: there is none."""

    def each(self, prefix: str) -> Iterator[ObjectSeen]:
        """The objects whose names begin with a prefix that ends in a slash, or "" for all; in any order."""

    def remove(self, names: Iterable[str]) -> None:
        """Remove objects; those that are not there are not missed."""


def open_objects(location: str | Path) -> NamedObjects:
    """The objects at a location: a folder, which is made when missing, or s3://BUCKET/PREFIX.

    Credentials, region and endpoint of a bucket come from the environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY,
    AWS_REGION, AWS_ENDPOINT, ...), never from the location.

    Raises:
        StoreUnavailable: it cannot be used, or the library for buckets is not installed.
    """
    text = str(location)
    if not text.startswith(S3):
        return FolderObjects(Path(location))
    bucket, _, prefix = text.removeprefix(S3).partition("/")
    prefix = prefix.strip("/")
    if not _BUCKET.fullmatch(bucket) or (prefix and not _NAME.fullmatch(prefix)):
        # not repeated: it may hold a key
        raise StoreUnavailable("a bucket is given as s3://BUCKET or s3://BUCKET/PREFIX, without keys, ports or queries")
    try:
        from gnd.tile_store.objects_s3 import S3Objects
    except ImportError as error:
        raise StoreUnavailable(
            f"{text}: objects in S3 need obstore ({error}): pip install 'gnd-fleet[objects]'"
        ) from None
    return S3Objects(bucket, prefix)


def check_creates(objects: NamedObjects) -> None:
    """Whether what keeps these objects refuses to create one twice. Without that, two writers of one name would both
    believe theirs is there.

    Raises:
        StoreUnavailable: it does not.
    """
    name = f"probe/{secrets.token_hex(16)}"
    is_new = objects.put_new(name, b"1")  # an error of it is told before anything is to be removed
    try:
        if not is_new or objects.put_new(name, b"2"):
            raise StoreUnavailable(
                f"{objects.location}: creates an object that is there already (conditional writes, If-None-Match: *,"
                " are not honoured); use a server that does"
            )
    finally:
        objects.remove([name])


def check_name(name: str) -> str:
    """The name itself; StoreError where it could leave a folder or confuse a server."""
    if not _NAME.fullmatch(name):
        raise StoreError(f"object name {name[:120]!r} is not made of letters, digits, _ - . and /")
    return name


class FolderObjects:
    """Objects as files. A file gets its name only when its bytes are on the disk.

    Args:
        folder: where; it is made when its parent exists.

    Raises:
        StoreUnavailable: it cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with self._refusing("open"):
            folder.mkdir(exist_ok=True)

    @property
    def location(self) -> str:
        """See `NamedObjects.location`."""
        return str(self._folder)

    def put_new(self, name: str, data: bytes) -> bool:
        """See `NamedObjects.put_new`."""
        with self._refusing(f"write {name}"), self._written(name, data) as (partial, path):
            try:
                os.link(partial, path)
            except FileExistsError:
                return False
            _sync(path.parent)
            return True

    def put(self, name: str, data: bytes, *, changes: bool = False) -> None:  # noqa: ARG002
        """See `NamedObjects.put`."""
        with self._refusing(f"write {name}"), self._written(name, data) as (partial, path):
            partial.replace(path)
            _sync(path.parent)

    def get(self, name: str, start: int = 0, length: int | None = None) -> bytes | None:
        """See `NamedObjects.get`."""
        with self._refusing(f"read {name}"):
            try:
                with self._path(name).open("rb") as file:
                    file.seek(start)
                    return file.read(-1 if length is None else length)
            except (FileNotFoundError, NotADirectoryError):
                return None

    def each(self, prefix: str) -> Iterator[ObjectSeen]:
        """See `NamedObjects.each`."""
        with self._refusing(f"list {prefix}"):
            for folder, _, names in os.walk(self._folder / prefix):
                for name in names:
                    if name.startswith("."):
                        continue
                    path = Path(folder) / name
                    try:
                        stat = path.stat()
                    except FileNotFoundError:  # removed meanwhile
                        continue
                    yield ObjectSeen(path.relative_to(self._folder).as_posix(), stat.st_size, stat.st_mtime_ns)

    def remove(self, names: Iterable[str]) -> None:
        """See `NamedObjects.remove`."""
        with self._refusing("remove"):
            for name in names:
                self._path(name).unlink(missing_ok=True)

    def remove_partial(self, before_ns: int) -> int:
        """Remove what writers that were killed have left, from before a time (ns UTC); how many files."""
        with self._refusing("remove"):
            old = [
                path
                for path in self._folder.rglob(f".*{_PARTIAL}")
                if path.is_file() and path.stat().st_mtime_ns < before_ns
            ]
            for path in old:
                path.unlink(missing_ok=True)
            return len(old)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """One process at a time holds it.

        Raises:
            StoreBusy: another one does.
        """
        import fcntl

        with self._refusing("lock"), (self._folder / ".lock").open("ab") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreBusy(f"{self.location}: somebody else publishes there now") from None
            yield

    def _path(self, name: str) -> Path:
        return self._folder / check_name(name)

    @contextmanager
    def _written(self, name: str, data: bytes) -> Iterator[tuple[Path, Path]]:
        """A file beside the object with its bytes, on the disk, and the object's path."""
        path = self._path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}{_PARTIAL}")
        try:
            with partial.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            yield partial, path
        finally:
            partial.unlink(missing_ok=True)

    @contextmanager
    def _refusing(self, what: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StoreUnavailable(f"{self.location}: cannot {what}: {error.strerror}") from error


def _sync(folder: Path) -> None:
    """Write the folder's names to the disk."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
