"""What is wrong with a recording although every number of it can be read: feet, mirrored axes, another place or time.

Each is found against something independent: the fixes, the measured motion, or the ground. What would bend or misplace
a map ends the import with what to do; what only might is a warning.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.schemas.drive import Scan
from gnd.schemas.limits import MAX_POINTS_OF_SCAN
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.choices import METRES_OF
from gnd.vehicle_agent.importers.cleaning import MAX_RANGE_M, cleaned
from gnd.vehicle_agent.importers.fitting import fit_heading_and_position
from gnd.vehicle_agent.importers.mount import GroundSeen, ground_of, ground_of_scans
from gnd.vehicle_agent.importers.quality import antenna_m, residuals_m
from gnd.vehicle_agent.importers.recording import Recording

F64 = NDArray[np.float64]

LOOKED_AT: Final = 5
MANY_POINTS: Final = 1_500_000
"""More points than a sweep of any LiDAR on a car has; a map cut into files has them."""
FAR_SHARE: Final = 0.5
SAME_SCALE: Final = 0.1
"""Scale of the track against the fixes that is no unit, but worth a warning."""
UNIT_SCALE: Final = 0.06
"""A scale this near to that of a unit is that unit."""
SIGMAS: Final = 10.0
"""The fixes must spread over so many of their sigmas before they judge scale, shape or time."""
MIRRORED: Final = 0.5
"""The mirrored track must fit so much better."""
LEAST_TURN_RAD: Final = np.radians(15.0)
OPPOSITE: Final = -0.7
FAR_M: Final = 10.0
FAR_SIGMAS: Final = 5.0
CLOCKS_S: Final = {18: "GPS time less UTC", 37: "TAI less UTC", 19: "TAI less GPS time", 3600: "an hour: a time zone"}


def suspicious_scans(recording: Recording) -> tuple[str, ...]:
    """Warnings about the scans alone.

    Raises:
        ImportDriveError: more points than a drive may hold in a scan; z that points downwards.
    """
    numbers = np.unique(np.linspace(0, len(recording) - 1, LOOKED_AT).astype(int))
    scans = [(int(i), recording.read(int(i))) for i in numbers]
    notes = []
    for i, scan in scans:
        if len(scan) > MAX_POINTS_OF_SCAN:
            raise ImportDriveError(
                f"{recording.name}: scan {i} has {len(scan)} points, {MAX_POINTS_OF_SCAN} at most: a map?"
            )
        if len(scan) > MANY_POINTS:
            notes.append(f"warning: scan {i} has {len(scan)} points: is it a sweep, or a piece of a map?")
        far = float((np.abs(scan.points_m) > MAX_RANGE_M).any(axis=1).mean()) if len(scan) else 0.0
        if far > FAR_SHARE:
            raise ImportDriveError(
                f"{recording.name}: {far:.0%} of the points of scan {i} lie beyond {MAX_RANGE_M:.0f} m: other units"
                " (--units mm, cm, ft), or points of a map frame instead of the sensor's?"
            )
    notes += _upside_down(recording, [points for _, s in scans if (points := cleaned(s).scan) is not None])
    return tuple(notes)


def _upside_down(recording: Recording, scans: list[Scan]) -> list[str]:
    """A warning where the ground is seen only when z is turned round; refused unless somebody gave the mount (in a
    tunnel a LiDAR may see the ceiling and not the road).
    """
    R = recording.T_vehicle_lidar[:3, :3]
    clouds = [np.asarray(scan.points_m, np.float64) @ R.T for scan in scans]
    if len(clouds) < 3:
        return []
    plain = ground_of_scans([ground_of(cloud, None) for cloud in clouds])
    if isinstance(plain, GroundSeen):
        return []
    turned = ground_of_scans([ground_of(cloud * [1.0, 1.0, -1.0], None) for cloud in clouds])
    if not isinstance(turned, GroundSeen):
        return []
    said = f"the ground lies {turned.height_m:.2f} m *above* the LiDAR: its z points downwards or is mirrored"
    if recording.mount == "given":
        return [f"warning: {said}, or this is a ceiling"]
    raise ImportDriveError(f"{recording.name}: {said}; one that hangs upside down: --mount X,Y,Z,180,0,0")


def check_track(recording: Recording, track: Trajectory) -> tuple[str, ...]:
    """Warnings about the track against fixes and motion.

    Raises:
        ImportDriveError: the track has another unit, is mirrored, or lies elsewhere or at another time than the fixes.
    """
    _check_turns(recording, track)
    by_track, measured = antenna_m(recording, track)
    residual = by_track - measured
    if len(residual) < 3:
        return ()
    sigma_m = float(np.median([fix.sigma_m for fix in recording.gnss]))
    spread_m = float(np.sqrt(measured[:, :2].var(axis=0).sum()))
    off_m = float(np.median(np.linalg.norm(residual[:, :2], axis=1)))
    far = off_m > max(FAR_M, FAR_SIGMAS * sigma_m)
    if far and recording.track is not None and (hint := _clock_hint(recording, track)):
        raise _elsewhere(recording, off_m, sigma_m, hint)
    if spread_m > SIGMAS * sigma_m:
        _check_scale(recording, by_track, measured)
        _check_mirrored(recording, by_track, measured, sigma_m)
    if far and recording.track is not None:
        raise _elsewhere(recording, off_m, sigma_m, "another UTM zone, anchor, axes or place")
    return (f"warning: the track lies {off_m:.1f} m from the fixes (sigma {sigma_m:.1f} m)",) if far else ()


def _elsewhere(recording: Recording, off_m: float, sigma_m: float, why: str) -> ImportDriveError:
    return ImportDriveError(
        f"{recording.name}: the poses lie {off_m:,.1f} m (median) from the GNSS fixes, which say they are off by"
        f" {sigma_m:.1f} m: {why}"
    )


def _check_scale(recording: Recording, by_track: F64, measured: F64) -> None:
    size = [float(np.sqrt(one[:, :2].var(axis=0).sum())) for one in (by_track, measured)]
    scale = size[1] / max(size[0], 1e-9)
    for unit, metres in METRES_OF.items():
        if unit != "m" and abs(scale / metres - 1.0) < UNIT_SCALE:
            raise ImportDriveError(
                f"{recording.name}: by the scans the vehicle went {1 / scale:.2f} times as far as by the fixes: the"
                f" coordinates count {unit}; give --units {unit}"
            )
    if abs(scale - 1.0) > SAME_SCALE:
        raise ImportDriveError(
            f"{recording.name}: by the scans the vehicle went {1 / scale:.2f} times as far as by the fixes: other units"
            f" ({', '.join(METRES_OF)}: --units), or poses and fixes of two drives"
        )


def _check_mirrored(recording: Recording, by_track: F64, measured: F64, sigma_m: float) -> None:
    off = [_rms_m(by_track * axes, measured) for axes in ([1.0, 1.0, 1.0], [1.0, -1.0, 1.0])]
    if off[1] < MIRRORED * off[0] and off[1] < 3.0 * sigma_m < off[0]:
        raise ImportDriveError(
            f"{recording.name}: the track lies {off[0]:.1f} m from the fixes, mirrored only {off[1]:.1f} m: one of the"
            " axes of the points or poses has the wrong sign"
        )


def _rms_m(by_track: F64, measured: F64) -> float:
    T = fit_heading_and_position(by_track, measured)
    return float(np.sqrt((((by_track @ T[:3, :3].T + T[:3, 3]) - measured)[:, :2] ** 2).sum(axis=1).mean()))


def _check_turns(recording: Recording, track: Trajectory) -> None:
    """Refuse a track that turns left where the measured yaw rate turns right."""
    t_ns = np.array([sample.t_ns for sample in recording.motion], np.int64)
    rate = np.array([sample.yaw_rate_radps for sample in recording.motion])
    if len(t_ns) < 2 or len(track) < 3:
        return
    step = T_inverse(track.T_dst_vehicle[:-1]) @ track.T_dst_vehicle[1:]
    turned = log_so3(step[:, :3, :3])[:, 2]
    turn = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t_ns) * 1e-9)])
    measured = np.diff(np.interp(track.t_ns, t_ns, turn))
    if np.abs(measured).sum() < LEAST_TURN_RAD or np.abs(turned).sum() < LEAST_TURN_RAD:
        return
    together = float(measured @ turned / np.sqrt((measured @ measured) * (turned @ turned)))
    if together < OPPOSITE:
        raise ImportDriveError(
            f"{recording.name}: the scans turn against the measured yaw rate (correlation {together:.2f}): an axis"
            " of the points is mirrored, or the yaw rate counts clockwise"
        )


def _clock_hint(recording: Recording, track: Trajectory) -> str:
    """The clock difference that explains where the poses lie, where one of the usual does; else nothing."""
    plain = _median_m(recording, track)
    for seconds, what in CLOCKS_S.items():
        for shift in (seconds, -seconds):
            moved = Trajectory(track.t_ns + shift * 1_000_000_000, track.T_dst_vehicle)
            off = _median_m(recording, moved)
            if off is not None and plain is not None and off < 0.2 * plain:
                return f"poses {shift:+d} s later lie {off:.1f} m from them ({what})"
    return ""


def _median_m(recording: Recording, track: Trajectory) -> float | None:
    residual = residuals_m(recording, track)
    return float(np.median(np.linalg.norm(residual[:, :2], axis=1))) if len(residual) >= 3 else None
