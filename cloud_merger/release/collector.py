"""What vehicles tell of versions on trial: put into the store, each vehicle's newest message once."""

import logging
from collections import Counter
from typing import Final

import apsw

from gnd.cloud_merger.ownership import Members
from gnd.fleet_bus.bus import Bus
from gnd.schemas.errors import SchemaError
from gnd.schemas.health import HealthReport, TileHealth
from gnd.schemas.keys import health_keys, parse_health_key
from gnd.schemas.ticket import ticket_of
from gnd.tile_store import sqlite_trials as trials
from gnd.tile_store.errors import StoreError
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.sqlite_versions import sha_of
from gnd.tile_store.trials import Arm, VehicleHealth, VersionTrial

_LOG: Final = logging.getLogger(__name__)


class HealthCollector:
    """Takes health messages of the districts that this shard owns. Its callback runs in one thread of the bus.

    Attributes:
        counts: rows "kept", "settled" (of a version that is not on trial), "other" (of a version that the vehicle was
            not to have), "older" (than what is known, or too many vehicles have spoken), and messages "refused".
    """

    def __init__(self, store: SqliteStore, members: Members) -> None:
        self._store, self._members = store, members
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
        if not self._members.is_mine(report.district):
            return  # its owner hears it, too
        if not self._store.trials(report.layer, report.district.path):
            self.counts["settled"] += len(report.tiles)
            return
        try:
            self.counts.update(self._store.transact(lambda c, now: self._put(c, vehicle, report, now)))
        except StoreError as error:
            _LOG.warning("health of %s is lost: %s", vehicle, error)

    def _put(self, c: apsw.Connection, vehicle: str, report: HealthReport, now: int) -> Counter[str]:
        open_trials = trials.open_trials(c, report.layer, report.district.path)
        counts: Counter[str] = Counter()
        for told in report.tiles:
            trial = open_trials.get(told.tile)
            arm = None if trial is None else _arm(c, trial, ticket_of(vehicle), told)
            if trial is None or arm is None:
                counts["settled" if trial is None else "other"] += 1
                continue
            kept = trials.put_health(c, trial, _row(vehicle, arm, told, report.t_ns, now), now)
            counts["kept" if kept else "older"] += 1
        return counts


def _arm(c: apsw.Connection, trial: VersionTrial, ticket: int, told: TileHealth) -> Arm | None:
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
