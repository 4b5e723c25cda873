"""Where the map has a road: on it, off it, and not known yet; and the chain of submaps of a vehicle without a map."""

import gc

import numpy as np
import pytest
from survey_street import FRAME, HEIGHT_M, published_map, street_points

from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.gnd_map.tile_id import covering_corridor
from gnd.schemas.drive import GnssFix
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from gnd.vehicle_agent.segment.segmenter import MotionSegmenter
from gnd.vehicle_agent.survey.chain import SUBMAP_M, GrowingSubmap, SubmapChain
from gnd.vehicle_agent.survey.coverage import (
    AHEAD_M,
    HERE_M,
    LOOK_EVERY_M,
    THIN_BACK_M,
    VAIN_M,
    RoadCoverage,
    WayOffTheMap,
)
from gnd.vehicle_agent.survey.odometry import OdometryScan


def local_map(end_m: float) -> LocalMap:
    """The street up to a place, and the knowledge that the store has nothing beyond."""
    tiles = published_map(-60.0, end_m)
    x = np.arange(-60.0, 150.0, 5.0)
    lat, lon, _ = FRAME.geodetic_from_enu(np.column_stack([x, np.zeros_like(x), np.full_like(x, HEIGHT_M)]))
    around = covering_corridor(lat, lon, 40.0)
    held = LocalMap(GridFrame.around(FRAME, around))
    for tile in tiles:
        held.set_tile(tile)
    for tile_id in set(around) - {tile.tile_id for tile in tiles}:
        held.set_absent(tile_id)
    return held


def test_a_road_on_the_map_is_covered_and_one_off_it_is_bare() -> None:
    coverage = RoadCoverage(local_map(40.0))

    def share(x_m: float, heading_rad: float, stretch_m: tuple[float, float]) -> float | None:
        return coverage.share(np.array([x_m, -1.8, HEIGHT_M]), heading_rad, stretch_m)

    assert [share(-20.0, 0.0, s) for s in (HERE_M, AHEAD_M)] == [1.0, 1.0]
    assert share(38.0, 0.0, AHEAD_M) == 0.0
    assert share(38.0, np.pi, AHEAD_M) == 1.0
    assert share(80.0, 0.0, HERE_M) == 0.0
    assert share(900.0, 0.0, HERE_M) is None, "tiles that are not here yet are no hole in the map"


def test_a_road_that_returns_nothing_is_on_the_map_where_all_else_is() -> None:
    """Wet asphalt: the strip is empty, the fronts that the vehicle sees are in the map."""
    held = local_map(40.0)
    coverage, here = RoadCoverage(held), np.array([-20.0, -1.8, HEIGHT_M])
    seen = street_points(-40.0, 0.0)
    share = coverage.share_held(here, seen)
    assert share is not None
    assert share > 0.9
    beyond = coverage.share_held(np.array([80.0, -1.8, HEIGHT_M]), street_points(60.0, 100.0))
    assert beyond == 0.0
    assert coverage.share_held(here, np.empty((0, 3))) is None
    assert coverage.share_held(np.array([900.0, 0.0, HEIGHT_M]), seen + np.array([920.0, 0.0, 0.0])) is None
    assert not driven((60.0, 0.0), held=share)[0].is_worth
    assert driven((60.0, 0.0), held=beyond)[0].is_worth
    assert driven((60.0, 0.0), held=None)[0].is_worth


def driven(*shares: tuple[float, float | None], held: float | None = 0.0) -> tuple[WayOffTheMap, float | None]:
    """Look along stretches (length in metres, share covered); also the way at which the survey ends, if it does."""
    off, way_m = WayOffTheMap(), 0.0
    for length_m, share in shares:
        for _ in range(round(length_m / LOOK_EVERY_M)):
            way_m += LOOK_EVERY_M
            assert off.is_due(way_m)
            off.look(way_m, share, held)
            if off.is_vain or off.is_back:
                return off, way_m
    return off, None


def test_a_hole_in_the_map_is_surveyed_and_ends_where_the_map_has_the_road_again() -> None:
    assert driven((20.0, 0.9), (30.0, 0.1))[0].is_worth
    off, end_m = driven((20.0, 0.9), (100.0, 0.0), (200.0, 1.0))
    assert (off.is_worth, off.bare_m, end_m) == (True, 100.0, 150.0)
    off, end_m = driven((100.0, 0.0), (200.0, 0.5))
    assert (off.is_worth, end_m) == (True, 100.0 + THIN_BACK_M), "a thin map never covers the road, but has it"
    assert driven((40.0, 0.0), (1000.0, None))[1] is None, "tiles that are not here yet say nothing"


