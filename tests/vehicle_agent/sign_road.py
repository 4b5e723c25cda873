"""A straight road along x with signs beside it: a drive whose truth is known, and what its camera says."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import atan2, hypot, radians

import numpy as np

from gnd.vehicle_agent.features.look import Look, MapFeatures
from gnd.vehicle_agent.features.slamcu import noise
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.sensor_model import SensorModel
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu
from gnd.vehicle_agent.features.view import CAMERA, Occlusion

PERIOD_S = 1.0 / 15.0
FEW = SlamcuParameters(particles=300)
NO_SHIFT = np.zeros(2)
CERTAIN = np.diag([1e-6, 1e-6, 1e-10])


@dataclass(frozen=True)
class Road:
    """What stands there, and how the camera errs."""

    standing: Sequence[tuple[float, float]]
    mapped: Sequence[tuple[float, float]] = ()
    kinds: Sequence[str] = ()
    range_m: float = 1.0
    bearing_deg: float = 2.5
    miss: float = 0.1
    false: float = 0.0
    speed_mps: float = 25.0
    start_m: float = 0.0
    end_m: float = 220.0

    def known(self) -> MapFeatures:
        n = len(self.mapped)
        xy = np.array(self.mapped, float).reshape(-1, 2)
        return MapFeatures(
            np.arange(1, n + 1), ("sign",) * n, xy, np.full(n, np.nan), np.tile(0.01 * np.eye(2), (n, 1, 1))
        )

    def poses(self) -> Iterator[tuple[int, np.ndarray]]:
        steps = int((self.end_m - self.start_m) / (self.speed_mps * PERIOD_S))
        for i in range(steps):
            yield i, np.array([self.start_m + i * self.speed_mps * PERIOD_S, 0.0, 0.0])

    def look(self, i: int, pose: np.ndarray, rng: np.random.Generator, *, hidden: Sequence[int] = ()) -> Look:
        found: list[tuple[float, float, str]] = []
        sigma_b = radians(self.bearing_deg)
        for j, (x, y) in enumerate(self.standing):
            r, b = hypot(x - pose[0], y - pose[1]), atan2(y - pose[1], x - pose[0]) - pose[2]
            if j not in hidden and bool(CAMERA.inside(np.array([r]), np.array([b]))[0]) and rng.random() >= self.miss:
                kind = self.kinds[j] if self.kinds else "sign"
                noise = rng.standard_normal(2)
                found.append((abs(r + self.range_m * noise[0]), b + sigma_b * noise[1], kind))
        found += [
            (80.0 * float(np.sqrt(rng.random())), radians(40.0) * (float(rng.random()) - 0.5), "sign")
            for _ in range(rng.poisson(self.false))
        ]
        columns = np.array([one[:2] for one in found], float).reshape(-1, 2)
        n = len(found)
        sigmas = (np.full(n, max(self.range_m, 1e-3)), np.full(n, max(sigma_b, 1e-4)))
        return Look(
            i * 66_666_667, columns[:, 0], columns[:, 1], *sigmas, tuple(one[2] for one in found)
        )  # fmt: skip


def driven(
    road: Road,
    seed: int = 0,
    parameters: SlamcuParameters = FEW,
    *,
    sigma_m: float = 0.5,
    sigma_deg: float = 0.5,
    hidden: Sequence[int] = (),
    occlusion: Occlusion | None = None,
    given: bool = False,
    sensor: SensorModel | None = None,
    yaw_rad: float = 0.0,
    share: float = 0.0,
) -> Slamcu:
    """A drive along the road: by the filter's own poses from an uncertain start, or by given ones.

    The camera is mounted `yaw_rad` off, and its ranges are too long by a `share` of them.
    """
    rng = np.random.default_rng([seed, 77])
    cov0 = np.diag([sigma_m**2, sigma_m**2, radians(sigma_deg) ** 2])
    start = np.array([road.start_m, 0.0, 0.0])
    off = np.zeros(3) if given else np.linalg.cholesky(cov0 + 1e-18 * np.eye(3)) @ rng.standard_normal(3)
    slamcu = Slamcu(parameters, road.known(), start + off, cov0, seed, sensor=sensor)
    scale, bias = noise.SCALE * rng.standard_normal(), noise.BIAS_RADPS * rng.standard_normal()
    for i, pose in road.poses():
        if given:
            slamcu.set_pose(pose, cov0)
        elif i:
            way, turn = np.sqrt(PERIOD_S) * np.array([noise.SPEED_M, noise.YAW_RAD]) * rng.standard_normal(2)
            speed = (road.speed_mps + way / PERIOD_S) / (1.0 + scale)
            slamcu.predict(PERIOD_S, speed, bias + turn / PERIOD_S)
        look = road.look(i, pose, rng, hidden=hidden)
        wrong = replace(look, range_m=look.range_m * (1.0 + share), bearing_rad=look.bearing_rad + yaw_rad)
        slamcu.look(wrong, CAMERA, occlusion)
    slamcu.decide()
    return slamcu
