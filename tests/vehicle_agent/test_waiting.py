"""Work that waits: in order, none lost, and none for long."""

from collections import deque

from gnd.vehicle_agent.waiting import next_few


def test_a_burst_is_worked_off_in_parts_in_order_and_soon() -> None:
    waiting, done, steps = deque(range(100)), list[int](), list[int]()
    while waiting:
        few = list(next_few(waiting))
        done += few
        steps.append(len(few))
    assert done == list(range(100))
    assert steps == sorted(steps, reverse=True)
    assert steps[0] == 13
    assert len(steps) < 30
    assert list(next_few(waiting)) == []


def test_no_more_than_the_most_come_at_once() -> None:
    waiting = deque(range(100))
    assert list(next_few(waiting, 2)) == [0, 1]
    assert list(next_few(deque([7]), 2)) == [7]


def test_what_is_cleared_on_the_way_is_not_given() -> None:
    waiting, given = deque(range(40)), list[int]()
    for one in next_few(waiting):
        given.append(one)
        waiting.clear()
    assert given == [0]
