"""First halves wait in bounded memory, for a bounded time."""

import numpy as np
import pytest
from merger_world import NEIGHBOUR, POLE, TILE
from short_world import KEY, drive_number, packed_of

from cloud_merger.errors import MergerError
from cloud_merger.waiting import Waiting, WaitingLimits, WaitingRoom
from gnd_map.codec import encode_mask
from schemas.packed import PackedReport, decode_upload

SECOND = 1_000_000_000


def waiting(number):
    report = drive_number(number, new={3: POLE})
    packed = decode_upload(packed_of(report))
    assert isinstance(packed, PackedReport)
    mask = np.array([True])
    return Waiting(KEY, packed, report, mask, encode_mask(mask), {TILE: np.array([3], np.int32)})


class Clock:
    def __init__(self):
        self.now = 0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def held(room, *numbers):
    return [room.get(waiting(n).packed.report_id) is not None for n in numbers]


def test_the_oldest_make_room(clock):
    room = WaitingRoom(WaitingLimits(reports=2), clock)
    for number in (1, 2, 3):
        room.hold(waiting(number))
    assert held(room, 1, 2, 3) == [False, True, True]


def test_voxels_are_bounded_however_few_the_reports(clock):
    room = WaitingRoom(WaitingLimits(voxels=2 * waiting(1).voxels), clock)
    for number in (1, 2, 3):
        room.hold(waiting(number))
    assert held(room, 1, 2, 3) == [False, True, True]
    room.forget(waiting(2).packed.report_id)
    room.hold(waiting(4))
    assert held(room, 3, 4) == [True, True], "what was forgotten weighs nothing"


def test_one_report_may_be_larger_than_the_room(clock):
    room = WaitingRoom(WaitingLimits(voxels=1), clock)
    room.hold(waiting(1))
    assert held(room, 1) == [True]


def test_what_nobody_comes_back_for_is_forgotten_and_no_longer_promised(clock):
    room = WaitingRoom(WaitingLimits(keep_s=10.0), clock)
    room.hold(waiting(1))
    clock.now = 10 * SECOND
    room.hold(waiting(2))
    assert room.promised(TILE, "ndt", but="").tolist() == [3, 3]
    clock.now += 1
    assert held(room, 1, 2) == [False, True]
    assert room.promised(TILE, "ndt", but="").tolist() == [3]


def test_a_report_that_is_held_again_is_held_once(clock):
    room = WaitingRoom(WaitingLimits(voxels=2 * waiting(1).voxels), clock)
    for _ in range(3):
        room.hold(waiting(1))
    room.hold(waiting(2))
    assert len(room) == 2


def test_promises_are_those_of_other_reports_on_this_tile_and_layer(clock):
    room = WaitingRoom(WaitingLimits(), clock)
    room.hold(waiting(1))
    room.hold(waiting(2))
    assert room.promised(TILE, "ndt", but=waiting(1).packed.report_id).tolist() == [3]
    assert room.promised(NEIGHBOUR, "ndt", but="").tolist() == []
    assert room.promised(TILE, "signs", but="").tolist() == []
    room.finish(waiting(2).packed.report_id)
    assert room.promised(TILE, "ndt", but="").tolist() == [3]


def test_finished_reports_are_known_up_to_a_number(clock):
    room = WaitingRoom(WaitingLimits(finished=2), clock)
    room.hold(waiting(1))
    for name in ("a", waiting(1).packed.report_id, "b"):
        room.finish(name)
    assert held(room, 1) == [False]
    assert [room.has_finished(name) for name in ("a", waiting(1).packed.report_id, "b")] == [False, True, True]


@pytest.mark.parametrize("limits", [{"reports": 0}, {"voxels": 0}, {"keep_s": 0.0}, {"finished": 0}])
def test_absurd_limits_are_refused(limits):
    with pytest.raises(MergerError, match="must be positive"):
        WaitingLimits(**limits)
