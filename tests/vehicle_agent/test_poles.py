"""The pole detector on small scenes: what it finds and what not, how exact, and what bad input does."""

from math import atan2, hypot, pi

import numpy as np
import pytest
from pole_scene import LIDAR_M, lamp, origin, post, rays_of, sign, tree

from gnd.fleet_sim import parts
from gnd.fleet_sim.shapes import Shape
from gnd.gnd_map.se3 import exp_so3, transform
from gnd.schemas.limits import MAX_DETECTIONS_OF_LOOK
from gnd.vehicle_agent.features.poles.detector import Pole, PoleDetector, Rays, detections_of
from gnd.vehicle_agent.features.poles.errors import PoleInputError
from gnd.vehicle_agent.features.poles.slices import PoseSigma

PLACE = np.zeros(3)


def found(*shapes: Shape, sensor: str = "VLP-16") -> tuple[Pole, ...]:
    return PoleDetector().window([rays_of(shapes, sensor)], PLACE)


@pytest.mark.parametrize("sensor", ["VLP-16", "HDL-32E", "HDL-64E"])
@pytest.mark.parametrize("place", [(5.0, 3.0), (-14.0, 6.0), (2.0, -21.0)])
def test_a_post_is_found_where_it_stands(sensor: str, place: tuple[float, float]) -> None:
    (pole,) = found(*post(*place, 0.1, 4.0), sensor=sensor)
    assert hypot(*(pole.xy_m - place)) < 0.05
    assert pole.diameter_m == pytest.approx(0.2, abs=3 * pole.sigma_diameter_m)
    assert pole.foot_z_m == pytest.approx(0.0, abs=0.1)
    assert 1.9 <= pole.top_m <= 4.25
    assert (pole.kind, pole.scans) == ("pole", 1)


@pytest.mark.parametrize(
    "shapes",
    [
        (),
        parts.wall(8.0, 20.0, 6.0, 2.5, 0.0),
        parts.car(8.0, 3.0, 0.0, 0.3, 5),
        post(8.0, 1.0, 0.23, 1.75),  # somebody who stands there
        post(8.0, 1.0, 0.45, 4.0),  # a column
        post(12.0, 1.0, 0.1, 3.5, bottom_m=2.0),  # hangs in the air
        parts.bollards(6.0, 5, 3.0, 0.0),
        parts.building(parts.Lot(1, 4.0, 16.0, 9.0, 9.0, 4, 0.0)),
    ],
    ids=["road", "wall", "car", "person", "column", "hanging", "bollards", "building"],
)
@pytest.mark.parametrize("sensor", ["VLP-16", "HDL-64E"])
def test_what_is_no_pole_is_not_found(shapes: tuple[Shape, ...], sensor: str) -> None:
    assert found(*shapes, sensor=sensor) == ()


@pytest.mark.parametrize(
    ("shapes", "kind"),
    [(lamp(22.0, 5.0), "streetlight"), (sign(12.0, 5.0), "traffic_sign"), (tree(14.0, -6.0), "trunk")],
)
def test_kinds_are_told_by_what_stands_above(shapes: tuple[Shape, ...], kind: str) -> None:
    (pole,) = found(*shapes)
    assert pole.kind == kind


def test_a_lamp_whose_top_is_out_of_view_is_a_pole() -> None:
    (pole,) = found(*lamp(12.0, 5.0), sensor="HDL-64E")
    assert pole.kind == "pole"


def test_a_pole_whose_foot_is_hidden_is_one() -> None:
    (pole,) = found(*post(14.0, 5.0, 0.1, 4.5), *parts.car(10.0, 3.57, 0.0, pi / 2, 3))
    assert pole.bottom_m > 1.0
    assert hypot(*(pole.xy_m - [14.0, 5.0])) < 0.05


def test_a_pole_before_a_wall_and_one_against_it() -> None:
    wall = parts.wall(2.0, 20.0, 7.0, 3.0, 0.0)
    assert len(found(*wall, *post(10.0, 5.5))) == 1
    assert found(*wall, *post(10.0, 6.75)) == ()


def test_two_poles_a_metre_apart_are_two() -> None:
    poles = found(*post(8.0, 3.0), *post(8.0, 4.0))
    assert [round(float(pole.xy_m[1])) for pole in poles] == [3, 4]


