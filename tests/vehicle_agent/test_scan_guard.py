"""Bad scans are named, counted and left out; the drive goes on."""

import numpy as np
import pytest

from gnd.schemas.drive import DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from gnd.vehicle_agent.errors import BadScan
from gnd.vehicle_agent.scans import Guard, check_points, spread_m

RNG = np.random.default_rng(11)


def scan(t_ns: int = 1000, points: np.ndarray | None = None) -> Scan:
    points = RNG.uniform(-30, 30, (5000, 3)) if points is None else points
    return Scan(t_ns, points.astype(np.float32), np.zeros(len(points), np.uint32))


def with_nan(share: float) -> np.ndarray:
    points = RNG.uniform(-30, 30, (5000, 3))
    points[: int(share * 5000)] = np.nan
    return points


@pytest.mark.parametrize(
    ("points", "state", "numbers"),
    [
        (np.empty((0, 3)), "empty", "0 points"),
        (RNG.normal(size=(49, 3)), "empty", "49 points"),
        (with_nan(0.6), "not-finite", "9000 of 15000"),
        (np.full((4000, 3), 7.25), "constant", "4000 points"),
        (RNG.normal(0, 0.02, (4000, 3)), "constant", "4000 points"),
    ],
)
def test_a_scan_without_information_is_named(points: np.ndarray, state: str, numbers: str) -> None:
    with pytest.raises(BadScan, match=numbers) as caught:
        check_points(points.astype(np.float32), 1000)
    assert caught.value.state == state


def test_a_few_points_that_are_not_finite_are_no_reason_to_refuse_a_scan() -> None:
    check_points(with_nan(0.2).astype(np.float32), 1000)


def test_a_scan_whose_sample_is_constant_is_looked_at_as_a_whole() -> None:
    points = np.full((5000, 3), 7.25)
    points[3] = 20.0
    check_points(points.astype(np.float32), 1000)
    assert spread_m(points.astype(np.float32)) == pytest.approx(12.75)


def test_the_guard_lets_the_rest_through_in_time_order_and_counts() -> None:
    pose = ReferencePose(5, np.eye(4))
    items: list[DriveItem] = [
        MotionSample(10, 1.0, 0.0),
        scan(20),
        scan(20),
        MotionSample(9, 1.0, 0.0),
        scan(30, np.empty((0, 3))),
        GnssFix(31, 0.65, 2.2, 30.0, 2.5),
        scan(19),
        pose,
        pose,
        scan(40),
    ]
    guard = Guard()
    passed = [item for item in items if guard.admits(item)]
    assert [item.t_ns for item in passed] == [10, 20, 31, 5, 5, 40]
    assert guard.bad == {"time-backwards": 3, "empty": 1}
    assert "19 ns comes after one at 20 ns" in guard.last_problem
