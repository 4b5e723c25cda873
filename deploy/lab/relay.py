"""Carries the packets between pairs of TUN interfaces: delayed, jittered, lost as a profile says, never out of order.

For kernels without netem. The rate is limited before, by the interfaces (`devices.py`). A mobile network delivers the
packets of one vehicle in order, so the jitter is a delay that wanders rather than one drawn anew for each packet.
"""

import contextlib
import fcntl
import json
import math
import os
import random
import select
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.lab.groups import LabLink
from gnd.deploy.lab.namespaces import inside
from gnd.deploy.lab.tools import TUN_DEVICE
from gnd.fleet_bus.links import LinkProfile

_TUNSETIFF: Final = 0x400454CA  # linux/if_tun.h
_IFF_TUN_NO_PI: Final = 0x1001
_MAX_PACKET_BYTES: Final = 65_535
_AT_ONCE: Final = 64
_JITTER_STEPS: Final = 4  # > 2 keeps the order
_LEAST_STEP_S: Final = 0.001
_MAX_WAIT_S: Final = 0.25
_SAVE_EVERY_S: Final = 1.0
_PRIORITY: Final = -15


@dataclass(slots=True)
class LineCount:
    """What a relay did with the packets of one direction of one link.

    Attributes:
        packets: delivered.
        size_bytes: delivered, IP bytes.
        lost: packets lost on purpose.
        refused: packets that the receiving interface did not take (it is down, or full).
        delay_sum_s: sum over the delivered packets of the time from taking to delivering, s.
        delay_max_s: the longest, s.
    """

    packets: int = 0
    size_bytes: int = 0
    lost: int = 0
    refused: int = 0
    delay_sum_s: float = 0.0
    delay_max_s: float = 0.0

    def __add__(self, other: "LineCount") -> "LineCount":
        return LineCount(
            self.packets + other.packets,
            self.size_bytes + other.size_bytes,
            self.lost + other.lost,
            self.refused + other.refused,
            self.delay_sum_s + other.delay_sum_s,
            max(self.delay_max_s, other.delay_max_s),
        )


@dataclass(slots=True)
class Jitter:
    """A delay that wanders evenly about its mean and never lets a packet overtake another.

    It moves in straight lines between values drawn evenly from ± `amplitude_s`, one every four amplitudes (1 ms at
    least): it changes by at most half a second a second, so what is sent later also arrives later, and a dense stream
    has the same mean delay as a thin one.

    Attributes:
        amplitude_s: how far it goes to either side, s.
        random: draws the values.
    """

    amplitude_s: float
    random: random.Random
    _from: tuple[float, float] = (-math.inf, 0.0)
    _to: tuple[float, float] = (-math.inf, 0.0)

    def at(self, now_s: float) -> float:
        """Return what to add to the mean delay, s; times must not decrease."""
        step_s = max(_LEAST_STEP_S, _JITTER_STEPS * self.amplitude_s)
        if now_s >= self._to[0] + step_s:  # idle for long: begin anew
            self._from, self._to = (now_s, self._draw()), (now_s, self._draw())
        while now_s >= self._to[0]:
            self._from, self._to = self._to, (self._to[0] + step_s, self._draw())
        (t0_s, value0_s), (t1_s, value1_s) = self._from, self._to
        return value0_s + (value1_s - value0_s) * (now_s - t0_s) / (t1_s - t0_s)

    def _draw(self) -> float:
        return self.random.uniform(-self.amplitude_s, self.amplitude_s)


@dataclass(slots=True)
class Line:
    """One direction of a link: packets in order of delivery.

    Attributes:
        link: delay, jitter, loss.
        random: decides about loss and jitter.
        count: what was done.
    """

    link: LinkProfile
    random: random.Random
    count: LineCount = field(default_factory=LineCount)
    _waiting: deque[tuple[float, float, bytes]] = field(default_factory=deque)
    _jitter: Jitter = field(init=False)

    def __post_init__(self) -> None:
        self._jitter = Jitter(self.link.jitter_ms / 1000, self.random)

    def take(self, packet: bytes, now_s: float) -> None:
        """Take a packet, or lose it.

        Args:
            packet: one IP packet.
            now_s: monotonic time, s.
        """
        if self.link.loss and self.random.random() < self.link.loss:
            self.count.lost += 1
            return
        self._waiting.append((now_s + self.link.delay_s + self._jitter.at(now_s), now_s, packet))

    @property
    def next_due_s(self) -> float | None:
        """When the next packet must be delivered, s; None when none waits."""
        return self._waiting[0][0] if self._waiting else None

    def deliver(self, now_s: float, write: Callable[[bytes], object]) -> None:
        """Hand over every packet whose time has come; `write` raises `OSError` where it is not taken."""
        waiting, count = self._waiting, self.count
        while waiting and waiting[0][0] <= now_s:
            _, taken_s, packet = waiting.popleft()
            try:
                write(packet)
            except OSError:
                count.refused += 1
                continue
            count.packets += 1
            count.size_bytes += len(packet)
            count.delay_sum_s += now_s - taken_s
            count.delay_max_s = max(count.delay_max_s, now_s - taken_s)


