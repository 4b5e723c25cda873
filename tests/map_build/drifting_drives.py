"""Drives whose reference poses drift as LiDAR odometry does, and what is true of them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation
from gnd.fleet_sim.world import World
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, exp_so3
from gnd.schemas.drive import ReferencePose
from gnd.schemas.drive_mcap import DriveWriter


@dataclass(frozen=True)
class MapDrift:
    """Errors of odometry: of scale, and of heading, pitch and height by the root of the way."""

    scale: float = 0.003
    yaw_deg_root_m: float = 0.03
    tilt_deg_root_m: float = 0.01
    start_m: float = 0.0
    start_deg: float = 0.0


def drifted(poses: Trajectory, drift: MapDrift, seed: int) -> Trajectory:
    """The track as odometry would have it: it begins at the truth (or beside it) and goes astray from there."""
    rng = np.random.default_rng([91, seed])
    steps = T_inverse(poses.T_dst_vehicle[:-1]) @ poses.T_dst_vehicle[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1)
    turn = np.radians([drift.tilt_deg_root_m, drift.tilt_deg_root_m, drift.yaw_deg_root_m])
    noise = rng.standard_normal((len(steps), 3)) * turn * np.sqrt(length)[:, None]
    steps[:, :3, 3] *= 1.0 + drift.scale
    steps[:, :3, :3] = steps[:, :3, :3] @ exp_so3(noise)
    T = poses.T_dst_vehicle[0].copy()
    T[:3, :3] = exp_so3([0.0, 0.0, np.radians(drift.start_deg)]) @ T[:3, :3]
    T[:2, 3] += drift.start_m * np.array([0.8, -0.6])
    found = [T]
    for step in steps:
        found.append(found[-1] @ step)
    return Trajectory(poses.t_ns, np.stack(found))


def drift_drive(world: World, config: DriveConfig, path: Path, drift: MapDrift) -> Trajectory:
    """Write a drive with drifting reference poses; give the true ones."""
    simulation = DriveSimulation(world, config)
    t_s = np.arange(-0.1, simulation.scans / config.model.rate_hz + 0.3, 0.1)
    truth = Trajectory(config.start_ns + np.round(t_s * 1e9).astype(np.int64), simulation.motion.T_map_vehicle(t_s))
    wrong = drifted(truth, drift, config.seed)
    with DriveWriter(path, simulation.header()) as writer:
        for t, T in zip(wrong.t_ns.tolist(), wrong.T_dst_vehicle, strict=True):
            writer.add(ReferencePose(t, T))
        for item in simulation.items():
            if not isinstance(item, ReferencePose):
                writer.add(item)
    return truth


def relative_errors(tracks: list[Trajectory], truths: list[Trajectory]) -> np.ndarray:
    """(N,) horizontal distance [m] of all poses from the truth, after the best common rigid motion is taken off."""
    found = np.concatenate([t.at(truth.t_ns)[:, :3, 3] for t, truth in zip(tracks, truths, strict=True)])
    true = np.concatenate([truth.T_dst_vehicle[:, :3, 3] for truth in truths])
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    return np.asarray(np.linalg.norm((a @ exp_so3([0.0, 0.0, yaw]).T - b)[:, :2], axis=1))
