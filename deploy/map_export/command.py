"""`gnd map export`: a map for the programs of others, and `gnd map diff`, whose changes go to a GIS."""

from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console

from gnd.deploy.map_export.autoware import export_autoware
from gnd.deploy.map_export.change_files import WRITERS, write_changes
from gnd.deploy.map_export.changes import ChangedVoxels, map_changes
from gnd.deploy.map_export.foxglove import write_mcap
from gnd.deploy.map_export.las import export_las
from gnd.deploy.map_export.projection import PROJECTORS
from gnd.deploy.map_export.sampling import PointsOf
from gnd.deploy.map_export.scene import read_scene, store_of
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import tables
from gnd.tile_store.arguments import parse_tile, parse_time_ns, parse_versions
from gnd.tile_store.compare import MapDiff, map_diff, version_diff
from gnd.tile_store.errors import StoreError
from gnd.tile_store.export import FORMATS, ExportError, export_map
from gnd.tile_store.location import LOCATION, StoreLocation
from gnd.tile_store.options import PATH, json_option, layer_option, region_option, show, to_read
from gnd.tile_store.store import Store

TO_HELP: Final = "What to write.  [default: by the file's ending]"
PROJECTOR_HELP: Final = "Of --to autoware.  [default: that of the export before, else TransverseMercator]"
POINTS_HELP: Final = (
    "Of --to autoware: points 0.2 m apart that have the Gaussians' moments, or the means alone.  [default: samples]"
)
OUTPUTS: Final = (*FORMATS, "autoware", "las", "laz", "mcap")
CHANGES_HELP: Final = "Write what differs as objects, for a GIS: FILE.gpkg or FILE.geojson (layers of Gaussians)."
Written = tuple[dict[str, Any], str]
"""What was written as JSON, and as a line."""


