"""Fixes without times to a track: which pose of the track a fix belongs to, from the shapes of the two paths alone.

How far along the track a fix lies beyond the way that the fixes themselves have covered is a slow function of that way,
found by dynamic programming on the headings of both paths: the turns must meet. (The nearest place of the track is no
such measure while the two lie metres apart: around corners it jumps.) Between turns it is interpolated, so that along a
straight road a fix is as good as the turns at its ends.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solveh_banded

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.georeference import Georeferenced, georeference
from gnd.vehicle_agent.localise.track_alignment import FixTable

STEP_M: Final = 1.0
"""Of the way, in the search."""
LEVER_M: Final = 4.0
"""A heading is that between two places so far before and behind."""
REACH_M: Final = 120.0
"""The fixes may lie so much farther or less far along than by their own way, at most."""
SLIP_COST: Final = 0.1
"""Of a slip by a metre, in squared radians of one place; headings differ by at most `MAX_TURN_RAD`."""
MAX_TURN_RAD: Final = 0.7
HEADING_RAD: Final = 0.05
SLIP_PER_M: Final = 0.03
"""One sigma of a heading, and of the slip's change in a metre, when it is interpolated between turns."""
NEAR_M: Final = (15.0, 5.0)
"""Then the nearest place of the bent track within so much, a round each."""
STANDING_M: Final = 0.5
"""Fixes nearer than this to the last one that was taken are left out: a standing receiver's wander is no way."""


@dataclass(frozen=True, slots=True, eq=False)
class Untimed:
    """Positions in the order of driving: lat_rad, lon_rad, height_m (NaN: unknown), each (N,); sigma of an axis."""

    lat_rad: F64
    lon_rad: F64
    height_m: F64
    sigma_m: float

    def __len__(self) -> int:
        return len(self.lat_rad)

    def moving(self) -> I64:
        """Numbers of the fixes without those of a standing vehicle."""
        p = LocalFrame(float(self.lat_rad[0]), float(self.lon_rad[0])).enu_from_geodetic(
            self.lat_rad, self.lon_rad, 0.0
        )
        kept = [0]
        for number in range(1, len(p)):
            if np.linalg.norm(p[number, :2] - p[kept[-1], :2]) >= STANDING_M:
                kept.append(number)
        return np.array(kept, np.int64)

    def at(self, t_ns: I64, chosen: I64) -> FixTable:
        """The chosen ones as fixes of these times, put in their order."""
        order = np.argsort(t_ns, kind="stable")
        take = chosen[order]
        sigma = np.full(len(take), self.sigma_m)
        return FixTable(t_ns[order], self.lat_rad[take], self.lon_rad[take], self.height_m[take], sigma, 2.0 * sigma)


def georeference_untimed(
    track: Trajectory,
    fixes: Untimed,
) -> tuple[Georeferenced, FixTable]:
    """As `georeference` for fixes without times; also the fixes with the times they were found to have.

    Raises:
        LocaliseError: fewer than three fixes, or fixes that lie nowhere apart.
    """
    chosen = fixes.moving()
    if len(chosen) < 3:
        raise LocaliseError(f"{len(chosen)} of {len(fixes)} fixes lie {STANDING_M} m apart; 3 are needed")
    p = _enu(LocalFrame(float(fixes.lat_rad[0]), float(fixes.lon_rad[0])), fixes, chosen)
    way = way_m(track.T_dst_vehicle[:, :3, 3])
    at = matched_way_m(track.T_dst_vehicle[:, :2, 3], p[:, :2])
    table = fixes.at(time_at(track, way, at), chosen)
    found = georeference(track, table)
    for window_m in NEAR_M:
        at = nearest_on_track(found.track.T_dst_vehicle[:, :3, 3], way, _enu(found.frame, fixes, chosen), at, window_m)
        table = fixes.at(time_at(track, way, at), chosen)
        found = georeference(track, table)
    return found, table


def matched_way_m(p_track_m: F64, p_fix_m: F64) -> F64:
    """(M,) how far along the track (N, 2) each of the fixes (M, 2) lies, metres; the frames may be turned.

    Viterbi over the slip: along the fixes' way, what the track's way is more than theirs.
    """
    way, walked = way_m(p_track_m), way_m(p_fix_m)
    at = np.arange(0.0, walked[-1] + STEP_M, STEP_M)
    slips = np.arange(-REACH_M, REACH_M + STEP_M, STEP_M)
    track, fix = _headings(p_track_m, way, np.arange(0.0, way[-1] + STEP_M, STEP_M)), _headings(p_fix_m, walked, at)
    first = np.angle(np.median(np.cos(d)) + 1j * np.median(np.sin(d)) if len(d := _common(fix, track)) else 1.0)
    where = np.round((at[:, None] + slips) / STEP_M).astype(np.int64)
    off = fix[:, None] - track[np.clip(where, 0, len(track) - 1)] - first
    cost = np.minimum(np.abs(np.arctan2(np.sin(off), np.cos(off))), MAX_TURN_RAD) ** 2
    cost[(where < 0) | (where >= len(track))] = MAX_TURN_RAD**2
    slip = _smooth(slips[_viterbi(cost, SLIP_COST * STEP_M)], np.gradient(np.unwrap(fix), STEP_M))
    return np.asarray(np.clip(walked + np.interp(walked, at, slip), 0.0, way[-1]))


