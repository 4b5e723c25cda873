"""Quality of a map, measured on itself: doubled surfaces, thickness of planes, coverage, and what was left out."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile import Tile
from gnd.vehicle_agent.map_build.build import BuiltMap
from gnd.vehicle_agent.map_build.double_layers import DoubleLayers, find_double_layers
from gnd.vehicle_agent.map_build.placed_scans import NoPose
from gnd.vehicle_agent.map_build.survey import DriveSurvey

WALLS, ROAD = (0, 1), (2,)

PLANE_LINEAR, PLANE_FLAT = 0.12, 0.6
"""A Gaussian is of a plane when its middle sd is at least this [m], its smallest one below this share of the middle
one.
"""

MOST_DOUBLED_WALLS, MOST_DOUBLED_ROAD = 25.0, 40.0
"""Of 1,000 surfaces. Single passes have 5 to 20 and 3 to 21: signs before walls, bonnets and hedges over the road."""
MOST_THICK_M: Final = 0.05
MOST_DRIFT_M, MOST_DRIFT_DEG = 0.10, 0.3
MOUNT_M: Final = 0.15
MOST_WITHOUT_POSE: Final = 0.02
MOST_MOVERS: Final = 0.15
MOST_BODYWORK: Final = 0.05
FEW_SIGHTS: Final = 0.3
"""Share of the survey's scans that must see the road before its height is trusted."""


@dataclass(frozen=True, slots=True)
class MountHeight:
    """How high the LiDAR of a drive stands over the road, and how high by its header.

    `road_m` is where the road lies in the vehicle frame; wheels stand on 0. Quantiles over the way.
    """

    drive: str
    header_m: float
    seen_m: float | None
    road_m: float | None
    spread_m: float | None
    scans: int
    scans_with_road: int


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """The figures of a map.

    walls, road: doubled surfaces. doubled_p_map_m: (D, 3) where they are, walls and road. plane_sd_m: (P,) smallest
    standard deviations of planar Gaussians. plane_p_map_m: (P, 3) where they are. way_m: of each drive. warnings: what
    is out of bounds, in words.
    """

    walls: DoubleLayers
    road: DoubleLayers
    doubled_p_map_m: F64
    plane_sd_m: F64
    plane_p_map_m: F64
    voxels_seen: int
    way_m: tuple[float, ...]
    mounts: tuple[MountHeight, ...]
    warnings: tuple[str, ...] = ()

    @property
    def thickness_m(self) -> tuple[float, float, float]:
        """10 %, 50 % and 90 % quantiles of the smallest sd of planes; zeros without planes."""
        if not len(self.plane_sd_m):
            return 0.0, 0.0, 0.0
        low, middle, high = np.quantile(self.plane_sd_m, (0.1, 0.5, 0.9))
        return float(low), float(middle), float(high)


def measure(built: BuiltMap) -> Quality:
    """Measure a map that was built."""
    frame = built.sources[0].header.anchor
    walls, road, places = list[DoubleLayers](), list[DoubleLayers](), [np.empty((0, 3))]
    voxels_seen = 0
    for accumulator in built.measured.accumulators:
        g, bits = accumulator.occupied()
        voxels_seen += len(g)
        walls.append(find_double_layers(g, bits, WALLS))
        road.append(find_double_layers(g, bits, ROAD))
        doubled = np.concatenate([walls[-1].g, road[-1].g]) + 0.5
        places.append(frame.enu_from_geodetic(*accumulator.grid_frame.geodetic_of_grid(doubled)))
    sd_m, p_map_m = planes(built.tiles, frame)
    found = Quality(
        walls=_joined(walls),
        road=_joined(road),
        doubled_p_map_m=np.concatenate(places),
        plane_sd_m=sd_m,
        plane_p_map_m=p_map_m,
        voxels_seen=voxels_seen,
        way_m=tuple(float(survey.way_m[-1]) if len(survey.way_m) else 0.0 for survey in built.surveys),
        mounts=tuple(
            mount_height(source.header.drive_id, float(source.header.T_vehicle_lidar[2, 3]), survey)
            for source, survey in zip(built.sources, built.surveys, strict=True)
        ),
    )
    return replace(found, warnings=tuple(_warnings(built, found)))


def planes(tiles: Sequence[Tile], frame: LocalFrame) -> tuple[F64, F64]:
    """(P,) thickness of the Gaussians that lie in a plane, one sd, and (P, 3) where they are in a frame."""
    sds, places = [np.empty(0)], [np.empty((0, 3))]
    for tile in tiles:
        gaussians = tile.gaussians
        sd = np.sqrt(np.maximum(np.linalg.eigvalsh(gaussians.full_cov().astype(np.float64)), 0.0))
        flat = (sd[:, 1] >= PLANE_LINEAR) & (sd[:, 0] < PLANE_FLAT * sd[:, 1])
        p_tile = VoxelGrid.of(tile.tile_id).centre_m(gaussians.voxel_id[flat]) + gaussians.mean_m[flat]
        sds.append(sd[flat, 0])
        places.append(transform(frame.T_self_other(LocalFrame.of_tile(tile.tile_id)), p_tile))
    return np.concatenate(sds), np.concatenate(places)


