"""From how far off a scan finds its place on the map of another part: our registration beside small_gicp's.

Every driven scan starts a few times from a seeded place a given distance off, in a random horizontal direction, turned
about the vertical (the offset's sign alternates). It has converged where the answer lies within 10 cm and 0.3° of the
LiDAR track, which is several times what the methods differ by among each other; of those that have not, it is counted
how many said so (ours: directions that nothing constrains, or no convergence; small_gicp: no convergence). VGICP gets
voxels of a metre like ours; GICP gets the map's points and a reach of the offset and a metre. Our sampling and their
downsampling are in the time.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import ceil
from time import perf_counter
from typing import Any, Final

import numpy as np
import small_gicp
from numpy.typing import NDArray

from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, log_so3
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.importers.lidar_odometry import reference_ns
from gnd.vehicle_agent.localise.match_map import MatchMap, MatchMapCache
from gnd.vehicle_agent.localise.parameters import WITHOUT_WHEELS, LocaliserParameters
from gnd.vehicle_agent.localise.registration import Start, register
from gnd.vehicle_agent.localise.sampling import sample_scan
from studies.frame.scans import posed
from studies.real_localisation.halves import SOURCE_M, Half, gicp

F64 = NDArray[np.float64]
Aligner = Callable[[F64, F64, float], tuple[F64, bool]]
"""Points (N, 3) in the vehicle frame, a start (4, 4) and its distance off: T_map_vehicle, and whether to doubt it."""

OFFSETS: Final[tuple[tuple[float, float, Start], ...]] = ((0.3, 1.0, "wide"), (1.0, 3.0, "wide"), (2.0, 5.0, "capture"))
"""Metres and degrees off, and how our registration is told to start."""
TRIALS: Final = 24
"""At least so many a row, unless told otherwise."""
CONVERGED_M: Final = 0.10
CONVERGED_DEG: Final = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    points: F64
    T_true: F64
    start: F64


def convergence_of(half: Half, seed: int = 0, trials: int = TRIALS) -> list[dict[str, Any]]:
    """A row an offset and method; every scan starts as often as gives at least so many trials."""
    rows = []
    for off_m, off_deg, start in OFFSETS:
        starts = list(_trials(half, off_m, off_deg, np.random.default_rng([33, seed, int(100 * off_m)]), trials))
        for name, align in _aligners(half, start).items():
            rows.append({"off_m": off_m, "off_deg": off_deg, "method": name} | _measured(align, starts, off_m))
    return rows


def _aligners(half: Half, start: Start) -> dict[str, Aligner]:
    plain = LocaliserParameters()
    free = replace(plain, registration=replace(plain.registration, rules=WITHOUT_WHEELS))
    ours = {"ours": _ours(half, start, plain), "ours, without wheels": _ours(half, start, free)}
    return ours | {"small_gicp VGICP": _vgicp(half), "small_gicp GICP": _gicp(half)}


def _trials(half: Half, off_m: float, off_deg: float, rng: np.random.Generator, at_least: int) -> Iterator[_Trial]:
    repeats = ceil(at_least / len(half.driven))
    for number, scan in enumerate(half.driven):
        points, T_true = vehicle_points(half, scan)
        for repeat in range(repeats):
            yield _Trial(points, T_true, T_true @ _offset(rng, off_m, off_deg if (number + repeat) % 2 else -off_deg))


def vehicle_points(half: Half, scan: Scan) -> tuple[F64, F64]:
    """(N, 3) points of a scan in the vehicle frame, sweep motion removed, and its pose by the track."""
    return posed(scan, half.scene.poses, half.scene.T_vehicle_lidar, reference_ns(scan))


def _offset(rng: np.random.Generator, off_m: float, off_deg: float) -> F64:
    direction = rng.uniform(0.0, 2.0 * np.pi)
    move = off_m * np.array([np.cos(direction), np.sin(direction), 0.0])
    return T_from_R_t(exp_so3([0.0, 0.0, np.radians(off_deg)]), move)


def _measured(align: Aligner, trials: list[_Trial], off_m: float) -> dict[str, Any]:
    align(trials[0].points, trials[0].T_true, off_m)  # kernels and caches are warm then
    errors, doubted, times_s = list[tuple[float, float]](), list[bool](), list[float]()
    for trial in trials:
        begin_s = perf_counter()
        T, doubt = align(trial.points, trial.start, off_m)
        times_s.append(perf_counter() - begin_s)
        errors.append(pose_error(T, trial.T_true))
        doubted.append(doubt)
    off, turned = np.array(errors).T
    converged = (off <= CONVERGED_M) & (turned <= CONVERGED_DEG)
    return {
        "trials": len(trials),
        "converged": float(converged.mean()),
        "not_and_said_so": float((~converged & doubted).mean()),
        "not_and_silent": float((~converged & ~np.array(doubted)).mean()),
        "error_m_p50": float(np.median(off[converged])) if converged.any() else None,
        "error_deg_p50": float(np.median(turned[converged])) if converged.any() else None,
        "ms_p50": 1e3 * float(np.median(times_s)),
    }


def pose_error(T: F64, T_true: F64) -> tuple[float, float]:
    """Horizontal metres and degrees of the whole turn."""
    off = T_inverse(T_true) @ T
    return float(np.hypot(off[0, 3], off[1, 3])), float(np.degrees(np.linalg.norm(log_so3(off[:3, :3]))))


def _ours(half: Half, start: Start, parameters: LocaliserParameters) -> Aligner:
    cache = MatchMapCache(half.local_map, parameters.registration.noise_m)
    return on_map(cache.near, start, parameters)


def on_map(near: Callable[[F64], MatchMap], start: Start, parameters: LocaliserParameters) -> Aligner:
    """Our registration on the map that `near` gives for a place."""

    def align(points: F64, T: F64, _off_m: float) -> tuple[F64, bool]:
        chosen = sample_scan(points, parameters.sampling)
        try:
            found = register(points[chosen], T, near(T[:3, 3]), parameters.registration, start)
        except RegistrationError:
            return T, True
        return found.T_map_vehicle, not found.converged or len(found.degenerate) > 0

    return align


def _vgicp(half: Half) -> Aligner:
    target = small_gicp.GaussianVoxelMap(1.0)
    target.set_lru(horizon=1_000_000, clear_cycle=1_000_000)
    target.insert(half.target)

    def align(points: F64, T: F64, _off_m: float) -> tuple[F64, bool]:
        cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=SOURCE_M)
        found = small_gicp.align(target, cloud, init_T_target_source=T, max_iterations=50)
        return np.asarray(found.T_target_source), not found.converged

    return align


def _gicp(half: Half) -> Aligner:
    return lambda points, T, off_m: gicp(half, points, T, off_m + 1.0)
