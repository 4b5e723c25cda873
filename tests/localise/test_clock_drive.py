"""The whole localiser on a drive whose wheels and gyro are stamped by another clock, and on one with a wrong header."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from replay import grid_frame_of, map_of, reference_of

from fleet_sim.drives import PERFECT, DriveConfig, DriveSimulation, simulate_drive
from fleet_sim.street import street
from gnd_map.motion import Trajectory
from schemas.drive import DriveItem, GnssFix, MotionSample, Scan
from vehicle_agent.local_map import LocalMap
from vehicle_agent.localise import Localiser, PoseEstimate, localisation_error

SEED = 1207  # of no street on which anything was tuned
SCANS = 130


@dataclass(frozen=True)
class Recorded:
    """A drive that brakes, accelerates and swerves, and the map that it drives on."""

    items: list[DriveItem]
    T_vehicle_lidar: np.ndarray
    reference: Trajectory
    local_map: LocalMap


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder, world = tmp_path_factory.mktemp("clock"), street(SEED)
    mapping = DriveConfig("mapper", "HDL-32E", "before", car_share=0.0, errors=PERFECT, cruise_mps=13.0, seed=1)
    path = simulate_drive(world, mapping, folder / "map.mcap")
    drive = DriveSimulation(world, DriveConfig("car", "VLP-16", "after", cruise_mps=8.5, seed=2, scans=SCANS))
    brisk = replace(
        drive.motion.style, wave_mps=3.5, wave_radps=0.6, start_share=0.8, wander_m=0.9, wander_length_m=50.0
    )
    drive.motion = replace(drive.motion, style=brisk)
    grid_frame = grid_frame_of(path)
    reference = reference_of(path)
    times = drive._times(100)  # the truth of this drive, which no recording holds
    T = drive.motion.T_map_vehicle(times[1])
    assert len(reference) > 0
    return Recorded(
        [item for item in drive.items() if isinstance(item, Scan | MotionSample | GnssFix)],
        drive.header().T_vehicle_lidar,
        Trajectory(times[0], T),
        map_of([path], grid_frame),
    )


@dataclass(frozen=True)
class Run:
    localiser: Localiser
    refined: list[PoseEstimate]
    online: list[PoseEstimate]


def driven(recorded: Recorded, offset_s: Callable[[float], float], T_vehicle_lidar: np.ndarray | None = None) -> Run:
    """Localise with motion samples stamped late by `offset_s` of the time since the start."""
    start_ns, localiser = (
        recorded.items[0].t_ns,
        Localiser(recorded.local_map, recorded.T_vehicle_lidar if T_vehicle_lidar is None else T_vehicle_lidar),
    )
    items = [
        replace(item, t_ns=item.t_ns + round(offset_s((item.t_ns - start_ns) * 1e-9) * 1e9))
        if isinstance(item, MotionSample) else item
        for item in recorded.items
    ]  # fmt: skip
    refined: list[PoseEstimate] = []
    online: list[PoseEstimate] = []
    for item in sorted(items, key=lambda item: item.t_ns):
        match item:
            case MotionSample():
                localiser.push_motion(item)
            case GnssFix():
                localiser.push_gnss(item)
            case Scan():
                refined += [scan.estimate for scan in localiser.push_scan(item)]
        if localiser.online is not None and (not online or online[-1].t_ns != localiser.online.t_ns):
            online.append(localiser.online)
    return Run(localiser, refined + [scan.estimate for scan in localiser.flush()], online)


@pytest.mark.slow
@pytest.mark.parametrize("offset_ms", [-50, -20, 0, 10, 50])
def test_a_clock_that_is_off_is_found_and_does_no_harm(recorded, offset_ms):
    """Before: 0.4 to 1.2 m at ±50 ms, every pose called good."""
    run = driven(recorded, lambda _: offset_ms * 1e-3)
    calibration = run.localiser.calibration
    assert calibration.time_offset_s == pytest.approx(offset_ms * 1e-3, abs=5e-3)
    assert calibration.time_offset_sigma_s < 5e-3
    assert calibration.clock_doubt == "none"
    for poses, most_m in ((run.refined, 0.02), (run.online, 0.05)):
        error = localisation_error(poses, recorded.reference)
        assert error.longitudinal_p95_m < most_m
        assert error.lateral_p95_m < 0.03
        assert error.heading_p95_deg < 0.08
    assert sum(pose.health != "good" for pose in run.refined) <= 0.03 * len(run.refined)


@pytest.mark.slow
@pytest.mark.parametrize("offset_s", [lambda _: 0.15, lambda t: 0.006 * t], ids=["150 ms", "6 ms a second"])
def test_a_clock_that_is_none_of_this_vehicle_is_said(recorded, offset_s):
    run = driven(recorded, offset_s)
    late = [pose for pose in run.online if pose.t_ns - run.online[0].t_ns > 8e9]
    said = [pose for pose in late if (pose.health, pose.cause) == ("degraded", "clock")]
    assert len(said) > 0.8 * len(late)


@pytest.mark.slow
def test_a_header_that_puts_the_lidar_on_the_ground_is_said_at_once(recorded):
    header = recorded.T_vehicle_lidar.copy()
    header[2, 3] = 0.0
    run = driven(recorded, lambda _: 0.0, header)
    assert run.localiser.calibration.mount_doubtful == ("height",)
    assert run.localiser.calibration.mount.height_m == pytest.approx(recorded.T_vehicle_lidar[2, 3], abs=0.05)
    late = [pose for pose in run.online if pose.t_ns - recorded.items[0].t_ns > 3e9]
    assert not any(pose.health == "good" for pose in late + run.refined[20:])
