"""A vehicle whose sensors put the messages of a drive on zenoh keys as they come: looks of cameras among them.

Whoever has the sensors answers on the key `header` with sensor, mount and the topics that it gives (`header_message`),
and puts each message on its topic's key. `gnd play DRIVE --zenoh` does so from a recording.
"""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusError, NoRouter
from gnd.fleet_bus.subscribing import Subscription
from gnd.gnd_map.bounded import json_value
from gnd.schemas.drive import DriveHeader
from gnd.schemas.drive_mcap import ITEM_TOPICS, POINTS_TOPIC, item_of
from gnd.schemas.drive_metadata import header_of, metadata_of
from gnd.schemas.errors import BadValue, SchemaError
from gnd.schemas.keys import live_key
from gnd.vehicle_agent.config import LiveParameters
from gnd.vehicle_agent.sources.live import ROUTER_WAIT_S, SCANS, LiveError, LiveItems

ASK_S: Final = 2.0


def header_message(header: DriveHeader, topics: list[str]) -> bytes:
    """What is known of a drive before it begins, and on which of `ITEM_TOPICS` its messages come."""
    told = {"metadata": metadata_of(header), "T_vehicle_lidar": header.T_vehicle_lidar.tolist(), "topics": topics}
    return json.dumps(told).encode()


def read_header_message(body: bytes) -> tuple[DriveHeader, list[str]]:
    """What `header_message` wrote.

    Raises:
        SchemaError: it did not write this.
    """
    try:
        told = json_value(body)
        mount = np.array(told["T_vehicle_lidar"], np.float64)
        topics = [str(topic) for topic in told["topics"]]
        header = header_of({str(key): str(value) for key, value in told["metadata"].items()}, mount)
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        raise BadValue(f"{len(body)} bytes are no header of a vehicle that drives now: {error}") from error
    if unknown := set(topics) - set(ITEM_TOPICS):
        raise BadValue(f"topics of no drive: {', '.join(sorted(unknown))}")
    return header, topics


class PlainSource:
    """The keys of one vehicle's sensors, listened to; made by `open_plain`.

    Attributes:
        header: sensor and mount.
        items: the measurements that come in.
    """

    def __init__(self, bus: Bus, vehicle: str, header: DriveHeader, topics: list[str]) -> None:
        self.header = header
        self._stream_of = {
            live_key(vehicle, topic): (SCANS if topic == POINTS_TOPIC else topic.strip("/"), topic) for topic in topics
        }
        streams = sorted((stream for stream, _ in self._stream_of.values()), key=lambda stream: stream != SCANS)
        self.items = LiveItems(streams)
        self._subscription: Subscription = bus.subscribe(live_key(vehicle, "*"), self._take, kind="control")

    def account(self) -> dict[str, Any]:
        """What came and what did not, as plain values."""
        return {**self.items.account(), "lost_on_the_way": {"all": n} if (n := self._subscription.dropped) else {}}

    def _take(self, key: str, payload: bytes) -> None:
        known = self._stream_of.get(key)
        if known is None:
            return
        stream, topic = known
        try:
            item = item_of(topic, payload)
        except SchemaError as error:
            self.items.refuse(stream, error)
            return
        self.items.put(stream, item.t_ns, lambda: item)


@contextmanager
def open_plain(live: LiveParameters, vehicle: str, stop: threading.Event) -> Iterator[PlainSource]:
    """Ask for the header until somebody answers, then listen.

    Args:
        live: which router.
        vehicle: pseudonym, part of the keys.
        stop: ends the waiting.

    Raises:
        LiveError: no router; stopped before anybody answered; a header that is none.
    """
    try:
        bus = open_bus(BusConfig(connect=live.connect, open_timeout_s=ROUTER_WAIT_S), name=f"{vehicle} sensors")
    except NoRouter as error:
        raise LiveError(str(error)) from error
    with bus:
        while not stop.is_set():
            try:
                body = bus.request(live_key(vehicle, "header"), b"", kind="control", timeout_s=ASK_S)
                header, topics = read_header_message(body)
            except SchemaError as error:
                raise LiveError(f"{live_key(vehicle, 'header')}: {error}") from error
            except BusError:
                continue  # nobody yet
            yield PlainSource(bus, vehicle, header, topics)
            return
    raise LiveError(f"stopped before anybody answered on {live_key(vehicle, 'header')}: nobody has the sensors")
