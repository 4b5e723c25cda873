"""`gnd view`: a map, its changes and the fleet in Rerun (rerun-sdk: the extra `export`)."""

from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from gnd.deploy.map_export.libraries import library
from gnd.deploy.map_export.scene import RGB, ExportScene, read_scene, store_of
from gnd.gnd_map.classes import ChangeClass
from gnd.tile_store.errors import StoreError
from gnd.tile_store.options import PATH, layer_option, region_option, to_read

_RADIUS_M: Final = 0.15


@click.command(short_help="Show a map, its changes and its fleet in Rerun.")
@click.argument("path", metavar="STORE|RUN", type=PATH)
@click.option("--save", type=PATH, help="Write a recording (FILE.rrd) and open no window.")
@region_option
@layer_option
def view(path: Path, save: Path | None, region: str, layer: str) -> None:
    """Show the map of STORE, or of the folder of a RUN with the ways of its vehicles, on the time of publication.

    What is new is red, modified orange, deleted green.
    """
    rerun = library("rerun")
    with to_read(store_of(path)) as opened:
        scene = read_scene(opened, layer, region, path if path.is_dir() else None)
    recording = rerun.RecordingStream("gnd view")
    if save is None:
        recording.spawn()
    else:
        if not save.parent.is_dir():
            raise StoreError(f"{save}: the folder {save.parent} does not exist")
        recording.save(str(save))
    log_scene(rerun, recording, scene)
    recording.flush()
    changes = sum(len(update.points_m) for update in scene.updates)
    where = "" if save is None else f"; written to {save}"
    click.echo(
        f"{len(scene.points_m)} Gaussians, {changes} changes in {len(scene.updates)} versions,"
        f" {len(scene.ways)} vehicles{where}"
    )


def log_scene(rerun: Any, recording: Any, scene: ExportScene) -> None:
    """Send the scene to a recording of Rerun: entities map, changes/*, vehicles/*."""
    recording.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    grey = _shades(scene.points_m)
    recording.log("map", rerun.Points3D(scene.points_m, colors=grey, radii=_RADIUS_M), static=True)
    colours = np.zeros((len(ChangeClass), 3), np.uint8)
    for kind, rgb in RGB.items():
        colours[kind] = rgb
    for update in scene.updates:
        recording.set_time("published", timestamp=update.t_ns / 1e9)
        recording.log(
            f"changes/{update.tile.morton}",
            rerun.Points3D(update.points_m, colors=colours[update.change], radii=1.5 * _RADIUS_M),
        )
    for name, way in scene.ways.items():
        for one in way:
            recording.set_time("published", timestamp=one.wall_ns / 1e9)
            degrees = np.degrees([[one.lat_rad, one.lon_rad]])
            recording.log(f"vehicles/{name}", rerun.GeoPoints(lat_lon=degrees, radii=rerun.Radius.ui_points(8.0)))


def _shades(points_m: "np.ndarray[Any, Any]") -> "np.ndarray[Any, Any]":
    """(N, 3) blue greys, the higher the lighter."""
    low, high = np.percentile(points_m[:, 2], (2, 98)) if len(points_m) else (0.0, 1.0)
    part = np.clip((points_m[:, 2] - low) / max(high - low, 1e-3), 0.0, 1.0)
    return np.asarray(np.array([60, 80, 110]) + part[:, None] * np.array([160, 150, 130]), np.uint8)
