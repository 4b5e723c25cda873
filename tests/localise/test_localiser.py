"""The localiser as the agent drives it: through a yard, with everything that can go wrong on the way."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from yard import FRAME, GROUND_M, local_map_of, match_map_of, offset, pose, seen_from

from gnd.gnd_map.se3 import T_inverse, transform
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.localise import Localiser, LocaliserParameters
from gnd.vehicle_agent.localise.parameters import GraphParameters, RefineParameters, RegistrationParameters
from gnd.vehicle_agent.localise.registration import fit_of

S = 1_000_000_000
SWEEP_NS = S // 10
SLICES = 5
MOUNT = pose(1.2, 0.0, 0.0, z=1.9)
SPEED_MPS, RADIUS_M = 5.0, 9.0
SHORT = RefineParameters(every_m=2.0, length_m=10.0, lag_m=1.0, longest_s=1.0)  # stretches that a yard has room for
PARAMETERS = LocaliserParameters(graph=GraphParameters(lag_s=1.0), refine=SHORT)


def true_pose(t_ns):
    """A circle around the yard's middle."""
    angle = SPEED_MPS / RADIUS_M * t_ns / S
    return pose(RADIUS_M * np.sin(angle), -1.0 - RADIUS_M * np.cos(angle), np.degrees(angle))


def elsewhere(t_ns):
    """The same circle, 14 m farther east."""
    T = true_pose(t_ns)
    T[0, 3] += 14.0
    return T


