"""Bytes a voxel against the 95 % shift of poses."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from gnd.picture_style import BLUE, GREY, INK, RED
from studies.frame.figures import dress, finish, new_figure

_COLOURS: Final = {"by sets": BLUE, "by sums": RED}
"""Of codecs, by how their names end; all others are grey."""


def draw(found: Mapping[str, Any], folder: Path) -> Path:
    """One point a scene and codec, in colours by what codes them; hollow what was learnt from."""
    figure = new_figure(9.6, 5.6)
    axes = figure.subplots()
    for name, scene in found["scenes"].items():
        marker = "o" if scene["kind"].startswith("real") else "s"
        for codec_name, one in scene["codecs"].items():
            colour = next((one for end, one in _COLOURS.items() if codec_name.endswith(end)), GREY)
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
        "grey: codecs 2 to 4, blue: 8 to 10, red: 11 to 13; circles: real, hollow: learnt from, squares: simulated;"
        " dashed: must on real streets"
    )
    return finish(figure, "What tiles weigh and what rounding costs", note, folder / "codec.png")
