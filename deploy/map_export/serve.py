"""`gnd map serve`: a map for Autoware over ROS 2, kept up to date while it is served."""

import json
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click

from gnd.deploy.interruption import ending_in_order
from gnd.deploy.map_export.autoware import ChangedCells
from gnd.deploy.map_export.map_service import DIFFERENTIAL, NAMESPACE, MapService
from gnd.deploy.map_export.projection import PROJECTORS, ProjectionError
from gnd.deploy.map_export.sampling import PointsOf
from gnd.deploy.map_export.served_map import ServedMap
from gnd.deploy.map_export.tile_feeds import TileFeed, open_feed
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import DEFAULT_ENDPOINT, BusConfig
from gnd.fleet_bus.identity.options import identity_option
from gnd.fleet_bus.ros2 import MAX_DOMAIN, RosNode
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.options import PATH, layer_option, region_option

NODE: Final = "gnd_map"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ServeEvent:
    """What happened: words for people, values for programs."""

    text: str
    values: dict[str, Any]


Tell = Callable[[ServeEvent], None]


def follow(feed: TileFeed, served: ServedMap, stop: threading.Event, tell: Tell) -> None:
    """Take new versions into the map until `stop` is set; what cannot be written is tried again."""
    waiting: dict[TileId, Tile] = {}
    trouble = ""
    while not stop.is_set():
        try:
            waiting |= {tile.tile_id: tile for tile in feed.newer()}
            for tile in list(waiting.values()):
                if (event := _taken(served, tile)) is not None:
                    tell(event)
                del waiting[tile.tile_id]
            trouble = ""
        except GndError as error:  # a full disk, a store that is being replaced, a lost router
            if str(error) != trouble:
                _log.warning("the map is not up to date: %s", error)
            trouble = str(error)


def _taken(served: ServedMap, tile: Tile) -> ServeEvent | None:
    """What taking a tile into the map has changed; None: nothing that one can see."""
    try:
        changed = served.replace([tile])
    except ProjectionError as error:
        _log.warning("tile %s is not served: %s", tile.tile_id.path, error)
        return None
    return _change(tile, changed) if changed != ChangedCells(0, 0) else None


def _change(tile: Tile, changed: ChangedCells) -> ServeEvent:
    return ServeEvent(
        f"tile {tile.tile_id.path} version {tile.version}: cells: {changed.written} new, {changed.removed} removed",
        {
            "tile": tile.tile_id.path,
            "version": tile.version,
            "cells_new": changed.written,
            "cells_removed": changed.removed,
        },
    )


def _start(served: ServedMap, service: MapService, domain: int) -> ServeEvent:
    projection = served.projection
    where = projection.square or f"origin {projection.lat_deg:.7f}, {projection.lon_deg:.7f}"
    return ServeEvent(
        f"{served.folder}: {served.cells} cells of {served.tiles} tiles, {projection.projector}, {where}\n"
        f"serving {' and '.join(service.names)} in domain {domain}; Ctrl-C ends",
        {
            "folder": str(served.folder),
            "cells": served.cells,
            "tiles": served.tiles,
            "projector": projection.projector,
            "services": list(service.names),
            "domain": domain,
        },
    )


def _end(service: MapService) -> ServeEvent:
    return ServeEvent(
        f"{service.answered} requests answered, {service.refused} refused",
        {"answered": service.answered, "refused": service.refused},
    )


@click.command(short_help="Serve a map to Autoware over ROS 2, and follow its updates.")
@identity_option
@click.argument("source")
@click.argument("folder", type=PATH)
@click.option("--connect", multiple=True, default=(DEFAULT_ENDPOINT,), show_default=True, help="Router of ROS 2.")
@click.option("--domain", type=click.IntRange(0, MAX_DOMAIN), default=0, show_default=True, help="ROS_DOMAIN_ID.")
@click.option("--namespace", default=NAMESPACE, show_default=True, help="Of the services.")
@click.option("--projector", type=click.Choice(PROJECTORS), help="[default: that of FOLDER, else TransverseMercator]")
@click.option(
    "--points", type=click.Choice(("samples", "means")), default="samples", show_default=True, help="Of a Gaussian."
)
@region_option
@layer_option
@click.option("--json", "as_json", is_flag=True, help="One JSON object a line.")
def serve(
    source: str,
    folder: Path,
    connect: tuple[str, ...],
    domain: int,
    namespace: str,
    projector: str | None,
    points: PointsOf,
    region: str,
    layer: str,
    as_json: bool,
) -> None:
    """Serve a map to Autoware's NDT localiser over rmw_zenoh, cell by cell, and its updates as they are published.

    SOURCE is where the map comes from: a store's file, the folder of a run, or the router of a fleet
    (tcp/host:7447). FOLDER is the map as `gnd map export --to autoware` writes it; it is brought up to date at the
    start and at each update, and keeps its projection. No ROS needs to be installed.
    """
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(name)s %(message)s")

    def tell(event: ServeEvent) -> None:
        click.echo(json.dumps(event.values) if as_json else event.text)

    with ending_in_order() as stop, open_feed(source, layer, region) as feed:
        served = ServedMap(folder, feed.all(), projector, points)
        with RosNode(open_bus(BusConfig(connect=connect), name=NODE), domain, NODE) as node:
            _warn_of_others(node, f"{namespace}/{DIFFERENTIAL}")
            service = MapService(node, served, namespace)
            tell(_start(served, service, domain))
            follow(feed, served, stop, tell)
            tell(_end(service))


def _warn_of_others(node: RosNode, name: str) -> None:
    """A client takes the first answer: those of two servers would mix two maps."""
    others = sorted({one.node for one in node.endpoints() if one.kind == "SS" and one.topic.name == name})
    if others:
        _log.warning(
            "%s is served by %s as well: clients would mix two maps; end it, or give --namespace",
            name,
            ", ".join(others),
        )
