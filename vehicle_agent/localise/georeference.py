"""A local track (SLAM, odometry) onto the Earth: where each of its poses lies, by GNSS of any quality.

First a robust rigid alignment of the whole track (`track_alignment`), turned about the vertical only or fully. Then,
because local tracks drift, a pose graph: the track's steps as factors between poses, the fixes as robust position
factors with the lever arm from the nearest pose.
"""

from dataclasses import dataclass
from typing import Final

import gtsam
import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.track_alignment import (
    FIX_INFLATION,
    FIX_SPACING_M,
    TRACK_LASTING_M,
    TRACK_ROBUST_K,
    TRACK_STEP_M,
    TRACK_STEP_RAD,
    TRACK_STEP_RAD_PER_ROOT_M,
    TRACK_STEP_SHARE,
    Alignment,
    FixTable,
    align,
)

MIN_FIXES: Final = 3
_COSTS: Final = (
    (gtsam.noiseModel.mEstimator.Huber, 1.0),
    (gtsam.noiseModel.mEstimator.GemanMcClure, 4.0),
    (gtsam.noiseModel.mEstimator.GemanMcClure, 1.0),
)
"""One after the other, with the robust scale in `robust_k`."""
_UNKNOWN_UP_M: Final = 1e3  # sigma of a height that nobody measured


@dataclass(frozen=True, slots=True, eq=False)
class Georeferenced:
    """A track on the Earth: poses T_frame_vehicle at the track's own times, in the ENU frame of a tile that it crosses.

    alignment: the rigid part. weights: (N,) 0 ... 1, how far each fix that was used was believed in the end; used: (N,)
    numbers of these fixes.
    """

    frame: LocalFrame
    track: Trajectory
    alignment: Alignment
    weights: F64
    used: I64

    def geodetic(self) -> tuple[F64, F64, F64, F64]:
        """Latitude, longitude, height and heading (clockwise from true north where the pose is), each (P,)."""
        T = self.track.T_dst_vehicle
        lat, lon, height = self.frame.geodetic_from_enu(T[:, :3, 3])
        ahead = T[:, :3, 0] @ self.frame.R_ecef_enu.T
        sine, cosine = np.sin(lon), np.cos(lon)
        east = cosine * ahead[:, 1] - sine * ahead[:, 0]
        north = np.cos(lat) * ahead[:, 2] - np.sin(lat) * (cosine * ahead[:, 0] + sine * ahead[:, 1])
        return lat, lon, height, np.asarray(np.arctan2(east, north) % (2.0 * np.pi))

    def residuals_m(self, fixes: FixTable) -> F64:
        """(N, 3) fix less track in the frame at the fixes' times, east, north, up (NaN where the height is unknown).

        Raises:
            LocaliseError: a fix lies outside the track's time.
        """
        outside = (fixes.t_ns < self.track.t_ns[0]) | (fixes.t_ns > self.track.t_ns[-1])
        if outside.any():
            raise LocaliseError(f"{outside.sum()} of {len(fixes)} fixes lie outside the track's time")
        off = fixes.enu_m(self.frame) - self.track.at(fixes.t_ns)[:, :3, 3]
        return np.where(np.column_stack([np.ones((len(fixes), 2), np.bool_), fixes.has_height]), off, np.nan)


def georeference(
    track: Trajectory,
    fixes: FixTable,
    *,
    tilt: bool = False,
    drift: bool = True,
    inflation: float = FIX_INFLATION,
    spacing_m: float = FIX_SPACING_M,
) -> Georeferenced:
    """Put a track on the Earth.

    Args:
        track: T_local_vehicle in any local frame; the z axis about upwards unless `tilt`.
        fixes: of the vehicle's origin, by the same clock; those outside the track's time are left out.
        tilt: find roll and pitch as well (a SLAM frame that does not know the vertical); needs heights.
        drift: False leaves it at the rigid alignment.
        inflation: of the fixes' sigmas: GNSS errors last for tens of seconds.
        spacing_m: of the fixes along the track, at least: a standing vehicle's do not add up.

    Raises:
        LocaliseError: fewer than three usable fixes, or none that lie apart.
    """
    used = _usable(track, fixes, spacing_m)
    chosen = fixes.take(used)
    if len(chosen) < MIN_FIXES:
        raise LocaliseError(f"{len(chosen)} of {len(fixes)} fixes lie apart and in the track's time; 3 are needed")
    middle = float(np.median(chosen.lat_rad)), float(np.median(chosen.lon_rad))
    frame = LocalFrame.of_tile(TileId.from_geodetic(*middle))
    p_local, p_frame = track.at(chosen.t_ns)[:, :3, 3], chosen.enu_m(frame)
    alignment = align(p_local, p_frame, chosen, tilt=tilt)
    T = alignment.T_frame_local @ track.T_dst_vehicle
    if not drift or len(track) < 2:
        return Georeferenced(frame, Trajectory(track.t_ns, T), alignment, alignment.weights, used)
    T, weights = _bent(Trajectory(track.t_ns, T), p_frame, chosen, inflation)
    return Georeferenced(frame, Trajectory(track.t_ns, T), alignment, weights, used)


