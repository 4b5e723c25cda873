"""LiDAR odometry against the map that grows from the scans: the reference track of recordings without one.

Every scan is matched with the Gaussians of all scans before it, by the localiser's own robust registration. Only
voxels with as many occupied sub-cells as a published map asks for take part: a voxel that holds one or two rings of a
scan says where the rings lie, which move with the vehicle, and not where the ground is. On KITTI's queue at a junction
this follows what stands (8.0 m); point-to-point neighbours (small_gicp) stayed with the rings and the traffic (2.9 m),
and then broke.
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, log_so3, transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.errors import ImportDriveError, RegistrationError
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.journal import FoundPose, ImportJournal
from gnd.vehicle_agent.importers.recording import Recording
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.match_map import MatchMap, MatchMapCache
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.parameters import RegistrationParameters, SamplingParameters
from gnd.vehicle_agent.localise.registration import RegistrationResult, Start, register
from gnd.vehicle_agent.localise.sampling import sample_scan

F64 = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

RANGE_M: Final = (2.0, 80.0)
"""Points nearer are the vehicle itself, points farther blur the map."""
NEAR_M, KEPT_M = 100.0, 200.0
"""Tiles this near are matched with; tiles farther away than the other are forgotten."""
REACH_M: Final = RANGE_M[1] + 20.0
"""From the vehicle to the farthest point of a scan that the map takes: the mount and the way of a sweep are in it."""
CARRIED: Final = 0.8
"""Share of the last step that the next one is taken to have: all of it lets an error of the turn grow on itself."""
FIRST_STEPS_M: Final = ((0.0, 0.0), (1.5, 0.0), (3.0, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, 3.0), (0.0, -1.5))
"""Steps (x, y) between the first two scans that are tried while no speed is known; each catches 2 m around it. Along
both axes, because a LiDAR whose mount is not told may look any way."""
MIN_SHARE: Final = 0.5
"""Share of the points that must lie in Gaussians; of a thinner map (a sparse sensor's first scans) voxels with half,
then a quarter of the sub-cells are taken."""
LINE_RATIO, UPRIGHT = 0.1, 0.7
"""A Gaussian is a line when its second variance is less than this share of its largest; upright by the cosine."""
GOOD_FIT, WARMING_SCANS = 0.6, 4
MIN_OVERLAP: Final = 0.3  # share of a scan's points that must lie on the map
MOTION_AHEAD_NS: Final = 1_000_000_000

_REGISTRATION: Final = RegistrationParameters()
_SAMPLING: Final = SamplingParameters(n_points=4000)


def lidar_odometry(recording: Recording, progress: Progress, journal: ImportJournal | None = None) -> Trajectory:
    """T_first_vehicle of every scan, at the middle of its sweep; the first is the identity.

    journal: keeps the poses as they are found; those that it holds already are taken, and the result is the same to
    the bit.

    Raises:
        ImportDriveError: a scan does not fit those before it.
    """
    odometry, first = _Odometry(recording), 0
    if journal is not None and journal.found:
        odometry.resume(journal.found, progress)
        first = journal.found[-1].number + 1
    for i in range(first, len(recording)):
        scan = cleaned(recording.read(i)).scan
        if scan is not None:
            odometry.add(scan, i)
            if journal is not None:
                journal.add(odometry.last(i))
        progress("LiDAR odometry", i + 1, len(recording))
    return odometry.trajectory


def track_of_scans(recording: Recording, scans: Sequence[Scan], rough: Trajectory | None = None) -> Trajectory:
    """The same of some scans of the recording, in their order.

    Args:
        recording: that the scans are of.
        scans: at least two.
        rough: the motion that they are deskewed with, where it is known; else that of the scans before each.

    Raises:
        ImportDriveError: a scan does not fit those before it, or there are fewer than two.
    """
    odometry = _Odometry(recording, rough)
    for i, scan in enumerate(scans):
        odometry.add(scan, i)
    return odometry.trajectory


def reference_ns(scan: Scan) -> int:
    """The middle of the sweep."""
    return scan.t_ns + int(scan.t_offset_ns.max(initial=0)) // 2


class _GrowingMap:
    """The Gaussians of the scans so far, in a frame at the recording's anchor."""

    def __init__(self, recording: Recording) -> None:
        self._frame = recording.anchor.frame
        tiles = covering_circle(self._frame.lat_rad, self._frame.lon_rad, KEPT_M)
        self._grid_frame = GridFrame.around(self._frame, tiles)
        self._points = VoxelAccumulator(self._grid_frame)

    def add(self, points_map_m: F64) -> None:
        self._points.add(points_map_m)

    def near(self, p_map_m: F64) -> MatchMap:
        """What lies around a place, ready for registration; what lies far behind is forgotten."""
        held, local_map = self._gaussians(self._tiles(p_map_m, NEAR_M)), LocalMap(self._grid_frame)
        for tile_id, gaussians in held.items():
            local_map.set_tile(Tile(tile_id, 1, gaussians))
        return MatchMapCache(local_map, _REGISTRATION.noise_m).near(p_map_m)

    def _tiles(self, p_map_m: F64, radius_m: float) -> frozenset[TileId]:
        lat, lon, _ = self._frame.geodetic_from_enu(p_map_m[None])
        return frozenset(covering_circle(float(lat[0]), float(lon[0]), radius_m))

    def _gaussians(self, tiles: frozenset[TileId]) -> dict[TileId, Gaussians]:
        measured = {t: g for t, g in self._points.finish(1).items() if t in tiles}
        dense: dict[TileId, Gaussians] = {}
        for n_min_cells in (N_MIN_CELLS, N_MIN_CELLS // 2, N_MIN_CELLS // 4):
            dense = {t: g.take(np.flatnonzero(g.cells >= n_min_cells)) for t, g in measured.items()}
            if _points_of(dense) >= MIN_SHARE * _points_of(measured):
                break
        return {t: g.take(np.flatnonzero(~_lies_as_a_line(g))) for t, g in dense.items()}

    def forget(self, p_map_m: F64) -> None:
        """Drop the tiles far from a place: bounded memory on a long drive."""
        kept = self.kept(p_map_m)
        self._points.pop([tile for tile in self._points.finish(1) if tile not in kept])

    def kept(self, p_map_m: F64) -> frozenset[TileId]:
        """The tiles that `forget` at a place leaves."""
        return self._tiles(p_map_m, KEPT_M)

    def reached(self, p_map_m: F64) -> frozenset[TileId]:
        """The tiles that a scan from a place adds to, and perhaps some more."""
        return self._tiles(p_map_m, REACH_M)


def _points_of(tiles: dict[TileId, Gaussians]) -> int:
    return sum(int(gaussians.count.sum()) for gaussians in tiles.values())


def _lies_as_a_line(gaussians: Gaussians) -> NDArray[np.bool_]:
    """(N,) True for the Gaussians of a single ring: much longer than wide, and not upright as a post is."""
    if not len(gaussians):
        return np.zeros(0, np.bool_)
    values, vectors = np.linalg.eigh(gaussians.full_cov())
    return np.asarray((values[:, 1] < LINE_RATIO * values[:, 2]) & (np.abs(vectors[:, 2, 2]) < UPRIGHT))


class _Odometry:
    def __init__(self, recording: Recording, rough: Trajectory | None = None) -> None:
        self._recording, self._rough = recording, rough
        self._motion, self._samples = MotionBuffer(), list(reversed(recording.motion))
        self._map = _GrowingMap(recording)
        self._t_ns: list[int] = []
        self._T: list[F64] = []
        self._forgot_m = np.zeros(3)

    @property
    def trajectory(self) -> Trajectory:
        if len(self._T) < 2:
            raise ImportDriveError(f"{self._recording.name}: {len(self._T)} scans with usable points; a track needs 2")
        return Trajectory(np.array(self._t_ns, np.int64), np.stack(self._T))

    def add(self, scan: Scan, number: int) -> None:
        t_ns = reference_ns(scan)
        self._take_motion(t_ns)
        points = self._deskewed(scan, t_ns)
        chosen = points[sample_scan(scan.points_m, _SAMPLING)]
        T = self._aligned(chosen, t_ns, number) if self._T else np.eye(4)
        self._map_points(scan, points, T)
        self._stand_at(t_ns, T)

    def last(self, number: int) -> FoundPose:
        """The pose that was found last, as that of scan `number`."""
        return FoundPose(number, self._t_ns[-1], self._T[-1])

    def resume(self, found: Sequence[FoundPose], progress: Progress) -> None:
        """Be where `add` of all scans with these poses led to, nothing being there yet.

        Only the scans of which the map still holds something are read; those between that gave no pose are read, too,
        for what is wrong with them.

        Raises:
            ImportDriveError: the scans are not those of the poses.
        """
        mapped, number = self._still_mapped(found), 0
        for pose in found:
            for without in range(number, pose.number):
                self._recording.read(without)
            number = pose.number + 1
            self._take_motion(pose.t_ns)
            if pose.number in mapped:
                scan = cleaned(self._recording.read(pose.number)).scan
                if scan is None or reference_ns(scan) != pose.t_ns:
                    raise ImportDriveError(f"{self._recording.name}: scan {pose.number} changed since the import began")
                self._map_points(scan, self._deskewed(scan, pose.t_ns), pose.T)
            self._stand_at(pose.t_ns, pose.T)
            progress("LiDAR odometry", number, len(self._recording))

    def _still_mapped(self, found: Sequence[FoundPose]) -> set[int]:
        """Numbers of the scans that no forgetting after them removes wholly from the map."""
        forgot_m, at, kept = self._forgot_m, list[int](), list[frozenset[TileId]]()
        for pose in found:
            if np.linalg.norm(pose.T[:3, 3] - forgot_m) > NEAR_M:
                forgot_m = pose.T[:3, 3]
                at.append(pose.number)
                kept.append(self._map.kept(forgot_m))
        mapped = set[int]()
        for pose in found:
            reached = self._map.reached(pose.T[:3, 3])
            after = kept[bisect_left(at, pose.number) :]
            if not any(reached.isdisjoint(tiles) for tiles in reversed(after)):
                mapped.add(pose.number)
        return mapped

    def _map_points(self, scan: Scan, points: F64, T: F64) -> None:
        range_m = np.linalg.norm(scan.points_m, axis=1)
        self._map.add(transform(T, points[(range_m >= RANGE_M[0]) & (range_m <= RANGE_M[1])]))

    def _stand_at(self, t_ns: int, T: F64) -> None:
        self._t_ns.append(t_ns)
        self._T.append(T)
        if np.linalg.norm(T[:3, 3] - self._forgot_m) > NEAR_M:
            self._forgot_m = T[:3, 3]
            self._map.forget(T[:3, 3])

    def _take_motion(self, t_ns: int) -> None:
        """Motion samples as far as they are needed: the buffer keeps some seconds only."""
        while self._samples and self._samples[-1].t_ns <= t_ns + MOTION_AHEAD_NS:
            sample = self._samples.pop()
            self._motion.push(sample.t_ns, sample.speed_mps, sample.yaw_rate_radps)

    def _deskewed(self, scan: Scan, t_ns: int) -> F64:
        sweep = self._sweep(scan, t_ns)
        return deskew(scan.points_m, scan.t_offset_ns, scan.t_ns, sweep, self._recording.T_vehicle_lidar, t_ns)

    def _sweep(self, scan: Scan, t_ns: int) -> Trajectory:
        """Motion during the sweep: as known or measured, else the motion between the two scans before."""
        if self._rough is not None:
            return self._rough
        end_ns = max(scan.t_ns + 1, 2 * t_ns - scan.t_ns)
        if len(self._motion):
            return self._motion.trajectory(scan.t_ns, end_ns)
        if len(self._T) < 2 or end_ns == scan.t_ns + 1:
            return Trajectory(np.array([t_ns], np.int64), np.eye(4)[None])
        last = Trajectory(np.array([0, self._t_ns[-1] - self._t_ns[-2]], np.int64), np.stack([np.eye(4), self._step()]))
        turn = last.at(np.array([0, end_ns - scan.t_ns]), tolerance_ns=end_ns - scan.t_ns)
        return Trajectory(np.array([scan.t_ns, end_ns], np.int64), turn)

    def _step(self) -> F64:
        return np.asarray(T_inverse(self._T[-2]) @ self._T[-1])

    def _aligned(self, points: F64, t_ns: int, number: int) -> F64:
        match_map = self._map.near(self._T[-1][:3, 3])
        best = max(self._matches(points, t_ns, match_map), key=lambda match: match[0], default=None)
        overlap = best[1].matching_ratio * best[1].known_ratio if best else 0.0
        if best is None or overlap < MIN_OVERLAP:
            raise ImportDriveError(
                f"{self._recording.name}: scan {number} shares {overlap:.0%} of its points with the {len(self._T)}"
                f" scans before it, {MIN_OVERLAP:.0%} are needed: are scans missing, or out of order?"
            )
        return best[1].T_map_vehicle

    def _matches(self, points: F64, t_ns: int, match_map: MatchMap) -> list[tuple[float, RegistrationResult]]:
        """What matching from the prediction gives, and from farther off where that fits poorly; each with its fit."""
        if not len(self._motion) and len(self._T) == 1:
            starts = [self._T[0] @ _shifted(*step_m) for step_m in FIRST_STEPS_M]
            return _registered(points, starts, match_map, "capture")
        guess = self._predicted(t_ns)
        found = _registered(points, [guess], match_map, "near")
        if not found or found[0][0] < GOOD_FIT or len(self._T) < WARMING_SCANS:
            found += _registered(points, [guess], match_map, "wide")
        return found

    def _predicted(self, t_ns: int) -> F64:
        if len(self._motion):
            return np.asarray(self._T[-1] @ self._motion.delta(self._t_ns[-1], t_ns))
        step, share = self._step(), CARRIED * (t_ns - self._t_ns[-1]) / (self._t_ns[-1] - self._t_ns[-2])
        return np.asarray(self._T[-1] @ T_from_R_t(exp_so3(share * log_so3(step[:3, :3])), share * step[:3, 3]))


def _shifted(x_m: float, y_m: float) -> F64:
    T = np.eye(4)
    T[:2, 3] = x_m, y_m
    return T


def _registered(
    points: F64, starts: list[F64], match_map: MatchMap, width: Start
) -> list[tuple[float, RegistrationResult]]:
    """The matches from these starts, each with the share of the scan that it explains; none where nothing is near."""
    found = []
    for start in starts:
        try:
            result = register(points, start, match_map, _REGISTRATION, width)
        except RegistrationError:
            continue
        found.append((result.fit * result.known_ratio, result))
    return found
