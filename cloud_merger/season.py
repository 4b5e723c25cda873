"""Leaves are no change: what came or went in the crown of a tree whose trunk stayed is not published.

A pure function of the epoch and of what was merged, as the merge itself; see `gnd.gnd_map.foliage`.
"""

from collections.abc import Sequence

from gnd.cloud_merger.merge import MergedTile
from gnd.cloud_merger.parked import waiting_of
from gnd.cloud_merger.statements import Report
from gnd.gnd_map.foliage import follows_season
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.tile_store.values import Unconfirmed


def hold_season(
    epoch: Gaussians, merged: MergedTile, reports: Sequence[Report]
) -> tuple[MergedTile, tuple[Unconfirmed, ...]]:
    """Take back what follows the season.

    Args:
        epoch: the tile that the reports were merged into.
        merged: of `merge_tile`.
        reports: those of the merge, in any order.

    Returns:
        The tile to publish, and who claims what was taken back.
    """
    if not reports or not len(merged.changed):
        return merged, ()
    voxels = follows_season(VoxelGrid.of(reports[0].change.tile), epoch, merged.delta.removed, merged.delta.put)
    if not len(voxels):
        return merged, ()
    return merged.without(voxels.tolist()), waiting_of(voxels, merged, epoch, reports, "season")
