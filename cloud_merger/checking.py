"""What a report may say about this map: looked at by the workers, long after its ack."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.cloud_merger.errors import BadReport, MergerError
from gnd.cloud_merger.features.kept import districts_of, square
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.settings import check_settings, setting
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.tile_store.store import Store

MAX_CELLS: Final = 1000  # sub-cells of 10 cm in a voxel of 1 m
REMEMBERED_PLACES: Final = 65_536

_MAX_MEAN_M: Final = 0.75
"""A mean farther than this from its voxel's centre along an axis is absurd."""
_MAX_VARIANCE_M2: Final = 0.5
"""So is a larger variance along an axis (points within 1 m have at most 0.25 m²)."""
_MAX_POSE_SIGMA_M: Final = 0.5
"""A vehicle that knows its position no better than this says nothing about voxels of 1 m."""
_MAX_POSE_SIGMA_RAD: Final = 0.05
"""The same for its heading."""


@dataclass(frozen=True, slots=True)
class IngestLimits:
    """What a statement about this map may say, beyond what `schemas` accepts of any."""

    reach_tiles: int = setting(
        3,
        "A tile that the map does not hold may be this many tiles away from one that it holds.",
        unit="tiles",
        least=0,
        most=32,
    )
    speeds: bool = setting(
        True,
        "Whether reports of places that their vehicle cannot have reached (70 m/s) are refused; off only for loads,"
        " whose vehicles jump from street to street.",
    )

    def __post_init__(self) -> None:
        check_settings(self, MergerError)


class MapCheck:
    """Whether reports speak of this map, and of voxels as they can be. Safe in several threads.

    Args:
        store: of the map.
        limits: what is refused.
    """

    def __init__(self, store: Store, limits: IngestLimits) -> None:
        self._store, self._limits = store, limits
        self._known: dict[tuple[str, TileId, bytes], None] = {}

    def check(self, report: ChangeReport) -> None:
        """Refuse what cannot be a true statement about this map.

        A base that the store does not hold (any more) is no reason: what has changed speaks for itself, and "as in the
        base" abstains (`statements_of`). Only the place must be on the map then.

        Raises:
            BadReport: with numbers.
        """
        for change in report.tiles:
            check_change(change)
            self._check_place(report.layer, change)

    def check_places(self, layer: str, tiles: Iterable[TileId]) -> None:
        """Refuse tiles without a map that are far from it, before anything is made of what is said about them.

        Raises:
            BadReport: with the tile.
        """
        for tile in tiles:
            self._check_reach(layer, tile)

    def _check_place(self, layer: str, change: TileChange) -> None:
        place = (layer, change.tile, change.base_sha)
        if place in self._known:
            return
        if not change.base_sha or self._store.by_sha(*place) is None:
            self._check_reach(layer, change.tile)
            return  # the tile may yet leave the map, or its base come to it: looked up again
        if len(self._known) >= REMEMBERED_PLACES:
            self._known.clear()
        self._known[place] = None

    def _check_reach(self, layer: str, tile: TileId) -> None:
        """Refuse a tile without a map that is far from all that the map holds."""
        near = set(square(tile, self._limits.reach_tiles))
        if near.isdisjoint(self._held(layer, near)):
            reach = self._limits.reach_tiles
            raise BadReport(f"tile {tile} is not on the map of layer {layer}, nor is any within {reach} tiles of it")

    def _held(self, layer: str, near: set[TileId]) -> Iterable[TileId]:
        return (head.tile for district in districts_of(near) for head in self._store.heads(layer, district.path))


def check_change(change: TileChange) -> None:
    """Refuse Gaussians that no points of their voxel can have, and poses too vague to speak of voxels.

    Raises:
        BadReport: says which voxel, with numbers.
    """
    if change.pose_sigma_m > _MAX_POSE_SIGMA_M or change.pose_sigma_rad > _MAX_POSE_SIGMA_RAD:
        raise BadReport(
            f"tile {change.tile}: pose known to {change.pose_sigma_m:.3g} m, {change.pose_sigma_rad:.3g} rad only; "
            f"the limits are {_MAX_POSE_SIGMA_M:g} m, {_MAX_POSE_SIGMA_RAD:g} rad"
        )
    for gaussians in (change.changed, change.unsure):
        _check_gaussians(change, gaussians)


def _check_gaussians(change: TileChange, gaussians: Gaussians) -> None:
    variance = gaussians.cov_m2[:, (0, 3, 5)]
    checks = (
        ("mean of {:.3g} m from the voxel's centre", np.abs(gaussians.mean_m).max(axis=1, initial=0), _MAX_MEAN_M),
        ("variance of {:.3g} m²", variance.max(axis=1, initial=0), _MAX_VARIANCE_M2),
        ("{:d} occupied sub-cells", gaussians.cells, MAX_CELLS),
        ("{:d} sub-cells more than points", gaussians.cells.astype(np.int64) - gaussians.count, 0),
    )
    for what, value, limit in checks:
        if (value > limit).any():
            row = int(np.argmax(value))
            shown = what.format(value[row].item())
            raise BadReport(f"tile {change.tile}, voxel {gaussians.voxel_id[row]}: {shown}, the limit is {limit:g}")
