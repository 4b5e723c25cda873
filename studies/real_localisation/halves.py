"""A map from part of a recording's scans, and the other part localised on it by the vehicle's own localiser.

The localiser gets what a vehicle has: speed and yaw rate (the recording's own, or as the importer makes them from the
track), and positions with one seeded error of `GNSS_SIGMA_M` an axis for the whole drive, so that the first pose must
be searched. Its final poses are held against two references: the LiDAR track that also made the map, and small_gicp
GICP of each scan on the points of the mapping scans, which shares no code with ours.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
import small_gicp
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M
from gnd.vehicle_agent.importers.splits import chosen_scans
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise import LocaliserParameters, PoseEstimate, localisation_error
from gnd.vehicle_agent.localise.parameters import WITHOUT_WHEELS, RefineParameters, RegistrationParameters
from gnd.vehicle_agent.tiles_at_hand import localising_on
from studies.real.drive import local_map_of
from studies.real.scene import RecordedScene, in_range

F64 = NDArray[np.float64]

SPLITS: Final = (("even", "odd"), ("first-half", "second-half"), ("second-half", "first-half"))
"""Interleaved, and apart: only what both halves saw from afar is the same place."""
TARGET_M: Final = 0.2
"""Points of the map for small_gicp: one in a cube of this edge."""
SOURCE_M: Final = 0.25
GICP_REACH_M: Final = 0.5
FAR_OFF_M: Final = 0.3
"""GICP's answer farther from the track than this is none (few points, a place without structure)."""


@dataclass(frozen=True, slots=True, eq=False)
class Half:
    """A map and the scans driven on it; `target` and `tree`: the map's points for small_gicp."""

    name: str
    scene: RecordedScene
    local_map: LocalMap
    driven: tuple[Scan, ...]
    target: Any
    tree: Any
    n_points: int

    @classmethod
    def of(cls, scene: RecordedScene, map_rule: str, drive_rule: str) -> "Half":
        """Part of the scans mapped at the poses of the track, another part to be driven."""
        mapped, driven = chosen_scans(map_rule, len(scene)), chosen_scans(drive_rule, len(scene))
        return cls.made(f"{map_rule} mapped, {drive_rule} driven", scene, mapped.tolist(), driven.tolist())

    @classmethod
    def made(cls, name: str, scene: RecordedScene, mapped: Sequence[int], driven: Sequence[int]) -> "Half":
        """The same from numbers of scans."""
        refined = [scene.refined(scene.scans[i]) for i in mapped]
        points = np.concatenate([scan.points_map_m[in_range(scan)] for scan in refined])
        target, tree = small_gicp.preprocess_points(points, downsampling_resolution=TARGET_M)
        local_map = local_map_of(scene, scene.accumulated(refined).finish())
        return cls(name, scene, local_map, tuple(scene.scans[i] for i in driven), target, tree, len(points))


@dataclass(frozen=True, slots=True, eq=False)
class LocalisedHalf:
    """Final poses of one run, and scans that got none."""

    estimates: tuple[PoseEstimate, ...]
    dropped: int
    searches: int


SEEDS: Final = (0, 1, 2)
"""Of the GNSS error."""
METHODS: Final = {  # the wheels stand on the road only as well as the recording tells where the LiDAR is mounted
    "with_submap": LocaliserParameters(),
    "without_submap": LocaliserParameters(refine=RefineParameters(enabled=False)),
    "without_submap_and_wheels": LocaliserParameters(
        registration=RegistrationParameters(rules=WITHOUT_WHEELS), refine=RefineParameters(enabled=False)
    ),
}


def localised(half: Half, seed: int, parameters: LocaliserParameters) -> LocalisedHalf:
    """The driven scans through the localiser."""
    scene, fixes = half.scene, _off(half.scene, seed)
    vehicle = localising_on(half.local_map, scene.header, fixes[0], parameters)
    items: list[MotionSample | GnssFix | Scan] = [*scene.motion, *fixes, *half.driven]
    estimates: list[PoseEstimate] = []
    for item in sorted(items, key=lambda item: (item.t_ns, isinstance(item, Scan))):
        estimates += vehicle.push(item).poses
    estimates += vehicle.finish().poses
    return LocalisedHalf(tuple(estimates), vehicle.localiser.dropped_scans, vehicle.localiser.initialisations)


