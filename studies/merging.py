"""What a merge of one tile costs: reports of a few and of many changed voxels, the clusters beside their numpy twin.

A tile of walls and ground in which voxels have changed; every vehicle has measured the same change, each with its own
noise, one in twenty of the voxels otherwise. The shift test of a report is made once, so it stands alone.
"""

from functools import partial
from typing import Final

import numpy as np

from gnd.cloud_merger.belief import ShiftTests
from gnd.cloud_merger.confirmation import ConfirmationParameters
from gnd.cloud_merger.memory import TileMemory
from gnd.cloud_merger.merge import plain_clusters
from gnd.cloud_merger.merge_kernels import clusters_of
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.shift import shift_of
from gnd.cloud_merger.statements import Report, statements_of
from gnd.cloud_merger.window import TileState, WindowMerger
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import content_sha
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import TileChange
from studies.frame.measure import Figure, least_s

TILE: Final = TileId(497353963154)
VOXELS: Final = 2_000
CHANGED: Final = (30, 900)
REPORTS: Final = (8, 16, 32, 64)
OTHERWISE: Final = 0.05
_NOISE_M: Final = 0.02
_CELLS: Final = 60
_SEED: Final = 13


def run() -> list[Figure]:
    """Measure merges of all sizes, and one shift test of each size of report."""
    base = base_of(VOXELS)
    merges = [merge_figure(base, reports, changed) for changed in CHANGED for reports in REPORTS]
    return [*merges, *(_shift_figure(base, changed) for changed in CHANGED)]


def merge_figure(base: Gaussians, reports: int, changed: int) -> Figure:
    """Return the processor time of a merge, with that of its clusters in the kernel and in numpy."""
    said, rules = reports_of(base, reports, changed), MergeParameters()
    sha = content_sha(TILE, base)
    tests = ShiftTests()
    merger = WindowMerger(rules, ConfirmationParameters(), tests, {sha: base}, frozenset())
    state = TileState(base, TileMemory())
    rows = statements_of(base, said, {sha: base}).rows
    whole_ms, ours_ms, twin_ms = (
        1e3 * least_s(work, 5)
        for work in (
            partial(merger.merge, state, said, None),
            partial(clusters_of, rows, rules),
            partial(plain_clusters, rows, rules),
        )
    )
    detail = f"{len(rows)} statements; clusters {ours_ms:.2f} ms, numpy twin {twin_ms:.1f} ms"
    return Figure(f"{reports} reports of {changed} changed voxels", whole_ms, "ms", detail)


def _shift_figure(base: Gaussians, changed: int) -> Figure:
    (report,) = reports_of(base, 1, changed)
    test = shift_of(report.change, base)
    detail = f"{test.gaussians} Gaussians that fit nothing, base of {len(base)}; once a report"
    return Figure(
        f"shift test of {changed} changed voxels", 1e3 * least_s(lambda: shift_of(report.change, base), 5), "ms", detail
    )


def base_of(voxels: int) -> Gaussians:
    """Return a tile of planes: two in five voxels of ground, the others of walls that face all ways."""
    rng = np.random.default_rng(_SEED)
    ids = np.arange(-voxels // 2, voxels - voxels // 2, dtype=np.int32)
    return _planes(ids, np.where(rng.random(voxels) < 0.4, np.nan, rng.uniform(0.0, np.pi, voxels)), rng)


def reports_of(base: Gaussians, reports: int, changed: int) -> list[Report]:
    """Return what so many vehicles say about a tile of which `changed` voxels are not as in the base."""
    rng = np.random.default_rng([_SEED, changed])
    rows = np.sort(rng.choice(len(base), changed, replace=False))
    now = _planes(base.voxel_id[rows], rng.uniform(0.0, np.pi, changed), rng)
    return [_report(number, base, now, rng) for number in range(reports)]


def _report(number: int, base: Gaussians, now: Gaussians, rng: np.random.Generator) -> Report:
    """One vehicle's measurement of the change."""
    is_other = rng.random(len(now)) < OTHERWISE
    off_m = rng.normal(0.0, np.where(is_other, 10.0, 1.0)[:, None] * _NOISE_M, (len(now), 3))
    mean_m = (now.mean_m + off_m).astype(np.float32)
    measured = Gaussians(now.voxel_id, now.count, now.cells, mean_m, now.cov_m2)
    change = TileChange(
        tile=TILE,
        base_version=1,
        base_sha=content_sha(TILE, base),
        observed=base.voxel_id,
        changed=measured,
        change_class=np.full(len(now), ChangeClass.MODIFIED, np.uint8),
        evidence=np.zeros((len(now), 4), np.int32),
        pose_sigma_m=0.03,
        pose_sigma_rad=0.001,
    )
    return Report(f"report-{number:04d}", change, vehicle=f"car-{number}", first_ns=number, last_ns=number + 1)


def _planes(ids: np.ndarray, facing_rad: np.ndarray, rng: np.random.Generator) -> Gaussians:
    """A plane a voxel, somewhere in it: upright ones by the way they face, level ones where that is NaN."""
    n = len(ids)
    is_level = np.isnan(facing_rad)
    turn = np.where(is_level, 0.0, facing_rad)
    normal = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(n)])
    normal[is_level] = (0.0, 0.0, 1.0)
    cov = 0.08 * (np.eye(3) - normal[:, :, None] * normal[:, None, :]) + _NOISE_M**2 * np.eye(3)
    six = cov[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)
    mean_m = rng.uniform(-0.3, 0.3, (n, 3)).astype(np.float32)
    return Gaussians(ids, np.full(n, 200, np.int32), np.full(n, _CELLS, np.int32), mean_m, six)
