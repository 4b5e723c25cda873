"""`gnd features`: feature layers of a store from files of others, and into files for others."""

from collections.abc import Sequence
from dataclasses import asdict
from math import radians
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

from gnd.deploy import features_tables as tables
from gnd.fleet_bus.identity.options import identity_option
from gnd.tile_store.cli import PATH, json_option, region_option, show, store_to_fill
from gnd.tile_store.feature_io.about import about_options
from gnd.tile_store.feature_io.errors import FeatureFileError
from gnd.tile_store.feature_io.formats import FORMATS, WRITTEN, export_features, format_of, read_features
from gnd.tile_store.feature_io.geojson_export import as_geojson
from gnd.tile_store.feature_io.placement import Placement
from gnd.tile_store.feature_io.stored import import_features, load_features, sources_of
from gnd.tile_store.feature_io.values import LEFT_OUT, SIGMA_M, SURE, ImportOptions, MapFeature, default_source
from gnd.tile_store.location import LOCATION, StoreLocation, shown
from gnd.tile_store.options import existing

GEOREFERENCE_HELP: Final = (
    "Where local coordinates lie: latlon (the file's lat and lon hold), LAT,LON[,HEIGHT[,BEARING]] of the local origin "
    "(degrees, metres; BEARING of the local y axis), or track (with --poses and --fixes)."
)


@click.group(name="features")
def features() -> None:
    """Import, export and list the feature layers of a store: signs, poles, streetlights, lanes, ...

    Files: Lanelet2 (.osm), OpenDRIVE (.xodr), GeoJSON (.geojson), Argoverse 2 maps (log_map_archive_*.json,
    read only).
    """


@features.command(name="import", short_help="Put the features of a file into a store.")
@click.argument("file", type=PATH)
@click.option("--store", "-o", "path", required=True, type=LOCATION, help="The store; it is made when missing.")
@click.option("--format", "kind", type=click.Choice(FORMATS), help="  [default: by the file's name]")
@click.option(
    "--layer", "layers", multiple=True, metavar="KIND=LAYER", help=f"Layer of a kind; {LEFT_OUT}: leave it out."
)
@click.option("--other", metavar="LAYER", help="Layer of all kinds without one.  [default: they are left out]")
@click.option("--source", help="Name of the source; importing it again replaces its features.  [default: file name]")
@click.option("--georeference", metavar="WHERE", help=GEOREFERENCE_HELP)
@click.option("--poses", type=PATH, help="Track in the local coordinates: 3 x 4 matrices (KITTI).")
@click.option("--fixes", type=PATH, help="GNSS of that track: lines of LAT LON in degrees.")
@click.option("--height-offset", default=0.0, metavar="METRES", help="Added to heights, which makes them ellipsoidal.")
@click.option("--sigma", default=SIGMA_M, show_default=True, metavar="METRES", help="Of positions, each axis.")
@click.option("--exist", default=SURE, show_default=True, help="Mass of existence of the features of the file.")
@click.option("--strict", is_flag=True, help="Refuse a file with lines or borders that cross; else they are reported.")
@click.option("--city", help="Of an Argoverse 2 map: PIT, ...  [default: by the file's name]")
@json_option
@identity_option
def import_(
    file: Path,
    path: StoreLocation,
    kind: str | None,
    layers: tuple[str, ...],
    other: str | None,
    source: str | None,
    georeference: str | None,
    poses: Path | None,
    fixes: Path | None,
    height_offset: float,
    sigma: float,
    exist: float,
    strict: bool,
    city: str | None,
    as_json: bool,
) -> None:
    """Put the features of FILE into the layers of a store: all or, when anything is wrong with it, none.

    Features of other files stay. Heights are ellipsoidal in a store: say --height-offset when the file's are above the
    sea (the geoid's height there) or above a local zero.
    """
    format_of(file, kind)  # a wrong name is told before a track is computed
    options = ImportOptions(
        _layers(layers), other, _placement(georeference, poses, fixes), georeference == "latlon", height_offset, sigma,
        sigma, exist, strict,
    )  # fmt: skip
    name = source or default_source(file)
    with _Bars() as bars:
        read = read_features(file, name, options, kind, city, bars)
        with store_to_fill(path) as store:
            result = import_features(store, read, name, about_options(options), bars)
    show(asdict(result), as_json, lambda console: tables.print_import(console, shown(path), result))


def _layers(said: Sequence[str]) -> dict[str, str]:
    pairs = [text.partition("=") for text in said]
    wrong = [text for text, (kind, _, layer) in zip(said, pairs, strict=True) if not (kind and layer)]
    if wrong:
        raise FeatureFileError(f"--layer {wrong[0]!r:.60} is not like traffic_light=signals")
    return {kind: layer for kind, _, layer in pairs}


