"""How a LiDAR is mounted, from its scans: height, roll and pitch from the ground, yaw from driving straight.

The vehicle's frame lies on the ground: z is the ground's normal, x the course on straight stretches. So a banked road
does not matter (the vehicle stands on it), and springs average out over a drive. Place along and across the vehicle
cannot be seen; the vehicle's origin is then on the ground beneath the LiDAR.

Both estimators refuse rather than guess: several scans must agree on a ground plane that is wide, near, and the lowest
big plane there is; the vehicle must have driven straight for some tens of metres.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import T_inverse, exp_so3, log_so3
from gnd.vehicle_agent.importers.voxels import voxels_of

F64 = NDArray[np.float64]

GROUND_WITHIN_M: Final = 10.0
"""Ground farther away bends, climbs, and is seen at a grazing angle."""
LANE_WITHIN_M, LANE_HALF_M = 15.0, 2.0
"""Where the course is known: the lane before and behind the vehicle. Roads are crowned by 2 %, kerbs stand beside."""
OWN_VEHICLE_M: Final = 1.5
HEIGHTS_M: Final = (0.2, 4.5)
MOST_TILT_DEG: Final = 20.0
CELL_M: Final = 0.5
FLAT_CELL_M: Final = 0.15
LEAST_CELLS: Final = 24
LEAST_SHARE: Final = 0.35
"""Share of the cells around the vehicle that the plane must hold."""
LEAST_SPREAD_M: Final = 1.5
LEAST_LANE_SPREAD_M: Final = 0.8
"""Least deviation of the ground's cells along their shorter axis: a narrower strip does not tell a tilt."""
BELOW_M, MOST_BELOW = 0.3, 0.2
"""A plane with more than this share of the points farther below it is a roof or a hedge, not the ground."""
INLIER_M: Final = 0.06
DRAWS: Final = 200
LEAST_SCANS: Final = 3
AGREE_M, AGREE_RAD = 0.10, np.radians(1.5)
"""Scans whose plane is farther from the median than this saw another one (a ramp, a kerb); half must be nearer."""
FLOOR_M, FLOOR_RAD = 0.01, np.radians(0.05)
"""No mount is known better: springs give."""
CROWN_RAD: Final = np.radians(1.0)
"""What crowns, kerbs and verges do to a tilt that is taken from all ground around (KITTI: 1.1° and 1.4°)."""
KEPT_SCANS: Final = 4.0
"""Neighbouring scans see the same ground: one in so many counts."""

CHORD_M: Final = 4.0
STRAIGHT_RAD: Final = np.radians(1.0)
LEAST_WAY_M: Final = 20.0
YAW_SPREAD_RAD: Final = np.radians(2.0)
YAW_FLOOR_RAD: Final = np.radians(0.1)
"""Camber and cross wind make a car drive at an angle of some hundredths of a degree."""


@dataclass(frozen=True, slots=True)
class GroundSeen:
    """Ground plane of one scan, or of many: height of the LiDAR above it, and how the LiDAR is tilted against it.

    roll_rad, pitch_rad: R_vehicle_lidar = R_y(pitch) R_x(roll) without the yaw; sigmas of one scan are not told (0).
    """

    height_m: float
    roll_rad: float
    pitch_rad: float
    height_sigma_m: float = 0.0
    roll_sigma_rad: float = 0.0
    pitch_sigma_rad: float = 0.0
    scans: int = 1


@dataclass(frozen=True, slots=True)
class YawSeen:
    """Yaw of the LiDAR's x axis against the course (counter-clockwise positive), its sigma, the straight way used."""

    yaw_rad: float
    sigma_rad: float
    way_m: float


@dataclass(frozen=True, slots=True)
class MountRefused:
    """Why something cannot be told."""

    reason: str


def ground_of(points_lidar_m: NDArray[np.generic], course_rad: float | None = None) -> GroundSeen | MountRefused:
    """The ground in one scan (N, 3); z of the LiDAR must point upwards to 20°.

    Args:
        points_lidar_m: LiDAR frame.
        course_rad: which way the vehicle drives in the LiDAR's axes, where it is known: then its lane alone is looked
            at.
    """
    points = np.asarray(points_lidar_m, np.float64)
    near, least_spread_m = _around(points), LEAST_SPREAD_M
    if course_rad is not None:
        near, least_spread_m = _lane(points, course_rad), LEAST_LANE_SPREAD_M
    lowest = _lowest_of_cells(near)
    candidates = lowest[lowest[:, 2] < 0.0]
    if len(candidates) < LEAST_CELLS:
        return MountRefused(f"{len(candidates)} places below the LiDAR within reach, {LEAST_CELLS} needed")
    found = _largest_plane(candidates)
    if found is None:
        return MountRefused("no plane below the LiDAR that is level to 20°")
    normal, height = _refined(near, *found)
    off = candidates @ normal + height
    ground = candidates[np.abs(off) < INLIER_M]
    spread_m = float(np.sqrt(np.linalg.eigvalsh(np.cov(ground[:, :2].T))[0])) if len(ground) > 2 else 0.0
    if spread_m < least_spread_m:
        return MountRefused(f"the ground is seen over {spread_m:.1f} m only (deviation), {least_spread_m} m needed")
    return _checked(normal, height, len(ground) / len(candidates), float((near @ normal + height < -BELOW_M).mean()))


