"""Measures a link by real transfers between its two ends: delay and loss of datagrams, rate of a flood, rate of TCP.

Both ends lie on this machine, so one monotonic clock times both: delays are one-way, not half of a round trip.
"""

import contextlib
import multiprocessing
import os
import signal
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from gnd.deploy.errors import LabError
from gnd.deploy.lab.devices import MTU_BYTES
from gnd.deploy.lab.groups import LabLink
from gnd.deploy.lab.namespaces import inside

Direction = Literal["up", "down"]

UDP_HEADER_BYTES: Final = 28
"""IPv4 and UDP."""
MAX_PER_S: Final = 1000.0
RATE_SHARE: Final = 0.25
"""Delay and loss are measured on a link that is a quarter busy, so that no queue grows."""
DRAIN_S: Final = 0.7
CONNECT_S: Final = 20.0
BACKLOG_S: Final = 0.2
MAX_SET_BACKLOG_BYTES: Final = 200_000
"""Systems refuse larger ones (net.core.wmem_max); the kernel's own growth goes further."""
_STAMP: Final = struct.Struct("<Qd")  # number, monotonic time of sending in s
_PROBE_BYTES: Final = _STAMP.size + UDP_HEADER_BYTES
_TCP_INFO_BYTES: Final = 232
_BYTES_SENT_AT, _BYTES_RETRANS_AT = 200, 208  # offsets in struct tcp_info

_fork = multiprocessing.get_context("fork")


@dataclass(frozen=True, slots=True)
class Stream:
    """What a thin stream of datagrams met on its way.

    Attributes:
        sent: datagrams sent.
        lost: datagrams that did not arrive.
        reordered: datagrams that arrived after one sent later.
        delay_ms: one-way delay in ms of its 5 %, 50 % and 95 % quantile.
    """

    sent: int
    lost: int
    reordered: int
    delay_ms: tuple[float, float, float]

    @property
    def loss(self) -> float:
        """Share of the datagrams that were lost."""
        return self.lost / self.sent


@dataclass(frozen=True, slots=True)
class Bulk:
    """What one TCP connection reached.

    Attributes:
        bit_s: payload delivered, bit/s.
        resent: share of the sent payload bytes that TCP sent again.
    """

    bit_s: float
    resent: float


def ends(link: LabLink, direction: Direction) -> tuple[tuple[str, str], tuple[str, str]]:
    """Return (namespace, address) of the sender and of the receiver of a direction."""
    vehicle = (link.vehicle_namespace, link.vehicle_address)
    cloud = (link.cloud_namespace, link.cloud_address)
    return (vehicle, cloud) if direction == "up" else (cloud, vehicle)


@contextmanager
def _bound(namespace: str, address: str, kind: socket.SocketKind) -> Iterator[socket.socket]:
    with inside(namespace):
        made = socket.socket(socket.AF_INET, kind)
    with made:
        made.bind((address, 0))
        yield made