def test_the_order_of_the_points_does_not_matter() -> None:
    rays = rays_of([*post(9.0, 3.0), *tree(14.0, -6.0), *sign(7.0, -4.0)])
    mixed = Rays(np.random.default_rng(0).permutation(rays.points_m), rays.origins_m)
    (first, second) = (PoleDetector().window([one], PLACE) for one in (rays, mixed))
    assert len(first) == len(second) == 3
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a.xy_m, b.xy_m, atol=1e-9)
        assert a.kind == b.kind


def test_far_coordinates_of_a_map_change_nothing() -> None:
    rays, far = rays_of(post(9.0, 3.0)), np.array([40_000.0, -30_000.0, 500.0])
    (here,) = PoleDetector().window([rays], PLACE)
    (there,) = PoleDetector().window([Rays(rays.points_m + far, rays.origins_m + far)], far)
    np.testing.assert_allclose(there.xy_m - far[:2], here.xy_m, atol=1e-6)
    assert there.foot_z_m == pytest.approx(here.foot_z_m + 500.0, abs=1e-6)


def test_a_window_knows_a_pole_better_than_a_scan_does() -> None:
    places = [(-4.0, 0.0), (0.0, 0.0), (4.0, 0.0)]
    scans = [rays_of(post(9.0, 6.0), seed=k, place_m=place) for k, place in enumerate(places)]
    (one,), (all_of_them,) = (PoleDetector().window(part, PLACE) for part in (scans[:1], scans))
    assert all_of_them.scans == 3
    assert np.linalg.det(all_of_them.cov_m2) < 0.5 * np.linalg.det(one.cov_m2)
    assert all_of_them.sigma_diameter_m < one.sigma_diameter_m


def test_empty_scans_of_a_window_say_nothing() -> None:
    rays, none = rays_of(post(9.0, 6.0)), Rays(np.empty((0, 3)), origin())
    (one,), (beside_empty,) = (PoleDetector().window(part, PLACE) for part in ([rays], [none, rays]))
    np.testing.assert_array_equal(one.xy_m, beside_empty.xy_m)
    assert beside_empty.scans == 1
    assert PoleDetector().window([], PLACE) == PoleDetector().window([none, none], PLACE) == ()


def test_errors_of_poses_go_into_the_covariance() -> None:
    rays = rays_of(post(10.0, 0.0))
    (exact,) = PoleDetector().window([rays], PLACE)
    (placed,) = PoleDetector().window([Rays(rays.points_m, rays.origins_m, PoseSigma(0.05, 0.002))], PLACE)
    assert placed.cov_m2[0, 0] - exact.cov_m2[0, 0] == pytest.approx(0.05**2, rel=0.05)
    assert placed.cov_m2[1, 1] - exact.cov_m2[1, 1] == pytest.approx(0.05**2 + 0.02**2, rel=0.05)


