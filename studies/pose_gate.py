"""What the gate on the vehicle lets through when poses are wrong: `python -m studies.pose_gate --seed 11`.

A simulated street of 120 m, scans at their true poses moved by an error that the vehicle does not know; on the map of
the street before. Prints a line for each error: voxels reported as changed, voxels observed, scans and tiles held back.
With `--shared`: what the cloud publishes of one vehicle and of two that share the error.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from gnd.fleet_sim.drives import PERFECT, DriveConfig, DriveSimulation
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.truth import make_truth
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.se3 import T_inverse, exp_so3, transform
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import ChangeReport
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import RefinedScan
from gnd.vehicle_agent.report.reporter import Identity, Reporter
from gnd.vehicle_agent.segment.segmenter import SegmentedScan
from studies.gated_merge import merged
from studies.simulation.options import PoseSource
from studies.simulation.poses import FromReference

ErrorAt = Callable[[float], F64]
"""The error (4, 4), vehicle axes, by the part of the drive that is done."""


def shift(forward_m: float = 0.0, left_m: float = 0.0, up_m: float = 0.0, yaw_deg: float = 0.0) -> F64:
    """(4, 4) an error of a pose in the vehicle's axes."""
    T = np.eye(4)
    T[:3, :3] = exp_so3(np.array([0.0, 0.0, np.radians(yaw_deg)]))
    T[:3, 3] = forward_m, left_m, up_m
    return T


ERRORS: dict[str, F64] = {
    "none": shift(), "5 cm left": shift(0.0, 0.05), "10 cm left": shift(0.0, 0.1), "20 cm left": shift(0.0, 0.2),
    "50 cm left": shift(0.0, 0.5), "1 m ahead": shift(1.0), "0.2 deg": shift(yaw_deg=0.2),
    "0.5 deg": shift(yaw_deg=0.5),
}  # fmt: skip


def always(error: F64) -> ErrorAt:
    """The same error (4, 4) all the way."""
    return lambda _: error


def drifting(forward_m: float, left_m: float) -> ErrorAt:
    """An error that grows from nothing to this."""
    return lambda done: shift(forward_m * done, left_m * done)


SHARED: dict[str, ErrorAt] = {
    "none": always(shift()),
    **{f"{off_m} m across": always(shift(0.3 * off_m, 0.95 * off_m)) for off_m in (0.2, 0.4, 0.8)},
    **{f"{turn_deg} deg": always(shift(yaw_deg=turn_deg)) for turn_deg in (0.5, 1.0)},
    "drifting to 0.8 m": drifting(0.24, 0.76),
    **{f"{up_m} m too high": always(shift(up_m=up_m)) for up_m in (0.1, 0.2, 0.5)},
}
"""What a whole fleet may have in common: firmware, a mount, half a map."""
PARTS = {"20 cm left": shift(0.0, 0.2), "1 m ahead": shift(1.0), "0.5 deg": shift(yaw_deg=0.5)}


def scans_of(seed: int, sensor: str, state: str, drive_seed: int = 3) -> tuple[LocalMap, list[RefinedScan]]:
    """The map of the street before, and a drive in `state` at its true poses."""
    world = street(seed, StreetOptions(120.0))
    before = make_truth(world).before
    local_map = LocalMap(GridFrame.around(world.frame, sorted(before)))
    for tile_id, gaussians in before.items():
        local_map.set_tile(Tile(tile_id, 1, gaussians))
    config = DriveConfig("car", sensor, "after" if state == "after" else "before", seed=drive_seed, errors=PERFECT)
    simulation = DriveSimulation(world, config)
    poses = FromReference(simulation.header(), local_map, PoseSource("true", 0.0, 0.0), 3)
    scans = [scan for item in simulation.items() for scan in poses.push(item)]
    return local_map, [*scans, *poses.flush()]


