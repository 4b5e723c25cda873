"""One drive's borders: where they are, what is said of the map's, and when nothing is said."""

import numpy as np
import pytest
from lane_road import BORDERS, FRAME, across, drive, tiles_of

from gnd.vehicle_agent.features.errors import BadLook, BadPose
from gnd.vehicle_agent.features.lanes.lane_mapper import SIGMA_CAMERA_M, LaneMapper
from gnd.vehicle_agent.features.lanes.looks import BorderLook


def _found(mapper):
    return [(across(one.piece.tile, _Piece(one)), one) for one in mapper.borders()]


class _Piece:
    def __init__(self, one):
        self.points_m = one.piece.points_m


def _said(mapper):
    changes = mapper.leave_all()
    states = [seen.existence.state for change in changes for seen in change.seen]
    return states.count("exist"), states.count("absent"), [one for change in changes for one in change.found]


def test_borders_are_found_where_they_are():
    found = _found(drive())
    for y, marking in BORDERS:
        own = [(off - y, one) for off, one in found if abs(off - y) < 0.3]
        assert len(own) >= 15
        assert np.abs([off for off, _ in own]).max() < 0.05
        assert {one.marking for _, one in own} == {marking}
    assert all(min(abs(off - y) for y, _ in BORDERS) < 0.1 for off, _ in found)


def test_the_maps_borders_are_confirmed():
    there, gone, found = _said(drive(held=tiles_of(off=0.05)))
    assert there >= 45
    assert gone == 0
    assert len(found) <= 2


def test_a_border_that_is_gone_is_denied_and_one_beside_is_found():
    now = ((-3.5, "solid"), (0.0, "dashed"), (2.9, "solid"))
    there, gone, found = _said(drive(now, held=tiles_of()))
    assert there >= 30
    assert gone >= 15
    assert len(found) >= 15


def test_another_type_of_paint_is_another_border():
    _, gone, found = _said(drive(((-3.5, "solid"), (0.0, "solid"), (3.5, "solid")), held=tiles_of()))
    assert gone >= 15
    assert {dict(one.attributes)["subtype"] for one in found} == {"solid"}


def test_a_drive_that_is_off_says_so_and_nothing_else():
    mapper = drive(held=tiles_of(), off=0.4)
    assert mapper.leave_all() == []
    assert mapper.counts["doubtful"] == 1
    assert mapper.counts["common_shift_mm"] == pytest.approx(-400, abs=30)


def test_a_wet_road_denies_nothing():
    there, gone, found = _said(drive(held=tiles_of(), wet=True))
    assert (there, gone, found) == (0, 0, [])


def test_the_blind_are_counted_and_have_viewed_nothing():
    mapper = drive(held=tiles_of(), wet=True)
    changes = mapper.leave_all()
    assert mapper.counts["blind"] >= 40
    assert all(change.viewed == 0 for change in changes)


def test_the_cameras_offset_is_found_against_the_lidar():
    mapper = drive(camera_off=0.2)
    found = _found(mapper)
    assert mapper.camera_off_m == pytest.approx(0.2, abs=0.03)
    assert np.abs([min((off - y for y, _ in BORDERS), key=abs) for off, _ in found]).max() < 0.06


def test_a_camera_alone_claims_no_more_than_it_knows():
    mapper = drive(lidar=False, camera_off=0.1)
    found = mapper.borders()
    assert mapper.camera_off_m is None
    assert len(found) >= 45
    assert min(one.sigma_m for one in found) >= SIGMA_CAMERA_M


def test_a_camera_alone_that_is_far_off_doubts_itself():
    mapper = drive(held=tiles_of(), lidar=False, camera_off=0.5)
    assert mapper.leave_all() == []
    assert mapper.counts["doubtful"] == 1


def test_a_short_drive_says_nothing():
    assert LaneMapper(FRAME).leave_all() == []


def test_bad_looks_are_refused():
    with pytest.raises(BadPose):
        LaneMapper(FRAME).see_borders(_look(np.zeros((2, 2))), np.full((4, 4), np.nan))
    with pytest.raises(BadLook, match="not finite"):
        _look(np.full((2, 2), np.nan))
    with pytest.raises(BadLook, match="at most"):
        BorderLook(np.zeros((20_000, 2)), np.zeros(20_000, np.int64), ("solid",), ("white",))
    with pytest.raises(BadLook, match="lines"):
        BorderLook(np.zeros((2, 2)), np.array([0, 1]), ("solid",), ("white",))


def _look(xy):
    return BorderLook(xy, np.zeros(len(xy), np.int64), ("solid",), ("white",))