def test_covariances_are_honest_without_the_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    """NEES of 2 is expected; less is allowed: layers are taken to see the same edges, which they only half do."""
    monkeypatch.setattr("gnd.vehicle_agent.features.poles.columns._SIGMA_FLOOR_M", 0.001)
    rng, nees = np.random.default_rng(3), []
    detector = PoleDetector()
    for seed in range(10):
        turn, away = rng.uniform(0.0, 0.4) + np.arange(8) * pi / 4, rng.uniform(4.0, 20.0, 8)
        places = away[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        shapes = [shape for place in places for shape in post(float(place[0]), float(place[1]), 0.12)]
        for pole in detector.window([rays_of(shapes, seed=seed)], PLACE):
            off = pole.xy_m - places[np.hypot(*(places - pole.xy_m).T).argmin()]
            nees.append(float(off @ np.linalg.solve(pole.cov_m2, off)))
    assert len(nees) >= 70
    assert 0.5 < np.mean(nees) < 2.5
    assert np.mean(np.array(nees) < 5.991) >= 0.88  # of 78, less than 69 has a chance of 0.5 % at 95 %


def test_a_look_is_the_poles_in_polar_coordinates() -> None:
    rays = rays_of([*post(9.0, 3.0), *sign(7.0, -4.0)])
    look = PoleDetector().look(rays.points_m, rays.origins_m, 5)
    poles = PoleDetector().poles(rays.points_m, rays.origins_m)
    assert (look.t_ns, look.sensor, look.layer, len(look)) == (5, "lidar", "poles", 2)
    assert look.kinds == ("traffic_sign", "pole")
    for k, pole in enumerate(poles):
        assert look.range_m[k] == pytest.approx(hypot(*pole.xy_m), abs=1e-4)
        assert look.bearing_rad[k] == pytest.approx(atan2(*pole.xy_m[::-1]), abs=1e-5)
    assert (look.sigma_bearing_rad * look.range_m < 0.1).all()


def test_poles_of_the_map_are_looked_at_from_a_pose() -> None:
    rays = rays_of(post(9.0, 3.0))
    (pole,) = PoleDetector().window([rays], PLACE)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = exp_so3([0.0, 0.0, 2.0]), [5.0, -1.0, 0.0]
    look = detections_of([pole], T, 7)
    local = transform(np.linalg.inv(T), np.array([[*pole.xy_m, pole.foot_z_m]]))[0]
    assert look.range_m[0] == pytest.approx(hypot(*local[:2]), abs=1e-4)
    assert look.bearing_rad[0] == pytest.approx(atan2(local[1], local[0]), abs=1e-5)
    assert look.height_m[0] == pytest.approx(local[2], abs=1e-5)
    across, along = look.sigma_bearing_rad[0] * look.range_m[0], look.sigma_range_m[0]
    assert along**2 + across**2 == pytest.approx(np.trace(pole.cov_m2), rel=1e-4)


def test_of_too_many_poles_the_nearest_are_told() -> None:
    (pole,) = found(*post(9.0, 3.0))
    look = detections_of([pole] * (MAX_DETECTIONS_OF_LOOK + 5), np.eye(4), 0)
    assert len(look) == MAX_DETECTIONS_OF_LOOK


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 3)),
        np.full((100, 3), np.nan),
        np.full((100, 3), np.inf),
        np.full((5000, 3), 7.0),
        np.column_stack([np.full((5000, 2), 7.0), np.linspace(0.0, 4.0, 5000)]),
        np.full((1, 3), 1e300),
    ],
    ids=["empty", "nan", "inf", "one place", "one line", "huge"],
)
def test_points_without_a_street_are_no_trouble(points: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
    assert len(PoleDetector().look(points, origin())) <= 1


def test_points_that_are_no_numbers_are_left_out() -> None:
    rays = rays_of(post(9.0, 3.0))
    holes = np.insert(rays.points_m, np.arange(0, len(rays.points_m), 7), np.nan, axis=0)
    (clean,), (dirty,) = (PoleDetector().window([Rays(p, rays.origins_m)], PLACE) for p in (rays.points_m, holes))
    np.testing.assert_array_equal(clean.xy_m, dirty.xy_m)


@pytest.mark.slow
def test_four_million_points_are_no_trouble() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-60.0, -60.0, -2.0], [60.0, 60.0, 8.0], (4_000_000, 3))
    points[:2_000_000] = rng.normal([5.0, 5.0, 1.0], 0.3, (2_000_000, 3))
    assert len(PoleDetector().look(points, np.array([0.0, 0.0, LIDAR_M]))) <= MAX_DETECTIONS_OF_LOOK


@pytest.mark.parametrize(
    ("points", "origins"),
    [
        (np.zeros((5, 2)), np.zeros(3)),
        (np.zeros(9), np.zeros(3)),
        (np.zeros((5, 3)), np.zeros((4, 3))),
        (np.zeros((5, 3)), np.full(3, np.nan)),
    ],
)
def test_what_is_no_scan_is_refused(points: np.ndarray[tuple[int, ...], np.dtype[np.float64]], origins: object) -> None:
    with pytest.raises(PoleInputError, match=r"\(|finite"):
        PoleDetector().look(points, np.asarray(origins))


def test_a_place_that_is_none_is_refused() -> None:
    with pytest.raises(PoleInputError, match="3 finite numbers"):
        PoleDetector().window([rays_of(())], np.array([0.0, np.nan, 0.0]))
