"""Makes messages of one process pass as slowly as a mobile link would let them.

A token bucket per direction in virtual time: each message books the link after the message before it, and its sender or
receiver waits until the last bit would have arrived. Loss is what TCP makes of it: lost packets are sent again, and a
message that lost any is one round trip late.
"""

import random
import threading
import time
from collections.abc import Callable
from typing import Final, Literal

from gnd.fleet_bus.errors import BusClosed
from gnd.fleet_bus.links import SEGMENT_BYTES, LinkProfile

Direction = Literal["up", "down"]

MESSAGE_OVERHEAD_BYTES: Final = 160
"""What a message costs on the wire beside its payload: key, headers, acknowledgement."""


class Bucket:
    """One direction of a link: books messages one after the other.

    Args:
        rate_byte_s: rate, byte/s; may be infinite.
        burst_bytes: depth of the bucket, bytes.
    """

    def __init__(self, rate_byte_s: float, burst_bytes: int) -> None:
        self._rate_byte_s = rate_byte_s
        self._burst_s = burst_bytes / rate_byte_s
        self._free_at_s = -float("inf")
        self._lock = threading.Lock()

    def book(self, now_s: float, size_bytes: float) -> float:
        """Time at which the last bit of a message offered now has been sent, s."""
        send_s = size_bytes / self._rate_byte_s
        with self._lock:
            # An idle link has saved up at most one burst.
            self._free_at_s = max(self._free_at_s, now_s - self._burst_s) + send_s
            return max(self._free_at_s, now_s)


class Pacer:
    """Both directions of one vehicle's link.

    Args:
        link: profile to imitate.
        closed: event that ends every waiting.
        seed: makes the losses repeatable.
        clock: monotonic time, s.
    """

    def __init__(
        self, link: LinkProfile, closed: threading.Event, *, seed: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._link, self._closed, self._clock = link, closed, clock
        self._buckets = {
            "up": Bucket(link.rate_byte_s("up"), link.burst_bytes),
            "down": Bucket(link.rate_byte_s("down"), link.burst_bytes),
        }
        self._random = random.Random(seed)

    def delay_s(self, direction: Direction, payload_bytes: int) -> float:
        """Books a message of that many bytes and returns how long it takes to arrive, s."""
        size_bytes = payload_bytes + MESSAGE_OVERHEAD_BYTES
        lost = self._lost_segments(size_bytes)
        now_s = self._clock()
        sent_s = self._buckets[direction].book(now_s, size_bytes + lost * SEGMENT_BYTES) - now_s
        return sent_s + self._link.delay_s * (3 if lost else 1)

    def wait(self, direction: Direction, payload_bytes: int) -> None:
        """Waits as long as a message of that many bytes takes.

        Raises:
            BusClosed: the bus was closed meanwhile.
        """
        if self._link.is_unlimited:
            return
        if self._closed.wait(self.delay_s(direction, payload_bytes)):
            raise BusClosed("the bus was closed while a message was on its way")

    def _lost_segments(self, size_bytes: int) -> int:
        if self._link.loss == 0:
            return 0
        segments = -(-size_bytes // SEGMENT_BYTES)
        return sum(self._random.random() < self._link.loss for _ in range(segments))
