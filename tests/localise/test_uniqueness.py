"""Is the pose the only one? Equal pillars, a smooth corridor, and what a wrong pose must never be called."""

import numpy as np
import pytest
from yard import FRAME, GROUND_M, corridor, local_map_of, match_map_of, pose, rectangle, seen_from, yard

from gnd.gnd_map.gaussian import full_matrices
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.localise import Localiser
from gnd.vehicle_agent.localise.first_pose import SearchPlace
from gnd.vehicle_agent.localise.health import HealthMonitor
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.parameters import (
    HealthParameters,
    LocaliserParameters,
    RegistrationParameters,
    UniquenessParameters,
)
from gnd.vehicle_agent.localise.registration import REGISTRATION_GATE_PER_SCALE
from gnd.vehicle_agent.localise.scan_pool import standing_points
from gnd.vehicle_agent.localise.uniqueness import ScanView, Uniqueness, ahead, ahead_of_both, fits_at, patches_of

PERIOD_M = 5.0
ODD_FROM_M = 40.0
"""From here on no two pillars are as far apart as any others."""
REACH_M = 14.0
STEP_M = 1.0


def pillars(rng):
    """(N, 3) two rows of equal pillars on level ground, evenly spaced for 100 m, then not."""
    parts = [rectangle(rng, (-70, -12, GROUND_M), (160, 0, 0), (0, 24, 0), 15)]
    even = np.arange(-60.0, ODD_FROM_M, PERIOD_M)
    odd = ODD_FROM_M + np.cumsum([2.3, 6.1, 3.4, 7.2, 2.9, 4.3, 6.6, 3.8])
    for y in (-6.2, 5.6):
        for x in [*even, *odd]:
            for corner, side in (
                ((x, y), (0.6, 0)),
                ((x, y + 0.6), (0.6, 0)),
                ((x, y), (0, 0.6)),
                ((x + 0.6, y), (0, 0.6)),
            ):
                parts.append(rectangle(rng, (*corner, GROUND_M), (*side, 0), (0, 0, 4), 90))
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def row():
    points = pillars(np.random.default_rng(3))
    return points, MatchMapCache(local_map_of(points), 0.04)


def drive_beside(scene, off_m, last_x_m, parameters=None):
    """Drive along x from 0 at poses that are `off_m` too far; gives x, whether proven, and margin, scan by scan."""
    points, maps = scene
    rng, unique = np.random.default_rng(1), Uniqueness(parameters or LocaliserParameters())
    told = []
    for k, x in enumerate(np.arange(0.0, last_x_m, STEP_M)):
        seen = standing_points(seen_from(rng, points, pose(x, 0.0, 0.0), 2500, REACH_M), 0.4)
        moved = pose(STEP_M if k else 0.0, 0.0, 0.0, z=0.0)
        place = SearchPlace(np.array([x + 2.0, -1.0, 0.0]), 2.5, 7.5)
        unique.see(seen, moved, pose(x + off_m, 0.0, 0.0), place, maps.near(np.array([x, 0.0, 0.0])))
        told.append((x, unique.proven, unique.margin, unique.beaten, unique.unconstrained_m))
    return told


def test_equal_pillars_prove_nothing_before_the_odd_ones_are_seen(row):
    told = drive_beside(row, 0.0, 62.0)
    assert told[-1][4] == 0.0  # pillars tell the place along, if not which
    first = min(x for x, proven, *_ in told if proven)
    assert first > ODD_FROM_M - REACH_M
    assert first < 62.0


@pytest.mark.parametrize("periods", [1, -1])
def test_a_pose_one_period_off_is_never_proven_and_is_beaten_at_last(row, periods):
    told = drive_beside(row, periods * PERIOD_M, 62.0)
    assert not any(proven for _, proven, *_ in told)
    assert told[-1][2] < -3.0
    assert told[-1][3]


def test_switched_off_it_asks_for_no_proof(row):
    off = LocaliserParameters(uniqueness=UniquenessParameters(enabled=False))
    assert all(proven for _, proven, *_ in drive_beside(row, PERIOD_M, 3.0, off))


def test_a_place_like_no_other_is_proven_at_once():
    rng = np.random.default_rng(2)
    points = yard(rng)
    unique, T = Uniqueness(LocaliserParameters()), pose(2.0, 1.0, 40.0)
    seen = standing_points(seen_from(rng, points, T, 2500), 0.4)
    unique.see(seen, np.eye(4), T, None, match_map_of(local_map_of(points)))
    assert unique.proven