def test_a_thin_map_with_dips_costs_no_bytes_and_is_given_up() -> None:
    """A map of few scans has half of the columns, here and there only a quarter: the road is on it."""
    off, end_m = driven(*[(20.0, 0.5), (6.0, 0.25)] * 50)
    assert (off.is_worth, off.is_vain, end_m) == (False, True, VAIN_M)
    assert driven((VAIN_M, None))[0].is_vain


def test_submaps_that_are_closed_are_no_longer_in_memory() -> None:
    """On a road that the map does not have no final pose comes that would take scans off the chain's list."""
    chain = SubmapChain(MotionSegmenter(SegmentParameters(enabled=False)), FRAME)
    nothing, most = np.zeros((1, 3)), 0
    for n in range(600):  # ten minutes, 1.2 km
        place = T_from_R_t(np.eye(3), [2.0 * n, 0.0, 0.0])
        chain.take(OdometryScan(n * 10**9, place, 2.0 * n, True, nothing + place[:3, 3], nothing + place[:3, 3]))
        chain.closed((n - 12) * 10**9)
        if n % 100 == 99:
            most = max(most, sum(isinstance(one, GrowingSubmap) for one in gc.get_objects()))
    assert most <= 6


def chain_of(way_m: float, blind_from_m: float = np.inf) -> SubmapChain:
    """A vehicle that drives straight on, a scan a metre."""
    chain = SubmapChain(MotionSegmenter(SegmentParameters(enabled=False)), FRAME)
    for n in range(round(way_m) + 1):
        T = T_from_R_t(np.eye(3), [float(n), 0.0, 0.0])
        seen = street_points(n - 10.0, n + 10.0)[::9] - np.array([0.0, 0.0, HEIGHT_M])
        origins = np.broadcast_to([float(n), 0.0, 1.9], seen.shape).copy()
        chain.take(OdometryScan(n * 10**8, T, float(n), n < blind_from_m, seen, origins))
        lat, lon, height = FRAME.geodetic_from_enu(np.array([[n, 0.0, HEIGHT_M]]))
        chain.take_fix(GnssFix(n * 10**8, float(lat[0]), float(lon[0]), float(height[0]), 2.5), T)
        if n < 8:
            pose = T_from_R_t(exp_so3([0.0, 0.0, 0.01]), [n + 100.0, 5.0, HEIGHT_M])
            chain.take_final(PoseEstimate(n * 10**8, pose, 0.03, 0.001, 1.0, "good", covariance=1e-4 * np.eye(6)))
    return chain


def test_submaps_follow_on_each_other_with_fixes_and_an_anchor() -> None:
    closed = chain_of(65.0).closed(None)
    assert [one.submap.number for one in closed] == [0, 1, 2, 3]
    assert closed[0].submap.step is None
    for one in closed[1:]:
        assert one.submap.step is not None
        np.testing.assert_allclose(one.submap.step.T[:3, 3], [SUBMAP_M, 0.0, 0.0], atol=1e-9)
    assert [one.anchor is not None for one in closed] == [True, False, False, False]
    assert sum(len(one.fixes) for one in closed) == 14
    anchor = closed[0].anchor
    assert anchor is not None
    T_map = FRAME.T_self_other(type(FRAME).of_tile(anchor.tile)) @ anchor.pose.T
    assert np.linalg.norm(T_map[:3, 3] - [100.0, 5.0, HEIGHT_M]) < 0.1
    mean_m = closed[1].submap.gaussians().mean_m
    road = mean_m[(np.abs(mean_m[:, 1]) < 7.0) & (mean_m[:, 2] < 1.0)]
    assert len(road) > 500
    assert np.abs(road[:, 2]).max() < 0.05


def test_a_step_without_scans_that_fit_is_worth_less() -> None:
    sure, blind = (
        chain_of(45.0).closed(None)[1].submap.step,
        chain_of(45.0, blind_from_m=0.0).closed(None)[1].submap.step,
    )
    assert sure is not None
    assert blind is not None
    assert np.sqrt(blind.covariance[3, 3] / sure.covariance[3, 3]) == pytest.approx(5.0, rel=0.1)
