"""What vehicles tell of versions on trial: put into the store, each vehicle's newest message once."""

import logging
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.schemas.errors import SchemaError
from gnd.schemas.health import HealthReport, TileHealth
from gnd.schemas.keys import health_keys, parse_health_key
from gnd.schemas.ticket import ticket_of
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.connection import SqlConnection
from gnd.tile_store.errors import StoreError
from gnd.tile_store.sql_versions import sha_of
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.trials import Arm, VehicleHealth, VersionTrial

_LOG: Final = logging.getLogger(__name__)


BURST: Final = 8
"""Messages that a vehicle may send at once, ..."""
EVERY_S: Final = 0.5
"""... and how often then: an agent looks once a second. What is more is left out before it costs a write."""
VEHICLES_PACED: Final = 20_000


class HealthCollector:
    """Takes health messages. Its callback runs in one thread of the bus.

    All shards hear all of them: whichever is there keeps a message, the others find it kept.

    Args:
        store: where they are kept.
        clock_s: a clock that does not step, s.

    Attributes:
        counts: rows "kept", "settled" (of a version that is not on trial), "other" (of a version that the vehicle was
            not to have), "older" (than what is known, or too many vehicles have spoken); messages "refused" and
            "flooding".
    """

    def __init__(self, store: SqlStore, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._store, self._clock_s = store, clock_s
        self._free_s: OrderedDict[str, float] = OrderedDict()
        self.counts: Counter[str] = Counter()

    def open(self, bus: Bus) -> None:
        """Begin to listen."""
        bus.subscribe(health_keys(), self.take, kind="telemetry")

    def take(self, key: str, payload: bytes) -> None:
        """Keep what one message says; one that is none is counted, and changes nothing."""
        try:
            vehicle, report = parse_health_key(key), HealthReport.decode(payload)
        except SchemaError as error:
            self.counts["refused"] += 1
            _LOG.info("refused on %s: %s", key, error)
            return
        if self._is_flooding(vehicle):
            self.counts["flooding"] += 1
            return
        if not self._store.trials(report.layer, report.district.path):
            self.counts["settled"] += len(report.tiles)
            return
        if self._store.look(lambda c: self._is_known(c, vehicle, report)):
            self.counts["older"] += len(report.tiles)
            return
        try:
            self.counts.update(self._store.transact(lambda c, now: self._put(c, vehicle, report, now)))
        except StoreError as error:
            _LOG.warning("health of %s is lost: %s", vehicle, error)

    def _is_flooding(self, vehicle: str) -> bool:
        """Whether a vehicle has used up its burst."""
        now_s = self._clock_s()
        free_s = max(self._free_s.pop(vehicle, now_s), now_s)
        is_over = free_s - now_s > BURST * EVERY_S
        self._free_s[vehicle] = free_s if is_over else free_s + EVERY_S
        if len(self._free_s) > VEHICLES_PACED:
            self._free_s.popitem(last=False)
        return is_over

    def _put(self, c: SqlConnection, vehicle: str, report: HealthReport, now: int) -> Counter[str]:
        open_trials = trials.open_trials(c, report.layer, report.district.path)
        counts: Counter[str] = Counter()
        for told in report.tiles:
            trial = open_trials.get(told.tile)
            arm = None if trial is None else _arm(c, trial, ticket_of(vehicle), told)
            if trial is None or arm is None:
                counts["settled" if trial is None else "other"] += 1
                continue
            row = _row(vehicle, arm, told, report.t_ns, now)
            kept = trials.put_health(c, trial, row, now)
            counts["kept" if kept else "older"] += 1
        return counts

    @staticmethod
    def _is_known(c: SqlConnection, vehicle: str, report: HealthReport) -> bool:
        """Whether the store holds this message already, or a later one: nothing is to be written then."""
        open_trials = trials.open_trials(c, report.layer, report.district.path)
        told = [open_trials[one.tile] for one in report.tiles if one.tile in open_trials]
        return bool(told) and all(trials.told_ns(c, trial, vehicle) >= report.t_ns for trial in told)


def _arm(c: SqlConnection, trial: VersionTrial, ticket: int, told: TileHealth) -> Arm | None:
    """Which version a vehicle speaks of; None: not the one that it was to have. The number may be an older one of the
    same content, which a vehicle keeps when a version is taken back.
    """
    is_first = trial.is_among_first(ticket)
    if told.version == trial.version:
        return "new" if is_first else None
    if is_first or sha_of(c, trial.layer, trial.tile, told.version) != trial.base_sha:
        return None
    return "old"


def _row(vehicle: str, arm: Arm, told: TileHealth, t_ns: int, now: int) -> VehicleHealth:
    return VehicleHealth(
        vehicle=vehicle,
        arm=arm,
        first_ns=now,
        t_ns=t_ns,
        scans=told.scans,
        matched=told.matched_permille,
        fit=told.fit_permille,
        elsewhere=told.elsewhere_permille,
        inside=told.inside,
        gated=told.gated,
        not_good=told.not_good,
        has_left=told.left,
    )
