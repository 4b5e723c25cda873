"""A wheel-and-gyro track put on the Earth by GNSS of different quality: a car in Nagoya with a reference.

The recording has no LiDAR. Its local track is dead reckoning from the drive's own speed and yaw rate (of the
reference), with the simulator's errors of wheel and gyro added (of the gyro's bias a tenth: a standing vehicle learns
it). Everything else is measured: RTK and single-point fixes by RTKLIB, and the reference's positions at every pose.
"""

from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.drives import SensorErrors
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.vehicle_agent.localise.georeference import Georeferenced, georeference
from gnd.vehicle_agent.localise.track_alignment import FixTable
from studies.frame.errors import RealDataError

I64 = NDArray[np.int64]

GPS_EPOCH: Final = datetime(1980, 1, 6)
WEEK_S: Final = 604_800
FIXED: Final = 1
"""Quality of a position whose ambiguities are integers."""
FLOOR_M: Final = 0.02
"""Least sigma that is believed."""
_FIRST: Final = 2  # column of the latitude


def gps_ns(week: float, second: float) -> int:
    """GPS time as nanoseconds since its epoch."""
    return int(week) * WEEK_S * 1_000_000_000 + round(second * 1e9)


def read_pos(path: Path) -> tuple[FixTable, I64]:
    """Fixes (times are GPS time) and the quality of each.

    Raises:
        RealDataError: the file cannot be read, or holds no such lines.
    """
    try:
        lines = [line.split() for line in path.read_text("ascii").splitlines() if line and not line.startswith("%")]
        t_ns = np.array([_time_ns(*line[:_FIRST]) for line in lines], np.int64)
        rows = np.array([line[_FIRST : _FIRST + 8] for line in lines], np.float64).reshape(-1, 8)
    except (OSError, ValueError, TypeError) as error:
        raise RealDataError(f"{path}: no positions of RTKLIB: {error}") from error
    if not len(rows):
        raise RealDataError(f"{path}: no positions")
    lat, lon, height, quality, _, north, east, up = rows.T
    sigma = np.maximum(np.hypot(north, east) / np.sqrt(2.0), FLOOR_M)
    table = FixTable(t_ns, np.radians(lat), np.radians(lon), height, sigma, np.maximum(up, FLOOR_M))
    return table, quality.astype(np.int64)


def _time_ns(first: str, second: str) -> int:
    """Of week and second, or of a date and a time of the day."""
    if "/" not in first:
        return gps_ns(float(first), float(second))
    clock, _, fraction = second.partition(".")
    since = datetime.strptime(f"{first} {clock}", "%Y/%m/%d %H:%M:%S") - GPS_EPOCH
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + int(fraction.ljust(9, "0"))


F64 = NDArray[np.float64]

SEED: Final = 0
EVERY: Final = 5
"""Of the reference's poses at 5 Hz one in so many."""
THINNED_S: Final = 10
ERRORS: Final = replace(SensorErrors(), gyro_bias_radps=SensorErrors().gyro_bias_radps / 10.0)
_COLUMNS: Final = 14


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """t_ns (N,) GPS time, latitude, longitude, height, heading (clockwise from north), speed forwards, each (N,)."""

    t_ns: I64
    lat_rad: F64
    lon_rad: F64
    height_m: F64
    heading_rad: F64
    speed_mps: F64

    def enu_m(self, frame: LocalFrame) -> F64:
        """(N, 3)."""
        return frame.enu_from_geodetic(self.lat_rad, self.lon_rad, self.height_m)

    def chosen(self, chosen: slice | I64) -> "Reference":
        """Some of it."""
        columns = (self.lat_rad, self.lon_rad, self.height_m, self.heading_rad, self.speed_mps)
        return Reference(self.t_ns[chosen], *(column[chosen] for column in columns))


def is_nagoya(folder: Path) -> bool:
    """Whether a folder holds such a recording."""
    return (folder / "reference.csv").is_file() and (folder / "rover_rtk.pos").is_file()


def read_reference(path: Path) -> Reference:
    """The reference trajectory.

    Raises:
        RealDataError: the file cannot be read or has other columns.
    """
    try:
        rows = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        raise RealDataError(f"{path}: no reference trajectory: {error}") from error
    if rows.shape[1] != _COLUMNS:
        raise RealDataError(f"{path}: {rows.shape[1]} columns; {_COLUMNS} are needed")
    t_ns = np.array([gps_ns(week, second) for second, week in rows[:, :2]], np.int64)
    lat, lon, heading = np.radians(rows[:, [2, 3, 10]]).T
    speed = rows[:, 11] * np.sin(heading) + rows[:, 12] * np.cos(heading)  # less than nothing when it reverses
    return Reference(t_ns, lat, lon, rows[:, 4], heading, speed)


