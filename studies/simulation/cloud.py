"""The cloud's half, in this process: what reaches it of the uploads, merged as the mergers do."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.cloud_merger.expanding import base_versions, expand, is_askable, with_measured
from gnd.cloud_merger.memory import TileMemory
from gnd.cloud_merger.merge import MergeParameters, merge_tile
from gnd.cloud_merger.parked import hold_parked
from gnd.cloud_merger.season import hold_season
from gnd.cloud_merger.statements import Report, statements_of, without_unsure
from gnd.cloud_merger.votes import TileVotes
from gnd.cloud_merger.wants import Known, WantParameters, wanted
from gnd.gnd_map.arrays import are_in
from gnd.gnd_map.codec import encode_mask
from gnd.gnd_map.foliage import follows_season
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile, TileDelta, apply, diff
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.vehicle_shape import has_vehicle_shape
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.packed import PackedReport
from gnd.vehicle_agent.report.packing import pack_measured
from studies.simulation.base_map import BaseMap
from studies.simulation.options import Upload
from studies.simulation.result import VehicleResult

Tiles = Mapping[TileId, Gaussians]
NOTHING_PARKED: Final = TileMemory().parked
PARKED_H: Final = ConfirmationParameters().parked_h


def reports_of_tiles(bodies: Iterable[bytes], parameters: MergeParameters) -> dict[TileId, list[Report]]:
    """Decode uploads, weigh them by their sensors and sort them by tile."""
    found: dict[TileId, list[Report]] = defaultdict(list)
    for body in bodies:
        report = ChangeReport.decode(body)
        for change in report.tiles:
            one = parameters.report_of(report.report_id, report.sensor_model, change)
            found[change.tile].append(replace(one, first_ns=report.first_ns, last_ns=report.last_ns))
    return dict(found)


def merged_map(
    base: BaseMap, bodies: Sequence[bytes], parameters: MergeParameters, parked_h: float = PARKED_H
) -> dict[TileId, Gaussians]:
    """Return the map that the cloud makes of a base map and uploads; `parked_h`: see `ConfirmationParameters`."""
    final = dict(base.tiles)
    for tile, told in reports_of_tiles(bodies, parameters).items():
        reports = told if parameters.together else list(without_unsure(told))
        epoch = base.tiles.get(tile, Gaussians.empty())
        bases = {base.shas[tile]: epoch} if tile in base.shas else {}
        merged = merge_tile(epoch, statements_of(epoch, reports, bases, parameters.mode), parameters)
        if not parameters.has_paper_rules:
            merged, _ = hold_season(epoch, merged, reports)
        final[tile] = hold_parked(epoch, merged, reports, NOTHING_PARKED, bases, parked_h).merged.gaussians
    return final


def map_of_one(
    base: BaseMap, bodies: Iterable[bytes], parameters: MergeParameters, parked_h: float = PARKED_H
) -> dict[TileId, Gaussians]:
    """Return the base map with what one vehicle reports, no cloud in between.

    Whoever takes a report sees in it what `merged_map` holds back: leaves, unless the rules are the paper's, and what
    has the shape of a standing vehicle, unless `parked_h` is 0.
    """
    final = dict(base.tiles)
    for tile, reports in reports_of_tiles(bodies, parameters).items():
        before = after = base.tiles.get(tile, Gaussians.empty())
        for report in reports:
            after = _with_change(after, report.change)
        if not parameters.has_paper_rules:
            after = _without_leaves(tile, before, after)
        if parked_h > 0.0:
            after = _without_parked(tile, before, after)
        final[tile] = after
    return final


def _without_parked(tile: TileId, before: Gaussians, after: Gaussians) -> Gaussians:
    at = np.flatnonzero(~are_in(after.voxel_id, before.voxel_id))
    parked = at[has_vehicle_shape(VoxelGrid.of(tile), before, after.take(at))]
    return after.take(np.setdiff1d(np.arange(len(after)), parked))


def _without_leaves(tile: TileId, before: Gaussians, after: Gaussians) -> Gaussians:
    change = diff(before, after)
    held = follows_season(VoxelGrid.of(tile), before, change.removed, change.put)
    put = change.put.take(np.flatnonzero(~are_in(change.put.voxel_id, held)))
    return apply(before, TileDelta(change.removed[~are_in(change.removed, held)], put))


def _with_change(tile: Gaussians, change: TileChange) -> Gaussians:
    there = change.changed.take(np.flatnonzero(change.changed.count > 0))
    gone = np.setdiff1d(change.changed.voxel_id, there.voxel_id)
    return apply(tile, TileDelta(np.intersect1d(gone, tile.voxel_id), there))


@dataclass(frozen=True, slots=True)
class Arrived:
    """What the cloud holds of one vehicle's reports, encoded `ChangeReport`s, and how many bytes brought it there."""

    bodies: tuple[bytes, ...]
    sent_bytes: int


