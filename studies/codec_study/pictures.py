"""Bytes a voxel against the 95 % shift of poses."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gnd.picture_style import BLUE, GREY, INK
from studies.frame.figures import dress, finish, new_figure


def draw(found: Mapping[str, Any], folder: Path) -> Path:
    """One point a scene and codec: grey those without, blue those by sets of tables; hollow what was learnt from."""
    figure = new_figure(9.6, 5.6)
    axes = figure.subplots()
    for name, scene in found["scenes"].items():
        marker = "o" if scene["kind"].startswith("real") else "s"
        for codec_name, one in scene["codecs"].items():
            colour = BLUE if codec_name.endswith("sets") else GREY
            face = "none" if "learnt" in scene["kind"] else colour
            axes.plot(one["bytes"], one["shift_cm"]["p95"], marker, color=colour, markerfacecolor=face)
            if codec_name == "standard, range coded by sets":
                at = (one["bytes"], one["shift_cm"]["p95"])
                axes.annotate(name, at, xytext=(5, 4), textcoords="offset points", fontsize=7, color=INK)
    must = found["must"]
    axes.plot([0, must["bytes"], must["bytes"]], [must["p95_cm"], must["p95_cm"], 0], "--", color=INK, linewidth=0.8)
    axes.set_yscale("log")
    axes.set_xlim(left=1.5)
    dress(axes, "bytes a voxel", "95 % of pose shifts, cm")
    note = (
        "blue: codecs 8 to 10, grey: 2 to 4 and 11 to 13; circles: recordings, hollow: learnt from, squares: simulated;"
        " dashed: the standard codec's must on real streets"
    )
    return finish(figure, "What tiles weigh and what rounding costs", note, folder / "codec.png")
