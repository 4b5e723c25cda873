"""Poses of all drives made one: loops found, the graph solved, found again from there, solved again, and reported.

Where passes agree already (poses from a survey, or from this very refinement), nothing is changed: a graph can only add
the error of its loops to poses that are better.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, log_so3, transform
from gnd.tile_store.build import MapSource
from gnd.vehicle_agent.map_build.anchors import EVERY_M, PoseAnchors
from gnd.vehicle_agent.map_build.loops import Loop, LoopCounts, find_loops, pairs, sigma_between
from gnd.vehicle_agent.map_build.pose_graph import GNSS_CORRELATION_S, GnssTies, bent, solve
from gnd.vehicle_agent.map_build.survey import DriveSurvey, Progress

RefineMode = Literal["auto", "always", "never"]

AGREE_M, AGREE_UP_M, AGREE_DEG = 0.05, 0.10, 0.15
"""Median disagreement of passes below which poses are left alone: what the match of two clouds itself is off by."""
MIN_LOOPS: Final = 3
AFTER_SIGMA_M: Final = 0.5
"""One sigma of how anchors lie to each other once loops are closed."""
OWN_M: Final = 1e-3
"""Fixes nearer than this to the track (median) are the track written once more, as importers do without GNSS."""
_S: Final = 1e-9


@dataclass(frozen=True, slots=True)
class PassDrift:
    """Disagreement of passes with their loops: medians and 95 % quantiles over `loops` loops."""

    loops: int
    horizontal_m: float
    horizontal_p95_m: float
    vertical_m: float
    angle_deg: float
    angle_p95_deg: float


@dataclass(frozen=True, slots=True)
class PosesReport:
    """What was done about the poses, and why."""

    mode: RefineMode
    refined: bool
    reason: str
    candidates: LoopCounts | None = None
    loops_left_out: int = 0
    fixes: int = 0
    fixes_left_out: int = 0
    moved_m: float = 0.0
    """Largest horizontal shift of an anchor."""
    before: PassDrift | None = None
    after: PassDrift | None = None


def refine_poses(
    sources: Sequence[MapSource], surveys: Sequence[DriveSurvey], mode: RefineMode, progress: Progress
) -> tuple[list[MapSource], PosesReport]:
    """The drives with poses that agree with each other and with GNSS, and what was done.

    Args:
        sources: the drives.
        surveys: of each.
        mode: "auto" refines where passes meet and disagree; "always" also ties single passes to GNSS; "never" not.
        progress: called while loops are looked for.
    """
    if mode == "never":
        return list(sources), PosesReport(mode, False, "switched off")
    first = PoseAnchors(surveys, [source.poses for source in sources])
    if not len(first):
        return list(sources), PosesReport(mode, False, "no scan has a pose")
    T = first.poses()
    tried = pairs(first, T)
    if not tried and mode == "auto":
        return list(sources), PosesReport(mode, False, "no place was passed twice")
    loops, counts = find_loops(first, T, tried, lambda a, b: sigma_between(first, a, b), _counted(progress, "loops"))
    before = drift(T, loops)
    reason = _why_not(before, counts)
    if reason is not None and mode == "auto":
        return list(sources), PosesReport(mode, False, reason, counts, before=before)
    return _refined(sources, surveys, first, loops, mode, progress)


def _refined(
    sources: Sequence[MapSource],
    surveys: Sequence[DriveSurvey],
    first: PoseAnchors,
    loops: list[Loop],
    mode: RefineMode,
    progress: Progress,
) -> tuple[list[MapSource], PosesReport]:
    """Two rounds: from the solution of the first, loops are found that odometry alone was too far off for."""
    T, fixes = first.poses(), _fixes(first, sources)
    solved = solve(first.drive, T, loops, fixes)
    second = PoseAnchors(surveys, _bent(sources, first, T, solved.T))
    again = pairs(second, solved.T)
    loops, counts = find_loops(second, solved.T, again, lambda _a, _b: AFTER_SIGMA_M, _counted(progress, "loops again"))
    solved = solve(first.drive, T, loops, fixes)
    believed = [loop for loop, taken in zip(loops, solved.loops, strict=True) if taken]
    tracks = _bent(sources, first, T, solved.T)
    before, after = _checked(sources, surveys, tracks, progress)
    report = PosesReport(
        mode=mode,
        refined=True,
        reason="passes disagreed" if loops else "asked for",
        candidates=counts,
        loops_left_out=len(loops) - len(believed),
        fixes=len(fixes.anchor),
        fixes_left_out=int((~solved.fixes).sum()),
        moved_m=float(np.hypot(*(solved.T[:, :2, 3] - T[:, :2, 3]).T).max()),
        before=before,
        after=after,
    )
    return [replace(source, poses=track) for source, track in zip(sources, tracks, strict=True)], report


def _checked(
    sources: Sequence[MapSource], surveys: Sequence[DriveSurvey], tracks: Sequence[Trajectory], progress: Progress
) -> tuple[PassDrift | None, PassDrift | None]:
    """How far passes disagreed before and after, by loops halfway between the anchors, which the graph did not use:
    its own it fits however wrong they are.
    """
    between = PoseAnchors(surveys, tracks, from_m=EVERY_M / 2)
    if not len(between):
        return None, None
    T = between.poses()
    counted = _counted(progress, "checking between loops")
    loops, _ = find_loops(between, T, pairs(between, T), lambda _a, _b: AFTER_SIGMA_M, counted)
    T_before = PoseAnchors(surveys, [source.poses for source in sources], from_m=EVERY_M / 2).poses()
    return drift(T_before, loops), drift(T, loops)


def _counted(progress: Progress, what: str) -> Callable[[int, int], None]:
    return lambda done, total: progress(what, done, total)


def drift(T: F64, loops: Sequence[Loop]) -> PassDrift | None:
    """How far poses T (N, 4, 4) are from their loops; None without loops."""
    if not loops:
        return None
    seen = np.stack([loop.T_early_late for loop in loops])
    early, late = ([getattr(loop, end) for loop in loops] for end in ("early", "late"))
    off = T_inverse(seen) @ T_inverse(T[early]) @ T[late]
    level, up = np.hypot(off[:, 0, 3], off[:, 1, 3]), np.abs(off[:, 2, 3])
    turn = np.degrees(np.linalg.norm(log_so3(off[:, :3, :3]), axis=1))
    return PassDrift(
        len(loops),
        float(np.median(level)),
        float(np.quantile(level, 0.95)),
        float(np.median(up)),
        float(np.median(turn)),
        float(np.quantile(turn, 0.95)),
    )


def _why_not(before: PassDrift | None, counts: LoopCounts) -> str | None:
    """Why poses are left alone, or None."""
    if before is None or before.loops < MIN_LOOPS:
        return (
            f"of {counts.tried} pairs of places {counts.found} were sure loops ({counts.poor} fit badly, "
            f"{counts.ambiguous} in two places, {counts.one_way} one way only, {counts.alone} alone); "
            f"{MIN_LOOPS} are needed"
        )
    if before.horizontal_m < AGREE_M and before.vertical_m < AGREE_UP_M and before.angle_deg < AGREE_DEG:
        return (
            f"passes agree: {before.loops} loops are off by {100 * before.horizontal_m:.1f} cm horizontally, "
            f"{100 * before.vertical_m:.1f} cm in height and {before.angle_deg:.2f} degrees (median)"
        )
    return None


def _bent(sources: Sequence[MapSource], anchors: PoseAnchors, T_old: F64, T_new: F64) -> list[Trajectory]:
    tracks = []
    for number, source in enumerate(sources):
        own = np.flatnonzero(anchors.drive == number)
        t_ns = np.array([anchors.all[k].t_ns for k in own], np.int64)
        tracks.append(bent(source.poses, t_ns, T_old[own], T_new[own]) if len(own) else source.poses)
    return tracks


def _fixes(anchors: PoseAnchors, sources: Sequence[MapSource]) -> GnssTies:
    """One fix an anchor, with a sigma that allows for how alike the errors of neighbours are."""
    found: list[tuple[int, F64, float]] = []
    for number, source in enumerate(sources):
        own = np.flatnonzero(anchors.drive == number)
        t_ns = np.array([anchors.all[k].t_ns for k in own], np.int64)
        inside = (source.gnss.t_ns >= source.poses.t_ns[0]) & (source.gnss.t_ns <= source.poses.t_ns[-1])
        if len(own) < 2 or inside.sum() < 2:
            continue
        gnss = type(source.gnss)(*(column[inside] for column in source.gnss))
        p_drive = source.header.anchor.enu_from_geodetic(gnss.lat_rad, gnss.lon_rad, gnss.height_m)
        p_map = transform(source.T_map_drive, p_drive)
        offset = p_map - source.poses.at(gnss.t_ns)[:, :3, 3]
        if np.median(np.linalg.norm(offset, axis=1)) < OWN_M:
            continue
        step_s = float(np.median(np.diff(t_ns))) * _S
        shared = np.sqrt(max(1.0, 2.0 * GNSS_CORRELATION_S / max(step_s, 1e-3)))
        for k, t in zip(own, t_ns, strict=True):
            near = int(np.argmin(np.abs(gnss.t_ns - t)))
            if abs(int(gnss.t_ns[near]) - int(t)) * _S < step_s:
                place = source.poses.at(int(t))[:3, 3] + offset[near]
                found.append((int(k), place, max(float(gnss.sigma_m[near]), 0.01) * float(shared)))
    return GnssTies(
        np.array([one[0] for one in found], np.int64),
        np.array([one[1] for one in found], np.float64).reshape(-1, 3),
        np.array([one[2] for one in found], np.float64),
    )
