"""Recordings without times of points: are the sweeps distorted, and if so, what are the times?

A window of consecutive scans in which the vehicle moves is laid together three times by LiDAR odometry: as recorded,
deskewed with the times that `sweep_times` finds, and deskewed with those times running backwards. Times are taken only
where upright surfaces become thinner with them, thicker with their reverse, and the motion found in the points is the
vehicle's. Surfaces that are thinnest as recorded tell that somebody freed the sweeps of motion before. Everything else
(the vehicle stands, nothing upright is there, the odometry fails) decides nothing, and the drive says so.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.errors import MotionError
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.schemas.drive import Deskew, Scan
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import RawScan, cleaned
from gnd.vehicle_agent.importers.firing_order import firing_share
from gnd.vehicle_agent.importers.lidar_odometry import track_of_scans
from gnd.vehicle_agent.importers.plane_thickness import Comparison, Thickness, compared, thickness_of
from gnd.vehicle_agent.importers.recording import Recording
from gnd.vehicle_agent.importers.sweep_times import (
    FoundSweep,
    SweepFit,
    azimuth_times,
    fit_sweep,
    middle_of_bins_rad,
    patches_of,
    pooled,
    steps_of,
)

F64 = NDArray[np.float64]
U32 = NDArray[np.uint32]

WINDOW: Final = 24
WINDOWS: Final = 4
"""So many over the recording, none overlaps another; the first that decides is the last that is looked at."""
LEAST_SCANS: Final = 12
LEAST_STEP_M: Final = 0.3
"""Mean way of a sweep below which a window says nothing (3 m/s at 10 Hz)."""
ROUNDS: Final = 3
THINNER: Final = 0.01
LIKELY, SURE = 1.5, 3.0
"""Sigmas by which surfaces must be thinner than as recorded, and thinner than with the times reversed."""
MOTION: Final = (0.5, 1.5)
"""Share of the vehicle's motion that the times must find in the points."""
BEGIN_SIGMA_RAD: Final = np.radians(10.0)
LEAST_CHI2: Final = 9.0
"""How much worse other directions, other beginnings and no distortion must fit before times are taken."""
NEAR_M, FAR_M = 3.0, 40.0
EVERY: Final = 2
UNSURE_RAD: Final = np.radians(8.0)
"""Lasers of a head look up to 9° past its azimuth, so points this near to the place where the sweep begins may be of
its beginning or of its end, a whole sweep apart: they are left out."""

ShareOf = Callable[[RawScan | Scan], F64]
"""(N,) share of the sweep that had passed when each point of a scan was measured; NaN where that cannot be told."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is known of the times of points, and the sentence that says why."""

    deskew: Deskew
    note: str


def with_times(recording: Recording) -> tuple[Recording, Verdict]:
    """The recording with times of points where they could be reconstructed, and what was found.

    Recordings that say what their times are come back as they are.
    """
    if recording.deskew != "none":
        return recording, Verdict(recording.deskew, "")
    if cleaned_offsets(recording):
        return replace(recording, deskew="measured"), Verdict("measured", "")
    sweep_ns = recording.sweep_ns or int(np.median(np.diff(recording.t_ns)))
    reasons, laid = [], list[_SpinWindow]()
    for numbers in windows_of(len(recording)):
        verdict, share_of = _decide(recording, numbers, sweep_ns, laid)
        if share_of is not None:
            return timed(recording, share_of, sweep_ns), verdict
        if verdict.deskew == "compensated":
            return replace(recording, deskew="compensated"), verdict
        reasons.append(verdict.note)
    note = f"no times of points, not deskewed, poses are the less sure the faster it drives: {reasons[-1]}"
    return replace(recording, sweep_ns=sweep_ns), Verdict("none", note)


