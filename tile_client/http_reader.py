"""Files of a web server, read with bounds: on bytes before they are read, on time whatever the server does."""

import http.client
import random
import re
import socket
import ssl
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final
from urllib.parse import urlsplit

from gnd.tile_client.errors import ArchiveAway, ArchiveError, ArchiveWrong

CONNECT_S: Final = 5.0
LEAST_RATE: Final = 20_000.0
"""An answer's bytes come at this rate at least, bytes/s."""
FIRST_PAUSE_S: Final = 0.2
"""Doubled with each attempt, and half of it by chance."""
_IDLE: Final = 4
_PIECE: Final = 64 * 1024
_TRIED_AGAIN: Final = frozenset((408, 425, 429, 500, 502, 503, 504))
_RANGE: Final = re.compile(r"bytes (\d+)-(\d+)/(\d+|\*)")
_AGENT: Final = "gnd"
_URL: Final = re.compile(
    r"https?://(?P<host>[A-Za-z0-9.-]+|\[[0-9A-Fa-f:.]+\])(:(?P<port>\d{1,5}))?(/[A-Za-z0-9._~%/+-]*)?"
)
"""Without the name and password that a URL may hold."""


@dataclass(frozen=True, slots=True)
class Patience:
    """How often a server is asked, and how long it has for its answer beside what its bytes take, s."""

    attempts: int
    attempt_s: float


PATIENT: Final = Patience(4, 10.0)
"""Who has nobody else to ask."""
HURRIED: Final = Patience(1, 3.0)
"""Who asks somebody else then."""


@dataclass(frozen=True, slots=True)
class HttpFile:
    """What a server answered.

    Attributes:
        body: the bytes asked for; None: those that the caller has (their `etag` was given) are the present ones.
        etag: of the server, for the next question; "": it gives none.
        sent_bytes: of the request's head, about.
        head_bytes: of the answer's head, about.
        took_s: how long it took, the attempts before it not counted, s.
    """

    body: bytes | None
    etag: str
    sent_bytes: int
    head_bytes: int
    took_s: float


class HttpReader:
    """Reads files below a URL. Safe in several threads.

    Args:
        url: http://… or https://…; credentials and queries are refused, and never repeated in a message.
        patience: with the server.

    Raises:
        ArchiveError: the URL is none of these.
    """

    def __init__(self, url: str, patience: Patience = PATIENT) -> None:
        match = _URL.fullmatch(url)
        if match is None:
            raise ArchiveError(
                "an archive is given as http://HOST/PATH or https://HOST/PATH, without password or query"
            )
        parts, self._patience = urlsplit(url), patience
        self._host, self._port = match["host"].strip("[]"), int(match["port"]) if match["port"] else None
        self._tls = ssl.create_default_context() if parts.scheme == "https" else None
        self._path = parts.path.rstrip("/") + "/"
        self.url = f"{parts.scheme}://{parts.netloc}{self._path}"
        self._lock, self._idle = threading.Lock(), list[http.client.HTTPConnection]()
        self._closed = threading.Event()

    def get(
        self, name: str, most_bytes: int, span: tuple[int, int, int] | None = None, etag: str = ""
    ) -> HttpFile | None:
        """Read a file, or some of its bytes.

        Args:
            name: below the URL.
            most_bytes: a longer answer is refused before it is read.
            span: first byte, one past the last, and how long the file must be; None: the whole file.
            etag: of what the caller has.

        Returns:
            None: the server has no such file.

        Raises:
            ArchiveAway: no answer, after several attempts.
            ArchiveWrong: an answer that is too long, cut off, or another one than asked for.
        """
        for attempt in range(self._patience.attempts):
            try:
                return self._once(name, most_bytes, span, etag)
            except ArchiveAway:
                pause_s = FIRST_PAUSE_S * 2**attempt * random.uniform(0.5, 1.0)
                if attempt == self._patience.attempts - 1 or self._closed.wait(pause_s):
                    raise
        raise AssertionError

    def close(self) -> None:
        """Close the connections; who waits for another attempt waits no longer."""
        self._closed.set()
        with self._lock:
            for connection in self._idle:
                connection.close()
            self._idle.clear()

    def _once(self, name: str, most_bytes: int, span: tuple[int, int, int] | None, etag: str) -> HttpFile | None:
        headers = {"User-Agent": _AGENT, "Accept-Encoding": "identity", "Accept": "*/*"}
        if span is not None:
            headers["Range"] = f"bytes={span[0]}-{span[1] - 1}"
        if etag:
            headers["If-None-Match"] = etag
        sent_bytes = len(f"GET {self._path}{name} HTTP/1.1\r\nHost: {self._host}\r\n\r\n") + _size(headers.items())
        began_s = time.monotonic()
        within_s = self._patience.attempt_s + most_bytes / LEAST_RATE
        with self._answer(name, headers, within_s) as answer:
            told = answer.getheaders()
            self._check_status(name, answer.status, answer.getheader("Location", ""))
            if answer.status == http.client.NOT_FOUND:
                _drain(answer)
                return None
            tag = answer.getheader("ETag", "")
            if answer.status == http.client.NOT_MODIFIED:
                answer.read()
                body = None
            else:
                body = self._body(name, answer, most_bytes, span)
            return HttpFile(body, tag[:200], sent_bytes, _size(told) + 17, time.monotonic() - began_s)

    def _check_status(self, name: str, status: int, moved_to: str) -> None:
        if status in (200, 206, 304, 404):
            return
        where = f"{self.url}{name}"
        if status in _TRIED_AGAIN:
            raise ArchiveAway(f"{where}: the server says {status}")
        if 300 <= status < 400:
            to = "".join(c for c in moved_to if c.isprintable())[:200]
            raise ArchiveWrong(f"{where}: moved ({status}); nothing is followed, give the address itself: {to!r}")
        raise ArchiveWrong(f"{where}: the server says {status}")

    def _body(
        self, name: str, answer: http.client.HTTPResponse, most_bytes: int, span: tuple[int, int, int] | None
    ) -> bytes:
        where = f"{self.url}{name}"
        if answer.getheader("Content-Encoding", "identity") != "identity":
            raise ArchiveWrong(f"{where}: comes encoded, which was not asked for")
        if span is None:
            if answer.status != http.client.OK:
                raise ArchiveWrong(f"{where}: a part ({answer.status}) where the whole was asked for")
            return _read(where, answer, most_bytes)
        start, end, length = span
        if answer.status == http.client.OK:  # a server without ranges sends the whole file
            data = _read(where, answer, length)
            _check_length(where, data, length)
            return data[start:end]
        match = _RANGE.fullmatch(answer.getheader("Content-Range", ""))
        if match is None or (int(match[1]), int(match[2]) + 1) != (start, end) or match[3] not in ("*", str(length)):
            told = answer.getheader("Content-Range", "")[:80]
            raise ArchiveWrong(f"{where}: asked for bytes {start}-{end - 1}/{length}, got {told!r}")
        data = _read(where, answer, end - start)
        _check_length(where, data, end - start)
        return data

    @contextmanager
    def _answer(self, name: str, headers: dict[str, str], within_s: float) -> Iterator[http.client.HTTPResponse]:
        """Ask on a connection that is kept for the next question if all goes well."""
        where = f"{self.url}{name}"
        connection, is_kept = self._take(), False
        try:
            if connection.sock is None:
                connection.connect()
            connection.sock.settimeout(self._patience.attempt_s)
            with _ended_after(within_s, connection.sock):
                connection.request("GET", self._path + name, headers=headers)
                answer = connection.getresponse()
                yield answer
                is_kept = answer.isclosed() and not answer.will_close
        except (OSError, http.client.HTTPException) as error:
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise ArchiveAway(f"{where}: {''.join(c for c in reason if c.isprintable())[:200]}") from error
        finally:
            self._give_back(connection, is_kept=is_kept)

    def _take(self) -> http.client.HTTPConnection:
        with self._lock:
            while self._idle:
                connection = self._idle.pop()
                if not _is_over(connection.sock):
                    return connection
                connection.close()
        if self._tls is None:
            return http.client.HTTPConnection(self._host, self._port, timeout=CONNECT_S)
        return http.client.HTTPSConnection(self._host, self._port, timeout=CONNECT_S, context=self._tls)

    def _give_back(self, connection: http.client.HTTPConnection, *, is_kept: bool) -> None:
        with self._lock:
            if is_kept and len(self._idle) < _IDLE and not self._closed.is_set():
                self._idle.append(connection)
                return
        connection.close()


