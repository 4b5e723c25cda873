import numpy as np
import pytest

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.schemas.drive import MotionSample
from gnd.vehicle_agent.localise.estimates import Health, PoseEstimate, localisation_error
from studies.localisation_study.series import HEALTHS, QUANTITIES, PoseSeries
from studies.localisation_study.trials import StartTrial, begin_times, judged, trials_row

STEP_NS = 100_000_000


def reference(n: int = 60) -> Trajectory:
    rng = np.random.default_rng(1)
    yaw = np.cumsum(rng.normal(scale=0.01, size=n))
    R = exp_so3(np.column_stack([np.zeros((n, 2)), yaw]))
    t = np.column_stack([np.arange(n) * 0.9, np.sin(np.arange(n) / 9), np.zeros(n)])
    return Trajectory(np.arange(1, n + 1, dtype=np.int64) * STEP_NS, T_from_R_t(R, t))


def estimate(true: Trajectory, k: int, off_m: tuple[float, float], off_deg: float, health: Health) -> PoseEstimate:
    off = T_from_R_t(exp_so3(np.array([0.0, 0.0, np.radians(off_deg)])), np.array([*off_m, 0.0]))
    return PoseEstimate(int(true.t_ns[k]), true.T_dst_vehicle[k] @ off, 0.1, 0.01, 1.0, health)


def series(healths: list[tuple[float, Health]]) -> PoseSeries:
    """Poses so far off along the way, with these healths."""
    t_ns = np.arange(1, len(healths) + 1, dtype=np.int64) * STEP_NS
    error = np.array([[off, 0.0, 0.0] for off, _ in healths]).reshape(-1, 3)
    return PoseSeries(t_ns, error, np.array([HEALTHS.index(h) for _, h in healths], np.uint8))


def test_errors_are_those_of_localisation_error() -> None:
    true, rng = reference(), np.random.default_rng(2)
    drawn = rng.normal(scale=(0.05, 0.1, 0.2), size=(60, 3))
    estimates = [estimate(true, k, (a, b), c, "good") for k, (a, b, c) in enumerate(drawn.tolist())]
    found, oracle = PoseSeries.of(estimates, true), localisation_error(estimates, true)
    assert found.error == pytest.approx(drawn, abs=1e-9)
    row = found.row(80)
    for name, unit in zip(QUANTITIES, ("m", "m", "deg"), strict=True):
        short = name.rsplit("_", 1)[0]
        assert row[name]["p95"] == pytest.approx(getattr(oracle, f"{short}_p95_{unit}"))
        assert row[name]["max"] == pytest.approx(getattr(oracle, f"{short}_max_{unit}"))
    assert (row["poses"], row["coverage"]) == (60, 0.75)


def test_poses_outside_the_reference_do_not_count() -> None:
    true = reference(10)
    late = PoseEstimate(int(true.t_ns[-1]) + 1, np.eye(4), 0.1, 0.01, 1.0, "good")
    assert len(PoseSeries.of([late], true)) == 0


def test_no_pose_is_no_accuracy() -> None:
    row = series([]).row(33)
    assert [row[name] for name in QUANTITIES] == [None] * 3
    assert (row["coverage"], row["wrong_called_good"]) == (0.0, 0)


def test_a_wrong_pose_counts_when_it_is_called_good() -> None:
    row = series([(0.43, "good"), (0.45, "good"), (-0.45, "good"), (2.0, "degraded")]).row(4)
    assert row["wrong_called_good"] == 2
    assert row["good_share"] == 0.75


def test_a_heading_is_wrong_beyond_half_a_degree() -> None:
    true = reference(2)
    found = PoseSeries.of([estimate(true, k, (0.0, 0.0), off, "good") for k, off in enumerate((0.49, -0.51))], true)
    assert found.wrong.tolist() == [False, True]


def test_a_start_is_judged_by_its_first_good_pose() -> None:
    right = judged(series([(3.0, "degraded"), (0.1, "good"), (0.2, "good")]), 0, 3)
    assert right == StartTrial(0, pytest.approx(0.2), right=True, wrong_called_good=0, scans=3)
    wrong = judged(series([(3.0, "good"), (0.1, "good")]), 0, 2)
    assert (wrong.right, wrong.wrong_called_good) == (False, 1)
    later = judged(series([(0.1, "good"), (3.0, "good")]), 0, 2)
    assert (later.right, later.wrong_called_good) == (True, 1)
    never = judged(series([(0.1, "degraded")]), 0, 1)
    assert (never.right, never.good_after_s) == (False, None)
    row = trials_row([right, wrong, later, never])
    assert (row["trials"], row["right"], row["never_good"], row["wrong_called_good"]) == (4, 2, 1, 2)
    assert row["right_share"] == 0.5


def test_starts_leave_time_to_find_the_pose() -> None:
    items = [MotionSample(k * STEP_NS, 1.0, 0.0) for k in range(331)]
    times = begin_times(items, 200, 7)
    assert times == begin_times(items, 200, 7) != begin_times(items, 200, 8)
    assert 0 <= times[0] < 2_000_000_000
    assert 16_000_000_000 < times[-1] < 18_000_000_000  # of 33 s, 15 to find the pose
    assert begin_times(items[:50], 50, 7)[-1] < 2_500_000_000