def _usable(track: Trajectory, fixes: FixTable, spacing_m: float) -> I64:
    """Numbers of the fixes in the track's time, thinned by the way driven."""
    within = np.flatnonzero((fixes.t_ns >= track.t_ns[0]) & (fixes.t_ns <= track.t_ns[-1]))
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(track.T_dst_vehicle[:, :3, 3], axis=0), axis=1).cumsum()])
    at = np.interp(fixes.t_ns[within] - track.t_ns[0], track.t_ns - track.t_ns[0], way)
    chosen, last = list[int](), -np.inf
    for number, way_m in zip(within.tolist(), at.tolist(), strict=True):
        if way_m - last >= spacing_m:
            chosen.append(number)
            last = way_m
    return np.array(chosen, np.int64)


def _bent(track: Trajectory, p_frame_m: F64, fixes: FixTable, inflation: float) -> tuple[F64, F64]:
    """Poses (P, 4, 4) that follow both the track's steps and the fixes, and the fixes' weights in the end.

    A convex cost first, so that fixes far off a drifted track still pull; then one that lets wild ones go.
    """
    near = _nearest(track.t_ns, fixes.t_ns)
    arms = transform_each(T_inverse(track.T_dst_vehicle[near]), track.at(fixes.t_ns)[:, :3, 3])
    steps = _steps(track.T_dst_vehicle)
    T = track.T_dst_vehicle
    for kind, k in _COSTS:
        graph = gtsam.NonlinearFactorGraph(steps)
        for number, p, arm, sigmas in zip(near.tolist(), p_frame_m, arms, _sigmas(fixes, inflation), strict=True):
            noise = gtsam.noiseModel.Robust.Create(
                kind.Create(k * TRACK_ROBUST_K), gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            )
            graph.add(gtsam.GPSFactorArm(number, p, arm, noise))
        T = _optimised(graph, T)
    off = (p_frame_m - transform_each(T[near], arms)) / _sigmas(fixes, inflation)
    return T, (1.0 + (off**2).sum(axis=1) / TRACK_ROBUST_K**2) ** -2


def _sigmas(fixes: FixTable, inflation: float) -> F64:
    up = np.where(fixes.has_height, inflation * fixes.sigma_up_m, _UNKNOWN_UP_M)
    return np.column_stack([inflation * fixes.sigma_m, inflation * fixes.sigma_m, up])


def _steps(T: F64) -> gtsam.NonlinearFactorGraph:
    """The track's steps, and a loose hold on the first pose: fixes on a straight line leave the roll free."""
    graph, step = gtsam.NonlinearFactorGraph(), T_inverse(T[:-1]) @ T[1:]
    length_m = np.linalg.norm(step[:, :3, 3], axis=1)
    turn = np.hypot(TRACK_STEP_RAD, TRACK_STEP_RAD_PER_ROOT_M * np.sqrt(length_m))
    move = np.hypot(TRACK_STEP_M, TRACK_STEP_SHARE * np.sqrt(length_m * TRACK_LASTING_M))
    for i, (a, m) in enumerate(zip(turn.tolist(), move.tolist(), strict=True)):
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([a, a, a, m, m, m]))
        graph.add(gtsam.BetweenFactorPose3(i, i + 1, gtsam.Pose3(step[i]), noise))
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.05, 0.05, 0.5, 1e3, 1e3, 1e3]))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(T[0]), loose))
    return graph


def _optimised(graph: gtsam.NonlinearFactorGraph, T: F64) -> F64:
    values = gtsam.Values()
    for i, pose in enumerate(T):
        values.insert(i, gtsam.Pose3(pose))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    return np.stack([found.atPose3(i).matrix() for i in range(len(T))])


def _nearest(t_ns: I64, query_ns: I64) -> I64:
    """(M,) number of the pose nearest in time."""
    after = np.clip(np.searchsorted(t_ns, query_ns), 1, len(t_ns) - 1)
    return np.where(query_ns - t_ns[after - 1] < t_ns[after] - query_ns, after - 1, after)


def transform_each(T: F64, p: F64) -> F64:
    """(N, 3) points (N, 3) or (3,) moved each by its own pose (N, 4, 4)."""
    return np.asarray((T[:, :3, :3] @ np.broadcast_to(p, (len(T), 3))[..., None])[..., 0] + T[:, :3, 3])
