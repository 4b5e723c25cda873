"""Motion segmentation once more, slowly and plainly: one point, one cell, one vote at a time."""

import math

import numpy as np

from gnd.vehicle_agent.segment.ground_kernels import GroundGrid
from gnd.vehicle_agent.segment.image_kernels import BINS, FAR_CM, GROUND_BIT, Optics, RangeJudge
from gnd.vehicle_agent.segment.voxel_kernels import GROUND, LOW


def lowest(points: np.ndarray, grid: GroundGrid, near_m: float) -> np.ndarray:
    """Second lowest height of each cell."""
    cell = np.floor((points[:, :2] - [grid.x0, grid.y0]) / grid.cell_m).astype(int)
    heights: dict[tuple[int, int], list[float]] = {}
    for (i, j), p in zip(cell, points, strict=True):
        if 0 <= i < grid.nx and 0 <= j < grid.ny and math.hypot(p[0], p[1]) >= near_m:
            heights.setdefault((i, j), []).append(p[2])
    result = np.full((grid.nx, grid.ny), np.inf, np.float32)
    for at, found in heights.items():
        if len(found) > 1:
            result[at] = sorted(found)[1]
    return result


def angles(d: np.ndarray) -> tuple[float, float, float]:
    """Share of a turn, tangent of elevation, length."""
    flat = math.hypot(d[0], d[1])
    return (math.atan2(d[1], d[0]) / (2 * math.pi)) % 1.0, d[2] / flat, math.hypot(flat, d[2])


def image(points: np.ndarray, origins: np.ndarray, voxel_of: np.ndarray, R: np.ndarray, optics: Optics) -> np.ndarray:
    """Nearest range of each cell, ground marked."""
    result = np.zeros((optics.columns, optics.rows), np.uint16)
    for p, o, v in zip(points, origins, voxel_of, strict=True):
        turn, tan, length = angles(R @ (p - o))
        row, column = math.floor((tan - optics.tan_low) / optics.tan_step), int(turn * optics.columns)
        cm = max(1, min(int(100 * length), FAR_CM))
        if 0 <= row < optics.rows and (result[column, row] == 0 or cm < (result[column, row] & FAR_CM)):
            result[column, row] = cm + (GROUND_BIT if v in (GROUND, LOW) else 0)
    return result


def opinion(  # noqa: C901
    p: np.ndarray, ranges: np.ndarray, places: np.ndarray, R: np.ndarray, optics: Optics, judge: RangeJudge
) -> str:
    """What a scan says about a point: `passed`, `met` or nothing."""
    place = places[int(angles(R @ p)[0] * BINS)]
    if np.isnan(place[0]):
        return ""
    turn, tan, r = angles(R @ (p - place))
    flat = r / math.hypot(1.0, tan)
    row, column = math.floor((tan - optics.tan_low) / optics.tan_step), int(turn * optics.columns)
    across = min(6, max(1, math.ceil(judge.reach_across_m / (flat * 2 * math.pi / optics.columns))))
    up = min(16, max(1, math.ceil(judge.reach_up_m / (flat * optics.tan_step))))
    extended = min(16, max(up, math.ceil(judge.gap_tan / optics.tan_step)))
    margin = judge.margin_m + judge.margin_share * r

    def seen(low: int, high: int) -> set[str]:
        """What rays of these rows did at the point's range."""
        found = set()
        for c in range(column - across, column + across + 1):
            for q in range(max(0, low), min(optics.rows, high + 1)):
                value = int(ranges[c % optics.columns, q])
                d = (value & FAR_CM) / 100 - r
                if value == 0:
                    continue
                if value & GROUND_BIT:
                    found |= {"beyond"} if d >= -margin else set()
                else:
                    found.add("beyond" if d > margin else "nearer" if d < -margin else "same")
        return found

    def free(near: tuple[int, int], steps: range) -> bool:
        """Whether the next ray on one side goes on beyond."""
        if "beyond" in seen(*near):
            return True
        for q in steps:
            found = seen(q, q)
            if "nearer" in found or "same" in found:
                return False
            if found:
                return True
        return False

    around = seen(row - up, row + up)
    if "same" in around:
        return "met"
    if "nearer" in around:
        return ""
    above = free((row, row + up), range(row + up + 1, row + extended + 1))
    below = free((row - up, row), range(row - up - 1, row - extended - 1, -1))
    return "passed" if above and below else ""


def joined(index: np.ndarray, reach: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of voxels that belong together: neighbours, else the next one straight above within reach."""
    where = {tuple(v): n for n, v in enumerate(index.tolist())}
    pairs = []
    for (i, j, k), n in where.items():
        near = [(i + a, j + b, k + c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (0, 1)]
        pairs += [(n, where[v]) for v in near if v in where]
        if not any(v in where and v[2] == k + 1 for v in near):
            above = [where[i, j, k + u] for u in range(2, int(reach[n]) + 1) if (i, j, k + u) in where]
            pairs += [(n, m) for m in above[:1]]
    return pairs