@contextmanager
def _datagrams(link: LabLink, direction: Direction) -> Iterator[tuple[socket.socket, socket.socket]]:
    """Give a connected sender and its receiver."""
    source, target = ends(link, direction)
    with _bound(*source, socket.SOCK_DGRAM) as sender, _bound(*target, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        sender.connect(receiver.getsockname())
        yield sender, receiver


def stream(link: LabLink, direction: Direction, seconds: float) -> Stream:
    """Send small numbered and timed datagrams at an even pace and see what becomes of them.

    Raises:
        LabError: not one arrived.
    """
    rate_byte_s = link.profile.rate_byte_s(direction)
    per_s = min(MAX_PER_S, RATE_SHARE * rate_byte_s / _PROBE_BYTES)
    count = max(10, round(per_s * seconds))
    with _datagrams(link, direction) as (sender, receiver):
        receiver.settimeout(DRAIN_S + 4 / per_s + 2 * link.profile.delay_s)
        arrived: list[tuple[int, float]] = []
        reader = threading.Thread(target=_collect, args=(receiver, count, arrived))
        reader.start()
        _send_evenly(sender, count, 1 / per_s)
        reader.join()
    if not arrived:
        raise LabError(f"{direction}: none of {count} datagrams passed the link of {link.vehicle_device}")
    numbers, delays_s = np.array([number for number, _ in arrived]), np.array([delay for _, delay in arrived])
    late = int(np.count_nonzero(numbers < np.maximum.accumulate(numbers)))
    low, median, high = (float(q) * 1000 for q in np.quantile(delays_s, (0.05, 0.5, 0.95)))
    return Stream(count, count - len(set(numbers.tolist())), late, (low, median, high))


def _send_evenly(sender: socket.socket, count: int, pause_s: float) -> None:
    start_s = time.monotonic()
    for number in range(count):
        time.sleep(max(0.0, start_s + number * pause_s - time.monotonic()))
        sender.send(_STAMP.pack(number, time.monotonic()))


def _collect(receiver: socket.socket, count: int, arrived: list[tuple[int, float]]) -> None:
    """Receive until all have come, none for a while, or the socket is closed."""
    with contextlib.suppress(OSError):
        while len(arrived) < count:
            number, sent_s = _STAMP.unpack(receiver.recv(_STAMP.size))
            arrived.append((number, time.monotonic() - sent_s))


def flood(link: LabLink, direction: Direction, seconds: float) -> float:
    """Send full datagrams as fast as the link takes them and return the IP bit/s that arrive.

    Raises:
        LabError: nothing arrived.
    """
    with _datagrams(link, direction) as (sender, receiver):
        process = _fork.Process(target=_pour, args=(sender, seconds, os.getpid()))
        process.start()
        try:
            return _arriving_bit_s(receiver, seconds)
        finally:
            process.terminate()
            process.join()


def _pour(sender: socket.socket, seconds: float, launcher: int) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # not the launcher's handlers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    datagram = bytes(MTU_BYTES - UDP_HEADER_BYTES)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s and os.getppid() == launcher:
        sender.send(datagram)  # blocks while the link's queue is full


def _arriving_bit_s(receiver: socket.socket, seconds: float) -> float:
    """Return the rate of arrival; the first tenth of the time fills the token bucket's burst and is left out."""
    receiver.settimeout(DRAIN_S + seconds)
    buffer = bytearray(MTU_BYTES)
    try:
        receiver.recv_into(buffer)
        start_s = time.monotonic() + seconds / 10
        while time.monotonic() < start_s:
            receiver.recv_into(buffer)
        begin_s = last_s = time.monotonic()
        size_bytes = 0
        receiver.settimeout(DRAIN_S)
        while (now_s := time.monotonic()) < begin_s + 0.8 * seconds:
            size_bytes += receiver.recv_into(buffer) + UDP_HEADER_BYTES
            last_s = now_s
    except TimeoutError as error:
        raise LabError(f"a flood of datagrams stopped arriving for {receiver.gettimeout()} s") from error
    return size_bytes * 8 / (last_s - begin_s)


def bulk(link: LabLink, direction: Direction, seconds: float) -> Bulk:
    """Send as much as one TCP connection passes in some seconds.

    Raises:
        LabError: no connection came about.
    """
    with _connection(link) as (vehicle, cloud):
        sender, receiver = (vehicle, cloud) if direction == "up" else (cloud, vehicle)
        _keep_short(sender, link.profile.rate_byte_s(direction))
        feeder = threading.Thread(target=_feed, args=(sender, seconds))
        feeder.start()
        start_s, size_bytes = time.monotonic(), 0
        while received := receiver.recv(1 << 18):
            size_bytes += len(received)
        took_s = time.monotonic() - start_s
        feeder.join()
        info = sender.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_BYTES)
        sent, again = (int(struct.unpack_from("=Q", info, at)[0]) for at in (_BYTES_SENT_AT, _BYTES_RETRANS_AT))
    return Bulk(size_bytes * 8 / took_s, again / sent if sent else 0.0)


def _keep_short(sender: socket.socket, rate_byte_s: float) -> None:
    """Keep the backlog within the sender short on slow links, where the kernel's own would take seconds to drain."""
    backlog_bytes = rate_byte_s * BACKLOG_S
    if backlog_bytes < MAX_SET_BACKLOG_BYTES:
        sender.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, max(16_384, round(backlog_bytes)))


def _feed(sender: socket.socket, seconds: float) -> None:
    data = bytes(1 << 16)
    end_s = time.monotonic() + seconds
    with contextlib.suppress(OSError):  # closed by an interruption
        while time.monotonic() < end_s:
            sender.sendall(data)
        sender.shutdown(socket.SHUT_WR)


@contextmanager
def _connection(link: LabLink) -> Iterator[tuple[socket.socket, socket.socket]]:
    """Give the vehicle's and the cloud's end of a TCP connection that the vehicle has opened."""
    source, target = ends(link, "up")
    with _bound(*target, socket.SOCK_STREAM) as listener, _bound(*source, socket.SOCK_STREAM) as vehicle:
        listener.listen(1)
        listener.settimeout(CONNECT_S)
        vehicle.settimeout(CONNECT_S)
        try:
            vehicle.connect(listener.getsockname())
            cloud, _ = listener.accept()
        except OSError as error:
            raise LabError(f"no TCP connection over the link of {link.vehicle_device}: {error}") from error
        with cloud:
            yield vehicle, cloud