@click.command(short_help="Write a map for Autoware, GIS and point-cloud programs.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("out", metavar="FILE", type=PATH)
@click.option("--to", "--format", "kind", type=click.Choice(OUTPUTS), help=TO_HELP)
@click.option("--projector", type=click.Choice(PROJECTORS), help=PROJECTOR_HELP)
@click.option("--points", type=click.Choice(("samples", "means")), help=POINTS_HELP)
@region_option
@layer_option
@json_option
def export(
    path: StoreLocation,
    out: Path,
    kind: str | None,
    projector: str | None,
    points: PointsOf | None,
    region: str,
    layer: str,
    as_json: bool,
) -> None:
    """Write the newest tiles of STORE (or of the folder of a run) to FILE; of --to autoware FILE is the map's folder.

    Gaussians go as points with covariances into PCD or PLY, tiles as polygons into GeoJSON. Autoware gets cells
    of 20 m with metadata and projection; heights are ellipsoidal. MCAP, for Foxglove, has the versions and, of a
    run, the ways of its vehicles as well.
    """
    name = kind or out.suffix.removeprefix(".").lower()
    if name not in OUTPUTS:
        raise ExportError(f"unknown export format {name!r}; known are {', '.join(OUTPUTS)}: say which with --to")
    for option, said in (("--projector", projector), ("--points", points)):
        if said is not None and name != "autoware":
            raise ExportError(f"{option} is for --to autoware, not for {name}")
    with to_read(store_of(path)) as opened:
        if name == "autoware":
            values, line = _autoware(opened, layer, region, out, projector, points or "samples")
        elif name == "mcap":
            values, line = _mcap(opened, layer, region, out, path)
        else:
            values, line = _plain(opened, layer, region, out, name)
    show(values, as_json, lambda console: console.print(line, highlight=False, soft_wrap=True))


def _plain(store: Store, layer: str, region: str, out: Path, name: str) -> Written:
    if name in ("las", "laz"):
        result = export_las(store, layer, region, out, compressed=name == "laz")
    else:
        result = export_map(store, layer, region, out, name)
    line = f"{out}: {result.gaussians} Gaussians of {result.tiles} tiles, {result.size_bytes / 1e6:.2f} MB"
    return asdict(result) | {"path": str(result.path)}, line


def _mcap(store: Store, layer: str, region: str, out: Path, path: StoreLocation) -> Written:
    scene = read_scene(store, layer, region, path if isinstance(path, Path) and path.is_dir() else None)
    write_mcap(scene, out)
    size_bytes = out.stat().st_size
    values = {
        "path": str(out),
        "gaussians": len(scene.points_m),
        "updates": len(scene.updates),
        "vehicles": sorted(scene.ways),
        "size_bytes": size_bytes,
    }
    return values, (
        f"{out}: {len(scene.points_m)} Gaussians, {len(scene.updates)} updates, {len(scene.ways)} vehicles,"
        f" {size_bytes / 1e6:.2f} MB"
    )


def _autoware(store: Store, layer: str, region: str, out: Path, projector: str | None, points: PointsOf) -> Written:
    result = export_autoware(store, layer, region, out, projector=projector, points=points)
    grid = result.square or f"origin {result.lat_deg:.7f}, {result.lon_deg:.7f}, scale {result.scale:.9f}"
    line = (
        f"{out}: {result.points} points of {result.gaussians} Gaussians, {result.size_bytes / 1e6:.2f} MB; "
        f"cells: {result.written} new, {result.kept} as before, {result.removed} removed\n"
        f"{result.projector}, {grid}; heights are ellipsoidal (vertical_datum WGS84)"
    )
    return asdict(result) | {"folder": str(result.folder)}, line


@click.command(short_help="Where two maps, times or versions differ.")
@click.argument("old", metavar="STORE", type=LOCATION)
@click.argument("new", metavar="[OTHER]", type=LOCATION, required=False)
@click.option("--since", help="Compare with STORE as it was then: 2026-01-31T12:00:00Z.")
@click.option("--tile", help="Compare two versions of one tile (path, number, or lat,lon) ...")
@click.option("--versions", help="... these two: 3..5.  [default: the newest with the one before]")
@click.option("--to", type=PATH, help=CHANGES_HELP)
@region_option
@layer_option
@json_option
def diff(
    old: StoreLocation,
    new: StoreLocation | None,
    since: str | None,
    tile: str | None,
    versions: str | None,
    to: Path | None,
    region: str,
    layer: str,
    as_json: bool,
) -> None:
    """Where STORE differs from OTHER, from itself at an earlier time, or between two versions of a tile."""
    if sum(way is not None for way in (new, since, tile)) != 1 or (versions and not tile):
        raise StoreError("diff: give either OTHER, --since TIME, or --tile TILE [--versions A..B]")
    if to is not None and to.suffix.lower() not in WRITERS:
        raise StoreError(f"{to}: changes go to {' or '.join(WRITERS)}")
    with ExitStack() as stack:
        first = stack.enter_context(to_read(old))
        second = first if new is None else stack.enter_context(to_read(new))
        old_at_ns = None if since is None else parse_time_ns(since)
        pair = None if tile is None else _pair(first, layer, parse_tile(tile), versions)
        if pair is not None:
            result = version_diff(first, layer, *pair)
        else:
            result = map_diff(first, second, layer=layer, prefix=region, old_at_ns=old_at_ns)
        found = None if to is None else _changes(first, second, layer, region, old_at_ns, pair)
    values = result.as_dict()
    if to is not None and found is not None:
        write_changes(found.changes, to)
        values |= {"changes": [change.as_dict() for change in found.changes], "voxels_alone": found.alone}
    show(values, as_json, lambda console: _print_diff(console, result, found, to))


def _changes(
    old: Store, new: Store, layer: str, region: str, old_at_ns: int | None, pair: tuple[TileId, int, int] | None
) -> ChangedVoxels:
    if pair is None:
        return map_changes(old, new, layer=layer, prefix=region, old_at_ns=old_at_ns)
    return map_changes(old, new, layer=layer, tile=pair[0], versions=pair[1:])


def _print_diff(console: Console, result: MapDiff, found: ChangedVoxels | None, to: Path | None) -> None:
    tables.print_diff(console, result)
    if found is not None:
        kinds = Counter(f"{change.change} {change.shape}" for change in found.changes)
        told = ", ".join(f"{n} {kind}" for kind, n in sorted(kinds.items())) or "none"
        console.print(
            f"{to}: {len(found.changes)} changes: {told}; {found.alone} voxels that lie alone are left out",
            highlight=False,
            soft_wrap=True,
        )


def _pair(store: Store, layer: str, tile: TileId, versions: str | None) -> tuple[TileId, int, int]:
    """The tile, and the two versions that are asked for, or its newest two."""
    if versions is not None:
        return (tile, *parse_versions(versions))
    lines = store.history(layer, tile)
    if len(lines) < 2:
        raise StoreError(f"tile {tile.path} of layer {layer} has {len(lines)} versions; two are needed")
    return tile, lines[-2].version, lines[-1].version
