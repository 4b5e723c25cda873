"""Maps of Argoverse 2 (`log_map_archive_*.json`) as features: borders of lanes, crosswalks, drivable areas.

City coordinates are UTM coordinates less those of the city's origin, both of WGS-84; source of zones and origins:
github.com/argoverse/av2-api, src/av2/geometry/utm.py (UTM_ZONE_MAP, CITY_ORIGIN_LATLONG_DICT, and
convert_city_coords_to_wgs84). Nothing is said there of the datum of z: heights count as unknown until an offset to the
ellipsoid is given.

Format of the file: av2-api, src/av2/map/map_api.py and lane_segment.py. Two lanes beside each other name their common
border both; it becomes one feature that names both lanes. Lanes with their successors are kept beside the features.
"""

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import feature_id_of
from gnd.gnd_map.utm import geodetic_from_utm, utm_from_geodetic
from gnd.tile_store.feature_io.errors import BadElement, BadGeometry, DuplicateId, NeedsGeoreference
from gnd.tile_store.feature_io.json_file import as_text, member, read_json, real_number
from gnd.tile_store.feature_io.lane_crossing import crossing_of
from gnd.tile_store.feature_io.lane_network import Border, MapLane
from gnd.tile_store.feature_io.osm_document import Progress
from gnd.tile_store.feature_io.values import (
    LEFT_OUT,
    FeatureFile,
    ImportOptions,
    MapFeature,
    MapFindings,
    attributes_of,
)

FORMAT: Final = "argoverse2"
_EVERY: Final = 64


@dataclass(frozen=True, slots=True)
class City:
    """UTM zone (northern) and origin, degrees, of a city's coordinates."""

    zone: int
    lat_deg: float
    lon_deg: float


CITIES: Final = {
    "ATX": City(14, 30.27464237939507, -97.7404457407424),
    "DTW": City(17, 42.29993066912924, -83.17555750783717),
    "MIA": City(17, 25.77452579915163, -80.19656914449405),
    "PAO": City(10, 37.416065, -122.13571963362166),
    "PIT": City(17, 40.44177902989321, -80.01294377242584),
    "WDC": City(18, 38.889377, -77.0355047439081),
}
_CITY_OF_NAME: Final = re.compile(r"_([A-Z]{3})_city_")


def city_of(name: str, said: str | None = None) -> City:
    """The city of a map, by its file's name ("…____PIT_city_47896.json") unless it is said.

    Raises:
        NeedsGeoreference: neither tells a known one.
    """
    found = _CITY_OF_NAME.search(name)
    key = said or (found[1] if found else "")
    if key not in CITIES:
        raise NeedsGeoreference(f"{name}: city {key!r:.20} is not known; say --city, one of {', '.join(CITIES)}")
    return CITIES[key]


def geodetic_of_city(points_m: F64, city: City) -> tuple[F64, F64]:
    """Latitude and longitude, radians, each (N,), of city coordinates (N, 2 or 3)."""
    east, north = utm_from_geodetic(np.radians(city.lat_deg), np.radians(city.lon_deg), city.zone)
    return geodetic_from_utm(points_m[:, 0] + east, points_m[:, 1] + north, city.zone)


@dataclass(slots=True)
class _LaneLine:
    """A line of the map, and what is said of it."""

    kind: str
    key: tuple[str, ...]
    points_m: F64
    attributes: dict[str, str]
    lanes: list[str] = field(default_factory=list)

    def also(self, attributes: dict[str, str]) -> None:
        """What another lane says of it; where it says otherwise, both are kept."""
        for name, value in attributes.items():
            words = sorted({*self.attributes.get(name, value).split(), *value.split()} - {""})
            marked = [word for word in words if word != "NONE"] if name == "mark" else words
            self.attributes[name] = " ".join(marked or words)