def dead_reckoned(reference: Reference, errors: SensorErrors = ERRORS, seed: int = SEED) -> Trajectory:
    """The drive as wheel and gyro would have it: planar, from the identity."""
    rng, dt_s = np.random.default_rng([64, seed]), np.diff(reference.t_ns) * 1e-9
    speed = (reference.speed_mps[1:] + reference.speed_mps[:-1]) / 2.0
    speed = speed * (1.0 + errors.wheel_scale) + rng.normal(0.0, errors.wheel_mps, len(dt_s)) * (np.abs(speed) > 0.1)
    turn = -np.diff(np.unwrap(reference.heading_rad))
    turn = turn + (errors.gyro_bias_radps + rng.normal(0.0, errors.gyro_radps, len(dt_s))) * dt_s
    yaw = np.concatenate([[0.0], turn.cumsum()])
    middle = (yaw[1:] + yaw[:-1]) / 2.0
    step = (speed * dt_s)[:, None] * np.column_stack([np.cos(middle), np.sin(middle), np.zeros(len(dt_s))])
    p = np.concatenate([np.zeros((1, 3)), step.cumsum(axis=0)])
    return Trajectory(reference.t_ns, T_from_R_t(exp_so3(np.column_stack([np.zeros((len(yaw), 2)), yaw])), p))


def nagoya_of(folder: Path) -> dict[str, Any]:
    """The same track by each kind of fixes, against the reference."""
    reference = read_reference(folder / "reference.csv")
    whole = dead_reckoned(reference)
    track, rows = Trajectory(whole.t_ns[::EVERY], whole.T_dst_vehicle[::EVERY]), list[dict[str, Any]]()
    reference = reference.chosen(slice(None, None, EVERY))
    for name, fixes in _fixes(folder).items():
        rigid, bent = (georeference(track, fixes, drift=drift) for drift in (False, True))
        raw = fixes.take(np.flatnonzero((fixes.t_ns >= track.t_ns[0]) & (fixes.t_ns <= track.t_ns[-1])))
        row = {"name": name, "fixes": len(raw), "used": len(bent.used), "sigma_m_p50": float(np.median(raw.sigma_m))}
        row |= {"fixes_off_m": _quantiles(_fixes_off(raw, reference)), "believed": float((bent.weights > 0.25).mean())}
        row |= {"rigid_off_m": _quantiles(track_off(rigid, reference)), "off_m": _quantiles(track_off(bent, reference))}
        row |= {"heading_deg": _quantiles(np.degrees(_heading_off(bent, reference)))}
        rows.append(row)
    way_m = float(np.linalg.norm(np.diff(whole.T_dst_vehicle[:, :3, 3], axis=0), axis=1).sum())
    return {"poses": len(track), "way_m": way_m, "by": rows}


def _fixes(folder: Path) -> dict[str, FixTable]:
    rtk, quality = read_pos(folder / "rover_rtk.pos")
    fixed = np.flatnonzero(quality == FIXED)
    thin = np.unique((rtk.t_ns[fixed] - rtk.t_ns[0]) // (THINNED_S * 1_000_000_000), return_index=True)[1]
    single, _ = read_pos(folder / "rover_1Hz_spp.pos")
    return {
        "RTK, all": rtk,
        "RTK, fixed": rtk.take(fixed),
        f"RTK, fixed, one in {THINNED_S} s": rtk.take(fixed[thin]),
        "single point": single,
    }


def track_off(found: Georeferenced, reference: Reference) -> F64:
    """(P,) horizontal metres of every pose from the reference."""
    off = found.track.T_dst_vehicle[:, :3, 3] - reference.enu_m(found.frame)
    return np.asarray(np.linalg.norm(off[:, :2], axis=1))


def _fixes_off(fixes: FixTable, reference: Reference) -> F64:
    frame = LocalFrame(float(reference.lat_rad[0]), float(reference.lon_rad[0]))
    p, t_s = reference.enu_m(frame), (reference.t_ns - reference.t_ns[0]) * 1e-9
    at = np.column_stack([np.interp((fixes.t_ns - reference.t_ns[0]) * 1e-9, t_s, p[:, k]) for k in (0, 1)])
    return np.asarray(np.linalg.norm(fixes.enu_m(frame)[:, :2] - at, axis=1))


def _heading_off(found: Georeferenced, reference: Reference) -> F64:
    """(M,) of the poses at which the vehicle moves, radians."""
    moving = np.abs(reference.speed_mps) > 1.0
    off = (found.geodetic()[3] - reference.heading_rad)[moving]
    return np.abs(np.arctan2(np.sin(off), np.cos(off)))


def _quantiles(values: F64) -> dict[str, float]:
    return {"p50": float(np.median(values)), "p95": float(np.quantile(values, 0.95)), "max": float(values.max())}
