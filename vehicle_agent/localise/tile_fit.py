"""How well scans lie on single tiles of the map: what tells a tile that is wrong from a vehicle that is.

A pose rests on all tiles around. Where one of them is off, the pose stays where the others put it, and the points in
that tile do not lie on its Gaussians.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.tile_id import TileId, morton_of
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.kernels import linearise
from gnd.vehicle_agent.localise.match_map import MatchMap, MatchMapCache
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import REGISTRATION_GATE_PER_SCALE

POINTS_LOOKED_AT: Final = 4_000
LEAST_POINTS: Final = 60
"""Fewer points of a scan in a tile say nothing about it."""


@dataclass(frozen=True, slots=True)
class TileFit:
    """How the points of a scan in one tile, or in several, lie on the map.

    Attributes:
        points: in voxels that the map knows.
        matched: share of them near a Gaussian.
        fit: 1 - their mean robust cost, 0 ... 1, as of a registration.
    """

    points: int
    matched: float
    fit: float


class TileFits:
    """Looks at scans with final poses.

    Args:
        local_map: on which they lie.
        parameters: of registration, whose cost it is.
    """

    def __init__(self, local_map: LocalMap, parameters: RegistrationParameters) -> None:
        self._map, self._par = local_map, parameters
        self._maps = MatchMapCache(local_map, parameters.noise_m)

    def of(
        self, points_map_m: F64, p_vehicle_map_m: F64, tiles: Collection[TileId]
    ) -> tuple[dict[TileId, TileFit], TileFit | None]:
        """The fit on each of some tiles that the scan shows well enough, and that on all others together (None: not
        well enough).

        Args:
            points_map_m: (N, 3) of the scan, map frame.
            p_vehicle_map_m: (3,) where the vehicle was.
            tiles: held ones.
        """
        points = points_map_m[:: max(1, len(points_map_m) // POINTS_LOOKED_AT)]
        lat, lon, _ = self._map.grid_frame.frame.geodetic_from_enu(points)
        of_point: I64 = morton_of(lat, lon)
        near = self._maps.near(p_vehicle_map_m)
        fits = {tile: self._fit(points[of_point == tile.morton], near) for tile in tiles}
        elsewhere = self._fit(points[~np.isin(of_point, [tile.morton for tile in tiles])], near)
        return {tile: fit for tile, fit in fits.items() if fit is not None}, elsewhere

    def _fit(self, points: F64, m: MatchMap) -> TileFit | None:
        if len(points) < LEAST_POINTS:
            return None
        scale = self._par.rules.scales[-1]
        cost, matched, inside = linearise(
            np.ascontiguousarray(points), np.eye(3), np.zeros(3), m.index, m.A, m.b, m.mean_m, m.information, scale**2,
            (REGISTRATION_GATE_PER_SCALE * scale) ** 2, np.empty((6, 6)), np.empty(6),
        )  # fmt: skip
        if inside < LEAST_POINTS:
            return None
        return TileFit(inside, matched / inside, max(0.0, 1.0 - cost / (scale**2 * inside)))