def read_argoverse(
    data: bytes,
    where: str,
    source: str,
    options: ImportOptions,
    progress: Progress | None = None,
    city: str | None = None,
) -> FeatureFile:
    """The features of a map archive.

    Args:
        data: its bytes.
        where: its name, which tells the city.
        source: what its features are known by.
        options: layers and sigmas; a height offset other than zero makes heights known.
        progress: called now and then.
        city: "PIT", ...; None: as the name says.

    Raises:
        FeatureFileError: one of its family says what is wrong and in which element.
    """
    place = city_of(where, city)
    told = read_json(data, where)
    findings = MapFindings(options.strict)
    borders = _lane_lines(told, where, findings, progress)
    lines = [*borders.lines.values(), *_crosswalks(told, where), *_areas(told, where)]
    left_out: Counter[str] = Counter()
    features: list[MapFeature] = []
    for line in lines:
        layer = options.layer_of(line.kind)
        if layer == LEFT_OUT:
            left_out[line.kind] += 1
            continue
        feature = _feature(line, layer, where, source, options, place)
        findings.check_simple(feature)
        features.append(feature)
    lanes = _lanes(told, where, source, borders) if options.layer_of("lane_boundary") != LEFT_OUT else ()
    return FeatureFile(FORMAT, tuple(features), dict(sorted(left_out.items())), notes=findings.told(), lanes=lanes)


def _feature(line: _LaneLine, layer: str, where: str, source: str, options: ImportOptions, city: City) -> MapFeature:
    attributes = line.attributes | ({"lanes": " ".join(line.lanes)} if line.lanes else {})
    lat, lon = geodetic_of_city(line.points_m, city)
    return MapFeature(
        feature_id_of(FORMAT, source, *line.key), line.kind, layer, lat, lon,
        line.points_m[:, 2] + options.height_offset_m, options.cov_m2(height_known=options.height_offset_m != 0.0),
        options.existence(), attributes_of(attributes), f"{where}: {' '.join(line.key)}",
    )  # fmt: skip


@dataclass(slots=True)
class _Borders:
    """The borders of all lanes, each once however many lanes name it, in either direction.

    Attributes:
        lines: by their vertices.
        of_lane: of each side of a lane, "1:left", its line and whether its vertices are in the lane's direction.
    """

    lines: dict[bytes, _LaneLine] = field(default_factory=dict)
    of_lane: dict[str, tuple[_LaneLine, bool]] = field(default_factory=dict)

    def put(self, line: _LaneLine, side: str) -> None:
        ahead, back = line.points_m.tobytes(), line.points_m[::-1].tobytes()
        first = self.lines.setdefault(min(ahead, back), line)
        same = first.points_m.tobytes() == ahead
        first.lanes.append(side)
        first.also(line.attributes if same else line.attributes | {"mark": _mirrored(line.attributes["mark"])})
        self.of_lane[side] = (first, same)


def _mirrored(mark: str) -> str:
    """A mark seen in the other direction."""
    swapped = {"DASH_SOLID": "SOLID_DASH", "SOLID_DASH": "DASH_SOLID"}
    return next((other + mark.removeprefix(name) for name, other in swapped.items() if mark.startswith(name)), mark)


def _lane_lines(told: Any, where: str, findings: MapFindings, progress: Progress | None) -> _Borders:
    segments = member(where, told, "lane_segments", dict)
    borders = _Borders()
    for number, (key, lane) in enumerate(segments.items()):
        lane_id = _id(where, "lane segment", key, lane)
        sides = {side: _points(lane_id, lane, f"{side}_lane_boundary") for side in ("left", "right")}
        _check_crossing(lane_id, sides["left"], sides["right"], findings)
        for side, points_m in sides.items():
            borders.put(_border(lane_id, lane, key, side, points_m), f"{key}:{side}")
        if progress and number % _EVERY == 0:
            progress("reading lanes", number, len(segments))
    return borders


_SUBTYPES: Final = {"VEHICLE": "road", "BUS": "bus_lane", "BIKE": "bicycle_lane"}


