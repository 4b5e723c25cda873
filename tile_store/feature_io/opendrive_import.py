"""OpenDRIVE maps as features: signals, objects, and the borders of lanes; the lanes with their successors beside them.

Format: ASAM OpenDRIVE 1.4 to 1.8. Curves are sampled every half metre and thinned to 5 mm. The header's geoReference is
any that pyproj understands (an optional library: extra `opendrive`); files without one need an anchor.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from gnd.gnd_map.features import feature_id_of
from gnd.tile_store.feature_io.errors import (
    BadElement,
    DuplicateId,
    FileTooLarge,
    UnknownFormat,
)
from gnd.tile_store.feature_io.lane_network import MapLane
from gnd.tile_store.feature_io.osm_document import Progress
from gnd.tile_store.feature_io.values import (
    LEFT_OUT,
    FeatureFile,
    ImportOptions,
    MapFeature,
    MapFindings,
    attributes_of,
)
from gnd.tile_store.feature_io.xml_spans import Element, read_root
from gnd.tile_store.feature_io.xodr_curves import simplified
from gnd.tile_store.feature_io.xodr_georeference import Georeference, georeference_of
from gnd.tile_store.feature_io.xodr_lanes import LaneId, lanes_of
from gnd.tile_store.feature_io.xodr_road import Road, road_of
from gnd.tile_store.feature_io.xodr_things import Thing, things_of

FORMAT: Final = "opendrive"
STEP_M: Final = 0.5
TOLERANCE_M: Final = 0.005
MAX_SAMPLES: Final = 50_000_000


def read_opendrive(
    data: bytes, where: str, source: str, options: ImportOptions, progress: Progress | None = None
) -> FeatureFile:
    """The features of an OpenDRIVE file.

    Args:
        data: its bytes.
        where: what to call it in messages.
        source: what its features are known by.
        options: a placement comes before the file's own geoReference.
        progress: called now and then.

    Raises:
        FeatureFileError: one of its family says what is wrong and where.
    """
    file = read_xodr(data, where, options)
    left_out: Counter[str] = Counter()
    features: list[MapFeature] = []
    findings = MapFindings(options.strict)
    for number, road in enumerate(file.roads.values()):
        for thing, feature in drawn_things(file, road, source, options):
            if feature is None:
                left_out[thing.kind] += 1
                continue
            findings.check_simple(feature)
            features.append(feature)
        if progress:
            progress("reading roads", number, len(file.roads))
    lanes: tuple[MapLane, ...] = ()
    junctions = file.root.all("junction")
    if options.layer_of("lane_boundary") != LEFT_OUT:
        lanes = lanes_of(file.roads, junctions, partial(_border_id, source))
    return FeatureFile(
        FORMAT, tuple(features), dict(sorted(left_out.items())), data, findings.told(), lanes,
        {"road": len(file.roads), "junction": len(junctions)},
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class XodrFile:
    """An OpenDRIVE file: its root, its roads by id, and where its coordinates lie on the Earth."""

    root: Element
    roads: dict[str, Road]
    georeference: Georeference


def read_xodr(data: bytes, where: str, options: ImportOptions) -> XodrFile:
    """The roads of a file; errors as `read_opendrive`."""
    root = read_root(data, where)
    header = _header(root, where)
    return XodrFile(root, _roads(root, where), georeference_of(header, where, options))


def drawn_things(
    file: XodrFile, road: Road, source: str, options: ImportOptions
) -> Iterator[tuple[Thing, MapFeature | None]]:
    """What a road has, each with its feature; None: its kind has no layer."""
    known = options.placement.height_known if options.placement else True
    with np.errstate(all="ignore"):  # numbers may overflow on the way: what comes out is checked to be finite
        things = (*_borders(road), *things_of(road, file.roads))
    for thing in things:
        layer = options.layer_of(thing.kind)
        if layer == LEFT_OUT:
            yield thing, None
            continue
        lat, lon, height = file.georeference.to_earth(thing.points_m)
        yield thing, MapFeature(
            feature_id_of(FORMAT, source, road.id, *thing.key), thing.kind, layer, lat, lon,
            height + options.height_offset_m, options.cov_m2(height_known=known), options.existence(),
            attributes_of({"road": road.id} | thing.attributes), f"{road.where}, {' '.join(map(str, thing.key))}",
        )  # fmt: skip


def _border_id(source: str, lane: LaneId) -> int:
    """The feature that is the outer border of a lane."""
    return feature_id_of(FORMAT, source, lane[0], "lane", *lane[1:])


def _header(root: Element, where: str) -> Element:
    if root.name != "OpenDRIVE":
        raise UnknownFormat(f"{where}: root element <{root.name[:40]}>, an OpenDRIVE file has <OpenDRIVE>")
    header = root.find("header")
    if header is None:
        raise BadElement(f"{where}: no <header>")
    major = header.attributes.get("revMajor")
    if major != "1":
        raise UnknownFormat(
            f"{where}: OpenDRIVE {major!r:.20}.{header.attributes.get('revMinor', '?'):.20}, known is major version 1"
        )
    return header


def _roads(root: Element, where: str) -> dict[str, Road]:
    roads: dict[str, Road] = {}
    for element in root.all("road"):
        road = road_of(element, where)
        if road.id in roads:
            raise DuplicateId(
                f"{road.where}: a road of this id comes twice, first in line {roads[road.id].element.line}"
            )
        roads[road.id] = road
    samples = sum(road.length_m / STEP_M * sum(len(s.lanes) for s in road.sections) for road in roads.values())
    if samples > MAX_SAMPLES:
        raise FileTooLarge(
            f"{where}: lanes of {samples * STEP_M / 1e3:.0f} km, the limit is {MAX_SAMPLES * STEP_M / 1e3:.0f}"
        )
    return roads


def _borders(road: Road) -> Iterator[Thing]:
    """The outer border of every lane, and lane 0: the line between left and right."""
    for number, section in enumerate(road.sections):
        steps = max(2, int(np.ceil((section.end_m - section.start_m) / STEP_M)) + 1)
        s = np.linspace(section.start_m, section.end_m, steps)
        inside = np.clip(s, section.start_m, np.nextafter(section.end_m, 0.0))
        for lane_id, lane in sorted(section.lanes.items()):
            t = road.lane_offset.at(inside) + section.border_m(lane_id, inside)
            told = {"lane": str(lane_id), "lane_type": lane.type, "mark": lane.mark, "section": str(number)}
            told |= {"color": lane.colour} if lane.colour else {}
            yield Thing("lane_boundary", ("lane", number, lane_id), simplified(road.points_m(s, t), TOLERANCE_M), told)
