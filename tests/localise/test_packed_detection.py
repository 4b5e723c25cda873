"""What packing costs detection: the same drive, its rays exact and from packed scans."""

from collections import Counter

import numpy as np
import pytest
from replay import grid_frame_of, map_of, reference_of

from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.motion import deskew
from gnd.gnd_map.se3 import transform
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.detect.classify import classify
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.localise.packed_scan import pack

SCANS = 60
CHANGED = (ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)


def exact(scan, sweep, mount, t_ns, T):
    args = (scan.t_offset_ns, scan.t_ns, sweep, mount, t_ns)
    ends, starts = deskew(scan.points_m, *args), deskew(np.zeros_like(scan.points_m), *args)
    return transform(T, ends), transform(T, starts)


def packed(scan, sweep, mount, t_ns, T):
    return pack(scan).placed(sweep, mount, t_ns, T).restore()


def classes_of(path, local_map, rays_of):
    """(tile, voxel) to class of everything that the drive saw."""
    detector, mount, reference = ChangeDetector(local_map), read_header(path).T_vehicle_lidar, reference_of(path)
    for scan in read_drive(path):
        if isinstance(scan, Scan):
            t_ns = scan.t_ns + int(scan.t_offset_ns.max()) // 2
            detector.add_scan(*rays_of(scan, reference, mount, t_ns, reference.at(t_ns)))
    found = {t: classify(e, detector.parameters) for t, e in detector.finish(local_map.tiles).items()}
    return {
        (t, int(v)): int(c)
        for t, decided in found.items()
        for v, c in zip(decided.evidence.voxel_id, decided.change_class, strict=True)
    }


@pytest.mark.slow
def test_packed_scans_find_the_same_changes(tmp_path):
    world = street(5)
    mapping = DriveConfig(
        "mapper", "HDL-32E", state="before", car_share=0.0, errors=PERFECT, seed=1, scans=3 * SCANS // 2
    )
    vehicle = DriveConfig("vehicle", "HDL-32E", state="after", seed=2, scans=SCANS)
    path = simulate_drive(world, mapping, tmp_path / "map.mcap")
    local_map = map_of([path], grid_frame_of(path))
    path = simulate_drive(world, vehicle, tmp_path / "vehicle.mcap")
    want, got = (classes_of(path, local_map, rays_of) for rays_of in (exact, packed))
    voxels = sorted(want.keys() | got.keys())
    changed = [v for v in voxels if want.get(v) in CHANGED or got.get(v) in CHANGED]
    differ = Counter((want.get(v), got.get(v)) for v in voxels if want.get(v) != got.get(v))
    differ_changed = sum(want.get(v) != got.get(v) for v in changed)
    print(f"{len(voxels)} voxels, {sum(differ.values())} differ; {len(changed)} changed, {differ_changed} differ")
    assert len(changed) > 100
    assert sum(differ.values()) <= 0.003 * len(voxels)
    assert differ_changed <= 0.01 * len(changed)
