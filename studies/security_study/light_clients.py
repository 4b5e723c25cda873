"""Clients that only open sessions, so cheaply that the router and not they are measured.

What a real zenoh client says when it opens a session (InitSyn, OpenSyn) is recorded once; then plain sockets, or
Python's `ssl` with a vehicle's certificate, say it again, each under a zenoh id of its own and with the cookie that the
router has just given. A session counts when the router has accepted it (OpenAck). As with zenoh, no TLS session is
resumed.
"""

import multiprocessing
import os
import resource
import secrets
import socket
import ssl
import struct
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig

_LENGTH: Final = struct.Struct("<H")
_INIT, _OPEN, _ACK_FLAG, _SIZES_FLAG = 0x01, 0x02, 0x20, 0x40
_KIND_BITS: Final = 0x1F
WAIT_S: Final = 20.0
THREADS: Final = 4
"""Sessions that one process of clients opens at the same time."""


@dataclass(frozen=True, slots=True)
class Opening:
    """How a zenoh client opens a session.

    Attributes:
        init: its first frame.
        zid: the id within it.
        before_cookie: its second frame up to the cookie.
        after_cookie: what follows.
    """

    init: bytes
    zid: bytes
    before_cookie: bytes
    after_cookie: bytes

    def of(self, zid: bytes) -> bytes:
        """The first frame under another id."""
        return self.init.replace(self.zid, zid)

    def answer(self, cookie: bytes) -> bytes:
        """The second frame with a cookie."""
        return self.before_cookie + cookie + self.after_cookie


@dataclass(frozen=True, slots=True)
class Opened:
    """What opening so many sessions took: seconds of the clock, and processor seconds of the clients."""

    sessions: int
    clock_s: float
    clients_cpu_s: float


def record_opening(port: int) -> Opening:
    """What a real client says to a plain router on that port of the loopback interface."""
    with _Recorder(port) as recorder, open_bus(BusConfig(connect=(f"tcp/127.0.0.1:{recorder.port}",))) as bus:
        bus.wait_connected(WAIT_S)
        init, opening = recorder.up[:2]
        cookie = cookie_of(recorder.down[0])
        number = str(bus.connection.session.info.zid())
    zid = bytes.fromhex(number.rjust(32, "0"))[::-1]
    if init.count(zid) != 1 or opening.count(cookie) != 1:
        raise RuntimeError(f"a zenoh opening of another form: {init.hex()} {opening.hex()}")
    before, _, after = opening.partition(cookie)
    return Opening(init, zid, before, after)


def open_sessions(opening: Opening, port: int, identity: Path | None, sessions: int, processes: int = 1) -> Opened:
    """Open sessions from so many processes and keep them until all are open; TLS with an identity folder."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes) as pool:
        pool.map(_nothing, range(processes))  # started
        began_s = time.perf_counter()
        jobs = [(opening, port, identity, sessions // processes) for _ in range(processes)]
        took = pool.map(_open_some, jobs, chunksize=1)
        clock_s = time.perf_counter() - began_s
    return Opened(sum(n for n, _ in took), clock_s, sum(cpu_s for _, cpu_s in took))


def cookie_of(init_ack: bytes) -> bytes:
    """The cookie in a router's first frame (zenoh's InitAck: header, version, id, sizes, cookie)."""
    header, id_bytes = init_ack[0], 1 + (init_ack[2] >> 4)
    if header & (_KIND_BITS | _ACK_FLAG) != _INIT | _ACK_FLAG:
        raise RuntimeError(f"no InitAck: {init_ack.hex()}")
    at = 3 + id_bytes + (3 if header & _SIZES_FLAG else 0)
    size, shift = 0, 0
    while True:
        byte = init_ack[at]
        size |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return init_ack[at : at + size]


def _nothing(_number: int) -> None:
    time.sleep(0.1)


def _open_some(job: tuple[Opening, int, Path | None, int]) -> tuple[int, float]:
    opening, port, identity, count = job
    before_s = _own_cpu_s()
    context = None if identity is None else _tls_context(identity)
    with ThreadPoolExecutor(THREADS) as pool:
        opened = list(pool.map(lambda _n: _open(opening, port, context), range(count)))
    cpu_s = _own_cpu_s() - before_s
    for one in opened:
        one.close()
    return len(opened), cpu_s


def _tls_context(identity: Path) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=str(identity / "authority.pem"))
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.load_cert_chain(str(identity / "certificate.pem"), str(identity / "key.pem"))
    return context


def _open(opening: Opening, port: int, context: ssl.SSLContext | None) -> socket.socket:
    """An open session; OSError where the router does not accept it."""
    link = socket.create_connection(("127.0.0.1", port), WAIT_S)
    try:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if context is not None:
            link = context.wrap_socket(link, server_hostname="127.0.0.1")
        _send(link, opening.of(secrets.token_bytes(15) + b"\x01"))
        _send(link, opening.answer(cookie_of(_receive(link))))
        _check_open(_receive(link))
    except BaseException:
        link.close()
        raise
    return link


def _check_open(ack: bytes) -> None:
    if ack[0] & (_KIND_BITS | _ACK_FLAG) != _OPEN | _ACK_FLAG:
        raise ConnectionError(f"the router has not opened the session: {ack.hex()}")


def _send(link: socket.socket, frame: bytes) -> None:
    link.sendall(_LENGTH.pack(len(frame)) + frame)


def _receive(link: socket.socket) -> bytes:
    return _exactly(link, *_LENGTH.unpack(_exactly(link, _LENGTH.size)))


def _exactly(link: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        more = link.recv(size - len(data))
        if not more:
            raise ConnectionError("the router has closed the connection")
        data += more
    return data


def _own_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


class _Recorder:
    """Passes one connection on to a port, and keeps the frames; use it in a `with` block."""

    def __init__(self, port: int) -> None:
        self.up: list[bytes] = []
        self.down: list[bytes] = []
        self._to = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._links: Sequence[socket.socket] = ()

    def __enter__(self) -> "_Recorder":
        threading.Thread(target=self._run, name="recorder", daemon=True).start()
        return self

    def __exit__(self, *_exception: Any) -> None:
        for link in (self._server, *self._links):
            link.close()

    def _run(self) -> None:
        near, _ = self._server.accept()
        far = socket.create_connection(("127.0.0.1", self._to))
        self._links = (near, far)
        back = threading.Thread(target=self._pass, args=(far, near, self.down), name="recorder back", daemon=True)
        back.start()
        self._pass(near, far, self.up)

    @staticmethod
    def _pass(source: socket.socket, sink: socket.socket, kept: list[bytes]) -> None:
        try:
            while True:
                frame = _receive(source)
                kept.append(frame)
                _send(sink, frame)
        except OSError:
            return


def cpu_of_s(process: int) -> float:
    """Processor time of a process until now, s (Linux)."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
