"""How long ago a publisher has said that the map is as it is: of a map that somebody freezes, the vehicle says so.

The cloud signs its lists of districts again each hour. The vehicle asks for the head of a list now and then, without
the districts. It drives on with what it has, however old that is: an outage of the cloud stops nobody.
"""

import logging
import threading
import time
from dataclasses import dataclass
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import BusClosed, BusError
from gnd.fleet_bus.publishers import Publishers
from gnd.fleet_bus.seldom import Seldom
from gnd.schemas.errors import SchemaError
from gnd.tile_client.archive_check import SeenStates
from gnd.tile_client.list_check import ListCheck

STALE_AFTER_S: Final = 86_400.0
"""24 times the hour after which running shards sign again."""
ASKED_AFTER_S: Final = 21_600.0
"""What was signed so long ago is asked for again, also after a new start: a question costs as much as a report."""
AGAIN_S: Final = 600.0
"""After nobody has answered, or nothing newer has come, it is asked again so late."""
ASK_S: Final = 30.0
LOOK_S: Final = 1.0
_SELDOM: Final = Seldom(logging.getLogger(__name__))


@dataclass(frozen=True, slots=True)
class MapAgeTimes:
    """When the vehicle asks, and from when on it calls its map stale, s."""

    stale_after_s: float = STALE_AFTER_S
    asked_after_s: float = ASKED_AFTER_S
    again_s: float = AGAIN_S
    look_s: float = LOOK_S


class MapAge:
    """Asks in a thread of its own.

    Args:
        bus: open, with an identity.
        layer: name of the layer.
        publishers: whose signature counts.
        seen: which lists were seen before; it outlives the process.
        times: when to ask.
    """

    def __init__(
        self, bus: Bus, layer: str, publishers: Publishers, seen: SeenStates, times: MapAgeTimes | None = None
    ) -> None:
        self._bus, self._layer, self._times = bus, layer, MapAgeTimes() if times is None else times
        self._check = ListCheck(publishers, layer, seen)
        self._signed_s = max((seen.newest(name).signed_s for name in seen.names(f"{layer}@")), default=0)
        self._began_s, self._stop = time.time(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="map age", daemon=True)
        self._thread.start()

    @property
    def age_s(self) -> float:
        """How long ago the newest list that was seen was signed, s; where none was: for how long it is looked for."""
        return max(time.time() - (self._signed_s or self._began_s), 0.0)

    @property
    def stale_h(self) -> int:
        """The same in whole hours, where it is too long; else 0."""
        return int(self.age_s // 3600) or 1 if self.age_s > self._times.stale_after_s else 0

    def close(self) -> None:
        """Ask no more; the bus is closed before."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        wait_s = self._times.look_s
        while not self._stop.wait(wait_s):
            wait_s = self._times.look_s
            if self._signed_s and self.age_s < self._times.asked_after_s:
                continue
            try:
                self._signed_s = max(self._signed_s, self._check.ask_head(self._bus, ASK_S))
            except BusClosed:
                return
            except (BusError, SchemaError) as error:
                _SELDOM.warning("nobody has confirmed that the map is the newest one: %s", error)
            if not self._signed_s or self.age_s >= self._times.asked_after_s:
                wait_s = self._times.again_s
            if self.stale_h:
                _SELDOM.warning(
                    "the map is stale: its publishers have confirmed it %.1f h ago for the last time (they do once an"
                    " hour), so newer versions may be withheld, or the cloud is away; driving on with what is here",
                    self.age_s / 3600,
                )