def _around(points: F64) -> F64:
    horizontal = np.hypot(points[:, 0], points[:, 1])
    return points[(horizontal < GROUND_WITHIN_M) & (horizontal > OWN_VEHICLE_M)]


def _lane(points: F64, course_rad: float) -> F64:
    along = points[:, :2] @ (np.cos(course_rad), np.sin(course_rad))
    across = points[:, :2] @ (-np.sin(course_rad), np.cos(course_rad))
    inside = (np.abs(along) < LANE_WITHIN_M) & (np.abs(along) > OWN_VEHICLE_M) & (np.abs(across) < LANE_HALF_M)
    return np.asarray(points[inside])


def _lowest_of_cells(points: F64) -> F64:
    """(M, 3) the lowest point of each cell of ground, of cells that are flat: not of walls and hedges, whose feet lie
    in a plane as well when what is below them is hidden.
    """
    cell = np.floor(points[:, :2] / CELL_M).astype(np.int64)
    order = np.lexsort((points[:, 2], cell[:, 1], cell[:, 0]))
    first = np.flatnonzero(np.r_[True, (np.diff(cell[order], axis=0) != 0).any(axis=1)][: len(order)])
    count = np.diff(np.r_[first, len(order)])
    lowest, middle = points[order[first]], points[order[first + count // 2]]
    return np.asarray(lowest[middle[:, 2] - lowest[:, 2] < FLAT_CELL_M])


def _largest_plane(points: F64) -> tuple[F64, float] | None:
    """Normal (upwards) and height over it of the plane through three of the points that most others lie on."""
    rng = np.random.default_rng(0)
    corners = points[rng.integers(0, len(points), (DRAWS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(length, 1e-9)[:, None] * np.sign(normals[:, 2:])
    heights = -(normals * corners[:, 0]).sum(axis=1)
    level = (length > 1.0) & (normals[:, 2] > np.cos(np.radians(MOST_TILT_DEG))) & (heights > 0.0)
    if not level.any():
        return None
    normals, heights = normals[level], heights[level]
    held = (np.abs(points @ normals.T + heights) < INLIER_M).sum(axis=0)
    best = int(held.argmax())
    return normals[best], float(heights[best])


def _refined(points: F64, normal: F64, height: float) -> tuple[F64, float]:
    """The plane through all points near it, cells alike: rings near the vehicle hold most points."""
    for reach in (2.0 * INLIER_M, INLIER_M, INLIER_M):
        close = points[np.abs(points @ normal + height) < reach]
        group, count = voxels_of(np.column_stack([close[:, :2], np.zeros(len(close))]), CELL_M)
        middles = np.stack([np.bincount(group, column) for column in close.T], axis=1) / count[:, None]
        mean = middles.mean(axis=0)
        normal = np.linalg.svd(middles - mean, full_matrices=False)[2][2]
        normal = normal * np.sign(normal[2])
        height = -float(mean @ normal)
    return normal, height


def _checked(normal: F64, height: float, share: float, below: float) -> GroundSeen | MountRefused:
    if share < LEAST_SHARE:
        return MountRefused(
            f"the largest plane holds {share:.0%} of the places below the LiDAR, {LEAST_SHARE:.0%} needed"
        )
    if not HEIGHTS_M[0] <= height <= HEIGHTS_M[1]:
        return MountRefused(
            f"the largest plane lies {height:.2f} m below the LiDAR, {HEIGHTS_M[0]} to {HEIGHTS_M[1]} m fit"
        )
    if below > MOST_BELOW:
        return MountRefused(f"{below:.0%} of the points lie below the largest plane, which is no ground then")
    return GroundSeen(height, *tilt_of(normal))


def tilt_of(normal_lidar: F64) -> tuple[float, float]:
    """Roll and pitch of a LiDAR that sees the ground's normal (3) so: R_y(pitch) R_x(roll) turns it upright."""
    roll = float(np.arctan2(normal_lidar[1], normal_lidar[2]))
    pitch = -float(np.arctan2(normal_lidar[0], np.hypot(normal_lidar[1], normal_lidar[2])))
    return roll, pitch


def ground_of_scans(
    seen: Iterable[GroundSeen | MountRefused], floor_rad: float = FLOOR_RAD
) -> GroundSeen | MountRefused:
    """What scans say together: the median of those that agree, and a sigma from how far they do.

    Args:
        seen: of each scan.
        floor_rad: tilts are not known better; `CROWN_RAD` where more than the lane was looked at.
    """
    every = list(seen)
    found = [one for one in every if isinstance(one, GroundSeen)]
    if len(found) < max(LEAST_SCANS, (len(every) + 1) // 2):
        reasons = [one.reason for one in every if isinstance(one, MountRefused)]
        said = f": {reasons[0]}" if reasons else ""
        return MountRefused(f"{len(found)} of {len(every)} scans show the ground{said}")
    values = np.array([(one.height_m, one.roll_rad, one.pitch_rad) for one in found])
    agree = (np.abs(values - np.median(values, axis=0)) < (AGREE_M, AGREE_RAD, AGREE_RAD)).all(axis=1)
    if agree.sum() < max(LEAST_SCANS, len(found) / 2):
        return MountRefused(
            f"{agree.sum()} of {len(found)} scans agree on the ground to {AGREE_M * 100:.0f} cm and 1.5°"
        )
    kept = values[agree]
    middle = np.median(kept, axis=0)
    deviation = 1.4826 * np.median(np.abs(kept - middle), axis=0)
    sigma = np.hypot(1.2533 * deviation / np.sqrt(max(1.0, len(kept) / KEPT_SCANS)), (FLOOR_M, floor_rad, floor_rad))
    height, roll, pitch = middle.tolist()
    height_sigma, roll_sigma, pitch_sigma = sigma.tolist()
    return GroundSeen(height, roll, pitch, height_sigma, roll_sigma, pitch_sigma, len(kept))


def yaw_of_track(T: F64) -> YawSeen | MountRefused:
    """Yaw of the LiDAR from the poses (N, 4, 4) of a levelled LiDAR (z upright, origin at the LiDAR) along a drive.

    Chords of `CHORD_M` over which the LiDAR does not turn point along the vehicle, seen in the LiDAR's axes. Chords
    against the course of most are driven backwards.
    """
    chords = _straight_chords(T)
    way = float(np.linalg.norm(chords, axis=1).sum()) if len(chords) else 0.0
    if way < LEAST_WAY_M:
        return MountRefused(f"{way:.0f} m driven straight, {LEAST_WAY_M:.0f} m needed")
    pointer = chords @ np.array([1.0, 1j])
    axis = np.sqrt((pointer**2 / np.abs(pointer)).sum())  # of the line, whichever way along it
    axis *= 1.0 if (pointer * axis.conjugate()).real.sum() > 0 else -1.0
    forward = pointer * np.sign((pointer * axis.conjugate()).real)
    backwards = float(np.abs(pointer[(pointer * axis.conjugate()).real < 0]).sum())
    if backwards > way / 3.0:
        return MountRefused(f"{backwards:.0f} of {way:.0f} m were driven against the rest: which way is forward?")
    course = np.angle(forward / axis)
    middle = float(np.median(course))
    spread = float(1.4826 * np.median(np.abs(course - middle)))
    if spread > YAW_SPREAD_RAD:
        return MountRefused(f"courses on straight stretches differ by {np.degrees(spread):.1f}°, 2° are allowed")
    sigma = np.hypot(1.2533 * spread / np.sqrt(len(course)), YAW_FLOOR_RAD)
    return YawSeen(-float(np.angle(axis * np.exp(1j * middle))), float(sigma), way)


def _straight_chords(T: F64) -> F64:
    """(K, 2) ways of `CHORD_M` and more one after the other, in the axes midway, over which nothing turned."""
    found, begin = [], 0
    for k in range(1, len(T)):
        step = T_inverse(T[begin]) @ T[k]
        if np.linalg.norm(step[:3, 3]) < CHORD_M:
            continue
        turn = log_so3(step[:3, :3])
        if np.linalg.norm(turn) < STRAIGHT_RAD:
            found.append((exp_so3(-0.5 * turn) @ step[:3, 3])[:2])
        begin = k
    return np.array(found).reshape(-1, 2)


def upright(ground: GroundSeen) -> F64:
    """(3, 3) rotation R_y(pitch) R_x(roll) that turns the ground's normal upwards."""
    return np.asarray(exp_so3([0.0, ground.pitch_rad, 0.0]) @ exp_so3([ground.roll_rad, 0.0, 0.0]))