def _lanes(told: Any, where: str, source: str, borders: _Borders) -> tuple[MapLane, ...]:
    """The lane segments with those successors that the file holds; logs cut their maps out of a city's."""
    segments = told["lane_segments"]
    lanes = []
    for key, lane in segments.items():
        name = f"{where}, lane segment {key}"
        sides = []
        for side in ("left", "right"):
            line, ahead = borders.of_lane[f"{key}:{side}"]
            sides.append(Border(feature_id_of(FORMAT, source, *line.key), ahead))
        successors = tuple(str(one) for one in member(name, lane, "successors", list) if str(one) in segments)
        subtype = _SUBTYPES.get(as_text(lane.get("lane_type", "")), "road")
        place = {"location": "urban", "one_way": "yes", "source_lane": key, "subtype": subtype}
        turn = {"intersection": "yes"} if lane.get("is_intersection") else {}
        lanes.append(MapLane(key, sides[0], sides[1], successors, tuple(sorted((place | turn).items()))))
    return tuple(lanes)


def _border(where: str, lane: dict[str, Any], key: str, side: str, points_m: F64) -> _LaneLine:
    mark = member(where, lane, f"{side}_lane_mark_type", str)
    attributes = {"lane_type": as_text(lane.get("lane_type", "")), "mark": mark}
    if lane.get("is_intersection"):
        attributes["is_intersection"] = "true"
    return _LaneLine("lane_boundary", ("lane", key, side), points_m, attributes)


def _check_crossing(where: str, left_m: F64, right_m: F64, findings: MapFindings) -> None:
    met = crossing_of(left_m[:, :2], right_m[:, :2])
    if met is not None:
        x, y = left_m[met[0], :2]
        findings.add(
            f"{where}: its borders cross each other, segment {met[0] + 1} of {len(left_m) - 1} on the left and "
            f"{met[1] + 1} of {len(right_m) - 1} on the right, near ({x:.1f}, {y:.1f}) m"
        )


def _crosswalks(told: Any, where: str) -> list[_LaneLine]:
    """The outlines of crosswalks: along one edge and back along the other."""
    lines = []
    for key, crossing in member(where, told, "pedestrian_crossings", dict).items():
        name = _id(where, "pedestrian crossing", key, crossing)
        first, second = (_points(name, crossing, edge) for edge in ("edge1", "edge2"))
        ahead = np.linalg.norm(first[-1] - second[-1]) <= np.linalg.norm(first[-1] - second[0])
        ring = np.concatenate([first, second[::-1] if ahead else second, first[:1]])
        lines.append(_LaneLine("crosswalk", ("crosswalk", key), ring, {}))
    return lines


def _areas(told: Any, where: str) -> list[_LaneLine]:
    """The outlines of drivable areas, closed."""
    lines = []
    for key, area in member(where, told, "drivable_areas", dict).items():
        points_m = _points(_id(where, "drivable area", key, area), area, "area_boundary")
        closed = points_m if np.array_equal(points_m[0], points_m[-1]) else np.concatenate([points_m, points_m[:1]])
        lines.append(_LaneLine("drivable_area", ("area", key), closed, {}))
    return lines


def _id(where: str, what: str, key: str, element: Any) -> str:
    """How messages call an element; DuplicateId when it bears another's id."""
    found = member(f"{where}, {what} {key:.20}", element, "id", int)
    if str(found) != key:
        raise DuplicateId(f"{where}: {what} {key:.20} says that its id is {found}, which is another's")
    return f"{where}, {what} {key}"


def _points(where: str, element: Any, name: str) -> F64:
    points = member(where, element, name, list)
    if len(points) < 2:
        raise BadElement(f"{where}: {name} has {len(points)} points, a line needs 2: no position")
    told = f"{where}, {name}"
    rows = [[real_number(told, member(told, p, axis, object)) for axis in "xyz"] for p in points]
    points_m = np.array(rows, np.float64)
    if np.abs(points_m).max() > MAX_CITY_M:
        raise BadGeometry(
            f"{told}: {np.abs(points_m).max():.0f} m from the city's origin, the limit is {MAX_CITY_M:.0f}"
        )
    return points_m


MAX_CITY_M: Final = 100_000.0