@pytest.fixture(scope="module")
def sweep(yard_points):
    """A scan whose slices are seen one after the other from the moving vehicle; made once for each time."""

    @cache
    def make(where, t_ns, n=5000):
        rng, parts, offsets = np.random.default_rng(t_ns), [], []
        for k in range(SLICES):
            at_ns = (2 * k + 1) * SWEEP_NS // (2 * SLICES)
            parts.append(seen_from(rng, yard_points[k::SLICES], where(t_ns + at_ns) @ MOUNT, n // SLICES))
            offsets.append(np.full(len(parts[-1]), at_ns))
        return Scan(t_ns, np.concatenate(parts).astype(np.float32), np.concatenate(offsets).astype(np.uint32))

    return make


def fix_at(T_map_vehicle, t_ns, away=(1.5, -1.0, 2.0), sigma_m=2.5):
    lat, lon, height = FRAME.geodetic_from_enu(T_map_vehicle[:3, 3] + away)
    return GnssFix(t_ns, float(lat), float(lon), float(height), sigma_m)


@pytest.fixture(scope="module")
def drive(sweep):
    """Feeds seconds of driving to a localiser and gives the scans that became final."""

    def run(localiser, first_s, last_s, *, where=true_pose, scale=1.004, bias=2e-3, gnss=fix_at, scans=True):
        final = []
        for k in range(round(first_s * 50), round(last_s * 50)):
            t_ns = k * S // 50
            if k % 5 == 0:
                if gnss is not None and k % 10 == 0:
                    localiser.push_gnss(gnss(where(t_ns), t_ns))
                if scans:
                    final += localiser.take_scan(sweep(where, t_ns))
            localiser.push_motion(MotionSample(t_ns, SPEED_MPS / scale, SPEED_MPS / RADIUS_M + bias))
        return final

    return run


def assert_right(final, where=true_pose, metres=0.03, degrees=0.15):
    assert final
    for scan in final:
        off_m, off_deg = offset(where(scan.t_ns), scan.estimate.T_map_vehicle)
        assert off_m < metres
        assert off_deg < degrees


@pytest.fixture
def localiser(yard_map):
    return Localiser(yard_map, MOUNT, PARAMETERS)


def test_a_drive_gives_every_scan_once_and_in_order(localiser, drive):
    final = drive(localiser, 0.0, 4.0)
    assert len(final) < 40  # the last second is not final yet
    final += list(localiser.flush())
    assert [scan.t_ns for scan in final] == sorted(scan.t_ns for scan in final)
    assert len(final) == 40 - localiser.dropped_scans
    assert localiser.dropped_scans <= 1
    assert_right(final)
    assert {scan.estimate.cause for scan in final[:8]} <= {
        "none",
        "unconfirmed",
    }  # the first metres may still be elsewhere
    assert all(scan.estimate.health == "good" and scan.estimate.matching_ratio > 0.9 for scan in final[8:])
    assert list(localiser.flush()) == []


def test_points_lie_on_the_map_and_rays_begin_at_the_sensor(localiser, drive):
    final = drive(localiser, 0.0, 3.0)
    scan = final[-1]
    on_ground = scan.points_map_m[np.abs(scan.points_map_m[:, 2] - GROUND_M) < 0.15]
    assert len(on_ground) > 1000
    assert np.abs(np.median(on_ground[:, 2]) - GROUND_M) < 0.01
    assert scan.points_map_m.shape == scan.origins_map_m.shape
    first = true_pose(scan.t_ns - 4 * SWEEP_NS // 10) @ MOUNT  # the first slice is seen before the reference time
    assert np.linalg.norm(scan.origins_map_m[0] - first[:3, 3]) < 0.05
    assert np.linalg.norm(scan.origins_map_m[0] - scan.origins_map_m[-1]) == pytest.approx(0.4 * 1.01, abs=0.05)


def test_sweep_motion_is_removed(localiser, yard_map, drive, sweep):
    """Half a metre of motion a sweep: left in, points miss the surfaces; taken out, they lie on them."""
    scan, m, parameters = drive(localiser, 0.0, 3.0)[-1], match_map_of(yard_map), RegistrationParameters()
    T = true_pose(scan.t_ns)
    raw = transform(MOUNT, sweep(true_pose, scan.t_ns - SWEEP_NS * 9 // 20).points_m)
    removed = transform(T_inverse(T), scan.points_map_m)
    fit, fit_raw = (fit_of(points[points[:, 2] > 0.5], T, m, parameters) for points in (removed, raw))
    assert fit > 0.85
    assert fit_raw < 0.7


def test_wheel_scale_and_gyro_bias_are_learnt(localiser, drive):
    drive(localiser, 0.0, 8.0, scale=1.01, bias=3e-3)
    assert localiser.speed_scale == pytest.approx(1.01, abs=0.004)
    assert localiser.yaw_bias_radps == pytest.approx(3e-3, abs=1e-3)


def test_without_a_fix_nothing_is_found_and_scans_are_counted(localiser, drive):
    assert drive(localiser, 0.0, 1.0, gnss=None) == []
    assert list(localiser.flush()) == []
    assert localiser.online is None
    assert localiser.dropped_scans == 10


def test_without_a_map_nothing_is_found(drive):
    localiser = Localiser(local_map_of(np.empty((0, 3))), MOUNT)
    assert drive(localiser, 0.0, 1.0) == []
    assert localiser.online is None


def test_online_pose_follows_every_scan(localiser, drive):
    drive(localiser, 0.0, 2.0)
    online = localiser.online
    assert online is not None
    assert 2.0 * S - online.t_ns < 2 * SWEEP_NS
    off_m, off_deg = offset(true_pose(online.t_ns), online.T_map_vehicle)
    assert off_m < 0.05
    assert off_deg < 0.2
    assert 0.0 < online.sigma_m < 0.05
    assert 0.0 < online.sigma_rad < np.radians(0.1)


def test_scans_of_something_else_degrade_then_lose_the_pose_and_it_is_found_again(localiser, drive):
    """A curtain in front of the sensor for six seconds; nothing seen meanwhile may reach the evidence as good."""
    drive(localiser, 0.0, 2.0)
    curtain = np.random.default_rng(1).uniform([-4, -4, 2.5], [4, 4, 6.5], (4000, 3)).astype(np.float32)
    seen = []
    for k in range(100, 400):
        t_ns = k * S // 50
        if k % 5 == 0:
            seen += localiser.take_scan(Scan(t_ns, curtain, np.zeros(len(curtain), np.uint32)))
        localiser.push_motion(MotionSample(t_ns, SPEED_MPS / 1.004, SPEED_MPS / RADIUS_M + 2e-3))
        if k == 150:
            assert localiser.online.health == "degraded"
    assert localiser.online.health == "lost"
    assert all(scan.estimate.health != "good" for scan in seen if scan.t_ns > 3.2 * S)
    dropped = localiser.dropped_scans
    assert dropped > 10
    again = drive(localiser, 8.0, 12.0) + list(localiser.flush())
    assert localiser.initialisations == 2
    assert_right(again[5:])


def test_a_vehicle_that_was_carried_away_finds_itself(localiser, drive):
    """Towed 14 m between two scans: fixes and scans contradict the pose, which is lost, and found where it is."""
    drive(localiser, 0.0, 1.5)
    final = drive(localiser, 1.5, 9.0, where=elsewhere) + list(localiser.flush())
    assert localiser.initialisations == 2
    assert_right([scan for scan in final if scan.t_ns > 7 * S], where=elsewhere)


def test_dead_reckoning_bridges_scans_that_are_missing(localiser, drive):
    drive(localiser, 0.0, 4.0)
    drive(localiser, 4.0, 4.5, scans=False)
    final = drive(localiser, 4.5, 7.0) + list(localiser.flush())
    assert localiser.initialisations == 1
    assert_right(final)


def test_memory_is_bounded_by_the_lag(localiser, drive):
    drive(localiser, 0.0, 3.0)
    few = len(localiser._track.held)
    drive(localiser, 3.0, 6.0)
    assert len(localiser._track.held) <= few + 3 <= 25
    assert len(localiser._drive.motion) < 2100


@pytest.mark.parametrize("n", [0, 3])
def test_a_scan_of_no_or_few_points_does_no_harm(localiser, drive, n):
    drive(localiser, 0.0, 2.0)
    empty = Scan(2 * S, np.ones((n, 3), np.float32), np.zeros(n, np.uint32))
    list(localiser.take_scan(empty))
    final = drive(localiser, 2.1, 4.0) + list(localiser.flush())
    assert_right(final)


def test_a_scan_from_the_past_is_dropped(localiser, drive, sweep):
    drive(localiser, 0.0, 2.0)
    dropped = localiser.dropped_scans
    for t_ns in (S, 19 * SWEEP_NS):
        list(localiser.take_scan(sweep(true_pose, t_ns)))
    assert localiser.dropped_scans == dropped + 2
    final = drive(localiser, 2.0, 4.0) + list(localiser.flush())
    assert [scan.t_ns for scan in final] == sorted(scan.t_ns for scan in final)
    assert_right(final)


def test_points_that_are_not_finite_are_left_out(localiser, drive, sweep):
    drive(localiser, 0.0, 1.0)
    whole = sweep(true_pose, S)
    scan = replace(whole, points_m=whole.points_m.copy())
    scan.points_m[::3] = np.nan
    list(localiser.take_scan(scan))
    final = [s for s in drive(localiser, 1.1, 4.0) if s.t_ns // SWEEP_NS == 10]
    assert len(final) == 1
    assert len(final[0].points_map_m) == np.isfinite(scan.points_m).all(axis=1).sum()
    assert np.isfinite(final[0].points_map_m).all()


def test_without_motion_samples_a_standing_vehicle_still_localises(yard_map, yard_points):
    localiser, rng = Localiser(yard_map, MOUNT), np.random.default_rng(0)
    T = true_pose(0)
    for k in range(5):
        localiser.push_gnss(fix_at(T, k * SWEEP_NS))
        points = seen_from(rng, yard_points, T @ MOUNT, 6000).astype(np.float32)
        list(localiser.take_scan(Scan(k * SWEEP_NS, points, np.zeros(len(points), np.uint32))))
    final = list(localiser.flush())
    assert len(final) == 5
    assert max(offset(T, scan.estimate.T_map_vehicle)[0] for scan in final) < 0.02


def test_a_tile_that_arrives_on_the_way_is_used(yard_points, drive):
    """The map of the yard without what lies ahead; the tile comes while driving."""
    whole = local_map_of(yard_points)
    missing = whole.tiles[len(whole.tiles) // 2]
    tile = whole.tile(missing)
    whole.remove_tile(missing)
    localiser = Localiser(whole, MOUNT, PARAMETERS)
    final = drive(localiser, 0.0, 2.0)
    before = whole.count
    whole.set_tile(tile)
    final += drive(localiser, 2.0, 4.0) + list(localiser.flush())
    assert whole.count > before
    assert_right(final)
