"""How good a drive is that was made of a recording: what a mapper looks at first."""

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.errors import MotionError
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.schemas.drive import GnssFix
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.deskewing import FAR_M, NEAR_M
from gnd.vehicle_agent.importers.mounting import ground_seen
from gnd.vehicle_agent.importers.plane_thickness import thickness_of
from gnd.vehicle_agent.importers.recording import Recording

F64 = NDArray[np.float64]

FIT_SCANS: Final = 12
FIT_WINDOWS: Final = 3


@dataclass(frozen=True, slots=True)
class ImportQuality:
    """Of a drive.

    duration_s, way_m: from first to last scan. gnss_m: median distance of the poses from the fixes, along the ground;
    gnss_sigma_m: what the fixes say they are off; drift_m: how the mean distance vector changes from the first third of
    the fixes to the last. None without fixes. thickness_m: of upright surfaces where 12 consecutive scans are laid
    together with the poses; None where nothing upright is seen. height_m: of the LiDAR above the ground that the scans
    see; None where they see none. posed: share of the scans that have a pose.
    """

    duration_s: float
    way_m: float
    gnss_m: float | None
    gnss_sigma_m: float | None
    drift_m: float | None
    thickness_m: float | None
    height_m: float | None
    posed: float

    @property
    def lines(self) -> tuple[str, ...]:
        """For people."""
        gnss = "no fixes to compare with"
        if self.gnss_m is not None and self.gnss_sigma_m is not None and self.drift_m is not None:
            gnss = f"{self.gnss_m:.2f} m from the fixes (sigma {self.gnss_sigma_m:.2f} m), drift {self.drift_m:.2f} m"
        fit = (
            "nothing upright to tell" if self.thickness_m is None else f"surfaces {100 * self.thickness_m:.1f} cm thick"
        )
        height = "ground not seen" if self.height_m is None else f"LiDAR {self.height_m:.2f} m above ground"
        return (
            f"{self.duration_s:.1f} s, {self.way_m:.1f} m, {self.posed:.0%} of the scans have a pose",
            f"poses: {gnss}; fit of {FIT_SCANS} scans: {fit}; {height}",
        )

    def as_json(self) -> dict[str, Any]:
        """Numbers by name."""
        return asdict(self)


def quality_of(recording: Recording, track: Trajectory) -> ImportQuality:
    """Of a recording whose track is known."""
    p = track.at(np.clip(recording.t_ns, track.t_ns[0], track.t_ns[-1]))[:, :3, 3]
    gnss = residuals_m(recording, track)
    ground = ground_seen(recording)
    return ImportQuality(
        duration_s=float((recording.t_ns[-1] - recording.t_ns[0]) * 1e-9),
        way_m=float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()),
        gnss_m=float(np.median(np.linalg.norm(gnss[:, :2], axis=1))) if len(gnss) else None,
        gnss_sigma_m=float(np.median([fix.sigma_m for fix in recording.gnss])) if len(gnss) else None,
        drift_m=_drift_m(gnss) if len(gnss) else None,
        thickness_m=_thickness_m(recording, track),
        height_m=None if ground is None else ground.height_m,
        posed=recording.posed,
    )


def residuals_m(recording: Recording, track: Trajectory) -> F64:
    """(N, 3) antenna by the track less fix, east, north, up, for the fixes from the track's first to its last pose."""
    by_track, measured = antenna_m(recording, track)
    return by_track - measured


def antenna_m(recording: Recording, track: Trajectory) -> tuple[F64, F64]:
    """(N, 3) places of the GNSS antenna, map frame: by the track, and by the fixes between its first and last pose."""
    fixes = fixes_within(recording, track)
    if not fixes:
        return np.zeros((0, 3)), np.zeros((0, 3))
    geodetic = np.array([(fix.lat_rad, fix.lon_rad, fix.height_m) for fix in fixes])
    T = track.at(np.array([fix.t_ns for fix in fixes], np.int64))
    by_track = T[:, :3, 3] + T[:, :3, :3] @ np.array(recording.lever_m)
    return np.asarray(by_track), recording.anchor.frame.enu_from_geodetic(*geodetic.T)


def fixes_within(recording: Recording, track: Trajectory) -> list[GnssFix]:
    """The fixes from the track's first to its last pose."""
    return [fix for fix in recording.gnss if track.t_ns[0] <= fix.t_ns <= track.t_ns[-1]]


def _drift_m(residual_m: F64) -> float:
    third = max(1, len(residual_m) // 3)
    return float(np.linalg.norm((residual_m[-third:] - residual_m[:third]).mean(axis=0)[:2]))


def _thickness_m(recording: Recording, track: Trajectory) -> float | None:
    """Geometric mean over some windows of the drive."""
    n = len(recording)
    begins = np.unique(np.linspace(0, max(0, n - FIT_SCANS), FIT_WINDOWS).astype(int))
    windows = [range(begin, min(begin + FIT_SCANS, n)) for begin in begins.tolist()]
    found = [thickness_of(_laid(recording, track, window)) for window in windows]
    sigmas = np.concatenate([one.sigma_m for one in found])
    return float(np.exp(np.log(sigmas).mean())) if len(sigmas) else None


def _laid(recording: Recording, track: Trajectory, numbers: range) -> list[F64]:
    """Points of scans in the frame of the track, deskewed."""
    clouds = [np.zeros((0, 3))]
    for scan in (cleaned(recording.read(number)).scan for number in numbers):
        if scan is None:
            continue
        range_m = np.linalg.norm(scan.points_m, axis=1)
        near = (range_m > NEAR_M) & (range_m < FAR_M)
        middle_ns = scan.t_ns + int(scan.t_offset_ns.max()) // 2
        try:
            points = deskew(
                scan.points_m[near], scan.t_offset_ns[near], scan.t_ns, track, recording.T_vehicle_lidar, middle_ns
            )
            clouds.append(transform(track.at(middle_ns), points))
        except MotionError:  # the sweep lies outside the poses
            continue
    return [transform(T_inverse(track.T_dst_vehicle[0]), cloud) for cloud in clouds]
