"""What the vehicle says about itself: after some way or time, and when something has happened.

The next sample makes up for a lost one. A sample a second would be most of what a vehicle sends.
"""

import logging
import threading
import time
from collections.abc import Callable

from fleet_bus.bus import Bus
from fleet_bus.errors import BusClosed, BusError
from schemas.keys import traffic_key
from schemas.traffic import TrafficSample

LOOK_S = 1.0
EVERY_M = 100.0
EVERY_S = 10.0
PUBLISH_WAIT_S = 0.5

_log = logging.getLogger(__name__)


class Telemetry:
    """A thread of its own: a lost router must not stop the drive."""

    def __init__(self, bus: Bus, vehicle: str, sample: Callable[[], TrafficSample], *, look_s: float = LOOK_S) -> None:
        self._bus, self._key, self._sample, self._look_s = bus, traffic_key(vehicle), sample, look_s
        self._said: TrafficSample | None = None
        self._said_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Publish a last sample and end the thread."""
        self._stop.set()
        self._thread.join()
        self._publish(self._sample())

    def _run(self) -> None:
        while not self._stop.wait(self._look_s):
            sample = self._sample()
            if self._is_news(sample):
                self._publish(sample)

    def _is_news(self, sample: TrafficSample) -> bool:
        said = self._said
        if said is None or time.monotonic() - self._said_s >= EVERY_S:
            return True
        happened = _told_at_once(sample) != _told_at_once(said)
        return happened or sample.odometer_m - said.odometer_m >= EVERY_M

    def _publish(self, sample: TrafficSample) -> None:
        self._said, self._said_s = sample, time.monotonic()
        try:
            self._bus.publish(self._key, sample.encode(), kind="control", wait_s=PUBLISH_WAIT_S)
        except BusClosed:
            self._stop.set()
        except BusError as error:
            _log.info("sample not published: %s", error)


def _told_at_once(sample: TrafficSample) -> tuple[object, ...]:
    """Scans that are taken back come in rows: they wait for the next sample."""
    return sample.health, sample.reports, sample.tiles_held_back, sample.tiles_doubtful
