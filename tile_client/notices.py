"""Update notices: they wait until they are taken, and it is known when some may have been lost."""

import queue
import time
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.subscribing import Subscription
from gnd.schemas.keys import parse_update_key
from gnd.schemas.updates import TileUpdate

MOST_KEYS: Final = 4
"""So many keys stay listened to after they were left: four districts meet at a corner."""


@dataclass(frozen=True, slots=True)
class QueuedNotice:
    """An update notice, the size of its message in bytes, and when it arrived, ns UTC."""

    update: TileUpdate
    size_bytes: int
    received_ns: int


class Notices:
    """Update notices of some keys, in the order of their arrival.

    They are notices: all are lost while there is no router, and a router, or this process, drops some where a
    subscriber does not keep up. The store is the truth, and can be asked.

    Args:
        bus: an open bus.
        history: also what publishers remember, and what was missed during an interruption.
    """

    def __init__(self, bus: Bus, *, history: bool = False) -> None:
        self._bus, self._history = bus, history
        self._waiting: queue.SimpleQueue[tuple[bytes, int]] = queue.SimpleQueue()
        self._followed: dict[str, Subscription] = {}
        self._losses = self._counted_losses()

    def follow(self, keys: Collection[str]) -> None:
        """Listen to these key expressions; of others to the few that were followed last."""
        for key in keys:
            followed = self._followed.pop(key, None)
            self._followed[key] = followed or self._subscribe(key)
        for key in list(self._followed)[: -max(MOST_KEYS, len(keys))]:
            self._followed.pop(key).close()

    def take(self, wait_s: float = 0.0) -> QueuedNotice | None:
        """The next notice; None where none came within `wait_s`.

        Raises:
            SchemaError: a message that is none; the next call gives the next one.
        """
        try:
            payload, received_ns = self._waiting.get(timeout=wait_s) if wait_s else self._waiting.get_nowait()
        except queue.Empty:
            return None
        return QueuedNotice(TileUpdate.decode(payload), len(payload), received_ns)

    def may_have_been_lost(self) -> bool:
        """Whether, since the last call, the connection was lost and made anew, or notices were dropped here."""
        before, self._losses = self._losses, self._counted_losses()
        return self._losses != before

    def close(self) -> None:
        """Listen to nothing any more."""
        while self._followed:
            self._followed.popitem()[1].close()

    def _counted_losses(self) -> tuple[int, int]:
        return self._bus.connections, sum(one.dropped for one in self._followed.values())

    def _subscribe(self, key: str) -> Subscription:
        return self._bus.subscribe(
            key,
            lambda _key, payload: self._waiting.put((payload, time.time_ns())),
            history=self._history,
            tile_of=lambda of: parse_update_key(of)[1],
        )
