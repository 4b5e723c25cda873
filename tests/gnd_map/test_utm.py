import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod, Proj, Transformer

from gnd.gnd_map.errors import GeodesyError
from gnd.gnd_map.utm import central_meridian_rad, convergence_rad, geodetic_from_utm, utm_from_geodetic

LATITUDES = st.floats(-80.0, 84.0)
OFFSETS = st.floats(-4.0, 4.0)
ZONES = st.integers(1, 60)


@given(LATITUDES, OFFSETS, ZONES)
def test_there_and_back(lat_deg: float, offset_deg: float, zone: int) -> None:
    lat, lon = np.radians(lat_deg), central_meridian_rad(zone) + np.radians(offset_deg)
    southern = lat_deg < 0
    back = geodetic_from_utm(*utm_from_geodetic(lat, lon, zone, southern=southern), zone, southern=southern)
    np.testing.assert_allclose(back, (lat, lon), atol=1e-12)


@pytest.mark.parametrize(("zone", "southern"), [(10, False), (32, False), (52, False), (56, True)])
def test_as_pyproj(zone: int, southern: bool) -> None:
    code = (32700 if southern else 32600) + zone
    lat = np.linspace(-79.0, -0.5, 40) if southern else np.linspace(0.5, 83.0, 40)
    lon = np.degrees(central_meridian_rad(zone)) + np.linspace(-3.2, 3.2, 40)
    expected = Transformer.from_crs(4326, code, always_xy=True).transform(lon, lat)
    found = utm_from_geodetic(np.radians(lat), np.radians(lon), zone, southern=southern)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(
        geodetic_from_utm(*expected, zone, southern=southern), np.radians([lat, lon]), atol=2e-12
    )


def test_convergence_as_pyproj() -> None:
    factors = Proj("+proj=utm +zone=10 +ellps=WGS84").get_factors(-122.0, 37.41)
    found = np.degrees(convergence_rad(np.radians(37.41), np.radians(-122.0), 10))
    assert found == pytest.approx(factors.meridian_convergence, abs=1e-6)


def test_a_grid_azimuth_plus_the_convergence_is_a_true_one() -> None:
    lat, lon = geodetic_from_utm([588348.0, 588348.0], [4141240.0, 4141340.0], 10)  # grid north
    azimuth_deg, _, _ = Geod(ellps="WGS84").inv(*np.degrees([lon[0], lat[0], lon[1], lat[1]]))
    assert np.radians(azimuth_deg) == pytest.approx(float(convergence_rad(lat[0], lon[0], 10)), abs=1e-5)


def test_zones_and_values_are_checked() -> None:
    with pytest.raises(GeodesyError, match="zone 61"):
        geodetic_from_utm(5e5, 4e6, 61)
    with pytest.raises(GeodesyError, match="finite"):
        geodetic_from_utm(np.nan, 4e6, 10)
