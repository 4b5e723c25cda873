"""Where the nodes of an OSM file are: by their local coordinates, or by latitude and longitude."""

from dataclasses import dataclass
from math import isnan

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.tile_store.feature_io.errors import BadGeometry, NeedsGeoreference
from gnd.tile_store.feature_io.osm_document import OsmDocument, OsmNode, real
from gnd.tile_store.feature_io.values import ImportOptions, check_positions


@dataclass(frozen=True, slots=True, eq=False)
class NodePlaces:
    """Where the nodes of a document are.

    index: by node id the row. lat_rad, lon_rad, height_m: (N,). has_height: (N,). local_m: (N, 3) when the document's
    local coordinates were used, else None.
    """

    index: dict[int, int]
    lat_rad: F64
    lon_rad: F64
    height_m: F64
    has_height: "np.ndarray[tuple[int], np.dtype[np.bool_]]"
    local_m: F64 | None

    def rows(self, nodes: list[OsmNode]) -> list[int]:
        """Rows of nodes."""
        return [self.index[node.id] for node in nodes]


def places_of(document: OsmDocument, options: ImportOptions) -> NodePlaces:
    """Where the nodes are: by their local coordinates when a placement is given, by latitude and longitude otherwise.

    Raises:
        NeedsGeoreference: there are local coordinates and nothing says whether latitudes and longitudes hold; or a
            placement is given and a node has no local coordinates.
        BadGeometry: a position beyond the Earth.
    """
    nodes = list(document.nodes.values())
    index = {node.id: row for row, node in enumerate(nodes)}
    has_local = np.array(["local_x" in node.tags and "local_y" in node.tags for node in nodes], np.bool_)
    has_height = np.array(["ele" in node.tags for node in nodes], np.bool_)
    height_m = np.array([_value(document, node, "ele") for node in nodes], np.float64)
    if options.placement is not None:
        local_m = _local(document, nodes, has_local, height_m)
        lat, lon, height_m = options.placement.geodetic(local_m) if nodes else (np.zeros(0),) * 3
        has_height &= options.placement.height_known or options.height_offset_m != 0.0
    else:
        _refuse_placeholders(document, nodes, has_local, options)
        local_m = None
        lat, lon = np.radians(np.array([(n.lat_deg, n.lon_deg) for n in nodes], np.float64).reshape(-1, 2)).T
    height_m = height_m + options.height_offset_m
    _check_places(document, nodes, lat, lon, height_m)
    return NodePlaces(index, lat, lon, height_m, has_height, local_m)


def _check_places(document: OsmDocument, nodes: list[OsmNode], lat: F64, lon: F64, height_m: F64) -> None:
    try:
        if nodes:
            check_positions(document.where, lat, lon, height_m)
    except BadGeometry:
        for row, node in enumerate(nodes):
            told = f"{document.where}, line {node.line}: node {node.id}"
            check_positions(told, *(column[row : row + 1] for column in (lat, lon, height_m)))
        raise


def _refuse_placeholders(
    document: OsmDocument,
    nodes: list[OsmNode],
    has_local: "np.ndarray[tuple[int], np.dtype[np.bool_]]",
    options: ImportOptions,
) -> None:
    if has_local.any() and not options.trust_latlon:
        raise NeedsGeoreference(
            f"{document.where}: {has_local.sum()} of {len(has_local)} nodes have local_x and local_y, so that their "
            "lat and lon may be placeholders; say --georeference latlon if they hold, an anchor "
            "(LAT,LON[,HEIGHT[,BEARING]]) or track if they do not"
        )
    empty = [node for node in nodes if isnan(node.lat_deg) or isnan(node.lon_deg)]
    if empty:
        raise NeedsGeoreference(
            f"{document.where}, line {empty[0].line}: {len(empty)} of {len(nodes)} nodes have no lat or lon, first "
            f"node {empty[0].id}; say --georeference with an anchor (LAT,LON[,HEIGHT[,BEARING]]) or track"
        )


def _local(
    document: OsmDocument,
    nodes: list[OsmNode],
    has_local: "np.ndarray[tuple[int], np.dtype[np.bool_]]",
    height_m: F64,
) -> F64:
    if not has_local.all():
        first = nodes[int(np.argmin(has_local))]
        raise NeedsGeoreference(
            f"{document.where}, line {first.line}: {(~has_local).sum()} of {len(nodes)} nodes have no local_x and "
            f"local_y, first node {first.id}; a georeference places local coordinates only"
        )
    x, y = (np.array([_value(document, node, key) for node in nodes], np.float64) for key in ("local_x", "local_y"))
    return np.column_stack([x, y, height_m])


def _value(document: OsmDocument, node: OsmNode, key: str) -> float:
    text = node.tags.get(key)
    return 0.0 if text is None else real(f"{document.where}, line {node.line}", f"{key} of node {node.id}", text)
