"""Reports that come in short: their flags are understood, Gaussians are asked for, and a whole report comes out."""

import logging
from threading import Lock
from typing import Final

from cloud_merger.errors import BadReport, MissingBase, MissingHalf, NotUnderstood
from cloud_merger.expanding import base_versions, expand, is_askable, with_measured
from cloud_merger.parameters import MergeParameters
from cloud_merger.statements import Report
from cloud_merger.stored import Bases, report_of
from cloud_merger.waiting import Waiting, WaitingLimits, WaitingRoom
from cloud_merger.wants import Known, WantParameters, asked_voxels, wanted
from gnd_map.codec import encode_mask
from gnd_map.errors import GndError
from gnd_map.tile import Tile
from gnd_map.tile_id import TileId
from schemas.changes import ChangeReport, TileChange
from schemas.errors import SchemaError
from schemas.keys import parse_change_key
from schemas.packed import PackedGaussians, PackedReport, crc_of
from tile_store.store import Store
from tile_store.values import ReportRow

_NO_BASE: Final = b""
_LOG = logging.getLogger(__name__)


class ShortReports:
    """Understands the halves of packed reports. Safe to call from several threads.

    First halves are to be understood one at a time, under `one_at_a_time`: that bounds the memory which looking along
    tracks takes, and a vehicle that asks again while its report is worked on costs nothing.

    Args:
        store: of tiles and reports.
        merge: how statements will be merged.
        want: which Gaussians are asked for.
        waiting: how many first halves are kept.
    """

    def __init__(self, store: Store, merge: MergeParameters, want: WantParameters, waiting: WaitingLimits) -> None:
        self.room = WaitingRoom(waiting)
        self._store, self._merge, self._want = store, merge, want
        self._bases = Bases(store)
        self.one_at_a_time = Lock()

    def expanded(self, key: str, packed: PackedReport) -> ChangeReport:
        """The report that the flags stand for, all Gaussians withheld.

        Raises:
            MissingBase: the store does not hold what the vehicle compared with.
            NotUnderstood: something else went wrong here.
            BadReport, SchemaError: the flags cannot be a report.
        """
        layer, district = parse_change_key(key)
        tiles = self._tiles(key, packed)
        try:
            return expand(packed, layer, district, tiles)
        except GndError:
            raise
        except Exception as error:  # a fault of ours must not hold up a report that can be sent whole
            _LOG.exception("report %s cannot be expanded", packed.report_id)
            raise NotUnderstood(f"report {packed.report_id}: {type(error).__name__}: {error}") from error

    def hold(self, key: str, packed: PackedReport, report: ChangeReport) -> Waiting | None:
        """Decide which Gaussians of the expanded report are wanted, and keep it until it is durable.

        Returns:
            What is asked for, perhaps nothing; None: the report is durable already.
        """
        known = {c.tile: self._known(report, c) for c in report.tiles if is_askable(c).any()}
        if any(report.report_id == other.report_id for one in known.values() for other in one.reports):
            return None
        mask = wanted(report, known, self._merge, self._want)
        waiting = Waiting(key, packed, report, mask, encode_mask(mask), asked_voxels(report, mask))
        self.room.hold(waiting)
        return waiting

    def waits(self, key: str, packed: PackedReport) -> Waiting | None:
        """The same first half, if it waits already: what was asked stays asked."""
        held = self.room.get(packed.report_id)
        return held if held is not None and (held.key, held.packed) == (key, packed) else None

    def completed(self, key: str, gaussians: PackedGaussians) -> ChangeReport:
        """The whole report of a first half that waits and its second half.

        Raises:
            MissingHalf: its first half is not here, or has asked for other voxels.
            BadReport, SchemaError: the Gaussians cannot be those that were asked for.
        """
        held = self.room.get(gaussians.report_id)
        if held is None:
            raise MissingHalf(f"report {gaussians.report_id}: {len(gaussians.measured)} bytes of Gaussians, no flags")
        if held.key != key:
            raise BadReport(f"report {gaussians.report_id} began on key {held.key} and goes on on {key}")
        if crc_of(held.encoded) != gaussians.wanted_crc:
            raise MissingHalf(
                f"report {gaussians.report_id}: its Gaussians answer mask {gaussians.wanted_crc:08x}, asked were the "
                f"{int(held.mask.sum())} voxels of mask {crc_of(held.encoded):08x}"
            )
        bases = {tile.tile_id: tile.gaussians for tile in self._tiles(key, held.packed)}
        return with_measured(held.report, bases, held.mask, gaussians.measured)

    def _tiles(self, key: str, packed: PackedReport) -> list[Tile]:
        layer, district = parse_change_key(key)
        return [self._tile(layer, *one) for one in base_versions(packed, district)]

    def _tile(self, layer: str, tile: TileId, version: int) -> Tile:
        found = self._bases.version(layer, tile, version)
        if found is None:
            raise MissingBase(f"tile {tile} of layer {layer} has no version {version} here")
        return found

    def _known(self, report: ChangeReport, change: TileChange) -> Known:
        journal = self._store.in_play(report.layer, change.tile)
        state, rows = self._bases.state(change.tile, journal), journal.reports
        shas = {row.base_sha for row in rows} | {change.base_sha}
        found = {sha: self._bases.content(report.layer, change.tile, sha) for sha in sorted(shas - {_NO_BASE})}
        return Known(
            epoch=state.gaussians,
            memory=state.memory,
            reports=[one for row in rows if (one := self._report(row)) is not None],
            bases={sha: gaussians for sha, gaussians in found.items() if gaussians is not None},
            promised=self.room.promised(change.tile, report.layer, but=report.report_id),
        )

    def _report(self, row: ReportRow) -> Report | None:
        """What a stored report says; nothing where it can no longer be read, which the merge will tell."""
        try:
            return report_of(row.body, self._merge)
        except SchemaError:
            return None
