"""The plane coordinates of an exported map, as Autoware's map_projection_loader names them.

All three are transverse Mercator projections of WGS-84, by Krüger's series of `gnd_map.utm`; they differ in central
meridian, scale and false origin. Heights stay ellipsoidal: `vertical_datum: WGS84`. Source: README of
autoware_map_projection_loader (autoware_core); its loader sets the altitude of the origin to 0.
"""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.deploy.errors import DeployError
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import WGS84_A_M
from gnd.gnd_map.utm import FALSE_EASTING_M, SCALE, central_meridian_rad, geodetic_from_utm, utm_from_geodetic

PROJECTORS: Final = ("TransverseMercator", "MGRS", "LocalCartesianUTM")
_ZONE: Final = 31  # its central meridian, 3 degrees east, stands for any other: longitudes are shifted to it
_MERIDIAN_RAD: Final = central_meridian_rad(_ZONE)
_SQUARE_M: Final = 100_000.0
_FARTHEST_M: Final = 150_000.0
_COLUMNS: Final = ("STUVWXYZ", "ABCDEFGH", "JKLMNPQR")  # of the zones 3n, 3n + 1, 3n + 2
_ROWS: Final = "ABCDEFGHJKLMNPQRSTUV"
_BANDS: Final = "CDEFGHJKLMNPQRSTUVWX"
_LINE: Final = re.compile(r"\s*(\w+):\s*(\S+)")


class ProjectionError(DeployError):
    """A map that a projection cannot hold, or a file of it that cannot be read."""


