"""WGS-84: geodetic, earth-centred (ECEF) and local east-north-up (ENU) coordinates, vectorised.

Latitude and longitude in radians, heights ellipsoidal in metres. Arrays of any shape broadcast; ECEF and ENU points
carry x, y, z last. Written out here because tiles and voxels rest on them bit for bit; pyproj is the oracle of the
tests.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import GeodesyError

WGS84_A_M = 6378137.0  # semi-major axis, defining constant
WGS84_F = 1.0 / 298.257223563  # flattening, defining constant
WGS84_B_M = WGS84_A_M * (1.0 - WGS84_F)
WGS84_E2 = WGS84_F * (2.0 - WGS84_F)  # first eccentricity squared
_EP2 = WGS84_E2 / (1.0 - WGS84_E2)  # second eccentricity squared
_MIN_RADIUS_M = 1.0e6  # below this (5,400 km under the ground) the latitude iteration is not proven to converge
_BOWRING_ROUNDS = 4  # 2 reach 1e-9 m near the ground; 4 do so up to satellites


def normal_radius_m(lat_rad: npt.ArrayLike) -> F64:
    """Radius of curvature in the prime vertical, N(φ), in metres."""
    return WGS84_A_M / np.sqrt(1.0 - WGS84_E2 * np.sin(lat_rad) ** 2)


def meridian_radius_m(lat_rad: npt.ArrayLike) -> F64:
    """Radius of curvature in the meridian, M(φ), in metres."""
    return WGS84_A_M * (1.0 - WGS84_E2) / (1.0 - WGS84_E2 * np.sin(lat_rad) ** 2) ** 1.5


def ecef_from_geodetic(lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike, height_m: npt.ArrayLike) -> F64:
    """ECEF points (..., 3) in metres of geodetic coordinates that broadcast to (...).

    Raises:
        GeodesyError: a value is not finite or a latitude lies beyond a pole.
    """
    lat, lon, height = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in (lat_rad, lon_rad, height_m)))
    check_geodetic(lat, lon)
    n = normal_radius_m(lat)
    r = (n + height) * np.cos(lat)
    return np.stack([r * np.cos(lon), r * np.sin(lon), (n * (1.0 - WGS84_E2) + height) * np.sin(lat)], axis=-1)


def geodetic_from_ecef(p_ecef_m: npt.ArrayLike) -> tuple[F64, F64, F64]:
    """Latitude, longitude (-π, π] and ellipsoidal height, each (...), of ECEF points (..., 3); exact to 1e-9 m.

    Bowring's parametric latitude, iterated; the height formula is the one that holds at the poles as well.

    Raises:
        GeodesyError: a value is not finite or nearer than 1,000 km to the Earth's centre.
    """
    p = np.asarray(p_ecef_m, dtype=np.float64)
    if p.shape[-1:] != (3,):
        raise GeodesyError(f"ECEF points: expected shape (..., 3), got {p.shape}")
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    r = np.hypot(x, y)
    radius = np.hypot(r, z)
    if not ((radius >= _MIN_RADIUS_M) & (radius < np.inf)).all():  # NaN fails as well
        raise GeodesyError(f"ECEF points: finite and >= {_MIN_RADIUS_M:.0f} m from the Earth's centre, got {p!r:.200}")
    beta = np.arctan2(z, (1.0 - WGS84_F) * r)
    lat = beta
    for _ in range(_BOWRING_ROUNDS):
        lat = np.arctan2(z + _EP2 * WGS84_B_M * np.sin(beta) ** 3, r - WGS84_E2 * WGS84_A_M * np.cos(beta) ** 3)
        beta = np.arctan2((1.0 - WGS84_F) * np.sin(lat), np.cos(lat))
    sin_lat = np.sin(lat)
    height = r * np.cos(lat) + z * sin_lat - WGS84_A_M * np.sqrt(1.0 - WGS84_E2 * sin_lat**2)
    return lat, np.arctan2(y, x), height


MAX_LON_RAD: Final = 1e6
"""Longitudes wrap, but not so often: the indices of tiles stay integers."""


def check_geodetic(lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike) -> None:
    """Refuse latitudes beyond a pole and values that are not finite.

    Raises:
        GeodesyError: with the worst value.
    """
    lat, lon = np.asarray(lat_rad), np.asarray(lon_rad)
    if not (np.isfinite(lat).all() and np.isfinite(lon).all()):
        raise GeodesyError("latitude or longitude is not finite")
    if lat.size and float(np.abs(lat).max()) > np.pi / 2:
        raise GeodesyError(f"latitude {float(np.abs(lat).max())} rad lies beyond a pole; are these degrees?")
    if lon.size and float(np.abs(lon).max()) > MAX_LON_RAD:
        raise GeodesyError(f"longitude {float(np.abs(lon).max())} rad is beyond {MAX_LON_RAD:g}")


def enu_axes(lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike) -> F64:
    """R_ecef_enu (..., 3, 3): the columns are the east, north and up unit vectors in ECEF."""
    lat, lon = np.broadcast_arrays(np.asarray(lat_rad, dtype=np.float64), np.asarray(lon_rad, dtype=np.float64))
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(lat)], axis=-1)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    up = np.stack([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat], axis=-1)
    return np.stack([east, north, up], axis=-1)


class HasCentre(Protocol):
    """A part of the Earth that has a centre: a tile."""

    @property
    def centre_rad(self) -> tuple[float, float]:
        """(latitude, longitude) of the centre."""


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """A right-handed east-north-up frame with its origin on or above the ellipsoid."""

    lat_rad: float
    """Geodetic latitude of the origin."""
    lon_rad: float
    """Longitude of the origin."""
    height_m: float = 0.0
    """Ellipsoidal height of the origin."""

    def __post_init__(self) -> None:
        check_geodetic(self.lat_rad, self.lon_rad)
        if not np.isfinite(self.height_m):
            raise GeodesyError(f"height {self.height_m} m is not finite")

    @classmethod
    def of_tile(cls, tile: HasCentre) -> "LocalFrame":
        """The tile's own frame: ENU at its centre on the ellipsoid."""
        return cls(*tile.centre_rad, 0.0)

    @property
    def R_ecef_enu(self) -> F64:
        """(3, 3) rotation: p_ecef = R_ecef_enu @ p_enu + origin_ecef. Read-only."""
        return _constants(self)[0]

    @property
    def origin_ecef(self) -> F64:
        """(3,) origin in ECEF metres. Read-only."""
        return _constants(self)[1]

    def enu_from_ecef(self, p_ecef_m: npt.ArrayLike) -> F64:
        """(..., 3) ECEF metres to (..., 3) ENU metres of this frame."""
        return (np.asarray(p_ecef_m, dtype=np.float64) - self.origin_ecef) @ self.R_ecef_enu

    def ecef_from_enu(self, p_enu_m: npt.ArrayLike) -> F64:
        """(..., 3) ENU metres of this frame to (..., 3) ECEF metres."""
        return np.asarray(p_enu_m, dtype=np.float64) @ self.R_ecef_enu.T + self.origin_ecef

    def enu_from_geodetic(self, lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike, height_m: npt.ArrayLike) -> F64:
        """Geodetic coordinates (...) to (..., 3) ENU metres of this frame."""
        return self.enu_from_ecef(ecef_from_geodetic(lat_rad, lon_rad, height_m))

    def geodetic_from_enu(self, p_enu_m: npt.ArrayLike) -> tuple[F64, F64, F64]:
        """(..., 3) ENU metres of this frame to latitude, longitude (radians) and ellipsoidal height (metres)."""
        return geodetic_from_ecef(self.ecef_from_enu(p_enu_m))

    def T_self_other(self, other: "LocalFrame") -> F64:
        """(4, 4) pose of `other` in this frame: p_self = T_self_other @ p_other."""
        T = np.eye(4)
        T[:3, :3] = self.R_ecef_enu.T @ other.R_ecef_enu
        T[:3, 3] = self.enu_from_ecef(other.origin_ecef)
        return T


@lru_cache(maxsize=4096)
def _constants(frame: LocalFrame) -> tuple[F64, F64]:
    rotation = enu_axes(frame.lat_rad, frame.lon_rad)
    origin = ecef_from_geodetic(frame.lat_rad, frame.lon_rad, frame.height_m)
    rotation.setflags(write=False)
    origin.setflags(write=False)
    return rotation, origin