def _off(scene: RecordedScene, seed: int) -> list[GnssFix]:
    """The fixes with one error for the whole drive."""
    frame = scene.grid_frame.frame
    east, north = np.random.default_rng([15, seed]).normal(0.0, GNSS_SIGMA_M, 2)
    rows = np.array([(fix.lat_rad, fix.lon_rad, fix.height_m) for fix in scene.gnss]).T
    lat, lon, height = frame.geodetic_from_enu(frame.enu_from_geodetic(*rows) + np.array([east, north, 0.0]))
    return [
        replace(fix, lat_rad=float(a), lon_rad=float(o), height_m=float(h), sigma_m=GNSS_SIGMA_M)
        for fix, a, o, h in zip(scene.gnss, lat, lon, height, strict=True)
    ]


def gicp_reference(half: Half) -> Trajectory | None:
    """T_map_vehicle of the driven scans by small_gicp on the map's points, from the track; None if none agrees."""
    found = []
    for scan in half.driven:
        refined = half.scene.refined(scan)
        T = refined.estimate.T_map_vehicle
        points = transform(T_inverse(T), refined.points_map_m[in_range(refined)])
        aligned, _ = gicp(half, points, T, GICP_REACH_M)
        if np.linalg.norm((T_inverse(T) @ aligned)[:3, 3]) <= FAR_OFF_M:
            found.append((refined.t_ns, aligned))
    return Trajectory(np.array([t for t, _ in found], np.int64), np.stack([T for _, T in found])) if found else None


def gicp(half: Half, points: F64, start: F64, reach_m: float) -> tuple[F64, bool]:
    """(4, 4) T_map_vehicle of points (N, 3) in the vehicle frame, and whether it did not converge."""
    cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=SOURCE_M)
    found = small_gicp.align(
        half.target, cloud, half.tree, start, max_correspondence_distance=reach_m, max_iterations=50
    )
    return np.asarray(found.T_target_source), not found.converged


def localisation_of(half: Half, seeds: Sequence[int] = SEEDS) -> dict[str, Any]:
    """Runs from several GNSS errors, pooled, against both references."""
    gicp_track = gicp_reference(half)
    references = {"track": half.scene.poses, "gicp": gicp_track}
    return {
        "name": half.name,
        "runs": len(seeds),
        "driven": len(half.driven) * len(seeds),
        "gaussians": int(half.local_map.count),
        **{name: _pooled([localised(half, seed, par) for seed in seeds], references) for name, par in METHODS.items()},
        "gicp_less_track": None if gicp_track is None else _errors(_as_estimates(gicp_track), half.scene.poses),
    }


def _pooled(found: Sequence[LocalisedHalf], references: dict[str, Trajectory | None]) -> dict[str, Any]:
    estimates = [estimate for one in found for estimate in one.estimates]
    good = [estimate for estimate in estimates if estimate.health == "good"]
    return {
        "localised": len(estimates),
        "health": _counted(e.health for e in estimates),
        "causes": _counted(e.cause for e in estimates),
        "degenerate": _counted(direction for e in estimates for direction in e.degenerate),
        "searches": [one.searches for one in found],
        "matching_ratio_p50": float(np.median([e.matching_ratio for e in estimates])) if estimates else None,
        "errors": {name: reference and _errors(good, reference) for name, reference in references.items()},
    }


def _errors(estimates: Sequence[PoseEstimate], reference: Trajectory) -> dict[str, Any] | None:
    """Of the poses called good, where the reference has a pose of the same scan."""
    known = set(reference.t_ns.tolist())
    at = [e for e in estimates if e.t_ns in known]
    return asdict(localisation_error(at, reference)) if at else None


def _as_estimates(found: Trajectory) -> list[PoseEstimate]:
    pairs = zip(found.t_ns, found.T_dst_vehicle, strict=True)
    return [PoseEstimate(int(t), T, 0.0, 0.0, 1.0, "good") for t, T in pairs]


def _counted(names: Iterable[str]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for name in names:
        counts[name] = counts.get(name, 0) + 1
    return counts
