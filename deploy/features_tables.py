"""The answers of `gnd features` as tables for people."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from gnd.tile_store import tables
from gnd.tile_store.feature_io.formats import FeaturesExported
from gnd.tile_store.feature_io.stored import ImportResult, layer_tiles
from gnd.tile_store.feature_io.values import MapFeature
from gnd.tile_store.sqlite_store import SqlStore
from gnd.words import many


def print_import(console: Console, path: str, result: ImportResult) -> None:
    """What an import did."""
    told = {
        "from": f"{result.source} ({result.format})",
        **{f"layer {layer}": many(n, "feature") for layer, n in result.features.items()},
        **_lanes(result.lanes),
        "left out": _counted(result.left_out) or "nothing",
        **({"kept in the file": _counted(result.kept)} if result.kept else {}),
        "gone since the last import": result.removed,
        "tiles": f"{result.tiles} published, {result.unchanged} unchanged",
    }
    console.print(tables.fields(path, told))
    for note in result.notes:
        console.print(note, highlight=False)


def _lanes(counts: Mapping[str, int]) -> dict[str, str]:
    if not counts.get("lanes"):
        return {}
    return {
        "lanes between them": f"{counts['lanes']}, of them {counts['with_successor']} with a successor and "
        f"{counts['with_neighbour']} with a neighbour"
    }


def print_export(console: Console, result: FeaturesExported) -> None:
    """What an export wrote."""
    console.print(f"{result.path}: {result.features} features, {result.size_bytes / 1e6:.2f} MB", highlight=False)
    changes = result.changes
    if changes is not None and changes.lanelets:
        console.print(
            f"{changes.lanelets} lanelets; ends joined over {changes.joined_m:.3f} m at most, {changes.apart} "
            f"successors too far apart, {changes.unbounded} lanes left out without a border",
            highlight=False,
        )
    if result.source is not None and changes is not None:
        console.print(
            f"into {result.source}: {changes.moved} nodes and lines moved, {changes.retagged} elements with "
            f"other tags, {changes.removed} elements removed, {changes.added} features new"
            + (f", {changes.unwritten} changes that the format cannot say" if changes.unwritten else ""),
            highlight=False,
        )


def print_list(console: Console, path: str, values: dict[str, Any]) -> None:
    """The features, and how many there are."""
    columns = ("id", "layer", "kind", "lat_deg", "lon_deg", "height_m", "vertices", "state", "exist", "sigma_m")
    table = Table(title=path)
    for column in columns:
        words = column in ("layer", "kind", "state")
        table.add_column(
            column.replace("_", " "), justify="left" if words else "right", min_width=19 if column == "id" else None
        )
    for row in values["listed"]:
        table.add_row(*(_cell(column, row[column]) for column in columns))
    console.print(table)
    for layer, kinds in values["layers"].items():
        console.print(f"{layer}: {_counted(kinds)}", highlight=False)
    if len(values["listed"]) < values["features"]:
        console.print(f"{len(values['listed'])} of {values['features']} shown (--limit)", highlight=False)


def feature(values: dict[str, Any]) -> Table:
    """One feature, a row a value."""
    properties = values["properties"]
    told = {key: value for key, value in properties.items() if key != "attributes"} | properties["attributes"]
    points = values["geometry"]["coordinates"]
    line = [points] if values["geometry"]["type"] == "Point" else points
    places = {"vertices": len(line), "from": _place(line[0]), "to": _place(line[-1])}
    reports = {"tiles": ", ".join(values["tiles"]), "reports": ", ".join(values["reports"]) or "none"}
    return tables.fields(f"feature {values['id']}", told | places | reports)


def whereabouts(store: SqlStore, found: MapFeature) -> dict[str, list[str]]:
    """The tiles that a feature lies in, and the reports that its newest versions come from."""
    tiles = [
        one for one in layer_tiles(store, found.layer) if any(f.feature_id == found.feature_id for f in one.features)
    ]
    reports = {
        report
        for tile in tiles
        for report in store.voxel_provenance(found.layer, tile.tile_id, tile.version).get(found.feature_id, ())
    }
    return {"tiles": [tile.tile_id.path for tile in tiles], "reports": sorted(reports)}


def _cell(column: str, value: Any) -> str:
    digits = {"lat_deg": 8, "lon_deg": 8, "height_m": 2, "exist": 2, "sigma_m": 2}
    return f"{value:.{digits[column]}f}" if column in digits else str(value)


def _place(position: list[float]) -> str:
    return f"{position[1]:.8f}, {position[0]:.8f}, {position[2]:.3f} m"


def _counted(counts: Any) -> str:
    return ", ".join(f"{n} {kind}" for kind, n in counts.items())