def reports_of(
    local_map: LocalMap, scans: list[RefinedScan], error_at: ErrorAt, *, gate: bool, vehicle: str = "car"
) -> tuple[Reporter, list[bytes]]:
    """The reporter of a drive whose poses are off, and its reports."""
    with tempfile.TemporaryDirectory() as folder:
        outbox = Outbox(Path(folder) / "outbox.sqlite")
        who = Identity(vehicle, "drive", "sensor", "ndt")
        reporter = Reporter(ChangeDetector(local_map), outbox, who, scans[0].t_ns, ReportParameters(check_poses=gate))
        for k, scan in enumerate(scans):
            one = _moved(scan, error_at(k / len(scans)))
            reporter.add_scan(one)
            reporter.leave_behind(one.scan.estimate, float(k))
        reporter.report_all(float(len(scans)))
        return reporter, [letter.body for letter in outbox.due(0, limit=1000)]


def drive(local_map: LocalMap, scans: list[RefinedScan], error_at: ErrorAt, *, gate: bool) -> str:
    """Report a drive whose poses are off; gives the account in a line."""
    reporter, bodies = reports_of(local_map, scans, error_at, gate=gate)
    tiles = [change for body in bodies for change in ChangeReport.decode(body).tiles]
    changed, observed = sum(len(c.changed) for c in tiles), sum(len(c.observed) for c in tiles)
    held_back = reporter.counts["scans_shifted"] + reporter.counts["scans_taken_back"]
    return (
        f"{changed:6d} changed of {observed:6d}; {held_back:3d} of {len(scans)} scans and "
        f"{reporter.counts['tiles_held_back']:2d} tiles held back; doubts {dict(reporter.doubts)}"
    )


def published(local_map: LocalMap, fleet: list[list[RefinedScan]], error_at: ErrorAt, *, gate: bool) -> str:
    """What the cloud makes of vehicles that share an error: of the first alone, and of all."""
    base = {tile: held.gaussians for tile in local_map.tiles if (held := local_map.tile(tile)) and held.version}
    reports = [
        reports_of(local_map, scans, error_at, gate=gate, vehicle=f"car-{number}")[1]
        for number, scans in enumerate(fleet)
    ]
    found = [merged(base, [body for own in reports[:n] for body in own]) for n in (1, len(fleet))]
    return "; ".join(
        f"{n} vehicle{'s' * (n > 1)}: {one.voxels:5d} published, waiting {dict(one.waiting)}, named {list(one.named)}"
        for n, one in zip((1, len(fleet)), found, strict=True)
    )


def _moved(scan: RefinedScan, error: F64) -> SegmentedScan:
    T = scan.estimate.T_map_vehicle
    M = T @ error @ T_inverse(T)
    pose = replace(scan.estimate, T_map_vehicle=T @ error, sigma_m=0.02, sigma_rad=0.001)
    moved = RefinedScan(scan.t_ns, transform(M, scan.points_map_m), transform(M, scan.origins_map_m), pose)
    return SegmentedScan(moved, np.zeros(len(moved.points_map_m), np.bool_))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m studies.pose_gate", description=__doc__)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--sensor", default="VLP-16")
    parser.add_argument("--state", choices=("before", "after"), default="before", help="after: the street is rebuilt")
    parser.add_argument("--shared", action="store_true", help="two vehicles with the same error, through the cloud")
    options = parser.parse_args()
    if options.shared:
        _shared(options.seed, options.sensor, options.state)
        return
    local_map, scans = scans_of(options.seed, options.sensor, options.state)
    for gate in (False, True):
        print(f"{'with' if gate else 'without'} the gate")
        for name, error in ERRORS.items():
            print(f"  {name:24s} {drive(local_map, scans, always(error), gate=gate)}")
    for name, error in PARTS.items():
        at = _third(error)
        print(f"  {name + ', middle third':24s} {drive(local_map, scans, at, gate=True)}")


def _shared(seed: int, sensor: str, state: str) -> None:
    local_map, first = scans_of(seed, sensor, state)
    _, second = scans_of(seed, sensor, state, drive_seed=4)
    for gate in (False, True):
        print(f"{'with' if gate else 'without'} the gate on the vehicle")
        for name, error_at in SHARED.items():
            print(f"  {name:20s} {published(local_map, [first, second], error_at, gate=gate)}", flush=True)


def _third(error: F64) -> ErrorAt:
    return lambda done: error if 1 / 3 < done < 2 / 3 else np.eye(4)


if __name__ == "__main__":
    main()
