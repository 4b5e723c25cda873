"""Watches the links of a lab while a fleet uses them: the highest rates, and what TCP measured."""

import logging
import statistics
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.lab.counters import DeviceReader, TcpSample, tcp_samples
from gnd.deploy.lab.lab import Lab
from gnd.deploy.repeating import repeated

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


class _Sampler:
    """Looks at the links of a lab; `seen` has its findings by number of the vehicle."""

    def __init__(self, lab: Lab) -> None:
        self.seen = {link.number: LinkSeen() for link in lab.links}
        self._cloud_namespace = lab.cloud_namespace
        self._links = {lab.links[group.first].vehicle_namespace: lab.links_of(group) for group in lab.groups}
        self._by_address = {link.vehicle_address: ("up", link.number) for link in lab.links}
        self._by_address |= {link.cloud_address: ("down", link.number) for link in lab.links}
        self._readers = {namespace: DeviceReader.of(namespace) for namespace in self._links}

    def look(self, number: int) -> None:
        """Read the interfaces, and at every twentieth look TCP."""
        for namespace, reader in self._readers.items():
            now_s, counters = time.monotonic(), reader.sent_and_received()
            for link in self._links[namespace]:
                self.seen[link.number].counted(now_s, *counters[link.vehicle_device])
        if number % TCP_EVERY == 0:
            self._ask_tcp()

    def _ask_tcp(self) -> None:
        try:
            samples = [sample for ns in (*self._links, self._cloud_namespace) for sample in tcp_samples(ns)]
        except LabError as error:  # a look that fails is a look less
            _log.warning("%s", error)
            return
        for sample in samples:
            place = self._by_address.get(_host(sample.local))
            if place is not None:
                self.seen[place[1]].tcp(place[0], sample)

    def close(self) -> None:
        """Close the interfaces, or their namespaces stay."""
        for reader in self._readers.values():
            reader.file.close()


def _host(local: str) -> str:
    """Return the IPv4 address of "198.18.0.1:7447" or "[::ffff:198.18.0.1]:7447"."""
    return local.rpartition(":")[0].strip("[]").removeprefix("::ffff:")


@contextmanager
def sampling(lab: Lab) -> Iterator[dict[int, LinkSeen]]:
    """Watch the links for the block; gives the findings by number of the vehicle, complete after the block."""
    sampler = _Sampler(lab)
    with closing(sampler), repeated(sampler.look, PERIOD_S, "lab-sampler"):
        yield sampler.seen
