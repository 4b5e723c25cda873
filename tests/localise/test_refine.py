"""Refined poses: each once, in order and in time; right where single scans are drawn aside; the online pose follows."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from yard import FRAME, GROUND_M, local_map_of, moved, offset, pose, seen_from

from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.localise import Localiser, LocaliserParameters
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.graph import SmoothedPose
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.parameters import (
    GraphParameters,
    RefineParameters,
    RegistrationParameters,
)
from gnd.vehicle_agent.localise.refine import REFINE_LEARNT_DEGPS, UNLEARNT_S, Refiner, between

S = 1_000_000_000
EVERY_NS = S // 10
SPEED_MPS, RADIUS_M = 5.0, 9.0
SPEED_SCALE, BIAS_RADPS = 1.004, 2e-3
MOUNT = pose(1.2, 0.0, 0.0, z=1.9)
SHORT = RefineParameters(every_m=2.0, length_m=10.0, lag_m=2.0, longest_s=1.5)  # stretches that a yard has room for
ALONG = exp_so3([0.0, 0.0, 0.3])  # from the yard's axes to the map's


def circle(t_ns):
    """A circle around the yard's middle."""
    angle = SPEED_MPS / RADIUS_M * t_ns / S
    return pose(RADIUS_M * np.sin(angle), -1.0 - RADIUS_M * np.cos(angle), np.degrees(angle))


def through(t_ns):
    """From one end of the yard to the other, with slight bends."""
    s = -32.0 + SPEED_MPS * t_ns / S
    x, y, _ = ALONG @ [s, 0.6 * np.sin(s / 9.0), 0.0]
    return pose(x, y, np.degrees(0.3 + np.arctan(0.6 / 9.0 * np.cos(s / 9.0))))


def standing(_t_ns):
    return pose(4.0, -3.0, 20.0)


def motion_at(where, t_ns):
    """The sample that the vehicle's sensors give, with what they are wrong by."""
    h = 1_000_000
    step = T_inverse(where(t_ns - h)) @ where(t_ns + h)
    speed, yaw_rate = np.linalg.norm(step[:3, 3]) / (2e-9 * h), np.arctan2(step[1, 0], step[0, 0]) / (2e-9 * h)
    return MotionSample(t_ns, float(speed) / SPEED_SCALE, float(yaw_rate) + BIAS_RADPS)


