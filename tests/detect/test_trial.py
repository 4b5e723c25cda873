"""Scans on trial: which of them become evidence when poses go wrong for a while, and when the pose is lost."""

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from gate_scene import CORRIDOR, START_NS, WALLS, map_of, match_maps, scan, seen, shift

from gnd.vehicle_agent.detect.trial import Trial
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.waiting import ScanRoom

SEGMENT = 5  # scans of 0.1 s


@pytest.fixture(scope="module")
def yard() -> LocalMap:
    return map_of()


@pytest.fixture(scope="module")
def points() -> list[np.ndarray]:
    return [seen(WALLS, seed, per_m2=1.0) for seed in range(3)]


def trial(local_map: LocalMap) -> Trial:
    return Trial(match_maps(local_map))


def numbers(found: Iterable[object]) -> list[int]:
    return [(one.scan.t_ns - START_NS) // 100_000_000 for one in found]  # type: ignore[attr-defined]


def drive(one: Trial, points: list[np.ndarray], errors: list[np.ndarray | None], first: int = 0) -> list[int]:
    """Numbers of the scans that became evidence."""
    counted = []
    for k, error in enumerate(errors):
        counted += numbers(one.push(scan(points[k % len(points)], first + k, error)))
    return counted


def test_right_poses_become_evidence_a_second_later_at_most_and_all_at_the_end(
    yard: LocalMap, points: list[np.ndarray]
) -> None:
    one = trial(yard)
    counted = drive(one, points, [None] * 30)
    assert counted == list(range(len(counted)))
    assert len(counted) >= 30 - 2 * SEGMENT - 1
    assert counted + numbers(one.flush()) == list(range(30))
    assert not one.counts
    assert {tried.verdict for tried in one.take_tried()} == {"good"}
    assert one.take_tried() == []


@pytest.mark.parametrize("busy", [lambda k: k % 5 == 0, lambda _: True], ids=["now and then", "always"])
def test_a_busy_vehicle_counts_a_scan_later_and_all_in_order(
    yard: LocalMap, points: list[np.ndarray], busy: Callable[[int], bool]
) -> None:
    one, counted, most = trial(yard), list[int](), 0
    for k in range(60):
        found = numbers(one.push(scan(points[k % len(points)], k), ScanRoom(0.0 if busy(k) else 1000.0)))
        assert len(found) <= (1 if busy(k) else 2), "it waits for one of the next scans"
        counted += found
        most = max(most, k - len(counted))
    assert counted == list(range(len(counted)))
    assert most <= 5 * SEGMENT, "what waits does not grow"
    assert counted + numbers(one.flush()) == list(range(60))


def test_scans_come_out_as_they_went_in(yard: LocalMap, points: list[np.ndarray]) -> None:
    one, went_in = trial(yard), scan(points[0], 0, shift(0.02))
    assert list(one.push(went_in)) == []
    (came_out,) = one.flush()
    assert came_out.scan.estimate is went_in.scan.estimate
    assert np.abs(came_out.scan.points_map_m - went_in.scan.points_map_m).max() < 1e-5
    assert np.abs(came_out.scan.origins_map_m - went_in.scan.origins_map_m).max() < 1e-3
    assert np.array_equal(came_out.moving, went_in.moving)


@pytest.mark.parametrize("error", [shift(0.0, 0.2), shift(-1.0), shift(yaw_deg=0.5)], ids=["20 cm", "1 m", "0.5 deg"])
@pytest.mark.parametrize("first_wrong", [20, 22])
def test_no_scan_of_a_wrong_stretch_counts_and_those_before_and_after_do(
    yard: LocalMap, points: list[np.ndarray], error: np.ndarray, first_wrong: int
) -> None:
    """Also where the pose goes wrong in the middle of a segment."""
    one, wrong = trial(yard), range(first_wrong, first_wrong + 15)
    counted = drive(one, points, [error if k in wrong else None for k in range(60)]) + numbers(one.flush())
    assert not set(counted) & set(wrong)
    assert set(range(first_wrong - 2 * SEGMENT)) <= set(counted)
    assert set(range(wrong.stop + 3 * SEGMENT, 60)) <= set(counted)
    assert one.counts["scans_shifted"] >= 10
    assert one.counts["scans_shifted"] + one.counts["scans_taken_back"] == 60 - len(counted)


def test_a_wrong_pose_that_creeps_in_counts_only_while_it_is_small(yard: LocalMap, points: list[np.ndarray]) -> None:
    one = trial(yard)
    errors = [shift(0.0, 0.01 * max(k - 20, 0)) for k in range(80)]
    counted = drive(one, points, list(errors)) + numbers(one.flush())
    assert max(counted) <= 20 + 10  # 10 cm
    assert min(counted) == 0


def test_when_the_pose_is_lost_what_waits_and_what_comes_late_is_taken_back(
    yard: LocalMap, points: list[np.ndarray]
) -> None:
    one = trial(yard)
    before = drive(one, points, [None] * 20)
    one.take_back(START_NS + 30 * 100_000_000)
    after = drive(one, points, [None] * 40, first=20) + numbers(one.flush())
    assert max(before) < 20 - SEGMENT
    assert min(after) > 30  # noticed at 30: what is older and becomes final later is refused
    assert set(range(31 + 2 * SEGMENT, 60)) <= set(after)
    assert one.counts["scans_taken_back"] == 60 - len(before) - len(after)


def test_after_a_wrong_pose_a_place_that_proves_nothing_does_not_make_it_right(points: list[np.ndarray]) -> None:
    corridor = map_of(CORRIDOR)
    views = [seen(CORRIDOR, seed, per_m2=1.0) for seed in range(3)]
    one = trial(corridor)
    assert drive(one, views, [None] * 30)  # at first there is no reason to doubt
    assert {tried.verdict for tried in one.take_tried()} == {"unchecked"}
    assert drive(one, views, [shift(0.0, 0.4)] * 10 + [None] * 30, first=30)[0] < 30
    assert numbers(one.flush()) == []


def test_movers_do_not_speak(yard: LocalMap, points: list[np.ndarray]) -> None:
    """Half of what is seen drives along; it is marked, so the pose is as good as before."""
    one, counted = trial(yard), []
    for k in range(20):
        still, along = points[k % 3], points[(k + 1) % 3] + np.array([1.0, 0.7, 0.0])
        mixed = scan(np.concatenate([still, along]), k)
        mixed.moving[len(still) :] = True
        counted += numbers(one.push(mixed))
    assert counted + numbers(one.flush()) == list(range(20))


def test_what_has_stood_but_was_not_given_yet_is_taken_back_too(yard: LocalMap, points: list[np.ndarray]) -> None:
    one = trial(yard)
    counted = drive(one, points, [None] * (2 * SEGMENT + 2))
    assert 0 < len(counted) < SEGMENT, "the first segment has stood, and is given scan by scan"
    one.take_back(START_NS + (2 * SEGMENT + 1) * 100_000_000)
    assert numbers(one.flush()) == []
    assert one.counts["scans_taken_back"] == 2 * SEGMENT + 2 - len(counted)
    assert one.oldest is None