def arrived(base: BaseMap, results: Sequence[VehicleResult], merge: MergeParameters, upload: Upload) -> list[Arrived]:
    """Return what the cloud holds of each vehicle after all have sent their reports, one after the other.

    Args:
        base: the map that all compared with.
        results: of the vehicles in the order in which they send.
        merge: how the cloud will merge; it decides what is asked for.
        upload: how they send.

    Raises:
        GndError: a report in short cannot be understood.
    """
    if upload != "packed":
        return [Arrived(result.reports, result.upload_bytes) for result in results]
    cloud = _StudyCloud(base, merge)
    return [cloud.take(result) for result in results]


class _StudyCloud:
    """Expands reports in short and asks for Gaussians as a merger does, nothing merged in between."""

    def __init__(self, base: BaseMap, merge: MergeParameters) -> None:
        self._base, self._merge = base, merge
        self._held: dict[TileId, list[Report]] = defaultdict(list)

    def take(self, result: VehicleResult) -> Arrived:
        bodies, sent_bytes = [], 0
        for body, half in zip(result.reports, result.packed, strict=True):
            whole, second = self._asked(body, half) if half else (ChangeReport.decode(body), 0)
            bodies.append(whole.encode())
            sent_bytes += len(half or body) + second
            for change in whole.tiles:
                statement = self._merge.report_of(whole.report_id, whole.sensor_model, change)
                self._held[change.tile].append(statement)
        return Arrived(tuple(bodies), sent_bytes)

    def _asked(self, body: bytes, half: bytes) -> tuple[ChangeReport, int]:
        """The report as the cloud keeps it, and the bytes of the second half."""
        whole, packed = ChangeReport.decode(body), PackedReport.decode(half)
        tiles = [self._tile(tile, version) for tile, version in base_versions(packed, whole.district)]
        expanded = expand(packed, whole.layer, whole.district, tiles)
        if packed.measured:
            return expanded, 0
        mask = self._wanted(expanded)
        if not mask.any():
            return expanded, 0
        by_sha = {tile.sha: tile.gaussians for tile in tiles if tile.version}
        second = pack_measured(whole, by_sha, encode_mask(mask))
        by_tile = {tile.tile_id: tile.gaussians for tile in tiles}
        return with_measured(expanded, by_tile, mask, second.measured), len(second.encode())

    def _wanted(self, expanded: ChangeReport) -> NDArray[np.bool_]:
        known = {change.tile: self._known(change.tile) for change in expanded.tiles if is_askable(change).any()}
        return wanted(expanded, known, self._merge, WantParameters()).mask

    def _known(self, tile: TileId) -> Known:
        epoch = self._base.tiles.get(tile, Gaussians.empty())
        bases = {self._base.shas[tile]: epoch} if tile in self._base.shas else {}
        return Known(epoch, TileVotes.of(self._held[tile]), bases)

    def _tile(self, tile: TileId, version: int) -> Tile:
        return Tile(tile, version, self._base.tiles.get(tile, Gaussians.empty()))
