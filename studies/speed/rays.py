"""Rays of scans through a map: our kernel beside the same walk in C, and whole scans beside OctoMap and DUFOMap."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import transform
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.kernel import KernelParameters, cast_rays, kernel_parameters, window_affine
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.detect.records import make_records
from gnd.vehicle_agent.local_map import EMPTY
from studies.speed import yardstick
from studies.speed.contest import Absent, Contest, Entrant
from studies.speed.scene import SpeedScene

CLEARLY = 5
"""Rays that must pass an empty voxel before others are asked about it."""
ASKED = 10_000


class Counts(NamedTuple):
    """What a walk leaves behind: the window, the records, the points that count."""

    state: Any
    words: Any
    kept: Any


class PlacedScan(NamedTuple):
    """Hits (N, 3) and the sensor (1, 3), m, map frame."""

    points: F64
    origin: F64


def placed(scene: SpeedScene) -> list[PlacedScan]:
    """The scans of the changed street on their true poses."""
    return [
        PlacedScan(transform(T, points), transform(T, scene.T_vehicle_lidar[None, :3, 3]))
        for points, T in scene.changed
    ]


class Walk:
    """All scans through one window, by any function that takes what `cast_rays` takes."""

    def __init__(self, scene: SpeedScene, scans: list[PlacedScan]) -> None:
        local_map, detect = scene.local_map, DetectParameters()
        anchor_m = local_map.mean_map_m.mean(axis=0)
        self._records = make_records(local_map.mean_map_m, local_map.cov_m2, anchor_m, detect)
        self._index, self._p = local_map.index, kernel_parameters(detect)
        self._jobs = []
        for points, origin in scans:
            A, b = window_affine(*local_map.grid_frame.affine(origin[0]), anchor_m, local_map.window_origin_g)
            self._jobs.append((points, origin, anchor_m, A, b, np.zeros(len(points), np.bool_)))
        self.crossed = sum(
            float(np.abs(np.floor((points - anchor_m) @ A.T + b) - np.floor((origin - anchor_m) @ A.T + b)).sum())
            for points, origin, _, A, b, _ in self._jobs
        )
        self._block = np.ascontiguousarray(self._records.block)  # C reads row by row
        # Made once: filling fresh pages is no part of a walk. Counters go on from call to call.
        self._state, self._words = self._index.copy(), self._records.words.copy()
        self._kept = [np.zeros(len(job[0]), np.uint8) for job in self._jobs]

    def by(self, cast: Any) -> int:
        """Cast all rays; how many there were."""
        records = self._words.view(np.float32)
        p: KernelParameters = self._p
        return sum(
            cast(points, origin, anchor_m, A, b, self._state.reshape(-1), self._state.shape, self._words, records,
                 self._block, p, moving, kept)
            for (points, origin, anchor_m, A, b, moving), kept in zip(self._jobs, self._kept, strict=True)
        )  # fmt: skip

    def counts(self, cast: Any) -> Counts:
        """What one call counts, from nothing."""
        self._state[:], self._words[:] = self._index, self._records.words
        self.by(cast)
        return Counts(self._state.copy(), self._words.copy(), np.concatenate(self._kept))


def kernel_contest(scene: SpeedScene, folder: Path) -> Contest:
    """The walk alone: numba's and gcc's."""
    scans = placed(scene)
    walk = Walk(scene, scans)
    ours = walk.counts(cast_rays)
    rays = sum(len(one.points) for one in scans)
    words = f"{rays / len(scans):,.0f} rays, {walk.crossed / len(scans):,.0f} voxels a scan"
    entrant = Entrant("ours (numba)", lambda: walk.by(cast_rays), lambda _: words)
    others: list[Entrant | Absent] = []
    if yardstick.compiler() is None:
        others.append(Absent("C", "there is no gcc"))
    else:
        in_c = yardstick.compiled(folder)
        equal = all(np.array_equal(a, b) for a, b in zip(ours, walk.counts(in_c), strict=True))
        name = f"C (gcc {' '.join(yardstick.FLAGS[:3])})"
        others.append(Entrant(name, lambda: walk.by(in_c), lambda _: f"counts equal to the bit: {equal}"))
    notes = (
        f"{scene.sensor} on the changed street. Each ray walks the voxels up to its hit, and counts the cases of GND"
        " section 4.2 at every Gaussian that it meets.",
    )
    return Contest("The ray kernel", "ms/scan", len(scans), entrant, others, notes)


def scan_contest(scene: SpeedScene) -> Contest:
    """Whole scans into what each holds of a place: evidence about Gaussians, occupancy, voids."""
    scans = placed(scene)
    free_m = _passed_m(scene, scans)
    voxel_m = _voxel_m(scene)
    entrant = Entrant("ours", lambda: _detect(scene, scans), lambda _: f"{len(free_m):,} voxels asked for")
    notes = (
        f"The same scans and true poses, voxels of {voxel_m:.2f} m, one thread, one map for all scans of a call. Ours"
        " compares every ray with a map and collects the points of new Gaussians; the others hold no map of before.",
        f"Result: of the centres of voxels that at least {CLEARLY} of our rays passed, the share that they call free."
        " DUFOMap shrinks its voids by a voxel on purpose (d_p 1, d_s 0.2 m).",
    )
    others = [*_octomap(scans, voxel_m, free_m), *_dufomap(scans, voxel_m, free_m)]
    return Contest("Whole scans counted", "ms/scan", len(scans), entrant, others, notes)


def _detect(scene: SpeedScene, scans: list[PlacedScan]) -> ChangeDetector:
    detector = ChangeDetector(scene.local_map)
    for points, origin in scans:
        detector.add_scan(points, origin)
    return detector


def _passed_m(scene: SpeedScene, scans: list[PlacedScan]) -> F64:
    """(K, 3) centres of empty voxels that rays have clearly passed, map frame; at most `ASKED`, evenly taken."""
    state = Walk(scene, scans).counts(cast_rays).state
    voxels_g = np.argwhere((state < 0) & (state <= EMPTY - CLEARLY) & (state > EMPTY - 2**24)) + 0.5
    voxels_g = voxels_g[:: 1 + len(voxels_g) // ASKED]
    A, b = scene.local_map.grid_frame.affine(scans[0].origin[0])
    return np.asarray(np.linalg.solve(A, (voxels_g + scene.local_map.window_origin_g - b).T).T)


def _voxel_m(scene: SpeedScene) -> float:
    """The mean edge of a voxel."""
    A, _ = scene.local_map.grid_frame.affine(scene.local_map.mean_map_m.mean(axis=0))
    return float(abs(np.linalg.det(A)) ** (-1 / 3))


def _octomap(scans: list[PlacedScan], voxel_m: float, free_m: F64) -> Iterator[Entrant | Absent]:
    name = "OctoMap, insertPointCloud"
    try:
        import octomap
    except ImportError:
        yield Absent(name, "octomap-python is not installed (extra `peers`)")
        return

    def work() -> Any:
        tree = octomap.OcTree(voxel_m)
        for points, origin in scans:
            tree.insertPointCloud(points, origin[0], lazy_eval=True)
        tree.updateInnerOccupancy()
        return tree

    def judge(tree: Any) -> str:
        found = [_occupied(tree, at) for at in free_m]
        share = np.mean([one is False for one in found])
        return f"{share:.1%} free; {np.mean([one is None for one in found]):.1%} unknown"

    yield Entrant(name, work, judge)


def _occupied(tree: Any, at_m: F64) -> bool | None:
    """Whether a place is occupied, None where nothing is known."""
    node = tree.search(at_m)
    try:
        return bool(tree.isNodeOccupied(node))
    except Exception as error:  # the binding has its own, and not in its module
        if type(error).__name__ != "NullPointerException":
            raise
        return None


def _dufomap(scans: list[PlacedScan], voxel_m: float, free_m: F64) -> Iterator[Entrant | Absent]:
    name = "DUFOMap, run"
    try:
        from dufomap import dufomap
    except ImportError:
        yield Absent(name, "dufomap is not installed (extra `peers`)")
        return

    def work() -> Any:
        voids = dufomap(voxel_m, 0.2, 1, num_threads=1)
        for points, origin in scans:
            voids.run(points, [*origin[0], 1.0, 0.0, 0.0, 0.0], cloud_transform=False)
        voids.oncePropagateCluster(if_propagate=True, if_cluster=False)
        return voids

    def judge(voids: Any) -> str:
        labels = voids.segment(free_m, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], cloud_transform=False)
        return f"{np.mean(labels == 1):.1%} in voids"

    yield Entrant(name, work, judge)
