"""Geodesy against pyproj, and its own round trips."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pyproj import Transformer

from gnd.gnd_map.errors import GeodesyError
from gnd.gnd_map.geodesy import (
    LocalFrame,
    ecef_from_geodetic,
    enu_axes,
    geodetic_from_ecef,
    meridian_radius_m,
    normal_radius_m,
)
from gnd.gnd_map.tile_id import TileId

SEOUL = LocalFrame(np.radians(37.56), np.radians(127.0365), 30.0)
latitudes = st.floats(-np.pi / 2, np.pi / 2)
longitudes = st.floats(-np.pi, np.pi)
heights = st.floats(-5_000.0, 50_000.0)


def _spread_positions(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    lat = np.r_[rng.uniform(-np.pi / 2, np.pi / 2, n), 0.0, np.pi / 2, -np.pi / 2, np.radians([89.9999, -89.9999])]
    lon = rng.uniform(-np.pi, np.pi, len(lat))
    return lat, lon, rng.uniform(-500.0, 9_000.0, len(lat))


def test_ecef_agrees_with_pyproj() -> None:
    lat, lon, height = _spread_positions(500)
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    expected = np.stack(to_ecef.transform(lon, lat, height, radians=True), axis=-1)
    np.testing.assert_allclose(ecef_from_geodetic(lat, lon, height), expected, rtol=0, atol=5e-9)


def test_geodetic_agrees_with_pyproj() -> None:
    lat, lon, height = _spread_positions(500)
    points = ecef_from_geodetic(lat, lon, height)
    to_geodetic = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    lon_deg, lat_deg, expected_height = to_geodetic.transform(*points.T)
    found_lat, found_lon, found_height = geodetic_from_ecef(points)
    np.testing.assert_allclose(
        np.degrees(found_lat), lat_deg, rtol=0, atol=2e-11
    )  # PROJ itself is off by 1 µm up there
    off_pole = np.abs(lat) < np.radians(89.99999)
    np.testing.assert_allclose(np.degrees(found_lon)[off_pole], lon_deg[off_pole], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found_height, expected_height, rtol=0, atol=2e-6)


@given(latitudes, longitudes, heights)
@example(np.pi / 2, 0.0, 0.0)
@example(0.0, np.pi, 0.0)
def test_there_and_back_is_exact_to_a_few_nanometres(lat: float, lon: float, height: float) -> None:
    point = ecef_from_geodetic(lat, lon, height)
    again = ecef_from_geodetic(*geodetic_from_ecef(point))
    np.testing.assert_allclose(again, point, rtol=0, atol=4e-9)


def test_local_frame_agrees_with_pyproj_topocentric() -> None:
    lat_0, lon_0 = float(np.degrees(SEOUL.lat_rad)), float(np.degrees(SEOUL.lon_rad))
    pipeline = (
        "+proj=pipeline +step +proj=unitconvert +xy_in=rad +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={lat_0!r} +lon_0={lon_0!r} +h_0=30"
    )
    rng = np.random.default_rng(2)
    lat = SEOUL.lat_rad + rng.uniform(-1e-3, 1e-3, 100)
    lon = SEOUL.lon_rad + rng.uniform(-1e-3, 1e-3, 100)
    height = rng.uniform(0.0, 100.0, 100)
    expected = np.stack(Transformer.from_pipeline(pipeline).transform(lon, lat, height, radians=True), axis=-1)
    np.testing.assert_allclose(SEOUL.enu_from_geodetic(lat, lon, height), expected, rtol=0, atol=1e-8)


@given(st.tuples(*[st.floats(-5_000.0, 5_000.0)] * 3))
def test_enu_round_trips(point: tuple[float, float, float]) -> None:
    p = np.array(point)
    np.testing.assert_allclose(SEOUL.enu_from_ecef(SEOUL.ecef_from_enu(p)), p, rtol=0, atol=4e-9)
    np.testing.assert_allclose(SEOUL.enu_from_geodetic(*SEOUL.geodetic_from_enu(p)), p, rtol=0, atol=4e-9)


def test_east_is_east_and_up_is_up() -> None:
    _, lon, _ = SEOUL.geodetic_from_enu(np.array([1.0, 0.0, 0.0]))
    lat, _, _ = SEOUL.geodetic_from_enu(np.array([0.0, 1.0, 0.0]))
    *_, height = SEOUL.geodetic_from_enu(np.array([0.0, 0.0, 1.0]))
    assert lon > SEOUL.lon_rad
    assert lat > SEOUL.lat_rad
    assert height == pytest.approx(31.0)


@given(latitudes, longitudes)
def test_axes_are_a_right_handed_rotation(lat: float, lon: float) -> None:
    R = enu_axes(lat, lon)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_pose_between_frames_takes_points_across() -> None:
    other = LocalFrame(np.radians(37.57), np.radians(127.05), 12.0)
    p_other = np.array([[10.0, -20.0, 3.0], [0.0, 0.0, 0.0]])
    T = SEOUL.T_self_other(other)
    np.testing.assert_allclose(
        p_other @ T[:3, :3].T + T[:3, 3], SEOUL.enu_from_ecef(other.ecef_from_enu(p_other)), rtol=0, atol=1e-8
    )


def test_a_tile_frame_has_its_origin_at_the_centre_on_the_ellipsoid() -> None:
    tile = TileId(497353963154)
    lat, lon, height = geodetic_from_ecef(LocalFrame.of_tile(tile).origin_ecef)
    assert (float(lat), float(lon)) == pytest.approx(tile.centre_rad, abs=1e-15)
    assert float(height) == pytest.approx(0.0, abs=1e-9)


def test_radii_of_curvature_are_the_metres_per_radian() -> None:
    lat, step = np.radians(49.0), 1e-4
    north = np.linalg.norm(ecef_from_geodetic(lat + step, 0.0, 0.0) - ecef_from_geodetic(lat - step, 0.0, 0.0)) / (
        2 * step
    )
    east = np.linalg.norm(ecef_from_geodetic(lat, step, 0.0) - ecef_from_geodetic(lat, -step, 0.0)) / (2 * step)
    assert north == pytest.approx(float(meridian_radius_m(lat)), rel=1e-8)
    assert east == pytest.approx(float(normal_radius_m(lat)) * np.cos(lat), rel=1e-8)


def test_arrays_of_any_shape_broadcast() -> None:
    points = ecef_from_geodetic(np.zeros((2, 1)), np.zeros((1, 3)), 5.0)
    assert points.shape == (2, 3, 3)
    assert geodetic_from_ecef(points)[2].shape == (2, 3)


def test_the_middle_of_the_earth_has_no_latitude() -> None:
    with pytest.raises(GeodesyError, match="centre"):
        geodetic_from_ecef([0.0, 0.0, 10.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_positions_must_be_finite(bad: float) -> None:
    with pytest.raises(GeodesyError):
        geodetic_from_ecef([6.4e6, bad, 0.0])
    with pytest.raises(GeodesyError):
        LocalFrame(0.0, bad)
    with pytest.raises(GeodesyError):
        LocalFrame(0.0, 0.0, bad)


def test_wrong_shape_is_named() -> None:
    with pytest.raises(GeodesyError, match=r"\(2,\)"):
        geodetic_from_ecef([6.4e6, 0.0])
