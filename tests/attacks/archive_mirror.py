"""A mirror of an archive that does as it likes: real HTTP, real files, and one way to answer wrongly at a time."""

import gzip
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

Answer = Callable[["Handler", bytes], None]
"""Sends something instead of these right bytes."""
ENDLESS_S = 30.0
BOMB = gzip.compress(bytes(20_000_000))


class Handler(BaseHTTPRequestHandler):
    """Answers from a folder, right where nobody says otherwise."""

    protocol_version = "HTTP/1.1"
    server: "Mirror"

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        path = self.server.folder / self.path.lstrip("/")
        if not path.is_file():
            self.whole(b"", status=404)
            return
        data = path.read_bytes()
        wrong = next((do for part, do in self.server.wrong.items() if part in self.path), None)
        if wrong is None:
            self.right(data)
        else:
            wrong(self, data)

    def right(self, data: bytes) -> None:
        if (span := self.span()) is None:
            self.whole(data)
            return
        start, end = span
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {start}-{end - 1}/{len(data)}")
        self.body(data[start:end])

    def span(self) -> tuple[int, int] | None:
        told = self.headers.get("Range")
        if told is None:
            return None
        start, end = told.removeprefix("bytes=").split("-")
        return int(start), int(end) + 1

    def whole(self, data: bytes, status: int = 200, **headers: str) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.body(data)

    def body(self, data: bytes) -> None:
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        pass


class Mirror(ThreadingHTTPServer):
    """Serves a folder; `wrong`: what to do instead where a path holds this text."""

    daemon_threads = True

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.folder, self.wrong, self.asked = folder, dict[str, Answer](), list[str]()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def handle_error(self, *_: object) -> None:
        """Clients that hang up are what is wanted."""


@contextmanager
def mirror_of(folder: Path) -> Iterator[Mirror]:
    mirror = Mirror(folder)
    thread = threading.Thread(target=mirror.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield mirror
    finally:
        mirror.shutdown()
        thread.join()
        mirror.server_close()


# Ways to answer wrongly.


def cut_off(handler: Handler, data: bytes) -> None:
    """Says the right length, and hangs up after half of it."""
    span = handler.span() or (0, len(data))
    part = data[span[0] : span[1]]
    handler.send_response(206 if handler.span() else 200)
    handler.send_header("Content-Range", f"bytes {span[0]}-{span[1] - 1}/{len(data)}")
    handler.send_header("Content-Length", str(len(part)))
    handler.end_headers()
    handler.wfile.write(part[: len(part) // 2])
    handler.close_connection = True


def shorter(handler: Handler, data: bytes) -> None:
    """Half of it, with a length that fits."""
    handler.right(data[: len(data) // 2])


def told_too_long(handler: Handler, data: bytes) -> None:
    handler.send_response(206 if handler.span() else 200)
    if span := handler.span():
        handler.send_header("Content-Range", f"bytes {span[0]}-{span[1] - 1}/{len(data)}")
    handler.send_header("Content-Length", str(2**40))
    handler.end_headers()
    _for_ever(handler, b"x" * 65536)


def endless(handler: Handler, data: bytes) -> None:
    """Chunks without end, as fast as they are taken."""
    handler.send_response(206 if handler.span() else 200)
    if span := handler.span():
        handler.send_header("Content-Range", f"bytes {span[0]}-{span[1] - 1}/{len(data)}")
    handler.send_header("Transfer-Encoding", "chunked")
    handler.end_headers()
    _for_ever(handler, b"10000\r\n" + b"x" * 65536 + b"\r\n")


def dripping(handler: Handler, data: bytes) -> None:
    """A byte now and then: never silent for long, never done."""
    handler.send_response(200)
    handler.send_header("Content-Length", str(len(data)))
    handler.end_headers()
    _for_ever(handler, b"x", pause_s=0.05)


def dripping_head(handler: Handler, _data: bytes) -> None:
    handler.wfile.write(b"HTTP/1.1 200 OK\r\nX-Slow: ")
    _for_ever(handler, b"x", pause_s=0.05)


def endless_head(handler: Handler, _data: bytes) -> None:
    handler.wfile.write(b"HTTP/1.1 200 OK\r\n")
    _for_ever(handler, b"X-More: " + b"y" * 1000 + b"\r\n")


def a_page(handler: Handler, _data: bytes) -> None:
    """As the Wi-Fi of a hotel does."""
    handler.whole(b"<html>Please log in</html>", Content_Type="text/html")


def encoded(handler: Handler, _data: bytes) -> None:
    handler.whole(BOMB, Content_Encoding="gzip")


def moved(handler: Handler, _data: bytes) -> None:
    handler.whole(b"", status=302, Location="http://127.0.0.1:9/secret")


def other_range(handler: Handler, data: bytes) -> None:
    handler.send_response(206)
    handler.send_header("Content-Range", f"bytes 0-9/{len(data)}")
    handler.body(data[:10])


def broken(handler: Handler, _data: bytes) -> None:
    handler.whole(b"", status=503)


def nonsense(handler: Handler, _data: bytes) -> None:
    handler.wfile.write(b"SSH-2.0-OpenSSH_9.2\r\n")
    handler.close_connection = True


def flipped(handler: Handler, data: bytes) -> None:
    """One bit of each tile."""
    changed = bytearray(data)
    for at in range(len(data) // 3, len(data), 97):
        changed[at] ^= 1
    handler.right(bytes(changed))


def instead(other: bytes) -> Answer:
    """Other bytes."""
    return lambda handler, _data: handler.right(other)


def _for_ever(handler: Handler, data: bytes, pause_s: float = 0.0) -> None:
    until_s = time.monotonic() + ENDLESS_S
    handler.close_connection = True
    while time.monotonic() < until_s:
        handler.wfile.write(data)
        handler.wfile.flush()
        if pause_s:
            time.sleep(pause_s)
