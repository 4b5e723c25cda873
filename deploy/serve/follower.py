"""Watches a map for the page: new versions, vehicles, how the cloud stands.

The store is what counts. Notices of the bus only say where to look at once; without a bus, or when notices are lost, a
look at the whole store now and then finds the same.
"""

import logging
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from gnd.deploy.run_folder import RunFolder
from gnd.deploy.serve.page_map import PageMap
from gnd.deploy.serve.page_vehicles import PageVehicles, run_is_going
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import LAYERS_KNOWN
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import traffic_keys, update_keys
from gnd.schemas.traffic import TrafficSample
from gnd.tile_client.notices import Notices

LOOK_S: Final = 1.0
"""So often the whole store is looked at, if that takes no more than `_SHARE` of the time."""
VEHICLES_S: Final = 0.25
STATUS_S: Final = 2.0
_SHARE: Final = 0.1
_WAIT_S: Final = 0.05
_ENDED_S: Final = 5.0

_log = logging.getLogger(__name__)
Tell = Callable[[dict[str, Any]], None]


class PageFollower:
    """A thread that tells what happens.

    Args:
        shown: the map.
        vehicles: who drives.
        tell: called with each message.
        connect: endpoint of the fleet's router; None: there is none to listen to.
        run: the folder of the run, whose end is told; None: none.
        status: how the cloud stands, asked for now and then; empty: nobody wants to know.
    """

    def __init__(
        self,
        shown: PageMap,
        vehicles: PageVehicles,
        tell: Tell,
        *,
        connect: str | None = None,
        run: RunFolder | None = None,
        status: Callable[[], dict[str, Any]] = dict,
    ) -> None:
        self._shown, self._vehicles, self._tell, self._status = shown, vehicles, tell, status
        self._connect, self._run = connect, run
        self._stop = threading.Event()
        self._next_s = dict.fromkeys(("look", "vehicles", "status"), 0.0)
        self._gone_s: float | None = None
        self.is_live = connect is not None or (run is not None and run_is_going(run))
        self._thread = threading.Thread(target=self._follow, name="page", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def look_soon(self) -> None:
        """Look at the whole store with the next round: somebody has just changed it. May be called from any thread."""
        self._next_s["look"] = 0.0

    def close(self) -> None:
        """End it. May be called again."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _follow(self) -> None:
        if self._connect is None:
            self._rounds(None)
            return
        try:
            with open_bus(BusConfig(connect=(self._connect,), patient=True), name="page") as bus:
                follow_revoked(bus)
                with bus.subscribe(traffic_keys(), self._on_traffic):
                    self._rounds(bus)
        except GndError as error:
            _log.warning("the bus is not followed, the store is: %s", error)
            self._rounds(None)
        else:
            self._rounds(None)

    def _rounds(self, bus: Bus | None) -> None:
        """Look around until closed, or, on a bus, until the run has ended."""
        notices = None if bus is None else Notices(bus)
        if notices is not None:
            notices.follow([update_keys(layer) for layer in (self._shown.layer, *LAYERS_KNOWN)])
        while not self._stop.is_set():
            try:
                self._round(notices)
            except GndError as error:  # a store that is being moved, a full disk
                _log.warning("the page is not up to date: %s", error)
                self._stop.wait(LOOK_S)
            if bus is not None and not self.is_live:
                break
        if notices is not None:
            notices.close()

    def _round(self, notices: Notices | None) -> None:
        if notices is None:
            self._stop.wait(_WAIT_S)
        else:
            self._hear(notices)
        self._now_and_then("vehicles", VEHICLES_S, self._tell_vehicles)
        self._now_and_then("look", LOOK_S, self._look)
        self._now_and_then("status", STATUS_S, self._tell_status)

    def _hear(self, notices: Notices) -> None:
        """Look at the tile of each notice; when some may have been lost, at all."""
        try:
            notice = notices.take(_WAIT_S)
        except SchemaError as error:
            _log.warning("a notice left out: %s", error)
            return
        if notice is not None:
            self._tell_updates(self._shown.refresh_tile(notice.update.layer, notice.update.tile))
        elif notices.may_have_been_lost():
            self._look()

    def _now_and_then(self, name: str, every_s: float, work: Callable[[], None]) -> None:
        begin_s = time.monotonic()
        if begin_s < self._next_s[name]:
            return
        work()
        end_s = time.monotonic()
        self._next_s[name] = end_s + max(every_s, (end_s - begin_s) / _SHARE)

    def _look(self) -> None:
        self._tell_updates(self._shown.refresh())

    def _tell_updates(self, found: list[tuple[str, TileId, int, int]]) -> None:
        for layer, tile, before, version in found:
            message: dict[str, Any] = {"type": "update", "layer": layer, "before": before, "version": version}
            if layer == self._shown.layer:
                message |= {"tile": self._shown.tile(tile)}
            self._tell(message)

    def _tell_vehicles(self) -> None:
        moved = self._vehicles.look()
        if moved:
            self._tell({"type": "vehicles", "vehicles": moved})
        self._notice_the_end()

    def _notice_the_end(self) -> None:
        """A run has ended when it says so, or when its router has been gone for a while."""
        if not self.is_live or self._run is None:
            return
        if run_is_going(self._run):
            self._gone_s = None
            return
        now_s = time.monotonic()
        self._gone_s = self._gone_s or now_s
        if self._run.summary.exists() or now_s - self._gone_s > _ENDED_S:
            self.is_live = False
            self._look()
            self._tell({"type": "ended"})

    def _tell_status(self) -> None:
        status = self._status()
        if status:
            self._tell({"type": "status", "status": status | {"live": self.is_live}})

    def _on_traffic(self, key: str, payload: bytes) -> None:
        try:
            self._vehicles.on_sample(TrafficSample.decode(payload), time.time_ns() // 1_000_000)
        except SchemaError as error:
            _log.warning("unreadable sample on %s: %s", key, error)
