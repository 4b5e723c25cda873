"""The overlap from above, before and after: A in grey, B in colour."""

from pathlib import Path
from typing import Final

from matplotlib.axes import Axes

from gnd.gnd_map.arrays import F64
from gnd.picture_style import INK, MUTED, PANEL_PT, RED, SMALL_PT
from gnd.vehicle_agent.localise_drive.style import new_figure, save_figure
from gnd.vehicle_agent.map_align.align import MapAlignment
from gnd.vehicle_agent.map_align.cloud import GaussianCloud

_SHOWN_M: Final = 80.0


def draw_alignment(a: GaussianCloud, b: GaussianCloud, found: MapAlignment, path: Path) -> None:
    """Draw the upright surfaces of both around the middle of the overlap, where B says it is and where it lies.

    Raises:
        LocaliseError: the file cannot be written.
    """
    verdict = "fits" if found.fits else f"does not fit: {found.reasons[0].split(':')[0]}"
    note = f"A grey, B red; residual {100 * found.median_m:.1f} cm (median); {verdict}"
    figure = new_figure(13.0, 7.2, "B on A, before and after", note)
    for k, (title, cloud) in enumerate((("before", b), ("after", b.moved(found.T_a_b)))):
        axes = figure.add_axes((0.04 + 0.49 * k, 0.06, 0.45, 0.76))
        _panel(axes, title, a, cloud, found.pivot_m)
    save_figure(figure, path)


def _panel(axes: Axes, title: str, a: GaussianCloud, b: GaussianCloud, middle_m: F64) -> None:
    for cloud, colour in ((a, MUTED), (b, RED)):
        at = cloud.mean_m[cloud.is_upright, :2] - middle_m[:2]
        axes.plot(*at.T, ".", color=colour, markersize=1.6, alpha=0.6, markeredgewidth=0)
    axes.set(xlim=(-_SHOWN_M, _SHOWN_M), ylim=(-_SHOWN_M, _SHOWN_M), aspect="equal")
    axes.set_title(title, color=INK, fontsize=PANEL_PT)
    axes.set_xlabel("m east of the middle of the overlap", color=MUTED, fontsize=SMALL_PT)
    axes.tick_params(colors=MUTED, labelsize=SMALL_PT)
