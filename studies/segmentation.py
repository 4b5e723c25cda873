"""How well moving objects are told from what stands: simulated drives with traffic, every sensor, labels of the world.

`movers that stay` is the share of the points on something that moves while the scan is taken that are not called
moving; `standing that goes` the share of all other points that are (parked cars, trees, ground, and cars and people
that have just stopped). Points up to 50 m, with the true poses and with poses that are wrong by 4 cm and 0.08° a scan.
Worlds and drives were not used for tuning. The labels go from the simulator to this benchmark, not to the vehicle.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from math import radians
from time import process_time

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.drives import PERFECT, DriveConfig, DriveSimulation
from gnd.fleet_sim.sensors import MODELS, SHORT_NAMES
from gnd.fleet_sim.street import street
from gnd.fleet_sim.traffic import Traffic
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import exp_so3, transform
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.segment import MotionSegmenter, SegmentedScan, SegmentParameters
from studies.frame.measure import Figure
from studies.frame.scans import rays

SEEDS = (201, 202, 203)
SECONDS = 8.0
POSES = {"true poses": (0.0, 0.0), "4 cm, 0.08°": (0.04, radians(0.08))}
NEAR_M, FAR_M = 2.0, 50.0

Mask = NDArray[np.bool_]


@dataclass(slots=True)
class SegmentationScore:
    """Counts of points and time over scans."""

    movers: int = 0
    movers_left: int = 0
    standing: int = 0
    standing_lost: int = 0
    scans: int = 0
    points: int = 0
    spent_s: float = 0.0

    def add(self, segmented: SegmentedScan, moves: Mask) -> None:
        """Count one scan against its labels (N,)."""
        scan = segmented.scan
        range_m = np.linalg.norm(scan.points_map_m - scan.origins_map_m, axis=1)
        judged = (range_m > NEAR_M) & (range_m < FAR_M)
        self.movers += int((moves & judged).sum())
        self.movers_left += int((moves & judged & ~segmented.moving).sum())
        self.standing += int((~moves & judged).sum())
        self.standing_lost += int((~moves & judged & segmented.moving).sum())
        self.scans += 1
        self.points += len(moves)

    @property
    def left_percent(self) -> float:
        """Mover points that survive."""
        return 100 * self.movers_left / max(self.movers, 1)

    @property
    def lost_percent(self) -> float:
        """Standing points that are lost."""
        return 100 * self.standing_lost / max(self.standing, 1)

    @property
    def ms(self) -> float:
        """Time a scan."""
        return 1e3 * self.spent_s / max(self.scans, 1)


def run() -> list[Figure]:
    """Measure every sensor with both kinds of poses."""
    figures: list[Figure] = []
    for short, sensor in SHORT_NAMES.items():
        scores = {name: SegmentationScore() for name in POSES}
        for seed in SEEDS:
            labelled = list(labelled_scans(sensor, seed))
            for name, (sigma_m, sigma_rad) in POSES.items():
                score(moved(labelled, sigma_m, sigma_rad), scores[name])
        for name, found in scores.items():
            figures += _figures(f"{short}, {name}", found)
    return figures


def _figures(name: str, found: SegmentationScore) -> list[Figure]:
    detail = f"{found.movers:,} points on movers, {found.points / found.scans:,.0f} points a scan"
    return [
        Figure(f"movers that stay, {name}", found.left_percent, "%", detail),
        Figure(f"standing that goes, {name}", found.lost_percent, "%", f"{found.ms:.1f} ms a scan (CPU)"),
    ]


def score(
    labelled: Iterator[tuple[RefinedScan, Mask]], found: SegmentationScore, parameters: SegmentParameters | None = None
) -> None:
    """Segment the scans of one drive and count; labels wait beside the scans, and are never shown to the segmenter."""
    segmenter, waiting = MotionSegmenter(parameters), deque[Mask]()
    for scan, moves in labelled:
        waiting.append(moves)
        start_s = process_time()
        done = segmenter.push(scan)
        found.spent_s += process_time() - start_s
        for segmented in done:
            found.add(segmented, waiting.popleft())
    for segmented in segmenter.flush():
        found.add(segmented, waiting.popleft())


def labelled_scans(sensor: str, seed: int, seconds: float = SECONDS) -> Iterator[tuple[RefinedScan, Mask]]:
    """Scans of a drive through lively traffic with their true poses, and which points (N,) move."""
    world = street(seed)
    scans = round(seconds * MODELS[sensor].rate_hz)
    config = DriveConfig("car", sensor, seed=seed, errors=PERFECT, traffic=Traffic.urban(), scans=scans)
    simulation = DriveSimulation(world, config)
    t_s = np.arange(-0.1, seconds + 0.3, 0.01)
    poses = Trajectory(config.start_ns + np.round(t_s * 1e9).astype(np.int64), simulation.motion.T_map_vehicle(t_s))
    labels: list[Mask] = []
    for item in simulation.items(on_labels=lambda _, moves: labels.append(moves)):
        if isinstance(item, Scan):
            yield _refined(item, poses, config.T_vehicle_lidar), labels.pop()


def _refined(scan: Scan, poses: Trajectory, T_vehicle_lidar: NDArray[np.float64]) -> RefinedScan:
    """The scan as localisation would give it, were it perfect."""
    t_ns = scan.t_ns + int(scan.t_offset_ns.max(initial=0)) // 2
    estimate = PoseEstimate(t_ns, poses.at(t_ns), 0.01, 0.001, 0.9, "good")
    return RefinedScan(t_ns, *rays(scan, poses, T_vehicle_lidar, t_ns), estimate)


def moved(
    labelled: list[tuple[RefinedScan, Mask]], sigma_m: float, sigma_rad: float
) -> Iterator[tuple[RefinedScan, Mask]]:
    """The scans with poses that are wrong by one standard deviation on each axis, drawn for each scan."""
    rng = np.random.default_rng(0)
    for scan, moves in labelled:
        T = scan.estimate.T_map_vehicle
        error = np.eye(4)
        error[:3, :3], error[:3, 3] = exp_so3(sigma_rad * rng.standard_normal(3)), sigma_m * rng.standard_normal(3)
        E = T @ error @ np.linalg.inv(T)
        estimate = PoseEstimate(scan.t_ns, E @ T, 0.01, 0.001, 0.9, "good")
        yield RefinedScan(scan.t_ns, transform(E, scan.points_map_m), transform(E, scan.origins_map_m), estimate), moves
