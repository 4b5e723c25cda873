"""Reports come in: checked, kept, and only then acknowledged. A bad one goes to quarantine with its reason.

A report may come whole, or in short: flags first, answered by "wanted" with the voxels of which Gaussians are asked
for, then these. Nothing of it is kept before all of it is here; what cannot be understood is answered by "resend".
A report about features always comes whole; what it found near a border is kept for the tile beyond, too.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from cloud_merger.errors import BadReport, MergerError, NotUnderstood
from cloud_merger.features.check import FeatureLimits
from cloud_merger.features.kept import FeatureInbox, check_is_of_gaussians, districts_of, square
from cloud_merger.features.parameters import FeatureMergeParameters
from cloud_merger.parameters import MergeParameters
from cloud_merger.short_reports import ShortReports
from cloud_merger.waiting import Waiting, WaitingLimits
from cloud_merger.wants import WantParameters
from gnd_map.tile_id import TileId
from schemas.changes import ChangeAck, ChangeReport, TileChange, split
from schemas.errors import SchemaError
from schemas.features import FeatureReport
from schemas.keys import parse_change_key
from schemas.limits import MAX_REASON_CHARACTERS
from schemas.packed import PackedGaussians, PackedReport, decode_upload
from tile_store.store import Store
from tile_store.values import ReportRow

MAX_CELLS: Final = 1000  # sub-cells of 10 cm in a voxel of 1 m
REMEMBERED_BASES: Final = 65_536
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class IngestLimits:
    """What a statement about this map may say, beyond what `schemas` accepts of any.

    Attributes:
        max_mean_m: a mean farther than this from its voxel's centre along an axis is absurd.
        max_variance_m2: so is a larger variance along an axis (points within 1 m have at most 0.25 m²).
        max_pose_sigma_m: a vehicle that knows its position no better than this says nothing about voxels of 1 m.
        max_pose_sigma_rad: the same for its heading.
        reach_tiles: a tile that the map does not hold may be this many tiles away from one that it holds.
    """

    max_mean_m: float = 0.75
    max_variance_m2: float = 0.5
    max_pose_sigma_m: float = 0.5
    max_pose_sigma_rad: float = 0.05
    reach_tiles: int = 3

    def __post_init__(self) -> None:
        for name in ("max_mean_m", "max_variance_m2", "max_pose_sigma_m", "max_pose_sigma_rad"):
            if not getattr(self, name) > 0:
                raise MergerError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 <= self.reach_tiles <= 32:
            raise MergerError(f"reach_tiles must lie in 0 … 32, got {self.reach_tiles}")


class Ingest:
    """Answers reports. Safe to call from several threads.

    Args:
        store: where reports are kept.
        limits: what is refused.
        short: how reports in short are understood; None: with the defaults.
        features: what becomes of reports about features; None: with the defaults.
        on_stored: called after new reports are durable.
        now_ns: the clock, int ns UTC.
    """

    def __init__(
        self,
        store: Store,
        limits: IngestLimits,
        on_stored: Callable[[], object] = lambda: None,
        now_ns: Callable[[], int] = time.time_ns,
        short: ShortReports | None = None,
        features: FeatureInbox | None = None,
    ) -> None:
        self._store, self._limits, self._on_stored, self._now_ns = store, limits, on_stored, now_ns
        self._short = short or ShortReports(store, MergeParameters(), WantParameters(), WaitingLimits())
        self._features = features or FeatureInbox(
            store, FeatureLimits(), FeatureMergeParameters().reach_m, limits.reach_tiles
        )
        self._known_bases: dict[tuple[str, TileId, bytes], None] = {}

    def answer(self, key: str, payload: bytes) -> ChangeAck:
        """The ack of one message; "stored" and "duplicate" only when every tile of its report is durable.

        Raises:
            StoreError: it could not be kept; the vehicle is to send it again.
        """
        report_id = ""
        try:
            upload = decode_upload(payload)
            report_id = upload.report_id
            return self._answer(key, upload)
        except (SchemaError, BadReport) as error:
            self._short.room.forget(report_id)
            return self._refuse(key, payload, report_id, error)
        except NotUnderstood as error:
            _LOG.info("asked for report %s again: %s", report_id, error)
            return ChangeAck(report_id, "resend", _one_line(str(error)))

    def _answer(self, key: str, upload: ChangeReport | PackedReport | PackedGaussians | FeatureReport) -> ChangeAck:
        if isinstance(upload, FeatureReport):
            self._features.check(key, upload)
            return self._keep_rows(upload.report_id, self._features.rows(upload, self._now_ns()))
        if not isinstance(upload, PackedGaussians):
            check_is_of_gaussians(key, upload)
        if isinstance(upload, ChangeReport):
            return self._checked_and_kept(key, upload)
        if isinstance(upload, PackedReport):
            return self._first_half(key, upload)
        if self._short.room.has_finished(upload.report_id):
            return ChangeAck(upload.report_id, "duplicate")
        return self._checked_and_kept(key, self._short.completed(key, upload))

    def _first_half(self, key: str, packed: PackedReport) -> ChangeAck:
        held = self._understood(key, packed)
        if held is None:
            self._short.room.finish(packed.report_id)
            return ChangeAck(packed.report_id, "duplicate")
        if held.mask.any():
            return ChangeAck(packed.report_id, "wanted", wanted=held.encoded)
        return self._keep(held.report)

    def _understood(self, key: str, packed: PackedReport) -> Waiting | None:
        """What is asked for, perhaps nothing; None: the report is durable already."""
        with self._short.one_at_a_time:
            if self._short.room.has_finished(packed.report_id):
                return None
            held = self._short.waits(key, packed)
            if held is not None:
                return held
            report = self._short.expanded(key, packed)
            self._check(key, report)
            return self._short.hold(key, packed, report)

    def _checked_and_kept(self, key: str, report: ChangeReport) -> ChangeAck:
        self._check(key, report)
        return self._keep(report)

    def _keep(self, report: ChangeReport) -> ChangeAck:
        received_ns = self._now_ns()
        rows = [
            ReportRow(report.report_id, report.layer, tile, report.vehicle, received_ns, body, base_sha=change.base_sha)
            for change, (tile, body) in zip(report.tiles, split(report), strict=True)
        ]
        ack = self._keep_rows(report.report_id, rows)
        self._short.room.finish(report.report_id)
        return ack

    def _keep_rows(self, report_id: str, rows: list[ReportRow]) -> ChangeAck:
        is_new = "stored" in self._store.put_reports(rows)
        if is_new:
            self._on_stored()
        return ChangeAck(report_id, "stored" if is_new else "duplicate")

    def _refuse(self, key: str, payload: bytes, report_id: str, error: Exception) -> ChangeAck:
        reason = _one_line(f"{type(error).__name__}: {error}")
        self._store.quarantine(payload, reason, source=key)
        _LOG.warning("quarantined a report of %d bytes on %s: %s", len(payload), key, reason)
        return ChangeAck(report_id, "quarantined", reason)

    def _check(self, key: str, report: ChangeReport) -> None:
        layer, district = parse_change_key(key)
        if (report.layer, report.district) != (layer, district):
            raise BadReport(f"report for {report.layer} {report.district} came on the key of {layer} {district}")
        for change in report.tiles:
            self._check_base(report.layer, change)
            check_change(change, self._limits)

    def _check_base(self, layer: str, change: TileChange) -> None:
        if not change.base_sha:
            self._check_reach(layer, change.tile)
            return
        place = (layer, change.tile, change.base_sha)
        if place in self._known_bases:
            return
        if self._store.by_sha(*place) is None:
            raise BadReport(
                f"tile {change.tile}: no version of the map has sha {change.base_sha.hex()[:16]}… (the report says "
                f"version {change.base_version}); fetch the tile again"
            )
        if len(self._known_bases) >= REMEMBERED_BASES:
            self._known_bases.clear()
        self._known_bases[place] = None

    def _check_reach(self, layer: str, tile: TileId) -> None:
        """Refuse a tile without a map that is far from all that the map holds."""
        near = set(square(tile, self._limits.reach_tiles))
        held = (head.tile for district in districts_of(near) for head in self._store.heads(layer, district.path))
        if near.isdisjoint(held):
            reach = self._limits.reach_tiles
            raise BadReport(f"tile {tile} is not on the map of layer {layer}, nor is any within {reach} tiles of it")


def check_change(change: TileChange, limits: IngestLimits) -> None:
    """Refuse Gaussians that no points of their voxel can have, and poses too vague to speak of voxels.

    Raises:
        BadReport: says which voxel, with numbers.
    """
    if change.pose_sigma_m > limits.max_pose_sigma_m or change.pose_sigma_rad > limits.max_pose_sigma_rad:
        raise BadReport(
            f"tile {change.tile}: pose known to {change.pose_sigma_m:.3g} m, {change.pose_sigma_rad:.3g} rad only; "
            f"the limits are {limits.max_pose_sigma_m:g} m, {limits.max_pose_sigma_rad:g} rad"
        )
    changed = change.changed
    variance = changed.cov_m2[:, (0, 3, 5)]
    checks = (
        ("mean of {:.3g} m from the voxel's centre", np.abs(changed.mean_m).max(axis=1, initial=0), limits.max_mean_m),
        ("variance of {:.3g} m²", variance.max(axis=1, initial=0), limits.max_variance_m2),
        ("{:d} occupied sub-cells", changed.cells, MAX_CELLS),
        ("{:d} sub-cells more than points", changed.cells.astype(np.int64) - changed.count, 0),
    )
    for what, value, limit in checks:
        if (value > limit).any():
            row = int(np.argmax(value))
            shown = what.format(value[row].item())
            raise BadReport(f"tile {change.tile}, voxel {changed.voxel_id[row]}: {shown}, the limit is {limit:g}")


def _one_line(text: str) -> str:
    printable = "".join(c if c.isprintable() else " " for c in text)
    return printable[:MAX_REASON_CHARACTERS]