@dataclass(frozen=True, slots=True)
class Wire:
    """One direction between two open TUN interfaces.

    Attributes:
        name: device of the sender, for the account.
        source: descriptor to read packets from.
        target: descriptor to write them to.
        line: what happens between.
    """

    name: str
    source: int
    target: int
    line: Line

    def read(self) -> None:
        """Take what the sender has sent, up to some packets at once."""
        now_s = time.monotonic()
        with contextlib.suppress(BlockingIOError):
            for _ in range(_AT_ONCE):
                self.line.take(os.read(self.source, _MAX_PACKET_BYTES), now_s)

    def write(self, packet: bytes) -> None:
        """Hand one packet to the receiver."""
        os.write(self.target, packet)


def run_relay(links: tuple[LabLink, ...], account: Path, *, stop: threading.Event) -> None:
    """Carry the packets of some links until `stop` is set; the role of a process.

    Args:
        links: their TUN interfaces must exist.
        account: folder of one JSON file a relay process, by device `LineCount`; written once a second and at the end.
        stop: ends it.

    Raises:
        LabError: an interface cannot be opened.
    """
    _come_first()
    with contextlib.ExitStack() as stack:
        wires = [wire for link in links for wire in _open_wires(link, stack)]
        file = account / f"relay-{os.getpid()}.json"
        save_at_s = 0.0
        while not stop.is_set():
            carry(wires, _MAX_WAIT_S)
            if time.monotonic() >= save_at_s:
                save_at_s = time.monotonic() + _SAVE_EVERY_S
                _save(file, wires)
        _save(file, wires)


def _come_first() -> None:
    """Ask to run before other processes: a relay does little, but what it does late is added to the delay."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, _PRIORITY)


def carry(wires: list[Wire], max_wait_s: float) -> None:
    """Wait for a packet to come or to become due, then move all that can be moved."""
    due_s = min((due for wire in wires if (due := wire.line.next_due_s) is not None), default=float("inf"))
    wait_s = min(max_wait_s, max(0.0, due_s - time.monotonic()))
    readable, _, _ = select.select([wire.source for wire in wires], (), (), wait_s)
    for wire in wires:
        if wire.source in readable:
            wire.read()
    now_s = time.monotonic()
    for wire in wires:
        wire.line.deliver(now_s, wire.write)


def _open_wires(link: LabLink, stack: contextlib.ExitStack) -> tuple[Wire, Wire]:
    vehicle = _open_tun(link.vehicle_namespace, link.vehicle_device)
    stack.callback(os.close, vehicle)
    cloud = _open_tun(link.cloud_namespace, link.cloud_device)
    stack.callback(os.close, cloud)
    lines = [Line(link.profile, random.Random(f"{link.number}{direction}")) for direction in ("up", "down")]
    return (
        Wire(link.vehicle_device, vehicle, cloud, lines[0]),
        Wire(link.cloud_device, cloud, vehicle, lines[1]),
    )


def _open_tun(namespace: str, device: str) -> int:
    with inside(namespace):
        try:
            descriptor = os.open(TUN_DEVICE, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise LabError(f"cannot open {TUN_DEVICE}: {error.strerror}") from error
        try:
            fcntl.ioctl(descriptor, _TUNSETIFF, struct.pack("16sH14x", device.encode("ascii"), _IFF_TUN_NO_PI))
        except OSError as error:
            os.close(descriptor)
            raise LabError(f"cannot carry the interface {device} of {namespace}: {error.strerror}") from error
    return descriptor


def _save(file: Path, wires: list[Wire]) -> None:
    partial = file.with_suffix(".partial")
    partial.write_text(json.dumps({wire.name: asdict(wire.line.count) for wire in wires}) + "\n", encoding="utf-8")
    partial.replace(file)


def read_account(folder: Path) -> dict[str, LineCount]:
    """Return by device what all relay processes of a lab did, restarted ones included; empty without relays."""
    total: dict[str, LineCount] = {}
    for file in sorted(folder.glob("relay-*.json")):
        for device, values in json.loads(file.read_text(encoding="utf-8")).items():
            total[device] = total.get(device, LineCount()) + LineCount(**values)
    return total
