"""Universal Transverse Mercator (WGS-84): what recordings and maps of others state their positions in.

Krüger's series in the third flattening n to n^4, which is good to a micrometre within a zone; pyproj is the oracle of
the tests. Source: Karney, "Transverse Mercator with an accuracy of a few nanometers", J. Geodesy 2011, eqs. (7)-(36).
"""

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import GeodesyError
from gnd.gnd_map.geodesy import WGS84_A_M, WGS84_E2, WGS84_F

SCALE = 0.9996
FALSE_EASTING_M = 500_000.0
FALSE_NORTHING_M = 10_000_000.0
"""Of the southern half."""
_N = WGS84_F / (2.0 - WGS84_F)
_RADIUS_M = WGS84_A_M / (1.0 + _N) * (1.0 + _N**2 / 4.0 + _N**4 / 64.0)  # rectifying radius, Karney (14)
_ALPHA = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16 + 41 * _N**4 / 180,
    13 * _N**2 / 48 - 3 * _N**3 / 5 + 557 * _N**4 / 1440,
    61 * _N**3 / 240 - 103 * _N**4 / 140,
    49561 * _N**4 / 161280,
)  # Karney (35)
_BETA = (
    _N / 2 - 2 * _N**2 / 3 + 37 * _N**3 / 96 - _N**4 / 360,
    _N**2 / 48 + _N**3 / 15 - 437 * _N**4 / 1440,
    17 * _N**3 / 480 - 37 * _N**4 / 840,
    4397 * _N**4 / 161280,
)  # Karney (36)
_ROUNDS = 4  # of Newton's method for the latitude; 2 reach the last bit


def central_meridian_rad(zone: int) -> float:
    """Longitude of the middle of a zone 1 ... 60.

    Raises:
        GeodesyError: no such zone.
    """
    if not 1 <= zone <= 60:
        raise GeodesyError(f"UTM zone {zone}: zones are 1 ... 60")
    return float(np.radians(6 * zone - 183))


def geodetic_from_utm(
    east_m: npt.ArrayLike, north_m: npt.ArrayLike, zone: int, *, southern: bool = False
) -> tuple[F64, F64]:
    """Latitude and longitude, rad, of eastings and northings in metres that broadcast.

    Raises:
        GeodesyError: no such zone, or values that are not finite.
    """
    east, north = np.asarray(east_m, np.float64), np.asarray(north_m, np.float64)
    if not (np.isfinite(east).all() and np.isfinite(north).all()):
        raise GeodesyError("UTM: eastings and northings must be finite")
    scale = SCALE * _RADIUS_M
    zeta = ((north - (FALSE_NORTHING_M if southern else 0.0)) + 1j * (east - FALSE_EASTING_M)) / scale
    zeta = zeta - sum(b * np.sin(2 * (k + 1) * zeta) for k, b in enumerate(_BETA))  # Karney (11)
    tau_conformal = np.sin(zeta.real) / np.hypot(np.sinh(zeta.imag), np.cos(zeta.real))
    lon = central_meridian_rad(zone) + np.arctan2(np.sinh(zeta.imag), np.cos(zeta.real))
    return np.arctan(_tau(tau_conformal)), lon


def utm_from_geodetic(
    lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike, zone: int, *, southern: bool = False
) -> tuple[F64, F64]:
    """Easting and northing, m, in a zone, of positions that broadcast; meant for positions near the zone.

    Raises:
        GeodesyError: no such zone.
    """
    lat, lon = np.asarray(lat_rad, np.float64), np.asarray(lon_rad, np.float64) - central_meridian_rad(zone)
    tau = _tau_conformal(np.tan(lat))
    zeta = np.arctan2(tau, np.cos(lon)) + 1j * np.arcsinh(np.sin(lon) / np.hypot(tau, np.cos(lon)))
    zeta = zeta + sum(a * np.sin(2 * (k + 1) * zeta) for k, a in enumerate(_ALPHA))  # Karney (11)
    scale, start = SCALE * _RADIUS_M, FALSE_NORTHING_M if southern else 0.0
    return scale * zeta.imag + FALSE_EASTING_M, scale * zeta.real + start


def convergence_rad(lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike, zone: int) -> F64:
    """Bearing of grid north, clockwise from true north: a grid azimuth plus this is a true one."""
    lat, lon = np.asarray(lat_rad, np.float64), np.asarray(lon_rad, np.float64)
    step = 1e-6  # 6 m: the angle of a small step to the north in the grid
    east, north = utm_from_geodetic(np.stack([lat - step, lat + step]), np.stack([lon, lon]), zone)
    return np.asarray(-np.arctan2(east[1] - east[0], north[1] - north[0]))


def _tau_conformal(tau: F64) -> F64:
    """Tangent of the conformal latitude of that of the geodetic one; Karney (7)-(9)."""
    e = np.sqrt(WGS84_E2)
    sigma = np.sinh(e * np.arctanh(e * tau / np.hypot(1.0, tau)))
    return np.asarray(tau * np.hypot(1.0, sigma) - sigma * np.hypot(1.0, tau))


def _tau(tau_conformal: F64) -> F64:
    """Its inverse by Newton's method; Karney (19)-(21)."""
    tau = np.array(tau_conformal)
    for _ in range(_ROUNDS):
        at = _tau_conformal(tau)
        slope = (1.0 - WGS84_E2) * np.hypot(1.0, at) * np.hypot(1.0, tau) / (1.0 + (1.0 - WGS84_E2) * tau**2)
        tau = tau + (tau_conformal - at) / slope
    return tau