def _placement(said: str | None, poses: Path | None, fixes: Path | None) -> Placement | None:
    if said == "track":
        if poses is None or fixes is None:
            raise FeatureFileError("--georeference track needs --poses FILE and --fixes FILE")
        from gnd.vehicle_agent.localise.drawn_map import placement_by_track  # it loads gtsam

        return placement_by_track(poses, fixes)
    if poses is not None or fixes is not None:
        raise FeatureFileError("--poses and --fixes go with --georeference track")
    return None if said in (None, "latlon") else _anchor(said or "")


def _anchor(said: str) -> Placement:
    try:
        values = [float(text) for text in said.split(",")]
    except ValueError:
        values = []
    if not 2 <= len(values) <= 4 or not (abs(values[0]) <= 90 and abs(values[1]) <= 180):
        raise FeatureFileError(f"--georeference {said!r:.60} is not latlon, track or LAT,LON[,HEIGHT[,BEARING]]")
    height_m = values[2] if len(values) > 2 else None
    bearing = radians(values[3]) if len(values) > 3 else 0.0
    return Placement.anchored(radians(values[0]), radians(values[1]), height_m, bearing)


@features.command(short_help="Write a store's features to a file.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("out", metavar="FILE", type=PATH)
@click.option("--layer", "layers", multiple=True, help="A layer, or several.  [default: all]")
@region_option
@click.option("--format", "kind", type=click.Choice(WRITTEN), help="  [default: by the file's name]")
@click.option("--source", help="Write into the file imported as this; '': a new file.  [default: the only one]")
@json_option
def export(
    path: StoreLocation,
    out: Path,
    layers: tuple[str, ...],
    region: str,
    kind: str | None,
    source: str | None,
    as_json: bool,
) -> None:
    """Write the newest features of STORE to FILE: GeoJSON, Lanelet2 (.osm) or OpenDRIVE (.xodr).

    A Lanelet2 or OpenDRIVE file that was imported comes back with all that is no feature; only what has changed is
    written anew. A new Lanelet2 file has the lanes of every source as lanelets.
    """
    with existing(path) as store:
        result = export_features(store, out, layers, region, kind, source)
    show(asdict(result), as_json, lambda console: tables.print_export(console, result))


@features.command(name="list", short_help="The features of a store.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.option("--layer", "layers", multiple=True, help="A layer, or several.  [default: all]")
@region_option
@click.option("--kind", help="Only of this kind.")
@click.option("--limit", default=100, show_default=True, type=click.IntRange(0), help="At most so many.")
@json_option
def list_(
    path: StoreLocation, layers: tuple[str, ...], region: str, kind: str | None, limit: int, as_json: bool
) -> None:
    """The features of STORE, a line each, and how many there are by layer."""
    with existing(path) as store:
        found = [one for one in load_features(store, layers, region) if kind in (None, one.kind)]
        sources = {name: {"format": one.format, **_counts(one.ids)} for name, one in sources_of(store).items()}
    values = {
        "features": len(found),
        "layers": _counts_of(found),
        "sources": sources,
        "listed": [_row(one) for one in found[:limit]],
    }
    show(values, as_json, lambda console: tables.print_list(console, shown(path), values))


def _counts(ids: Any) -> dict[str, int]:
    return {layer: len(numbers) for layer, numbers in ids.items()}


def _counts_of(found: Sequence[MapFeature]) -> dict[str, dict[str, int]]:
    counts: dict[str, dict[str, int]] = {}
    for one in found:
        kinds = counts.setdefault(one.layer, {})
        kinds[one.kind] = kinds.get(one.kind, 0) + 1
    return counts


def _row(feature: MapFeature) -> dict[str, Any]:
    told = as_geojson(feature)
    first = told["geometry"]["coordinates"] if len(feature) == 1 else told["geometry"]["coordinates"][0]
    return {
        "id": told["id"],
        "lon_deg": first[0],
        "lat_deg": first[1],
        "height_m": first[2],
        "vertices": len(feature),
    } | {key: told["properties"][key] for key in ("layer", "kind", "state", "exist", "absent", "unknown", "sigma_m")}


@features.command(name="show", short_help="One feature of a store.")
@click.argument("path", metavar="STORE", type=LOCATION)
@click.argument("feature_id", metavar="ID", type=int)
@json_option
def show_(path: StoreLocation, feature_id: int, as_json: bool) -> None:
    """One feature of STORE: as GeoJSON, with its tiles and the reports that it comes from."""
    with existing(path) as store:
        found = [one for one in load_features(store) if one.feature_id == feature_id]
        if not found:
            raise FeatureFileError(f"{shown(path)}: no feature {feature_id}; gnd features list shows what there is")
        values = as_geojson(found[0]) | tables.whereabouts(store, found[0])
    show(values, as_json, lambda console: console.print(tables.feature(values)))


class _Bars:
    """A bar for each step of the work, on a terminal."""

    def __init__(self) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        console = Console(stderr=True)
        self._bars = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> "_Bars":
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def __call__(self, what: str, done: int, total: int) -> None:
        if what not in self._tasks:
            self._tasks[what] = self._bars.add_task(what, total=total)
        self._bars.update(self._tasks[what], completed=done, total=total)