def mount_height(drive: str, header_m: float, survey: DriveSurvey) -> MountHeight:
    """Compare the mount's height with the road that the scans of a drive see."""
    road = survey.road_z_m[np.isfinite(survey.road_z_m)]
    if not len(road):
        return MountHeight(drive, header_m, None, None, None, len(survey.t_ns), 0)
    low, middle, high = np.quantile(road, (0.05, 0.5, 0.95))
    return MountHeight(
        drive, header_m, header_m - float(middle), float(middle), float(high - low), len(survey.t_ns), len(road)
    )


def _joined(parts: Sequence[DoubleLayers]) -> DoubleLayers:
    return DoubleLayers(
        sum(part.surfaces for part in parts),
        np.concatenate([np.empty((0, 3), np.int32), *(part.g for part in parts)]),
        np.concatenate([np.empty(0), *(part.apart_m for part in parts)]),
    )


def _warnings(built: BuiltMap, q: Quality) -> list[str]:
    """What is out of bounds, in words, each with its figure and what it may come from."""
    found = [*_layer_warnings(q), *_pose_warnings(built)]
    for mount in q.mounts:
        found += _mount_warnings(mount)
    for source, counts in zip(built.sources, built.counts, strict=True):
        found += _share_warnings(source.header.drive_id, counts.points, counts.movers, counts.bodywork)
        found += _scan_warnings(source.header.drive_id, counts.scans, counts.without_pose)
    return found


def _layer_warnings(q: Quality) -> list[str]:
    found = []
    for name, layers, most in (("walls", q.walls, MOST_DOUBLED_WALLS), ("pieces of road", q.road, MOST_DOUBLED_ROAD)):
        if layers.surfaces and layers.per_thousand > most:
            found.append(
                f"{layers.doubled} of {layers.surfaces} {name} are double, {np.median(layers.apart_m):.2f} m apart "
                f"(median), as passes with different poses leave them"
            )
    if q.thickness_m[1] > MOST_THICK_M:
        found.append(
            f"half of the planes are thicker than {100 * q.thickness_m[1]:.1f} cm (one sd), usual are 1 to 4 cm: poses "
            f"tremble, sweeps are not deskewed, or the clock of the poses is off"
        )
    return found


def _pose_warnings(built: BuiltMap) -> list[str]:
    drift = built.poses.after or built.poses.before
    if drift is None or (drift.horizontal_m < MOST_DRIFT_M and drift.angle_deg < MOST_DRIFT_DEG):
        return []
    return [
        f"passes lie {100 * drift.horizontal_m:.0f} cm and {drift.angle_deg:.2f} degrees off each other (median of "
        f"{drift.loops} places): {built.poses.reason}"
    ]


def _mount_warnings(mount: MountHeight) -> list[str]:
    if mount.road_m is None or mount.scans_with_road < FEW_SIGHTS * mount.scans:
        return [f"{mount.drive}: {mount.scans_with_road} of {mount.scans} scans see enough road to check the mount"]
    if abs(mount.road_m) <= MOUNT_M:
        return []
    side = "below" if mount.road_m < 0 else "above"
    return [
        f"{mount.drive}: the road lies {abs(mount.road_m):.2f} m {side} where the wheels should stand: the header has "
        f"the LiDAR {mount.header_m:.2f} m over the road, the scans {mount.seen_m:.2f} m; a vehicle with the right "
        f"mount will not stand on this map's road"
    ]


def _share_warnings(drive: str, points: int, movers: int, bodywork: int) -> list[str]:
    found = []
    if movers > MOST_MOVERS * points:
        found.append(
            f"{drive}: {movers / points:.0%} of the points were left out as moving: heavy traffic, or poses that shake"
        )
    if bodywork > MOST_BODYWORK * points:
        found.append(
            f"{drive}: {bodywork / points:.0%} of the points were left out as the vehicle's own bodywork: look whether "
            f"the mount is right"
        )
    return found


def _scan_warnings(drive: str, scans: int, missing: Counter[NoPose]) -> list[str]:
    total = scans + missing.total()
    if missing.total() <= MOST_WITHOUT_POSE * total:
        return []
    why = ", ".join(f"{n} {reason}" for reason, n in sorted(missing.items()))
    return [f"{drive}: {missing.total()} of {total} scans have no pose ({why})"]
