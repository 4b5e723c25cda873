"""A street's borders: the truth, the HD map, and what the fleet maps, with the edits."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gnd.deploy.lane_edits import map_pieces
from gnd.fleet_sim.markings import FloatArray, Paint
from gnd.gnd_map.features import Feature, geodetic_in_tile
from gnd.gnd_map.tile_id import TileId
from gnd.picture_style import BLUE, GREY, MAGENTA, ORANGE
from studies.frame.figures import dress, finish, new_figure
from studies.lanes_study.driving import LaneDrive, LaneTask, hd_map
from studies.lanes_study.merging import fresh_layer, map_edits


def draw_street(task: LaneTask, drives: Sequence[LaneDrive], path: Path) -> Path:
    """Draw along and across, across ten times as wide; edits are written where they begin."""
    paint = task.paint
    figure = new_figure(12.0, 6.0)
    axes = figure.subplots()
    dress(axes, "along the street, m", "across, m")
    for one in paint.after:
        style = (0, (3, 6)) if one.marking == "dashed" else "-"
        axes.plot([one.start_m, one.end_m], [one.y_m] * 2, linestyle=style, color=GREY, linewidth=6, alpha=0.5)
    tiles = {tile: one.features for tile, one in map_pieces(hd_map(paint).features).items()}
    _draw_layer(axes, paint, tiles, ORANGE, "HD map of before")
    _draw_layer(axes, paint, fresh_layer(drives), BLUE, f"mapped by {len(drives)} vehicles")
    for edit in map_edits(task, drives).edits:
        place = paint.world.frame.enu_from_geodetic(
            np.radians([edit.lat_deg]), np.radians([edit.lon_deg]), np.array([paint.world.height_m])
        )
        x, y, _ = paint.world.street_of_map(np.atleast_2d(place))[0]
        words = f"{edit.what} {edit.shift_m:+.2f} m" if edit.shift_m else f"{edit.what} {edit.subtype} {edit.color}"
        axes.annotate(words, (x, y), (x, y + 0.35), color=MAGENTA, fontsize=9)
    axes.legend(fontsize=9, loc="lower right")
    note = f"seed {task.seed}; grey: the paint now"
    return finish(figure, "Borders of lanes mapped by vehicles", note, path)


def _draw_layer(axes: object, paint: Paint, layer: Mapping[TileId, Sequence[Feature]], colour: str, label: str) -> None:
    for tile, some in layer.items():
        for one in some:
            places = paint.world.street_of_map(
                paint.world.frame.enu_from_geodetic(*geodetic_in_tile(tile, one.points_m))
            )
            _line(axes, places, colour, label)
            label = ""


def _line(axes: object, places: FloatArray, colour: str, label: str) -> None:
    axes.plot(places[:, 0], places[:, 1], color=colour, linewidth=1.4, label=label or None)  # type: ignore[attr-defined]
