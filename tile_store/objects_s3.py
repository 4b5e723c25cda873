"""Objects in a bucket of S3, or of a server that speaks like it."""

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Final, Literal

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, GenericError
from obstore.store import S3Store

from gnd.tile_store.errors import ObjectsAway, StoreError, StoreUnavailable
from gnd.tile_store.objects import ObjectSeen, check_name

FOR_EVER: Final = "public, max-age=31536000, immutable"
ASK_AGAIN: Final = "public, max-age=0, must-revalidate"
_TYPE: Final = "application/octet-stream"
_TIMEOUT: Final = "30s"
_RETRY_FOR: Final = timedelta(seconds=20)
_RETRIES: Final = 5
_NS_PER_US: Final = 1_000
_REMOVED_AT_ONCE: Final = 500
_PASSING: Final = ("InternalError", "ServiceUnavailable", "SlowDown")
_CODE: Final = re.compile(r"<Code>(\w+)</Code>")


def _is_plain_allowed() -> bool:
    """Options of ours take the place of those of the environment, so it is asked here."""
    return os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true")


class S3Objects:
    """Objects below a prefix of a bucket; endpoint and credentials as the environment says (AWS_…).

    Args:
        bucket: its name.
        prefix: in front of all names; "": none.

    Raises:
        StoreUnavailable: the environment says what cannot be.
    """

    def __init__(self, bucket: str, prefix: str = "") -> None:
        self._location = f"s3://{bucket}/{prefix}".rstrip("/")
        self._prefix = f"{prefix}/" if prefix else ""
        with self._refusing("open"):
            self._store = S3Store(
                bucket,
                client_options={"timeout": _TIMEOUT, "connect_timeout": "5s", "allow_http": _is_plain_allowed()},
                retry_config={"max_retries": _RETRIES, "retry_timeout": _RETRY_FOR},
            )

    @property
    def location(self) -> str:
        """See `NamedObjects.location`."""
        return self._location

    def put_new(self, name: str, data: bytes) -> bool:
        """See `NamedObjects.put_new`."""
        with self._refusing(f"write {name}"):
            try:
                self._put(name, data, FOR_EVER, "create")
            except AlreadyExistsError:
                return False
            return True

    def put(self, name: str, data: bytes, *, changes: bool = False) -> None:
        """See `NamedObjects.put`."""
        with self._refusing(f"write {name}"):
            self._put(name, data, ASK_AGAIN if changes else FOR_EVER, "overwrite")

    def _put(self, name: str, data: bytes, caching: str, mode: Literal["create", "overwrite"]) -> None:
        attributes = {"Cache-Control": caching, "Content-Type": _TYPE}
        # in one request: parts could not be put on a condition
        obstore.put(self._store, self._full(name), data, attributes=attributes, mode=mode, use_multipart=False)

    def get(self, name: str, start: int = 0, length: int | None = None) -> bytes | None:
        """See `NamedObjects.get`."""
        with self._refusing(f"read {name}"):
            try:
                if length is None:
                    return bytes(obstore.get(self._store, self._full(name)).bytes())
                return bytes(obstore.get_range(self._store, self._full(name), start=start, length=length))
            except FileNotFoundError:
                return None

    def each(self, prefix: str) -> Iterator[ObjectSeen]:
        """See `NamedObjects.each`."""
        with self._refusing(f"list {prefix}"):
            for page in obstore.list(self._store, prefix=(self._prefix + prefix).rstrip("/") or None):
                for one in page:
                    written = one["last_modified"]
                    ns = round(written.timestamp() * 1e6) * _NS_PER_US
                    yield ObjectSeen(one["path"].removeprefix(self._prefix), one["size"], ns)

    def remove(self, names: Iterable[str]) -> None:
        """See `NamedObjects.remove`."""
        with self._refusing("remove"):
            every = [self._full(name) for name in names]
            for at in range(0, len(every), _REMOVED_AT_ONCE):
                obstore.delete(self._store, every[at : at + _REMOVED_AT_ONCE])

    def _full(self, name: str) -> str:
        return self._prefix + check_name(name)

    @contextmanager
    def _refusing(self, what: str) -> Iterator[None]:
        try:
            yield
        except StoreError:
            raise
        except (BaseError, OSError, ValueError) as error:
            # of the library's text only what the server calls it: the rest is long, and tells of requests
            text = str(error)
            code = _CODE.search(text)
            said = code[1] if code else " ".join(text.split("\n\n")[0].split())[:160]
            # what has no code was answered by nobody
            is_away = type(error) is GenericError and (code is None or code[1] in _PASSING)
            kind = ObjectsAway if is_away else StoreUnavailable
            raise kind(f"{self._location}: cannot {what}: {type(error).__name__}: {said}") from None
