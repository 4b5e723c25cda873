"""Watches the links of a lab while a fleet uses them: the highest rates, and what TCP measured."""

import logging
import statistics
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.lab.counters import DeviceReader, TcpSample, tcp_samples
from gnd.deploy.lab.groups import LabLink
from gnd.deploy.lab.lab import Lab

PERIOD_S: Final = 0.1
WINDOW_S: Final = 1.0
TCP_EVERY: Final = 20
"""TCP is asked at every twentieth look: that starts a process."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class LinkSeen:
    """What was seen of one vehicle's link.

    Attributes:
        peak_bit_s: by direction, the highest mean over a window of `WINDOW_S`, bit/s.
        round_trips_ms: smoothed round trips of the vehicle's connection, one a look.
        shortest_ms: the shortest round trip that TCP has met, ms; infinite before the first.
        resent: by direction and connection, newest (sent, sent again) payload bytes.
    """

    peak_bit_s: dict[str, float] = field(default_factory=lambda: {"up": 0.0, "down": 0.0})
    round_trips_ms: list[float] = field(default_factory=list)
    shortest_ms: float = float("inf")
    resent: dict[tuple[str, str], tuple[int, int]] = field(default_factory=dict)
    _past: deque[tuple[float, int, int]] = field(default_factory=deque)

    def counted(self, now_s: float, up_bytes: int, down_bytes: int) -> None:
        """Take the interface's counters of a moment."""
        past = self._past
        past.append((now_s, up_bytes, down_bytes))
        while len(past) > 2 and now_s - past[1][0] >= WINDOW_S:
            past.popleft()
        span_s = now_s - past[0][0]
        if span_s >= WINDOW_S:
            for name, size in (("up", up_bytes - past[0][1]), ("down", down_bytes - past[0][2])):
                self.peak_bit_s[name] = max(self.peak_bit_s[name], size * 8 / span_s)

    def tcp(self, direction: str, sample: TcpSample) -> None:
        """Take what TCP says of one end of the vehicle's connection ("up": the vehicle's own end)."""
        self.resent[direction, sample.local] = (sample.sent_bytes, sample.resent_bytes)
        self.shortest_ms = min(self.shortest_ms, sample.min_rtt_ms)
        if direction == "up":
            self.round_trips_ms.append(sample.rtt_ms)

    def median_ms(self) -> float | None:
        """Return the median of the smoothed round trips, ms."""
        return statistics.median(self.round_trips_ms) if self.round_trips_ms else None

    def resent_share(self, direction: str) -> float | None:
        """Return the share of the payload bytes of a direction that TCP sent again, as far as seen."""
        values = [value for (name, _), value in self.resent.items() if name == direction]
        sent = sum(value[0] for value in values)
        return sum(value[1] for value in values) / sent if sent else None


@dataclass(slots=True)
class Sampler:
    """The thread that looks; `seen` holds its findings by number of the vehicle."""

    lab: Lab
    seen: dict[int, LinkSeen]
    _stop: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Look until told to stop."""
        links = {self.lab.links[group.first].vehicle_namespace: self.lab.links_of(group) for group in self.lab.groups}
        readers = {namespace: DeviceReader.of(namespace) for namespace in links}
        try:
            look = 0
            while not self._stop.wait(PERIOD_S):
                for namespace, reader in readers.items():
                    self._count(links[namespace], reader)
                if look % TCP_EVERY == 0:
                    self._ask_tcp(tuple(links))
                look += 1
        finally:
            for reader in readers.values():
                reader.file.close()

    def _count(self, links: tuple[LabLink, ...], reader: DeviceReader) -> None:
        now_s, counters = time.monotonic(), reader.sent_and_received()
        for link in links:
            self.seen[link.number].counted(now_s, *counters[link.vehicle_device])

    def _ask_tcp(self, namespaces: tuple[str, ...]) -> None:
        by_address = {link.vehicle_address: ("up", link.number) for link in self.lab.links}
        by_address |= {link.cloud_address: ("down", link.number) for link in self.lab.links}
        try:
            samples = [sample for ns in (*namespaces, self.lab.cloud_namespace) for sample in tcp_samples(ns)]
        except LabError as error:  # a look that fails is a look less
            _log.warning("%s", error)
            return
        for sample in samples:
            place = by_address.get(_host(sample.local))
            if place is not None:
                self.seen[place[1]].tcp(place[0], sample)

    def stop(self) -> None:
        """End the looking."""
        self._stop.set()


def _host(local: str) -> str:
    """Return the IPv4 address of "198.18.0.1:7447" or "[::ffff:198.18.0.1]:7447"."""
    return local.rpartition(":")[0].strip("[]").removeprefix("::ffff:")


@contextmanager
def sampling(lab: Lab) -> Iterator[dict[int, LinkSeen]]:
    """Watch the links for the block; gives the findings by number of the vehicle, complete after the block."""
    sampler = Sampler(lab, {link.number: LinkSeen() for link in lab.links})
    thread = threading.Thread(target=sampler.run, name="lab-sampler")
    thread.start()
    try:
        yield sampler.seen
    finally:
        sampler.stop()
        thread.join()