@dataclass(frozen=True, slots=True)
class Projection:
    """A plane: x east, y north of the grid, in metres.

    Attributes:
        projector: the name that Autoware gives it, of `PROJECTORS`.
        meridian_rad: the central meridian.
        scale: on the central meridian, at height 0.
        east_m: what is taken off the easting from the central meridian.
        north_m: what is taken off the northing from the equator.
        lat_deg: the origin that the file names; of MGRS the place it was made for.
        lon_deg: the same.
        square: of MGRS: zone, band and 100 km square, such as 54SUE.
    """

    projector: str
    meridian_rad: float
    scale: float
    east_m: float
    north_m: float
    lat_deg: float
    lon_deg: float
    square: str = ""

    def forward(self, lat_rad: npt.ArrayLike, lon_rad: npt.ArrayLike) -> tuple[F64, F64]:
        """Plane coordinates x and y, m, of positions.

        Raises:
            ProjectionError: a position is farther than 150 km from the origin, or outside its MGRS square.
        """
        east, north = _mercator(np.asarray(lat_rad, np.float64), np.asarray(lon_rad, np.float64), self.meridian_rad)
        x, y = self.scale * east - self.east_m, self.scale * north - self.north_m
        low, high = (0.0, _SQUARE_M) if self.square else (-_FARTHEST_M, _FARTHEST_M)
        for name, values in (("x", x), ("y", y)):
            if values.size and not (low <= values.min() and values.max() < high):
                raise ProjectionError(
                    f"{self.projector} {self.square}: {name} of {values.min():.0f} ... {values.max():.0f} m is not in"
                    f" {low:.0f} ... {high:.0f} m: export a smaller region (--region), or with another --projector"
                )
        return x, y

    def inverse(self, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> tuple[F64, F64]:
        """Latitude and longitude, rad, of plane coordinates."""
        east = (np.asarray(x_m, np.float64) + self.east_m) / self.scale
        north = (np.asarray(y_m, np.float64) + self.north_m) / self.scale
        lat, lon = geodetic_from_utm(SCALE * east + FALSE_EASTING_M, SCALE * north, _ZONE)
        return lat, _wrapped(lon - _MERIDIAN_RAD + self.meridian_rad)

    def yaml(self) -> str:
        """The content of `map_projector_info.yaml`."""
        lines = [f"projector_type: {self.projector}", "vertical_datum: WGS84"]
        if self.square:
            return "\n".join((*lines, f"mgrs_grid: {self.square}", ""))
        lines += ["map_origin:", f"  latitude: {self.lat_deg!r}", f"  longitude: {self.lon_deg!r}"]
        lines.append("  altitude: 0.0")  # versions before 2025 ask for it
        if self.projector == "TransverseMercator":
            lines.append(f"scale_factor: {self.scale:.9f}")
        return "\n".join((*lines, ""))


def projection_for(projector: str, lat_deg: float, lon_deg: float, height_m: float) -> Projection:
    """The projection of a map around a place.

    Args:
        projector: of `PROJECTORS`.
        lat_deg: the middle of the map.
        lon_deg: the same.
        height_m: ellipsoidal height of the ground: TransverseMercator gets the scale 1 + height / Earth's radius, so
            that a metre of the map is a metre on the ground. The others have 0.9996, as their definition says.
    """
    lat_deg, lon_deg = round(lat_deg, 7), round(lon_deg, 7)
    if projector == "TransverseMercator":
        return _transverse_mercator(lat_deg, lon_deg, 1.0 + height_m / WGS84_A_M)
    zone = utm_zone(lat_deg, lon_deg)
    meridian = central_meridian_rad(zone)
    east, north = (float(SCALE * v) for v in _mercator(np.radians(lat_deg), np.radians(lon_deg), meridian))
    if projector == "LocalCartesianUTM":
        return Projection(projector, meridian, SCALE, east, north, lat_deg, lon_deg)
    if projector != "MGRS":
        raise ProjectionError(f"unknown projector {projector!r}; known are {', '.join(PROJECTORS)}")
    column, row = (int(np.floor(v / _SQUARE_M)) for v in (east + FALSE_EASTING_M, north))
    x0, y0 = column * _SQUARE_M - FALSE_EASTING_M, row * _SQUARE_M
    band = _BANDS[min(max(int((lat_deg + 80.0) // 8.0), 0), len(_BANDS) - 1)]
    letters = _COLUMNS[zone % 3][column - 1] + _ROWS[(row + (0 if zone % 2 else 5)) % len(_ROWS)]
    return Projection(projector, meridian, SCALE, x0, y0, lat_deg, lon_deg, f"{zone}{band}{letters}")


def _transverse_mercator(lat_deg: float, lon_deg: float, scale: float) -> Projection:
    scale = round(float(np.float32(scale)), 9)  # Autoware reads it as a float
    _, north = _mercator(np.radians(lat_deg), np.radians(lon_deg), float(np.radians(lon_deg)))
    return Projection(
        "TransverseMercator", float(np.radians(lon_deg)), scale, 0.0, scale * float(north), lat_deg, lon_deg
    )


def projection_in(text: str) -> Projection | None:
    """The projection that a `map_projector_info.yaml` of ours says; None: of MGRS, which names no place.

    Raises:
        ProjectionError: it is none of ours.
    """
    found = {match[1]: match[2] for match in map(_LINE.match, text.splitlines()) if match}
    try:
        projector = found["projector_type"]
        if projector == "MGRS":
            return None
        lat_deg, lon_deg = float(found["latitude"]), float(found["longitude"])
        if projector == "TransverseMercator":
            return _transverse_mercator(lat_deg, lon_deg, float(found["scale_factor"]))
        return projection_for(projector, lat_deg, lon_deg, 0.0)
    except (KeyError, ValueError) as error:
        raise ProjectionError(f"map_projector_info.yaml cannot be read: {error}") from None


def utm_zone(lat_deg: float, lon_deg: float) -> int:
    """The zone, with the exceptions of Norway and Svalbard; ProjectionError near the poles."""
    if not -80.0 <= lat_deg < 84.0:
        raise ProjectionError(f"latitude {lat_deg} degrees: UTM reaches from -80 to 84")
    if 56.0 <= lat_deg < 64.0 and 3.0 <= lon_deg < 12.0:
        return 32
    if lat_deg >= 72.0 and 0.0 <= lon_deg < 42.0:
        return 31 if lon_deg < 9.0 else 33 if lon_deg < 21.0 else 35 if lon_deg < 33.0 else 37
    return int((lon_deg + 180.0) // 6.0) % 60 + 1


def _mercator(lat_rad: F64, lon_rad: F64, meridian_rad: float) -> tuple[F64, F64]:
    """Easting and northing of scale 1 from a central meridian and the equator."""
    lon = _wrapped(lon_rad - meridian_rad)
    east, north = utm_from_geodetic(lat_rad, lon + _MERIDIAN_RAD, _ZONE)
    return (east - FALSE_EASTING_M) / SCALE, north / SCALE


def _wrapped(angle_rad: F64) -> F64:
    return np.asarray((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)