def _is_over(sock: socket.socket | None) -> bool:
    """Whether the server has closed an idle connection, or says something that nobody has asked."""
    if sock is None:
        return True
    try:
        sock.settimeout(0.0)
        return bool(sock.recv(1) or True)
    except (BlockingIOError, ssl.SSLWantReadError):
        return False
    except OSError:
        return True
    finally:
        with suppress(OSError):
            sock.settimeout(CONNECT_S)


@contextmanager
def _ended_after(seconds: float, sock: socket.socket) -> Iterator[None]:
    """Cut a connection when time is up: a server that sends a byte now and then would keep it for ever."""
    late = threading.Event()

    def cut() -> None:
        late.set()
        with suppress(OSError):
            sock.shutdown(socket.SHUT_RDWR)

    timer = threading.Timer(seconds, cut)
    timer.daemon = True
    timer.start()
    try:
        yield
    except (OSError, http.client.HTTPException, ArchiveError):
        if not late.is_set():
            raise
    finally:
        timer.cancel()
    if late.is_set():  # whatever the cut looked like
        raise TimeoutError(f"not done within {seconds:.1f} s")


def _read(where: str, answer: http.client.HTTPResponse, most_bytes: int) -> bytes:
    """The body; refused unread where the server says that it is too long, and in time where it does not say so."""
    told = answer.getheader("Content-Length")
    if told is not None and answer.length is not None and answer.length > most_bytes:
        raise ArchiveWrong(f"{where}: {answer.length} bytes, at most {most_bytes} can be right")
    pieces, size = list[bytes](), 0
    while piece := answer.read(_PIECE):
        size += len(piece)
        if size > most_bytes:
            raise ArchiveWrong(f"{where}: more than the {most_bytes} bytes that can be right")
        pieces.append(piece)
    if told is not None and answer.length:
        raise ArchiveAway(f"{where}: cut off after {size} of {told[:20]} bytes")
    return b"".join(pieces)


def _check_length(where: str, data: bytes, length: int) -> None:
    if len(data) != length:
        raise ArchiveWrong(f"{where}: {len(data)} bytes, {length} are right")


def _drain(answer: http.client.HTTPResponse) -> None:
    """Read the page that goes with a 404, so that the connection can be used again; a long one is left."""
    if answer.length is not None and answer.length <= _PIECE:
        answer.read()


def _size(headers: Iterable[tuple[str, str]]) -> int:
    return sum(len(name) + len(value) + 4 for name, value in headers)
