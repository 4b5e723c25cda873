"""How long a step of SLAMCU takes: one look at 15 Hz with the motion before it, at the shipped number of particles.

A step is everything that happens from one look of the camera to the next: prediction for each sample of the wheels and
the gyro (50 Hz), fixes of the GNSS (1 Hz), association, existence, features, weights, resampling. The drives are those
of `gnd.fleet_sim.roads.motorway`, whole; beside the time stand the classes and the positions that it buys.
"""

from dataclasses import dataclass
from math import radians
from time import perf_counter
from typing import Final

import numpy as np

from gnd.fleet_sim.roads.drive import RoadDrive, drive_route
from gnd.fleet_sim.roads.motorway import motorway
from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu
from studies.frame.measure import Figure
from studies.frame.options import option, seeds
from studies.slamcu_study.driving import look_of, map_features, occlusion_of, sensor_view, sign_truth
from studies.slamcu_study.scores import SignScore, accuracy_of, score

PAPER_MS = 30.39
"""Section 6.1: mean, Core i5-4670."""


@dataclass(frozen=True, slots=True)
class SlamcuStepOptions:
    """What is timed."""

    seeds: tuple[int, ...] = seeds(11, 12, text="Of the motorways.")
    particles: tuple[int, ...] = option((0, 300, 3000), "Numbers of particles; 0: the shipped one.")
    km: float = option(20.0, "Length of each motorway.")


OPTIONS: Final = SlamcuStepOptions


def run(chosen: SlamcuStepOptions | None = None) -> list[Figure]:
    """Time whole drives."""
    chosen = chosen or SlamcuStepOptions()
    drives = [drive_route(motorway(seed, 1e3 * chosen.km), seed) for seed in chosen.seeds]
    return [_figure(drives, particles) for particles in chosen.particles]


def _figure(drives: list[RoadDrive], particles: int) -> Figure:
    number = particles or SlamcuParameters().particles
    parameters = SlamcuParameters(particles=number)
    timed = [timed_drive(drive, parameters) for drive in drives]
    steps_ms = np.concatenate([steps for _, steps in timed])
    scores = [scored(drive, slamcu) for drive, (slamcu, _) in zip(drives, timed, strict=True)]
    right = accuracy_of(np.sum([one.confusion for one in scores], axis=0))["overall"]
    error_m = np.concatenate([one.distance_m for one in scores])
    detail = (
        f"mean {steps_ms.mean():.2f}, 95 % {np.percentile(steps_ms, 95):.1f} ms of {len(steps_ms)} steps;"
        f" {right:.1f} % of classes right, new signs {error_m.mean():.2f} m off; paper {PAPER_MS} ms"
    )
    name = f"{number} particles{'' if particles else ', as shipped'}"
    return Figure(name, float(np.median(steps_ms)), "ms a step", detail)


def timed_drive(drive: RoadDrive, parameters: SlamcuParameters) -> tuple[Slamcu, F64]:
    """SLAMCU at the end of a drive that began 2 m and 2° uncertain, and the time of each step [ms]."""
    sigma = np.array([2.0, 2.0, radians(2.0)])
    start = drive.truth.poses[0] + sigma * np.random.default_rng(drive.seed).standard_normal(3)
    slamcu = Slamcu(parameters, map_features(drive.route), start, np.diag(sigma**2), drive.seed)
    view, steps_ms, spent_s, before_ns = sensor_view(drive.view), [], 0.0, int(drive.motion.t_ns[0])
    for t_ns, what, i in drive.events():
        look, occlusion = (look_of(drive.looks[i]), occlusion_of(drive, i)) if what == "look" else (None, None)
        begun_s = perf_counter()
        if what == "motion":
            speed, yaw_rate = float(drive.motion.speed_mps[i]), float(drive.motion.yaw_rate_radps[i])
            slamcu.predict((t_ns - before_ns) * 1e-9, speed, yaw_rate)
            before_ns = t_ns
        elif what == "gnss":
            slamcu.gnss(float(drive.gnss.xy_m[i, 0]), float(drive.gnss.xy_m[i, 1]), drive.gnss.sigma_m)
        elif look is not None:
            slamcu.look(look, view, occlusion)
        spent_s += perf_counter() - begun_s
        if look is not None:
            steps_ms.append(1e3 * spent_s)
            spent_s = 0.0
    return slamcu, np.array(steps_ms)


def scored(drive: RoadDrive, slamcu: Slamcu) -> SignScore:
    """Return how well the drive tells the signs."""
    known, new = slamcu.known_states(), slamcu.new_features()
    classes = np.array([int(one.feature_class) for one in known], np.uint8)
    ids = np.array([one.feature_id for one in known], np.int64)
    xy_m, cov_m2 = np.array([one.position_m for one in new]), np.array([one.cov_m2 for one in new])
    return score(sign_truth(drive.route), (ids, classes), (xy_m.reshape(-1, 2), cov_m2.reshape(-1, 2, 2)))
