"""The cloud's half, in this process: reports of the first n vehicles merged as the mergers do, and scored."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from gnd.cloud_merger.merge import MergeParameters, merge_tile
from gnd.cloud_merger.statements import Report, statements_of
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import TileDelta, apply
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from studies.simulation.base_map import BaseMap

Tiles = Mapping[TileId, Gaussians]


def reports_of_tiles(bodies: Iterable[bytes], parameters: MergeParameters) -> dict[TileId, list[Report]]:
    """Decode uploads, weigh them by their sensors and sort them by tile."""
    found: dict[TileId, list[Report]] = defaultdict(list)
    for body in bodies:
        report = ChangeReport.decode(body)
        for change in report.tiles:
            found[change.tile].append(parameters.report_of(report.report_id, report.sensor_model, change))
    return dict(found)


def merged_map(base: BaseMap, bodies: Sequence[bytes], parameters: MergeParameters) -> dict[TileId, Gaussians]:
    """Return the map that the cloud makes of a base map and uploads."""
    final = dict(base.tiles)
    for tile, reports in reports_of_tiles(bodies, parameters).items():
        epoch = base.tiles.get(tile, Gaussians.empty())
        bases = {base.shas[tile]: epoch} if tile in base.shas else {}
        merged = merge_tile(epoch, statements_of(epoch, reports, bases, parameters.mode), parameters)
        final[tile] = merged.gaussians
    return final


def map_of_one(base: BaseMap, bodies: Iterable[bytes]) -> dict[TileId, Gaussians]:
    """Return the base map with what one vehicle says about it, no cloud in between."""
    final = dict(base.tiles)
    for tile, reports in reports_of_tiles(bodies, MergeParameters()).items():
        for report in reports:
            final[tile] = _with_change(final.get(tile, Gaussians.empty()), report.change)
    return final


def _with_change(tile: Gaussians, change: TileChange) -> Gaussians:
    there = change.changed.take(np.flatnonzero(change.changed.count > 0))
    gone = np.setdiff1d(change.changed.voxel_id, there.voxel_id)
    return apply(tile, TileDelta(np.intersect1d(gone, tile.voxel_id), there))