def windows_of(n: int) -> list[range]:
    """Windows of n scans."""
    begins = np.linspace(0, max(0, n - WINDOW), min(WINDOWS, max(1, n // WINDOW))).astype(int)
    return [range(begin, min(begin + WINDOW, n)) for begin in begins.tolist()]


def cleaned_offsets(recording: Recording) -> bool:
    """Whether the first scans give times of points."""
    return any(bool(recording.read(i).t_offset_ns.any()) for i in range(min(3, len(recording))))


def timed(recording: Recording, share_of: ShareOf, sweep_ns: int) -> Recording:
    """The recording with times of points: sweeps of `sweep_ns` that begin half a sweep before the stamp, or at it."""
    early_ns = sweep_ns // 2 if recording.stamp == "middle" else 0
    return replace(
        recording,
        t_ns=recording.t_ns - early_ns,
        read=lambda i: _with_offsets(recording.read(i), share_of, sweep_ns, early_ns),
        deskew="reconstructed",
        sweep_ns=sweep_ns,
    )


def _with_offsets(scan: RawScan | Scan, share_of: ShareOf, sweep_ns: int, early_ns: int) -> RawScan:
    share = share_of(scan)
    sure = np.isfinite(share)
    offset = np.round(share[sure] * sweep_ns).astype(np.uint32)
    ring = None if scan.ring is None else scan.ring[sure]
    return RawScan(scan.t_ns - early_ns, np.ascontiguousarray(scan.points_m[sure]), offset, ring)


def share_by_azimuth(sweep: FoundSweep) -> ShareOf:
    """Times from the azimuths of points, for scans whose points lie in any order."""

    def share_of(scan: RawScan | Scan) -> F64:
        share = sweep.share(np.arctan2(scan.points_m[:, 1], scan.points_m[:, 0]).astype(np.float64))
        unsure = np.minimum(share, 1.0 - share) * 2.0 * np.pi < UNSURE_RAD
        return np.where(unsure, np.nan, share)

    return share_of


def share_by_order(scan: RawScan | Scan) -> F64:
    """Times from the order of points, for scans in firing order."""
    share = firing_share(scan.points_m)
    return np.full(len(scan), np.nan) if share is None else share


def _backwards(share_of: ShareOf) -> ShareOf:
    return lambda scan: 1.0 - share_of(scan)


@dataclass(frozen=True, slots=True, eq=False)
class _SpinWindow:
    """A window laid together: its scans, their track (a pose more at either end), how thick upright surfaces are."""

    scans: tuple[Scan, ...]
    track: Trajectory
    thickness: Thickness

    @property
    def step_m(self) -> float:
        """Mean way from scan to scan."""
        return float(np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1).mean())

    @property
    def poses(self) -> F64:
        """(N, 4, 4) of the scans."""
        return self.track.T_dst_vehicle[1:-1]


def _laid(recording: Recording, numbers: range, rough: Trajectory | None = None) -> _SpinWindow:
    """Lay a window together; `rough`: the motion to deskew with, so that the first sweeps are deskewed as well."""
    scans = [scan for i in numbers if (scan := cleaned(recording.read(i)).scan) is not None]
    track = _longer(track_of_scans(recording, scans, rough))
    clouds = []
    for scan, t_ns, T in zip(scans, track.t_ns[1:], track.T_dst_vehicle[1:], strict=False):
        some = scan.points_m[::EVERY]
        points = deskew(some, scan.t_offset_ns[::EVERY], scan.t_ns, track, recording.T_vehicle_lidar, int(t_ns))
        range_m = np.linalg.norm(some, axis=1)
        clouds.append(transform(T, points[(range_m > NEAR_M) & (range_m < FAR_M)]))
    return _SpinWindow(tuple(scans), track, thickness_of(clouds))


def _longer(track: Trajectory) -> Trajectory:
    """The track with its first and last step gone once more: sweeps begin before their pose and end after it."""
    t_ns, T = track.t_ns, track.T_dst_vehicle
    first, last = T[0] @ T_inverse(T[1]) @ T[0], T[-1] @ T_inverse(T[-2]) @ T[-1]
    times = np.concatenate([[2 * t_ns[0] - t_ns[1]], t_ns, [2 * t_ns[-1] - t_ns[-2]]])
    return Trajectory(times, np.concatenate([first[None], T, last[None]]))


def _decide(
    recording: Recording, numbers: range, sweep_ns: int, before: list[_SpinWindow]
) -> tuple[Verdict, ShareOf | None]:
    """What a window says, with those before it (it joins them); with times where they are to be reconstructed."""
    if len(numbers) < LEAST_SCANS:
        return Verdict("none", f"{len(numbers)} scans, {LEAST_SCANS} are needed to tell"), None
    try:
        plain = _laid(recording, numbers)
        if plain.step_m < LEAST_STEP_M:
            return Verdict("none", f"the vehicle moves {plain.step_m:.2f} m a sweep, too little to tell"), None
        before.append(plain)
        tried = _times_in(recording, before, sweep_ns)
        share_of = tried.share_of
        forward = _laid(timed(recording, share_of, sweep_ns), numbers, plain.track)
        backward = _laid(timed(recording, _backwards(share_of), sweep_ns), numbers, plain.track)
    except (ImportDriveError, MotionError) as error:
        return Verdict("none", f"LiDAR odometry fails on scans {numbers.start} to {numbers.stop - 1} ({error})"), None
    return _judged(tried, (plain.thickness, forward.thickness, backward.thickness))


@dataclass(frozen=True, slots=True)
class _Tried:
    """Times of points that are tried: what they are, and whether the points alone make them certain."""

    said: str
    share_of: ShareOf
    certain: bool


def _times_in(recording: Recording, laid: Sequence[_SpinWindow], sweep_ns: int) -> _Tried:
    if all(firing_share(scan.points_m) is not None for scan in laid[-1].scans):
        turn = "clockwise" if _turns_clockwise(laid[-1].scans[0]) else "counter-clockwise"
        return _Tried(f"from the firing order, {turn}", share_by_order, certain=True)
    fit = _fit(recording, laid, sweep_ns)
    turn = "clockwise" if fit.sweep.clockwise else "counter-clockwise"
    begin_deg, sigma_deg = np.degrees(fit.sweep.begin_rad) % 360.0, np.degrees(fit.begin_sigma_rad)
    certain = (
        MOTION[0] <= fit.motion <= MOTION[1]
        and min(fit.rival, fit.still) > LEAST_CHI2
        and fit.begin_sigma_rad < BEGIN_SIGMA_RAD
    )
    said = (
        f"from azimuth: sweep begins at {begin_deg:.0f} ± {sigma_deg:.0f}°, {turn},"
        f" {fit.motion:.2f} ± {fit.motion_sigma:.2f} of the motion is in the points"
    )
    return _Tried(said, share_by_azimuth(fit.sweep), certain)


def _turns_clockwise(scan: Scan) -> bool:
    share = firing_share(scan.points_m)
    assert share is not None
    azimuth = np.unwrap(np.arctan2(scan.points_m[:, 1], scan.points_m[:, 0]).astype(np.float64)[np.argsort(share)])
    return bool(azimuth[-1] < azimuth[0])


def _fit(recording: Recording, laid: Sequence[_SpinWindow], sweep_ns: int) -> SweepFit:
    """The saw tooth in some windows; surfaces are paired anew with the times found so far."""
    patches = [[patches_of(scan.points_m, recording.T_vehicle_lidar) for scan in window.scans] for window in laid]
    steps = [steps_of(window.track.t_ns[1:-1], window.poses, sweep_ns) for window in laid]
    known, fit = None, None
    for _ in range(ROUNDS):
        times = [azimuth_times(p, w.poses, s, known) for p, w, s in zip(patches, laid, steps, strict=True)]
        fit = fit_sweep(pooled(times))
        known = min(1.0, fit.motion) * (fit.sweep.share(middle_of_bins_rad()) - 0.5)
    assert fit is not None
    return fit


def _judged(tried: _Tried, thickness: tuple[Thickness, Thickness, Thickness]) -> tuple[Verdict, ShareOf | None]:
    """What comes of upright surfaces as recorded, with the times that were tried, and with their reverse."""
    plain, forward, backward = thickness
    gain, loss, apart = compared(plain, forward), compared(plain, backward), compared(backward, forward)
    said = f"{tried.said}; upright surfaces {_percent(gain)} with these times, {_percent(loss)} with their reverse"
    if tried.certain and gain.by(THINNER, LIKELY) and apart.by(THINNER, SURE) and loss.thinner < 0.0:
        return Verdict("reconstructed", f"times of points reconstructed {said}"), tried.share_of
    if compared(forward, plain).by(THINNER, LIKELY) and compared(backward, plain).by(THINNER, LIKELY):
        return Verdict("compensated", f"sweeps are free of motion already: times {said}"), None
    return Verdict("none", f"times {said}"), None


def _percent(one: Comparison) -> str:
    percent = one.percent
    return f"{abs(percent):.1f} ± {100.0 * one.sigma:.1f} % {'thinner' if percent >= 0 else 'thicker'}"