def test_a_smooth_corridor_proves_nothing_but_does_not_take_a_proof_away():
    rng = np.random.default_rng(5)
    points = corridor(rng)
    m, unique = match_map_of(local_map_of(points)), Uniqueness(LocaliserParameters())
    see = lambda x: unique.see(  # noqa: E731
        standing_points(seen_from(rng, points, pose(x, 0, 0), 2500), 0.4),
        pose(STEP_M, 0, 0, z=0.0),
        pose(x, 0, 0),
        None,
        m,
    )
    for x in range(12):
        see(float(x))
    assert not unique.proven
    unique.proven = True
    for x in range(12, 45):
        see(float(x))
    assert unique.proven
    assert abs(unique.margin) < 2.0
    assert unique.unconstrained_m > 30.0  # odometry alone knows the place along
    unique.distrust(moved=True)
    assert not unique.proven


def test_odds_are_of_patches_not_of_points():
    few = np.array([0.5, 0.4, -0.3, 0.6])
    patches = np.arange(4)
    one = ahead(np.repeat(few, 10), np.repeat(patches, 10), 8)
    assert ahead(np.repeat(few, 1000), np.repeat(patches, 1000), 8) == pytest.approx(one)
    assert ahead(-np.repeat(few, 10), np.repeat(patches, 10), 8) == pytest.approx(-one)
    assert ahead(np.ones(1000), np.zeros(1000, np.int64), 8) < 1.0  # one car, however many points it has
    assert ahead(np.empty(0), np.empty(0, np.int64), 8) == 0.0


def test_where_nothing_is_kept_no_pose_is_ahead_more_often_than_chance():
    """Cars that come and go in slots: differences are as likely positive as negative."""
    rng, n = np.random.default_rng(8), 4000
    high = sum(
        ahead(rng.choice([-0.8, 0.0, 0.8], 40) * rng.uniform(0.2, 1.0, 40), np.arange(40), 1) > 3.0 for _ in range(n)
    )
    assert high / n < 0.005


def test_lamps_are_heard_among_cars():
    cars, lamps = np.repeat([-0.8, 0.8], 150), np.full(15, 0.8)
    difference, patches = np.concatenate([cars, lamps]), np.arange(315)
    high = patches >= 300
    assert ahead(difference, patches, 1) < 3.0
    assert ahead_of_both(difference, patches, high, 1) > 3.0
    assert ahead_of_both(-difference, patches, high, 1) < -3.0


def test_the_kernel_agrees_with_its_plain_twin():
    rng = np.random.default_rng(6)
    points = yard(rng)
    m, par, T = match_map_of(local_map_of(points)), RegistrationParameters(), pose(1.0, -2.0, 10.0)
    seen = np.concatenate([seen_from(rng, points, T, 300), rng.uniform(-80, 80, (100, 3))])
    scale2 = par.rules.scales[-1] ** 2
    expected = [plain_fit(T[:3, :3] @ p + T[:3, 3], m, scale2, REGISTRATION_GATE_PER_SCALE**2 * scale2) for p in seen]
    fits = fits_at(seen, T, m, par)
    assert fits == pytest.approx(expected, abs=1e-12)
    assert 0.3 < fits[:300].mean() < 1.0
    assert fits[300:].mean() < 0.1


def plain_fit(q, m, scale2, gate_m2):
    """Of one point: the nearest Gaussian of its voxel and the six beside it."""
    w = m.A @ q + m.b
    if (w < 1).any() or (w >= np.array(m.index.shape) - 1).any() or m.index[tuple(w.astype(int))] < -1:
        return 0.0
    beside = np.concatenate([np.zeros((1, 3), int), np.eye(3, dtype=int), -np.eye(3, dtype=int)])
    rows = [r for r in (m.index[tuple(w.astype(int) + s)] for s in beside) if r >= 0]
    m2 = [float((q - m.mean_m[r]) @ full_matrices(m.information[[r]])[0] @ (q - m.mean_m[r])) for r in rows]
    return scale2 / (scale2 + min(m2)) if m2 and min(m2) < gate_m2 else 0.0


