"""Where the coordinates of an OpenDRIVE file lie on the Earth: by its header, or by an anchor."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.tile_store.feature_io.errors import BadElement, MissingLibrary, NeedsGeoreference
from gnd.tile_store.feature_io.values import ImportOptions
from gnd.tile_store.feature_io.xml_spans import Element
from gnd.tile_store.feature_io.xodr_road import value


@dataclass(frozen=True, slots=True)
class Georeference:
    """Both ways between a file's coordinates and the Earth.

    Attributes:
        to_earth: from points (N, 3) of the file to latitude, longitude (radians) and height, each (N,).
        from_earth: the inverse.
    """

    to_earth: Callable[[F64], tuple[F64, F64, F64]]
    from_earth: Callable[[F64, F64, F64], F64]


def georeference_of(header: Element, where: str, options: ImportOptions) -> Georeference:
    """A placement comes before the file's own geoReference.

    Raises:
        NeedsGeoreference: there is neither.
        MissingLibrary: the geoReference needs pyproj.
        BadElement: pyproj does not understand it.
    """
    if options.placement is not None:
        return Georeference(options.placement.geodetic, options.placement.local)
    reference = header.find("geoReference")
    text = reference.text.strip() if reference else ""
    if not text:
        raise NeedsGeoreference(
            f"{where}: its header has no geoReference; say --georeference LAT,LON[,HEIGHT[,BEARING]]"
        )
    return _by_projection(text, header.find("offset"), where)


def _by_projection(text: str, offset: Element | None, where: str) -> Georeference:
    try:
        from pyproj import CRS, Transformer
        from pyproj.exceptions import ProjError
    except ImportError:
        raise MissingLibrary(
            f"{where}: its geoReference {text!r:.80} needs pyproj (pip install 'gnd-fleet[opendrive]'); or say "
            "--georeference"
        ) from None
    try:
        transformer = Transformer.from_crs(CRS.from_user_input(text), CRS.from_epsg(4326), always_xy=True)
    except ProjError as error:
        raise BadElement(f"{where}: geoReference {text!r:.80}: {error}") from None
    shift = np.array([value(where, offset, key, 0.0) if offset else 0.0 for key in ("x", "y", "z")])
    turn = value(where, offset, "hdg", 0.0) if offset else 0.0
    R = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])

    def to_earth(points_m: F64) -> tuple[F64, F64, F64]:
        east, north, height = (points_m @ R.T + shift).T
        lon_deg, lat_deg = transformer.transform(east, north)
        return np.radians(lat_deg), np.radians(lon_deg), height.copy()

    def from_earth(lat_rad: F64, lon_rad: F64, height_m: F64) -> F64:
        east, north = transformer.transform(np.degrees(lon_rad), np.degrees(lat_rad), direction="INVERSE")
        return np.asarray((np.column_stack([east, north, height_m]) - shift) @ R)

    return Georeference(to_earth, from_earth)
