"""The download plan: when each tile is needed, and what a link brings in time."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vehicle_scene import FIGURE_2, FRAME

from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.link.plan import (
    LARGEST_BATCH_BYTES,
    SLOWEST_MPS,
    SMALLEST_BATCH_BYTES,
    Need,
    VehicleCourse,
    batch_bytes,
    in_time,
    needs,
    tile_boxes_m,
)
from gnd.vehicle_agent.surroundings import tile_distance_m

AROUND = covering_circle(*FIGURE_2[0].centre_rad, 150.0)
NEAR_M = 60.0
STEP_S = 0.05


LOW_M, HIGH_M = tile_boxes_m(FRAME, AROUND)


def seconds_near(tile_index: int, course: VehicleCourse, velocity_mps: np.ndarray) -> list[float]:
    """The plain twin: drive it and look."""
    low, high = LOW_M[tile_index] - NEAR_M, HIGH_M[tile_index] + NEAR_M
    way = ((t, course.here_m + t * velocity_mps) for t in np.arange(0.0, 20.0, STEP_S))
    return [t for t, at_m in way if (at_m >= low).all() and (at_m <= high).all()]


@settings(deadline=None, max_examples=40)
@given(x=st.floats(-80, 80), y=st.floats(-80, 80), heading=st.floats(-math.pi, math.pi), speed=st.floats(0.01, 40.0))
def test_a_tile_is_needed_from_when_it_is_near_until_it_is_left(
    x: float, y: float, heading: float, speed: float
) -> None:
    course = VehicleCourse(x, y, heading, speed)
    planned = {need.tile_id: need for need in needs(FRAME, AROUND, course, NEAR_M)}
    assert sorted(planned) == sorted(AROUND)
    velocity = max(speed, SLOWEST_MPS) * np.array([math.cos(heading), math.sin(heading)])
    for tile_index in range(0, len(AROUND), 7):
        need = planned[AROUND[tile_index]]
        seen = seconds_near(tile_index, course, velocity)
        if seen:
            assert need.from_s == pytest.approx(seen[0], abs=1.01 * STEP_S)
            if seen[-1] < 20.0 - 2 * STEP_S:
                assert need.until_s / course.patience == pytest.approx(seen[-1], abs=1.01 * STEP_S)
        elif need.from_s < 20.0 - STEP_S:
            assert need.until_s / course.patience - need.from_s <= STEP_S


def test_soonest_first_and_among_those_needed_now_the_nearest() -> None:
    planned = needs(FRAME, AROUND, VehicleCourse(0.0, 0.0, 0.0, 10.0), NEAR_M)
    assert [need.from_s for need in planned] == sorted(need.from_s for need in planned)
    now = [need for need in planned if need.from_s == 0.0]
    assert [need.distance_m for need in now] == sorted(need.distance_m for need in now)
    assert now[0].distance_m == 0.0
    assert planned[0].tile_id == TileId.from_geodetic(FRAME.lat_rad, FRAME.lon_rad)
    for need in planned[:: len(planned) // 5]:
        away_m = tile_distance_m(FRAME, need.tile_id, np.zeros(3))
        assert need.distance_m == pytest.approx(away_m, abs=0.01)


def test_of_a_vehicle_without_heading_what_is_near_is_needed_for_ever() -> None:
    for need in needs(FRAME, AROUND, VehicleCourse(0.0, 0.0, None, 0.0), 30.0):
        assert (need.from_s, need.until_s) in ((0.0, math.inf), (math.inf, math.inf))
        assert (need.from_s == 0.0) >= (need.distance_m <= 30.0)


def test_a_vehicle_that_stands_needs_what_is_near_until_it_drives() -> None:
    standing, slow = (needs(FRAME, AROUND, VehicleCourse(0.0, 0.0, 0.3, speed), NEAR_M) for speed in (0.0, 1.0))
    assert all(need.until_s == math.inf for need in standing)
    assert in_time(standing, lambda _: 1e9, 1.0, 1.0) == standing
    driven = {need.tile_id: need.until_s for need in needs(FRAME, AROUND, VehicleCourse(0.0, 0.0, 0.3, 3.0), NEAR_M)}
    for need in slow:
        assert need.until_s == pytest.approx(3.0 * driven[need.tile_id])


def test_what_lies_behind_is_needed_last_or_not_at_all() -> None:
    ahead = VehicleCourse(0.0, 0.0, math.pi / 2, 20.0)
    planned = {need.tile_id: need for need in needs(FRAME, AROUND, ahead, 10.0)}
    for tile_id, need in planned.items():
        if tile_distance_m(FRAME, tile_id, np.array([0.0, -1.0, 0.0])) < need.distance_m > 15.0:
            assert need.from_s == math.inf, "it lies behind"


SOON = [Need(float(k), 10.0 * k, tile_id, k + 4.0) for k, tile_id in enumerate(AROUND[:12])]


def test_a_fast_link_brings_everything_and_a_slow_one_what_it_can() -> None:
    assert in_time(SOON, lambda _: 1000.0, math.inf, 0.01) == SOON
    assert in_time(SOON, lambda _: 1000.0, 1e6, 0.01) == SOON
    slow = in_time(SOON, lambda _: 1000.0, 500.0, 0.1)  # 2 s a tile, a new one needed every second
    assert 5 <= len(slow) < len(SOON)
    assert slow[0] == SOON[0]
    assert slow == sorted(slow)
    assert in_time(SOON, lambda _: 1e6, 500.0, 0.1) == []


@settings(deadline=None)
@given(
    rate=st.floats(10.0, 1e5), delay=st.floats(0.0, 2.0), sizes=st.lists(st.floats(0, 1e5), min_size=12, max_size=12)
)
def test_whatever_is_asked_for_arrives_before_it_is_left(rate: float, delay: float, sizes: list[float]) -> None:
    size = dict(zip([need.tile_id for need in SOON], sizes, strict=True))
    arrival_s = 2 * delay
    for need in in_time(SOON, size.__getitem__, rate, delay):
        arrival_s += size[need.tile_id] / rate
        assert arrival_s <= need.until_s


def test_batches_suit_the_link() -> None:
    assert batch_bytes(math.inf, 0.25) == LARGEST_BATCH_BYTES
    assert batch_bytes(6_250.0, 0.25) == SMALLEST_BATCH_BYTES
    assert batch_bytes(100_000.0, 0.25) == 25_000


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"near_m": 100.0}, "near_m = 100.0"),
        ({"ahead_m": -1.0}, "ahead_m = -1.0"),
        ({"in_flight": 65}, "in_flight = 65"),
    ],
)
def test_settings_that_cannot_work_are_named(setting: dict[str, float], said: str) -> None:
    with pytest.raises(AgentConfigError, match=said):
        DownloadParameters(**setting)  # type: ignore[arg-type]