def _smooth(slip: F64, bend: F64) -> F64:
    """(K,) the slip as the turns tell it, interpolated between them: `bend` (K,) is the turn in a metre, radians."""
    weight = (bend / HEADING_RAD) ** 2 + 1e-9
    tie = np.full(len(slip), 1.0 / SLIP_PER_M**2 / STEP_M)
    diagonal = weight + np.concatenate([tie[:1], 2.0 * tie[2:], tie[:1]])
    banded = np.stack([np.concatenate([[0.0], -tie[1:]]), diagonal])
    return np.asarray(solveh_banded(banded, weight * slip))


def _common(fix: F64, track: F64) -> F64:
    n = min(len(fix), len(track))
    return fix[:n] - track[:n]


def _headings(p_m: F64, way: F64, at: F64) -> F64:
    """(K,) directions of a path at distances along it."""
    ahead, behind = (np.column_stack([np.interp(at + d, way, p) for p in p_m.T]) for d in (LEVER_M, -LEVER_M))
    return np.asarray(np.arctan2(*(ahead - behind).T[::-1]))


def _viterbi(cost: F64, slip_cost: float) -> I64:
    """(K,) the states of least cost (K, S) along a path, where a change by n states costs n times `slip_cost`."""
    n_states = cost.shape[1]
    reach = slip_cost * np.arange(n_states, dtype=np.float64)
    best, came = cost[0], np.empty(cost.shape, np.int64)
    for k in range(len(cost)):
        if k:
            best, came[k] = _slipped(best, reach)
            best = best + cost[k]
    states = np.empty(len(cost), np.int64)
    states[-1] = best.argmin()
    for k in range(len(cost) - 1, 0, -1):
        states[k - 1] = came[k, states[k]]
    return states


def _slipped(best: F64, reach: F64) -> tuple[F64, I64]:
    """(S,) least cost of coming to each state, and (S,) from which: the lower envelope of cones, from either side."""
    number = np.arange(len(best))
    up = best - reach  # from the left: min over j <= i of best[j] + (i - j) c
    left = np.minimum.accumulate(up)
    from_left = np.maximum.accumulate(np.where(up == left, number, 0))
    down = (best + reach)[::-1]
    right = np.minimum.accumulate(down)
    from_right = (len(best) - 1 - np.maximum.accumulate(np.where(down == right, number, 0)))[::-1]
    by_left, by_right = left + reach, right[::-1] - reach
    return np.minimum(by_left, by_right), np.where(by_left <= by_right, from_left, from_right)


def way_m(p_m: F64) -> F64:
    """(N,) distance driven on the ground until each of the positions (N, 2 or 3)."""
    return np.concatenate([[0.0], np.linalg.norm(np.diff(p_m[:, :2], axis=0), axis=1).cumsum()])


def time_at(track: Trajectory, way: F64, at_m: F64) -> I64:
    """(M,) times at which the track had driven so far."""
    offset = np.interp(at_m, way, (track.t_ns - track.t_ns[0]).astype(np.float64))
    return np.asarray(track.t_ns[0] + np.round(offset).astype(np.int64))


def _enu(frame: LocalFrame, fixes: Untimed, chosen: I64) -> F64:
    return frame.enu_from_geodetic(fixes.lat_rad[chosen], fixes.lon_rad[chosen], 0.0)


def nearest_on_track(p_track: F64, way: F64, p_fix: F64, at_m: F64, window_m: float) -> F64:
    """(M,) distances along the track of the places nearest to fixes (M, 3), not farther along than the window."""
    fine = np.arange(0.0, way[-1] + 0.1, 0.1)
    path = np.column_stack([np.interp(fine, way, p_track[:, axis]) for axis in (0, 1)])
    found = np.empty(len(at_m))
    for i, centre in enumerate(at_m):
        first, last = np.searchsorted(fine, [centre - window_m, centre + window_m])
        first = min(int(first), len(fine) - 1)
        off = path[first : max(int(last), first + 1)] - p_fix[i, :2]
        found[i] = fine[first + int((off**2).sum(axis=1).argmin())]
    return found
