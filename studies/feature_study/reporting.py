"""From what a drive of a study says to reports as vehicles send them, and from merged tiles back to the route's frame.

The studies are in the plane: heights are told as 0 m within `SIGMA_HEIGHT_M` of the route's frame.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.features import Existence, Feature, FeatureTile, full_covariance
from gnd.gnd_map.features.existence import prior
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.features import FeatureChange, FeatureReport, Found, Seen
from gnd.schemas.report_id import deterministic_report_id
from gnd.vehicle_agent.features.coverage import Coverage
from gnd.vehicle_agent.features.feature_map import place_in_tile, with_height
from gnd.vehicle_agent.features.view import Occlusion, SensorView
from studies.frame.kept import Kept

SIGMA_HEIGHT_M: Final = 0.5
STEP_M: Final = 4.0
_SENSOR: Final = "study"
_SOFTWARE: Final = "gnd reproduce"


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What a drive alone says of a feature of the map; `xy_m` (2,) and `cov_m2` (2, 2) where it measured it."""

    feature_id: int
    existence: Existence
    hits: int
    xy_m: F64 | None
    cov_m2: F64 | None


@dataclass(frozen=True, slots=True, eq=False)
class Discovered:
    """A feature that a drive found and the map has not: `xy_m` (2,), `cov_m2` (2, 2), route's frame."""

    kind: str
    xy_m: F64
    cov_m2: F64
    existence: Existence
    hits: int


@dataclass(frozen=True, slots=True, eq=False)
class BaseLayer:
    """A feature layer before anybody drove.

    Attributes:
        frame: the route's.
        tiles: by id.
        tile_of: tile of each feature.
    """

    frame: LocalFrame
    tiles: Mapping[TileId, FeatureTile]
    tile_of: Mapping[int, TileId]

    @classmethod
    def of(cls, frame: LocalFrame, feature_id: I64, kinds: Sequence[str], xy_m: F64, sigma_m: float) -> "BaseLayer":
        """Return the layer of point features (N,) at xy_m (N, 2) [m] in the route's frame."""
        found: dict[TileId, list[Feature]] = defaultdict(list)
        for number, kind, xy in zip(feature_id.tolist(), kinds, xy_m, strict=True):
            tile, points, cov = _in_tile(frame, xy, sigma_m**2 * np.eye(2))
            found[tile].append(Feature(number, kind, points, cov, prior(0.95)))
        tiles = {tile: FeatureTile.of(tile, 1, features) for tile, features in found.items()}
        return cls(frame, tiles, {one.feature_id: tile for tile, features in found.items() for one in features})

    @classmethod
    def empty(cls, frame: LocalFrame) -> "BaseLayer":
        """Return a layer that holds nothing."""
        return cls(frame, {}, {})

    @property
    def epochs(self) -> dict[TileId, tuple[Feature, ...]]:
        """Features by tile, for the merge."""
        return {tile: one.features for tile, one in self.tiles.items()}


def coverage_along(
    frame: LocalFrame, view: SensorView, poses: F64, occlusions: Iterable[Occlusion | None], height_m: float
) -> Coverage:
    """Return where a drive with poses (S, 3) and what was in the way at each has looked."""
    coverage = Coverage(frame, view, height_m, step_m=STEP_M)
    for (x, y, heading), occlusion in zip(poses.tolist(), occlusions, strict=True):
        coverage.look(x, y, heading, occlusion)
    return coverage


def reports_of(
    base: BaseLayer,
    layer: str,
    vehicle: str,
    time_ns: tuple[int, int],
    coverage: Coverage,
    said: tuple[Sequence[Judged], Sequence[Discovered]],
) -> list[FeatureReport]:
    """Return what a vehicle sends after a drive: a report a district.

    Args:
        base: what it drove with.
        layer: name of the layer.
        vehicle: pseudonym.
        time_ns: first and last look.
        coverage: where it has looked.
        said: of features of the map, and what it found.
    """
    seen, found = _by_tile(base, *said)
    tiles = sorted({*coverage.tiles, *seen, *found})
    districts: dict[District, list[FeatureChange]] = defaultdict(list)
    for tile in tiles:
        held = base.tiles.get(tile)
        known = (held.version, held.sha) if held is not None else (0, b"")
        rows = tuple(sorted(seen[tile], key=lambda one: one.feature_id))
        districts[tile.district].append(FeatureChange(tile, *known, coverage.viewed(tile), rows, tuple(found[tile])))
    first_ns, last_ns = time_ns
    return [
        FeatureReport(
            report_id=deterministic_report_id(first_ns // 1_000_000, vehicle, layer, district.path),
            vehicle=vehicle,
            sensor_model=_SENSOR,
            software=_SOFTWARE,
            layer=layer,
            district=district,
            first_ns=first_ns,
            last_ns=last_ns,
            tiles=tuple(changes),
        )
        for district, changes in districts.items()
    ]


def _by_tile(
    base: BaseLayer, judged: Sequence[Judged], discovered: Sequence[Discovered]
) -> tuple[dict[TileId, list[Seen]], dict[TileId, list[Found]]]:
    seen: dict[TileId, list[Seen]] = defaultdict(list)
    found: dict[TileId, list[Found]] = defaultdict(list)
    for one in judged:
        tile = base.tile_of[one.feature_id]
        if one.xy_m is None or one.cov_m2 is None:
            seen[tile].append(Seen(one.feature_id, one.existence, one.hits))
            continue
        _, points, cov = _in_tile(base.frame, one.xy_m, one.cov_m2, tile)
        seen[tile].append(Seen(one.feature_id, one.existence, one.hits, points[0], cov))
    for new in discovered:
        tile, points, cov = _in_tile(base.frame, new.xy_m, new.cov_m2)
        found[tile].append(Found(new.kind, points, cov, new.existence, new.hits))
    return seen, found


def _in_tile(frame: LocalFrame, xy_m: F64, cov_m2: F64, tile: TileId | None = None) -> tuple[TileId, F64, F64]:
    point, cov = with_height(xy_m, cov_m2, 0.0, SIGMA_HEIGHT_M, 0.0)
    return place_in_tile(frame, point, cov, tile)


def in_route_frame(frame: LocalFrame, tile: TileId, features: Sequence[Feature]) -> tuple[F64, F64]:
    """Return positions (N, 2) and covariances (N, 2, 2) of a tile's features in the route's frame."""
    T = frame.T_self_other(LocalFrame.of_tile(tile))
    R = T[:3, :3]
    xy_m = np.array([(R @ one.position_m + T[:3, 3])[:2] for one in features]).reshape(-1, 2)
    cov = np.array([(R @ full_covariance(one.cov_m2) @ R.T)[:2, :2] for one in features]).reshape(-1, 2, 2)
    return xy_m, cov


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
