"""What the vehicle says about itself about once a second; the next sample makes up for a lost one."""

import logging
import threading
from collections.abc import Callable

from fleet_bus.bus import Bus
from fleet_bus.errors import BusClosed, BusError
from schemas.keys import traffic_key
from schemas.traffic import TrafficSample

PERIOD_S = 1.0
PUBLISH_WAIT_S = 0.5

_log = logging.getLogger(__name__)


class Telemetry:
    """A thread of its own: a lost router must not stop the drive."""

    def __init__(self, bus: Bus, vehicle: str, sample: Callable[[], TrafficSample]) -> None:
        self._bus, self._key, self._sample = bus, traffic_key(vehicle), sample
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Publish a last sample and end the thread."""
        self._stop.set()
        self._thread.join()
        self._publish()

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            self._publish()

    def _publish(self) -> None:
        try:
            self._bus.publish(self._key, self._sample().encode(), kind="control", wait_s=PUBLISH_WAIT_S)
        except BusClosed:
            self._stop.set()
        except BusError as error:
            _log.info("sample not published: %s", error)
