"""`gnd map export`: a map for the programs of others, and `gnd map diff`, whose changes go to a GIS."""

from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import click

from gnd.deploy.map_export.autoware import export_autoware
from gnd.deploy.map_export.las import export_las
from gnd.deploy.map_export.projection import PROJECTORS
from gnd.tile_store.export import FORMATS, ExportError, export_map
from gnd.tile_store.options import PATH, json_option, layer_option, region_option, show, to_read
from gnd.tile_store.store import Store

TO_HELP: Final = "What to write.  [default: by the file's ending]"
PROJECTOR_HELP: Final = "Of --to autoware.  [default: that of the export before, else TransverseMercator]"
POINTS_HELP: Final = "Of --to autoware: points 0.2 m apart that have the Gaussians' moments, or the means alone."
OUTPUTS: Final = (*FORMATS, "autoware", "las", "laz")
Written = tuple[dict[str, Any], str]
"""What was written as JSON, and as a line."""


@click.command(short_help="Write a map for Autoware, GIS and point-cloud programs.")
@click.argument("path", metavar="STORE", type=PATH)
@click.argument("out", metavar="FILE", type=PATH)
@click.option("--to", "--format", "kind", type=click.Choice(OUTPUTS), help=TO_HELP)
@click.option("--projector", type=click.Choice(PROJECTORS), help=PROJECTOR_HELP)
@click.option(
    "--points", type=click.Choice(("samples", "means")), default="samples", show_default=True, help=POINTS_HELP
)
@region_option
@layer_option
@json_option
def export(
    path: Path, out: Path, kind: str | None, projector: str | None, points: Any, region: str, layer: str, as_json: bool
) -> None:
    """Write the newest tiles of STORE to FILE; with --to autoware FILE is the folder of the map.

    Gaussians go as points with covariances into PCD or PLY, tiles as polygons into GeoJSON. Autoware gets cells
    of 20 m with metadata and projection; heights are ellipsoidal.
    """
    name = kind or out.suffix.removeprefix(".").lower()
    if name not in OUTPUTS:
        raise ExportError(f"unknown export format {name!r}; known are {', '.join(OUTPUTS)}: say which with --to")
    if projector is not None and name != "autoware":
        raise ExportError(f"--projector is for --to autoware, not for {name}")
    with to_read(path) as opened:
        if name == "autoware":
            values, line = _autoware(opened, layer, region, out, projector, points)
        else:
            values, line = _plain(opened, layer, region, out, name)
    show(values, as_json, lambda console: console.print(line, highlight=False, soft_wrap=True))


def _plain(store: Store, layer: str, region: str, out: Path, name: str) -> Written:
    result = (
        export_las(store, layer, region, out) if name in ("las", "laz") else export_map(store, layer, region, out, name)
    )
    line = f"{out}: {result.gaussians} Gaussians of {result.tiles} tiles, {result.size_bytes / 1e6:.2f} MB"
    return asdict(result) | {"path": str(result.path)}, line


def _autoware(store: Store, layer: str, region: str, out: Path, projector: str | None, points: Any) -> Written:
    result = export_autoware(store, layer, region, out, projector=projector, points=points)
    grid = result.square or f"origin {result.lat_deg:.7f}, {result.lon_deg:.7f}, scale {result.scale:.9f}"
    line = (
        f"{out}: {result.points} points of {result.gaussians} Gaussians, {result.size_bytes / 1e6:.2f} MB; "
        f"cells: {result.written} new, {result.kept} as before, {result.removed} removed\n"
        f"{result.projector}, {grid}; heights are ellipsoidal (vertical_datum WGS84)"
    )
    return asdict(result) | {"folder": str(result.folder)}, line
