"""Feature tiles into a vehicle's pipeline, its reports out of it, and both in the plane of a route."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.features import Feature, FeatureTile, full_covariance, prior
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.features import FeatureChange, FeatureReport
from gnd.vehicle_agent.features.feature_map import place_in_tile, with_height
from gnd.vehicle_agent.pipeline import Output
from gnd.vehicle_agent.place import Place
from studies.frame.kept import Kept

SIGMA_HEIGHT_M: Final = 0.5
"""The studies are in the plane: heights are 0 m, this uncertain, in the route's frame."""


class TilesAtOnce:
    """All tiles of some layers, with the first question: a `FeatureTiles`."""

    def __init__(self, layers: Mapping[str, Iterable[FeatureTile]]) -> None:
        self._tiles = [(layer, tile) for layer, tiles in layers.items() for tile in tiles]

    def follow(self, place: Place) -> Iterator[tuple[str, FeatureTile]]:  # noqa: ARG002  (all are given at once)
        """See `FeatureTiles`."""
        tiles, self._tiles = self._tiles, []
        yield from tiles


def tiles_of(
    frame: LocalFrame, feature_id: I64, kinds: Sequence[str], xy_m: F64, sigma_m: float
) -> dict[TileId, FeatureTile]:
    """Return point features (N,) at xy_m (N, 2) [m] in the route's frame as version 1 of their tiles."""
    found: dict[TileId, list[Feature]] = defaultdict(list)
    for number, kind, xy in zip(feature_id.tolist(), kinds, xy_m, strict=True):
        point, cov = with_height(xy, sigma_m**2 * np.eye(2), 0.0, SIGMA_HEIGHT_M, 0.0)
        tile, points, six = place_in_tile(frame, point, cov)
        found[tile].append(Feature(number, kind, points, six, prior(0.95)))
    return {tile: FeatureTile.of(tile, 1, features) for tile, features in found.items()}


def reports_of(outputs: Iterable[Output]) -> list[FeatureReport]:
    """Return the reports of a drive as the cloud reads them."""
    return [FeatureReport.decode(report.body) for output in outputs for report in output.reports]


def in_route_frame(frame: LocalFrame, tile: TileId, places: Sequence[tuple[F64, F64]]) -> tuple[F64, F64]:
    """Return positions (N, 2) and covariances (N, 2, 2) in the route's frame.

    Args:
        frame: the route's.
        tile: in whose frame the places are.
        places: position (3,) [m] and covariance (6,) [m^2] of each, as in tiles and reports.
    """
    T = frame.T_self_other(LocalFrame.of_tile(tile))
    R = T[:3, :3]
    xy_m = np.array([(R @ position + T[:3, 3])[:2] for position, _ in places]).reshape(-1, 2)
    cov = np.array([(R @ full_covariance(six) @ R.T)[:2, :2] for _, six in places]).reshape(-1, 2, 2)
    return xy_m, cov


def found_in(frame: LocalFrame, changes: Iterable[FeatureChange]) -> tuple[F64, F64]:
    """Return positions (N, 2) and covariances (N, 2, 2) in the route's frame of what tiles' changes say is new."""
    return joined(
        in_route_frame(frame, change.tile, [(new.points_m[0], new.cov_m2) for new in change.found])
        for change in changes
    )


def joined(places: Iterable[tuple[F64, F64]]) -> tuple[F64, F64]:
    """Return the places of all tiles together, (N, 2) and (N, 2, 2)."""
    xy_m, cov_m2 = zip((np.zeros((0, 2)), np.zeros((0, 2, 2))), *places, strict=True)
    return np.concatenate(xy_m), np.concatenate(cov_m2)


def write_reports(reports: Sequence[FeatureReport], kept: Kept) -> None:
    """Keep reports as they are sent; the file appears complete or not at all."""
    kept.write([report.encode() for report in reports])


def read_reports(kept: Kept) -> list[FeatureReport]:
    """Read reports as the cloud does.

    Raises:
        FolderError: they are missing or damaged.
        SchemaError: what is there is no report.
    """
    return [FeatureReport.decode(body) for body in kept.read(list[bytes])]
