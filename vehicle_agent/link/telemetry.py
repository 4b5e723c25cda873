"""What the vehicle says about itself: by the way driven, and when its health or its doubts have changed.

The next sample makes up for a lost one, and that a report was acknowledged the cloud knows: a sample and its packets
weigh as much as the flags of 300 changed voxels. Way and time are those of the drive, not of the clock: a vehicle on a
busy machine, or one that stands, has no more to say.
"""

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import BusClosed, BusError
from gnd.schemas.health import HealthReport
from gnd.schemas.keys import health_key, traffic_key
from gnd.schemas.traffic import TrafficSample

LOOK_S = 1.0
"""With each look goes a reading of the connection, by which the ledger tells keep-alives from messages."""
EVERY_M = 1000.0
EVERY_S = 600.0
HEALTH_S = 10.0
"""Health that wavers, and doubts that grow, are told no oftener than this."""
PUBLISH_WAIT_S = 0.5

_log = logging.getLogger(__name__)


class Telemetry:
    """A thread of its own: a lost router must not stop the drive.

    Args:
        bus: open.
        vehicle: its pseudonym.
        sample: what the vehicle says about itself now.
        health: what there is to tell of tiles on trial; `all_of_it`: the drive has ended.
        look_s: how often to look.
    """

    def __init__(
        self,
        bus: Bus,
        vehicle: str,
        sample: Callable[[], TrafficSample],
        health: Callable[..., Sequence[HealthReport]] = lambda **_: (),
        *,
        look_s: float = LOOK_S,
    ) -> None:
        self._health, self._health_key = health, health_key(vehicle)
        self._bus, self._key, self._sample, self._look_s = bus, traffic_key(vehicle), sample, look_s
        self._said: TrafficSample | None = None
        self._began_ns = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Publish a last sample, which alone holds the ledger's totals by kind, and end the thread."""
        self._stop.set()
        self._thread.join()
        self._publish_health(all_of_it=True)
        self._publish(self._sample())

    def _run(self) -> None:
        while not self._stop.wait(self._look_s):
            self._publish_health()
            sample = self._sample()
            if self._is_news(sample):
                self._publish(replace(sample, lines=()))

    def _is_news(self, sample: TrafficSample) -> bool:
        said = self._said
        if said is None:
            self._began_ns = self._began_ns or sample.t_ns
            return sample.health == "good" or (sample.t_ns - self._began_ns) * 1e-9 >= HEALTH_S
        passed_s = (sample.t_ns - said.t_ns) * 1e-9
        if _well_being(sample) != _well_being(said) and passed_s >= HEALTH_S:
            return True
        return passed_s >= EVERY_S or sample.odometer_m - said.odometer_m >= EVERY_M

    def _publish(self, sample: TrafficSample) -> None:
        self._said = sample
        self._put(self._key, sample.encode())

    def _put(self, key: str, payload: bytes) -> None:
        try:
            self._bus.publish(key, payload, kind="telemetry", wait_s=PUBLISH_WAIT_S)
        except BusClosed:
            self._stop.set()
        except BusError as error:
            _log.info("sample not published: %s", error)

    def _publish_health(self, *, all_of_it: bool = False) -> None:
        for report in self._health(all_of_it=all_of_it):
            self._put(self._health_key, report.encode())


def _well_being(sample: TrafficSample) -> tuple[object, ...]:
    """Scans that are taken back come in rows: they wait for the next sample."""
    return sample.health, sample.tiles_held_back, sample.tiles_doubtful, sample.map_stale_h > 0