def samples(where, k):
    """Those since the scan before scan `k`; none before time 0."""
    times = (k * EVERY_NS - j * S // 50 for j in range(4, -1, -1))
    return [motion_at(where, t_ns) for t_ns in times if t_ns >= 0]


# --- the refiner alone ---------------------------------------------------------------------------------------------


@dataclass
class Bench:
    """A refiner, what it is fed, and what came out with each scan."""

    refiner: Refiner
    motion: MotionBuffer
    teacher: MotionTeacher
    surfaces: np.ndarray
    where: object = circle
    waiting_s: list[float] = field(default_factory=list)  # age of the oldest scan that is not final, after each push
    learnt: list[bool] = field(default_factory=list)
    final: list[SmoothedPose] = field(default_factory=list)
    busy: bool = False

    def drive(self, n, first=0, online_m=0.05, online_deg=0.3):
        """Push scans `first` ... `first + n`, online poses off by so much."""
        for k in range(first, first + n):
            for sample in samples(self.where, k):
                self.motion.push(sample.t_ns, sample.speed_mps, sample.yaw_rate_radps)
            rng, T = np.random.default_rng(k), self.where(k * EVERY_NS)
            points = seen_from(rng, self.surfaces[k % 7 :: 7], T, 1500)
            T_online = moved(rng, T, online_m, online_deg)
            self.final += self.refiner.push(k, k * EVERY_NS, points, T_online, busy=self.busy)
            self.waiting_s.append((k - (self.final[-1].number + 1 if self.final else 0)) * EVERY_NS / S)
            self.learnt.append(self.teacher.uncertainty[1] < np.radians(REFINE_LEARNT_DEGPS))
        return self

    def errors(self, poses=None):
        """(N, 4) forward, left, up [m] and heading [deg] of final poses."""
        off = [T_inverse(self.where(p.t_ns)) @ p.T_map_vehicle for p in poses or self.final]
        return np.array([[*e[:3, 3], np.degrees(np.arctan2(e[1, 0], e[0, 0]))] for e in off])


@pytest.fixture
def bench(yard_map, yard_points):
    def make(parameters=SHORT, where=circle, local_map=yard_map):
        motion = MotionBuffer()
        teacher = MotionTeacher(motion)
        cache = MatchMapCache(local_map, 0.04)
        refiner = Refiner(parameters, RegistrationParameters(), cache, motion, teacher)
        return Bench(refiner, motion, teacher, yard_points, where)

    return make


@pytest.fixture(scope="module")
def whole(yard_map, yard_points):
    """Nine seconds on the circle, with what came out on the way; do not push more."""
    motion = MotionBuffer()
    teacher = MotionTeacher(motion)
    refiner = Refiner(SHORT, RegistrationParameters(), MatchMapCache(yard_map, 0.04), motion, teacher)
    return Bench(refiner, motion, teacher, yard_points).drive(90)


def test_every_pose_comes_once_and_in_order_and_all_after_the_flush(bench):
    run = bench().drive(60)
    before = [p.number for p in run.final]
    assert before == list(range(len(before)))
    assert 30 < len(before) < 60
    rest = run.refiner.flush()
    assert [p.number for p in run.final + rest] == list(range(60))
    assert [p.t_ns for p in run.final + rest] == [k * EVERY_NS for k in range(60)]
    assert run.refiner.flush() == []


@pytest.mark.parametrize("n", [0, 1, 2, 9])
def test_short_tracks_come_out_whole(bench, n):
    run = bench().drive(n)
    assert [p.number for p in run.final + run.refiner.flush()] == list(range(n))


def test_poses_are_right_where_online_ones_are_not(whole):
    forward, left, up, heading = np.abs(whole.errors(whole.final[20:])).T
    assert max(forward.max(), left.max()) < 0.012
    assert up.max() < 0.06  # the heights within a submap are those of single scans, here up to 0.05 m off
    assert heading.max() < 0.1


def test_errors_are_as_large_as_their_covariances_say(whole):
    off = whole.errors()[:, :2]
    sigma = np.array([np.sqrt(np.diag(p.covariance)[3:5]) for p in whole.final])
    assert (np.abs(off) < 4.0 * sigma).mean() > 0.95
    assert (sigma[30:] < 0.05).all()
    for p in whole.final:
        np.testing.assert_allclose(p.covariance, p.covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(p.covariance).min() > 0.0


def test_wheels_and_gyro_learn(whole):
    assert whole.motion.speed_scale == pytest.approx(SPEED_SCALE, abs=1e-3)
    assert whole.motion.yaw_bias_radps == pytest.approx(BIAS_RADPS, abs=5e-4)


def test_poses_become_certain_and_say_so(whole):
    certain = [p.certain for p in whole.final]
    assert whole.refiner.certain
    assert certain[-1]
    assert sum(np.diff(np.array(certain, int)) != 0) <= 1  # once certain, always: nothing goes wrong here


# --- lag and memory ------------------------------------------------------------------------------------------------


def test_no_scan_waits_for_longer_than_it_may(whole):
    """As long as the gyro is not known, longer; a scan after its time comes out with the next scan."""
    par, period_s = SHORT, EVERY_NS / S
    assert max(whole.waiting_s) <= UNLEARNT_S + period_s
    known = whole.learnt.index(True) + 1
    assert known < 60
    between_s = par.every_m / SPEED_MPS
    assert max(whole.waiting_s[known:]) <= par.longest_s + between_s + period_s


def test_a_scan_is_not_final_before_what_comes_after_it_is_matched(bench):
    par = replace(SHORT, longest_s=30.0, lag_m=4.0)
    run = bench(par).drive(90)
    behind_m = (89 - run.final[-1].number) * SPEED_MPS * EVERY_NS / S
    assert par.lag_m - 0.51 <= behind_m <= par.lag_m + 2 * par.every_m


def test_while_something_else_takes_long_a_stretch_is_solved_with_the_next_scan(bench):
    """Once, not as long as it takes."""
    runs = [bench().drive(40) for _ in range(2)]
    solved = [[], []]
    for k in range(40, 70):
        for run, busy, found in zip(runs, (False, True), solved, strict=True):
            run.busy = busy
            run.drive(1, first=k)
            found.append(run.refiner.solved)
    at, later = (np.flatnonzero(found) for found in solved)
    assert len(at) > 4
    assert abs(len(at) - len(later)) <= 2
    assert 0 < later[0] - at[0] <= 3  # with the next knot
    assert np.abs(runs[1].errors()[:, :2]).max() < 0.05


def test_a_standing_vehicle_does_not_wait_for_way(bench):
    """Nor for the gyro to be known, which nothing tells while it stands."""
    run = bench(where=standing).drive(110, online_m=0.02)
    assert max(run.waiting_s) <= UNLEARNT_S + 1.0 + EVERY_NS / S
    assert [p.number for p in run.final + run.refiner.flush()] == list(range(110))
    assert max(offset(standing(0), p.T_map_vehicle)[0] for p in run.final) < 0.04


def test_scans_that_are_done_with_are_let_go(bench):
    run = bench().drive(60)
    held = []
    for first in range(60, 100, 10):
        run.drive(10, first)
        held.append(len(run.refiner._scans))
    assert max(held) <= (SHORT.length_m + 2 * SHORT.every_m) / (SPEED_MPS * EVERY_NS / S) + 2
    assert [p.number for p in run.final + run.refiner.flush()] == list(range(100))
    assert np.abs(run.errors(run.final[30:])[:, :2]).max() < 0.015


def test_what_old_scans_knew_is_remembered(bench, yard_points):
    """The map is taken away; when all scans that knew it have left the stretch, the poses are still known."""
    local_map = local_map_of(yard_points)
    run = bench(local_map=local_map).drive(50)
    for tile_id in list(local_map.tiles):
        local_map.remove_tile(tile_id)
    run.drive(40, 50)
    assert not run.refiner.supported
    late = run.final[-5:]
    assert np.abs(run.errors(late)[:, :2]).max() < 0.15  # of 20 m without a map
    assert max(np.sqrt(np.diag(p.covariance)[3:5]).max() for p in late) < 0.2
    assert min(np.sqrt(np.diag(p.covariance)[3:5]).max() for p in late) > 0.01


# --- without a match -----------------------------------------------------------------------------------------------


def test_without_a_map_poses_are_dead_reckoned_and_never_certain(bench):
    run = bench(local_map=local_map_of(np.empty((0, 3)))).drive(60)
    final = run.final + run.refiner.flush()
    assert [p.number for p in final] == list(range(60))
    assert not any(p.certain for p in final)
    assert not run.refiner.certain
    sigma = [np.sqrt(np.diag(p.covariance)[3:5]).max() for p in final]
    assert sigma[-1] > sigma[0]
    step = T_inverse(final[0].T_map_vehicle) @ final[-1].T_map_vehicle
    true = T_inverse(circle(0)) @ circle(59 * EVERY_NS)
    assert np.linalg.norm((step - true)[:2, 3]) < 0.5  # of 30 m


# --- the online pose -----------------------------------------------------------------------------------------------


def corrections(run, first, T_off):
    """What is said about online poses that are off by `T_off` (4, 4), for scans until something is."""
    for k in range(first, first + 10):
        run.drive(1, k)
        T = run.where(k * EVERY_NS)
        found = run.refiner.correction(T @ T_off)
        if found is not None:
            return T, found
    return None


@pytest.mark.parametrize(
    ("shift_m", "turn_deg"), [((0.3, 0.0, 0.0), 0.0), ((0.0, -0.2, 0.0), 0.0), ((0.0, 0.0, 0.0), 1.0)]
)
def test_an_online_pose_that_is_off_is_corrected(bench, shift_m, turn_deg):
    T, found = corrections(bench().drive(50), 50, T_from_R_t(exp_so3([0, 0, np.radians(turn_deg)]), shift_m))
    error = T_inverse(T) @ found.T_map_vehicle
    assert np.linalg.norm(error[:2, 3]) < 0.03
    assert abs(np.degrees(error[1, 0])) < 0.15
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0


def test_a_right_online_pose_is_left_alone(bench):
    run = bench().drive(50)
    assert corrections(run, 50, np.eye(4)) is None


def test_before_the_first_solution_nothing_is_corrected(bench):
    assert corrections(bench(), 0, T_from_R_t(np.eye(3), [1.0, 0.0, 0.0])) is None


def test_between_two_poses():
    first, last = pose(1.0, 2.0, 30.0), pose(1.4, 2.2, 34.0)
    np.testing.assert_allclose(between(first, last, 0.0), first, atol=1e-12)
    np.testing.assert_allclose(between(first, last, 1.0), last, atol=1e-12)
    middle = between(first, last, 0.5)
    assert np.degrees(np.arctan2(middle[1, 0], middle[0, 0])) == pytest.approx(32.0)
    np.testing.assert_allclose(middle[:3, 3], [1.2, 2.1, GROUND_M], atol=1e-12)


# --- through the localiser -----------------------------------------------------------------------------------------


def fix_at(T_map_vehicle, t_ns):
    lat, lon, height = FRAME.geodetic_from_enu(T_map_vehicle[:3, 3] + [1.5, -1.0, 2.0])
    return GnssFix(t_ns, float(lat), float(lon), float(height), 2.5)


@dataclass
class Drive:
    """Through the yard; the sensor reaches 15 m."""

    localiser: Localiser
    surfaces: np.ndarray
    final: list = field(default_factory=list)
    online_m: list[float] = field(default_factory=list)  # horizontal error after each scan
    most: int = 0  # scans that came out with one

    def on(self, first, last, slip_mps=0.0):
        """Push scans `first` to before `last`, the wheels turning too fast."""
        for k in range(first, last):
            t_ns, T = k * EVERY_NS, through(k * EVERY_NS)
            for sample in samples(through, k):
                self.localiser.push_motion(replace(sample, speed_mps=sample.speed_mps + slip_mps))
            if k % 5 == 0:
                self.localiser.push_gnss(fix_at(T, t_ns))
            seen = seen_from(np.random.default_rng(k), self.surfaces[k % 5 :: 5], T @ MOUNT, 1500, 15.0)
            scan = Scan(t_ns, seen.astype(np.float32), np.zeros(len(seen), np.uint32))
            came = list(self.localiser.take_scan(scan))
            self.most = max(self.most, len(came))
            self.final += came
            if self.localiser.online is not None:
                self.online_m.append(horizontal_m(self.localiser.online))
        return self

    def finished(self):
        self.final += list(self.localiser.flush())
        return np.array([horizontal_m(scan.estimate) for scan in self.final])


def horizontal_m(estimate):
    return float(np.linalg.norm((estimate.T_map_vehicle - through(estimate.t_ns))[:2, 3]))


def localiser_on(local_map, enabled):
    refine = replace(SHORT, lag_m=4.0, longest_s=2.0, enabled=enabled)
    return Localiser(local_map, MOUNT, LocaliserParameters(graph=GraphParameters(lag_s=1.0), refine=refine))


@pytest.fixture(scope="module")
def outdated_map(yard_points):
    """The yard, but 12 m of it, walls and sheds on both sides, stood 0.3 m aside when it was mapped."""
    then = yard_points @ ALONG
    part = (then[:, 0] > 0.0) & (then[:, 0] < 12.0) & (then[:, 2] > GROUND_M + 0.05)
    then[part] += [0.0, 0.3, 0.0]
    return local_map_of(then @ ALONG.T + np.random.default_rng(2).normal(0.0, 0.02, then.shape))


def test_where_walls_were_moved_refined_poses_are_nearer_to_the_truth(outdated_map, yard_points):
    with_submaps, without = (
        Drive(localiser_on(outdated_map, enabled), yard_points).on(10, 115).finished() for enabled in (True, False)
    )
    assert len(with_submaps) == len(without) > 95
    assert np.quantile(without, 0.95) > 0.02  # single scans are drawn aside
    assert np.quantile(with_submaps, 0.95) < 0.5 * np.quantile(without, 0.95)
    assert with_submaps.max() < 0.03


def test_a_drive_gives_every_scan_once(yard_map, yard_points):
    run = Drive(localiser_on(yard_map, enabled=True), yard_points).on(10, 70)
    assert run.finished().max() < 0.03
    times = [scan.t_ns for scan in run.final]
    assert times == sorted(set(times))
    assert len(times) == 60 - run.localiser.dropped_scans
    assert times[-1] == 69 * EVERY_NS
    assert run.most <= 5  # although some thirty become final at once when the first stretch is learnt


def test_wheels_that_slip_bend_the_stretch_for_a_moment_only(yard_map, yard_points):
    """0.3 m too far within 0.3 s: scans tell better, and submaps hear them."""
    run = Drive(localiser_on(yard_map, enabled=True), yard_points).on(10, 60)
    off_m = run.on(60, 63, slip_mps=1.0).on(63, 115).finished()
    assert off_m.max() < 0.1
    assert off_m[-30:].max() < 0.03


def test_the_online_pose_begins_anew_from_what_submaps_say(yard_map, yard_points):
    """Pushed 0.25 m aside and sure of it, the graph of single scans takes seconds to return, submaps take it back."""
    seconds_off = {}
    for enabled in (True, False):
        run = Drive(localiser_on(yard_map, enabled), yard_points).on(10, 70)
        wrong = run.localiser.online.T_map_vehicle.copy()
        wrong[:3, 3] += ALONG @ [0.0, 0.25, 0.0]
        run.localiser._track.graph.restart(wrong, np.eye(6) * 1e-6)
        run.online_m.clear()
        run.on(70, 105)
        assert run.online_m[0] > 0.2
        assert run.online_m[-1] < 0.02
        seconds_off[enabled] = sum(off > 0.05 for off in run.online_m) * EVERY_NS / S
    assert seconds_off[True] < 1.0
    assert seconds_off[False] > 2.0 * seconds_off[True]
