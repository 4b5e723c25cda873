"""Scans that wait for their final pose: half the bytes, and nothing that detection could notice."""

import numpy as np
import pytest
from yard import pose

from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import transform
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.localise.packed_scan import MAX_REACH_M, pack

SWEEP_NS = 100_000_000
MOUNT = pose(1.2, 0.1, 5.0, roll_deg=1.0, z=1.9)


def scan_of(reach_m, n=4000, bad=0):
    rng = np.random.default_rng(3)
    points = rng.uniform(-reach_m, reach_m, (n, 3)).astype(np.float32)
    scan = Scan(1_000, points, np.sort(rng.integers(0, SWEEP_NS, n)).astype(np.uint32))
    points[:bad, 1] = np.nan  # as they come where nobody has checked them
    return scan


def sweep():
    t_ns = np.linspace(-10_000_000, SWEEP_NS + 20_000_000, 14).astype(np.int64)
    return Trajectory(t_ns, np.stack([pose(12e-9 * t, 0.5e-9 * t, 3e-8 * t) for t in t_ns]))


def plain(scan, reference_ns, T_map_vehicle):
    """The way over gnd_map: deskewed points, and a LiDAR at the vehicle's pose at each point's time."""
    finite = np.isfinite(scan.points_m).all(axis=1)
    args = (scan.t_offset_ns[finite], scan.t_ns, sweep(), MOUNT, reference_ns)
    ends = deskew(scan.points_m[finite], *args)
    starts = deskew(np.zeros((int(finite.sum()), 3), np.float32), *args)
    return transform(T_map_vehicle, ends), transform(T_map_vehicle, starts)


@pytest.mark.parametrize(("reach_m", "limit_m"), [(60.0, 0.0017), (120.0, 0.0034), (2 * MAX_REACH_M, 3e-5)])
def test_rays_lie_where_the_plain_way_puts_them(reach_m, limit_m):
    """Half a step each axis: at 60 m 0.9 mm, at 120 m 1.8 mm; beyond what 16 bits hold, nothing is rounded."""
    scan, T, reference_ns = scan_of(reach_m, bad=7), pose(30.0, -20.0, 40.0), 1_000 + SWEEP_NS // 2
    ends, starts = pack(scan).placed(sweep(), MOUNT, reference_ns, T).restore()
    want_ends, want_starts = plain(scan, reference_ns, T)
    assert ends.shape == want_ends.shape == (3993, 3)
    assert np.abs(starts - want_starts).max() < 2e-5  # a tick is 2 µs, the vehicle does 12 m/s
    assert np.linalg.norm(ends - want_ends, axis=1).max() < limit_m


@pytest.mark.parametrize("reach_m", [120.0, 2 * MAX_REACH_M])
def test_rays_from_their_centre_are_those_of_the_map_frame(reach_m):
    rays = pack(scan_of(reach_m)).placed(sweep(), MOUNT, 1_000, pose(812.0, -4711.0, 40.0))
    ends, starts = rays.restore()
    points, origins = rays.from_centre()
    some = np.array([0, 7, 7, len(rays) - 1])
    np.testing.assert_array_equal(rays.points_at(some), points[some])
    assert points.dtype == origins.dtype == np.float32
    assert len(rays) == len(points)
    np.testing.assert_array_equal(points, rays.points_m)
    np.testing.assert_allclose(points + rays.centre_m, ends, atol=2e-5)
    np.testing.assert_allclose(origins + rays.centre_m, starts, atol=1e-6)
    assert np.linalg.norm(starts - rays.centre_m, axis=1).max() < 1.0, "12 m/s, half a sweep"


def test_a_packed_scan_is_half_as_large():
    scan = scan_of(100.0)
    assert pack(scan).nbytes == (scan.points_m.nbytes + scan.t_offset_ns.nbytes) // 2


def test_a_scan_of_no_finite_point_is_empty():
    packed = pack(scan_of(50.0, n=60, bad=60))
    assert len(packed) == 0
    ends, starts = packed.placed(sweep(), MOUNT, 1_000, np.eye(4)).restore()
    assert ends.shape == starts.shape == (0, 3)


def test_slow_sweeps_keep_their_times_within_half_a_tick():
    """A sweep of a second has ticks of 15 µs: at 12 m/s 0.1 mm."""
    offset_ns = np.array([0, 333_333_333, 999_999_999], np.uint32)
    packed = pack(Scan(0, np.ones((3, 3), np.float32), offset_ns))
    kept_ns = packed.ticks.astype(np.int64) * packed.tick_ns
    assert np.abs(kept_ns - offset_ns.astype(np.int64)).max() <= packed.tick_ns / 2 <= 10_000
