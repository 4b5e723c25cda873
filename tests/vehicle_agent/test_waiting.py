"""Work that waits: in order, none lost, and none for long."""

from collections import deque

from gnd.vehicle_agent.waiting import MOST_WAITING, Patient, ScanRoom, next_few


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


def test_there_is_room_until_it_is_used_and_for_what_has_waited_long_enough() -> None:
    room = ScanRoom(50.0)
    assert [room.takes(20.0) for _ in range(3)] == [True, True, False]
    assert room.takes(10.0)
    assert not room.takes(0.1)
    assert room.takes(20.0, must=True)
    assert room.left_ms == -20.0
    assert ScanRoom().takes(1e9)


def test_what_is_patient_waits_for_room_but_not_for_ever() -> None:
    one = Patient()
    assert [one.may(9.0, ScanRoom(5.0)) for _ in range(2 * MOST_WAITING + 2)] == 2 * ([False] * MOST_WAITING + [True])
    assert not one.may(9.0, ScanRoom(5.0))
    room = ScanRoom(10.0)
    assert one.may(9.0, room)
    assert room.left_ms == 1.0
    assert one.waited == 0


def test_what_is_cleared_on_the_way_is_not_given() -> None:
    waiting, given = deque(range(40)), list[int]()
    for one in next_few(waiting):
        given.append(one)
        waiting.clear()
    assert given == [0]
