"""From what a drive found out about a feature layer to the outbox: one report a district that the vehicle has left."""

import logging
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field

from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.features import FeatureChange, FeatureReport
from gnd.schemas.keys import change_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.report.sink import ReportSink

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _PendingFeatures:
    """Tiles of one district that are decided; the district's other tiles are still in sight."""

    since_m: float
    first_ns: int
    changes: dict[TileId, FeatureChange] = field(default_factory=dict)


class FeatureReporter:
    """Gathers the tiles of a layer that were left and puts a report a district into the outbox.

    Report ids are made of vehicle, drive, layer, district and the report's number in it: a restarted agent makes the
    same ones, and what was sent is not sent again.

    Args:
        outbox: where reports go.
        identity: who reports, about which layer.
        start_ns: of the drive, UTC.
        longest_m: a district is reported at the latest after this much way.
    """

    def __init__(self, outbox: ReportSink, identity: Identity, start_ns: int, longest_m: float) -> None:
        self.counts: Counter[str] = Counter()
        self._outbox, self._who, self._start_ns, self._longest_m = outbox, identity, start_ns, longest_m
        self._pending: dict[District, _PendingFeatures] = {}
        self._numbers: Counter[District] = Counter()

    def add(self, change: FeatureChange, t_ns: int, odometer_m: float) -> None:
        """A tile that was left; one that was left before in the same report ends that report."""
        district = change.tile.district
        if district in self._pending and change.tile in self._pending[district].changes:
            self._report(district, t_ns)
        pending = self._pending.setdefault(district, _PendingFeatures(odometer_m, t_ns))
        pending.changes[change.tile] = change

    def report(self, in_sight: Collection[TileId], t_ns: int, odometer_m: float) -> None:
        """Report the districts of which no tile is in sight any more, or which have waited for too long."""
        open_districts = {tile.district for tile in in_sight}
        for district, pending in list(self._pending.items()):
            if district not in open_districts or odometer_m - pending.since_m > self._longest_m:
                self._report(district, t_ns)

    def report_all(self, t_ns: int) -> None:
        """The drive has ended."""
        for district in list(self._pending):
            self._report(district, t_ns)

    def _report(self, district: District, t_ns: int) -> None:
        pending = self._pending.pop(district)
        pending.changes = {tile: one for tile, one in pending.changes.items() if not self._outbox.hides(tile)}
        if not pending.changes:
            return
        report = self._make(district, pending, t_ns)
        self._numbers[district] += 1
        if self._outbox.put(report.report_id, change_key(report.layer, district), report.encode()):
            self.counts["reports"] += 1
            self.counts["seen"] += sum(len(change.seen) for change in report.tiles)
            self.counts["found"] += sum(len(change.found) for change in report.tiles)
        else:
            self.counts["reports_known"] += 1  # this agent was restarted: its first statement stands
        _log.info("report %s: %d tiles of layer %s in %s", report.report_id, len(report.tiles), report.layer, district)

    def _make(self, district: District, pending: _PendingFeatures, t_ns: int) -> FeatureReport:
        who, number = self._who, str(self._numbers[district])
        parts = who.vehicle, who.drive_id, who.layer, district.path, number
        return FeatureReport(
            report_id=deterministic_report_id(who.begun_ns(self._start_ns) // 1_000_000, *parts),
            vehicle=who.vehicle,
            sensor_model=who.sensor_model,
            software=who.software,
            layer=who.layer,
            district=district,
            first_ns=min(pending.first_ns, t_ns),
            last_ns=t_ns,
            tiles=tuple(change for _, change in sorted(pending.changes.items())),
        )