def test_the_view_forgets_what_is_far_behind_and_keeps_height_and_tilt_of_the_track():
    view = ScanView(5.0, 1.0, 100)
    for x in range(12):
        tilted = pose(float(x), 0.0, 3.0 * (x == 11), pitch_deg=2.0, z=0.1 * x)
        view.push(np.array([[2.0, 0.0, 1.0]]), pose(1.0, 0.0, 0.0, z=0.0), tilted)
    points = view.points_m
    assert len(points) == 6
    assert points[0] == pytest.approx([2.0, 0.0, 1.0])
    assert points[1, 0] == pytest.approx(1.0, abs=0.05)  # the one before: seen a metre further back
    assert points[1, 2] == pytest.approx(1.0 - 0.1 - np.sin(np.radians(2.0)), abs=0.02)


def test_gnss_over_the_way_rules_out_the_opposite_heading():
    view = ScanView(25.0, 1.0, 100)
    for x in range(20):
        view.push(np.zeros((1, 3)), pose(1.0, 0, 0, z=0.0), pose(float(x), 0, 0))
        view.see_position(np.array([x + 3.0, 1.0, 0.0]), 7.5)
    own = pose(19.0, 0, 0)
    assert view.allowed(pose(16.0, 0, 0), own)
    assert not view.allowed(pose(30.0, 0, 0), own)
    assert not view.allowed(pose(19.0, 0, 180.0), own)


def test_patches_are_squares_of_the_ground():
    points = np.array([[0.1, 0.1, 0.0], [1.9, 1.9, 5.0], [2.1, 0.1, 0.0], [-0.1, 0.1, 0.0]])
    assert len(set(patches_of(points, 2.0))) == 3
    assert patches_of(points, 2.0)[0] == patches_of(points, 2.0)[1]


def test_nothing_else_makes_a_pose_good_that_is_not_the_only_one():
    monitor = HealthMonitor(HealthParameters(), 0)
    monitor.see_match(0.95, 0.95, np.empty((0, 6)))
    monitor.see_sigma(0.01, 1e-4)
    assert monitor.judge(0) == ("good", "none")
    monitor.unique, monitor.certain = False, True
    assert monitor.judge(0) == ("degraded", "unconfirmed")


S = 1_000_000_000
MOUNT = pose(1.2, 0.0, 0.0, z=1.9)
SPEED_MPS = 5.0


def localised_along(scene, off_m, seconds):
    """The localiser told, and trusted, that it starts `off_m` too far along the row: x, error along, and health of
    every online and every refined pose.
    """
    points, maps = scene
    localiser, rng = Localiser(maps.local_map, MOUNT), np.random.default_rng(4)
    at = lambda t_ns: pose(SPEED_MPS * t_ns / S, 0.0, 0.0)  # noqa: E731
    localiser.start_at(0, pose(off_m, 0.0, 0.0), trusted=True)
    online, refined = [], []
    told = lambda e: (at(e.t_ns)[0, 3], e.T_map_vehicle[0, 3] - at(e.t_ns)[0, 3], e.health)  # noqa: E731
    for k in range(round(seconds * 20)):
        t_ns = k * S // 20
        if k % 10 == 0:
            lat, lon, height = FRAME.geodetic_from_enu(at(t_ns)[:3, 3] + [2.0, -1.0, 0.0])
            localiser.push_gnss(GnssFix(t_ns, float(lat), float(lon), float(height), 2.5))
        if k % 4 == 0:
            seen = seen_from(rng, points, at(t_ns) @ MOUNT, 2500, REACH_M).astype(np.float32)
            refined += [told(one.estimate) for one in localiser.take_scan(Scan(t_ns, seen, np.zeros(2500, np.uint32)))]
            if localiser.online is not None:
                online.append(told(localiser.online))
        localiser.push_motion(MotionSample(t_ns, SPEED_MPS, 0.0))
    return online, refined + [told(one.estimate) for one in localiser.flush()]


@pytest.mark.parametrize("off_m", [0.0, PERIOD_M])
def test_the_localiser_calls_no_pose_good_before_it_has_seen_that_it_is_the_only_one(row, off_m):
    online, refined = localised_along(row, off_m, 12.4)
    assert not [one for one in online + refined if one[2] == "good" and abs(one[1]) > 0.44]
    assert not [x for x, _, health in online if health == "good" and x < ODD_FROM_M - REACH_M]
    if off_m == 0.0:
        assert online[-1][2] == "good"
