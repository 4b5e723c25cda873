"""`gnd lanes`: the borders of a Lanelet2 map as a layer that vehicles keep up to date, and back as edits of the map."""

from collections import Counter
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from gnd.answers import tell
from gnd.deploy.lane_edits import MapEdits, lane_edits, map_pieces, painted
from gnd.fleet_bus.identity.options import identity_option
from gnd.gnd_map.features import Feature
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.cli import PATH, json_option, show, store_to_fill
from gnd.tile_store.feature_io.errors import FeatureFileError
from gnd.tile_store.feature_io.formats import read_features
from gnd.tile_store.feature_io.osm_change import apply_osm_change
from gnd.tile_store.feature_io.osm_document import MAX_FILE_BYTES
from gnd.tile_store.feature_io.stored import layer_tiles
from gnd.tile_store.feature_io.values import FeatureFile, ImportOptions, default_source
from gnd.tile_store.feature_io.whole_file import write_whole
from gnd.tile_store.feature_io.xml_spans import read_bytes
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import to_read
from gnd.vehicle_agent.features.lanes.lane_mapper import MARKINGS

_LAYER = click.option("--layer", default=MARKINGS.name, show_default=True, help="Of the markings.")
_SOURCE = click.option("--source", help="Name of the map.  [default: its file's name]")


@click.group(name="lanes")
def lanes() -> None:
    """Lane borders of a Lanelet2 map that vehicles keep up to date: into a store, and back as edits of the map."""


def _map(file: Path, source: str | None) -> tuple[FeatureFile, str, ImportOptions]:
    name, options = source or default_source(file), ImportOptions(trust_latlon=True)
    read = read_features(file, name, options, "lanelet2")
    if not painted(read.features):
        raise FeatureFileError(f"{file}: no painted borders (ways of type line_thin or line_thick) among its features")
    return read, name, options


@lanes.command(name="import", short_help="Put a map's painted borders into a store, in pieces.")
@click.argument("file", metavar="MAP.osm", type=PATH)
@click.option("--store", "-o", "path", required=True, type=LOCATION, help="The store; it is made when missing.")
@_SOURCE
@_LAYER
@json_option
@identity_option
def import_(file: Path, path: StoreLocation, source: str | None, layer: str, as_json: bool) -> None:
    """Put the painted borders of MAP.osm into a store: the first version of the layer that vehicles compare with."""
    read, name, _ = _map(file, source)
    tiles = map_pieces(read.features)
    with store_to_fill(path) as store:
        if layer_tiles(store, layer):
            raise FeatureFileError(f"{shown(path)}: layer {layer} has tiles already; what vehicles found would be lost")
        results = store.put_tiles(tiles.values(), "base", layer)
    values = {
        "source": name,
        "layer": layer,
        "borders": len(painted(read.features)),
        "pieces": sum(len(tile.features) for tile in tiles.values()),
        "tiles": len(results),
    }
    made = f"{values['pieces']} pieces of {values['borders']} borders in {len(results)} tiles"
    told = f"{shown(path)}, layer {layer}: {made}"
    show(values, as_json, lambda console: console.print(told))


@lanes.command(short_help="What changed, as edits of a Lanelet2 map.")
@click.argument("file", metavar="MAP.osm", type=PATH)
@click.option("--store", "path", required=True, type=LOCATION, help="The store in which vehicles keep the layer.")
@click.option("--out", "-o", type=PATH, help="Write the edits here (osmChange, .osc).")
@click.option("--edited", type=PATH, help="Write the whole map after the edits here, too.")
@_SOURCE
@_LAYER
@json_option
def edits(
    file: Path,
    path: StoreLocation,
    out: Path | None,
    edited: Path | None,
    source: str | None,
    layer: str,
    as_json: bool,
) -> None:
    """Compare MAP.osm with the layer of a store and tell what changed: borders moved, gone, new, painted otherwise."""
    read, name, options = _map(file, source)
    with to_read(path) as store:
        tiles: dict[TileId, tuple[Feature, ...]] = {one.tile_id: one.features for one in layer_tiles(store, layer)}
    if not tiles:
        raise FeatureFileError(f"{shown(path)}: no tiles of layer {layer}; put the map there first: gnd lanes import")
    found = lane_edits(read, tiles, name, options)
    for target, data in ((out, found.change.data), (edited, found.edited)):
        if target is not None:
            write_whole(target, data)
    show(_values(found), as_json, lambda console: _print(console, found, out))


@lanes.command(short_help="Apply edits to a map.")
@click.argument("file", metavar="MAP.osm", type=PATH)
@click.argument("change", metavar="EDITS.osc", type=PATH)
@click.argument("out", metavar="OUT.osm", type=PATH)
@json_option
def apply(file: Path, change: Path, out: Path, as_json: bool) -> None:
    """Write MAP.osm with all edits of EDITS.osc to OUT.osm; an edit that does not fit refuses all."""
    limit = MAX_FILE_BYTES
    data = apply_osm_change(read_bytes(file, limit), read_bytes(change, limit), str(file))
    write_whole(out, data)
    tell({"file": str(out), "size_bytes": len(data)}, as_json, f"{out}: {len(data)} bytes")


def _values(found: MapEdits) -> dict[str, Any]:
    return {
        "borders": found.borders,
        "length_m": round(found.length_m, 1),
        "edits": [edit.as_dict() for edit in found.edits],
        "counts": dict(Counter(edit.what for edit in found.edits)),
        "change": {name: dict(kinds) for name, kinds in found.change.counts.items()},
    }


def _print(console: Console, found: MapEdits, out: Path | None) -> None:
    table = Table("edit", "border", "shift m", "painted", "length m", "pieces", "sigma m", "at")
    for one in found.edits:
        painted_as = " ".join(word for word in (one.color, one.subtype) if word)
        shift = f"{one.shift_m:+.2f}" if one.what == "moved" else ""
        of = f"{one.pieces[0]} of {one.pieces[1]}"
        at = f"{one.lat_deg:.6f}, {one.lon_deg:.6f}"
        table.add_row(one.what, one.border, shift, painted_as, f"{one.length_m:.1f}", of, f"{one.sigma_m:.3f}", at)
    console.print(table)
    console.print(f"{len(found.edits)} edits of {found.borders} borders, {found.length_m / 1e3:.2f} km")
    if out is not None:
        console.print(f"written to {out}")
