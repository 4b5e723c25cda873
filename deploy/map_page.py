"""The quality of a map as a page."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

from gnd.deploy.html_page import card_list, document, picture, section, text_table, write_html
from gnd.deploy.map_page_pictures import height_picture, map_picture, thickness_picture
from gnd.vehicle_agent.map_build.build import BuiltMap
from gnd.vehicle_agent.map_build.quality import MOST_DOUBLED_ROAD, MOST_DOUBLED_WALLS, MOST_THICK_M, Quality
from gnd.vehicle_agent.map_build.refine_poses import PassDrift
from gnd.vehicle_agent.map_build.result import summary

_MORE_STYLE: Final = """
figure img{display:block;width:100%;max-width:52rem;height:auto;border-radius:.5rem;background:#fff}
ul.warn{margin:.5rem 0;padding:0;list-style:none}
ul.warn li{border-left:.3rem solid #d1433f;background:var(--card);padding:.5rem .8rem;margin:.4rem 0;
border-radius:.3rem}
p.fine{border-left:.3rem solid var(--down);background:var(--card);padding:.5rem .8rem;border-radius:.3rem}
td.t{white-space:normal}
"""
_DOUBLE: Final = f"""<p>A surface is doubled when two thin layers of points lie side by side, 0.2 to 1 m apart, over
most of a voxel: what two passes leave whose poses disagree. Some are real (a sign before a wall, a bonnet
over the road); more than {MOST_DOUBLED_WALLS:.0f} of 1,000 walls or {MOST_DOUBLED_ROAD:.0f} of 1,000 pieces of road are
not. Layers nearer than 0.2 m show as thick planes: a median above
{100 * MOST_THICK_M:.0f} cm is out of bounds.</p>"""


def page(title: str, built: BuiltMap, quality: Quality) -> str:
    """The page of a map as HTML."""
    told = summary(built, quality)
    name = f"Map {escape(title)}"
    return document(
        name,
        (
            f"<header><h1>{name}</h1><p>{told['drives']} drives, {told['quality']['way_m'] / 1000:.2f} km, "
            f"{told['scans']} scans, {told['tiles']} tiles, {told['gaussians']:,} voxels</p></header>",
            _warnings(quality.warnings),
            _cards(told),
            section("From above", picture(map_picture(built, quality), "Planes by thickness, ways, doubled surfaces")),
            section("Doubled surfaces and thick planes", _DOUBLE + _surfaces(told["quality"])),
            section("", picture(thickness_picture(quality), "Thickness of planes")),
            section("Poses", _poses(built)),
            section("By drive", _drives(told["by_drive"])),
            section("The LiDAR over the road", picture(height_picture(built, quality), "Height along the way")),
        ),
        _MORE_STYLE,
    )


def write_map_page(path: Path, title: str, built: BuiltMap, quality: Quality) -> None:
    """Write the page; an earlier one is replaced at once.

    Raises:
        PageError: the file cannot be written.
    """
    write_html(path, page(title, built, quality))


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return '<p class="fine">Nothing is out of bounds.</p>'
    return f'<ul class="warn">{"".join(f"<li>{escape(one)}</li>" for one in warnings)}</ul>'


def _cards(told: dict[str, Any]) -> str:
    quality, points = told["quality"], sum(one["points"] for one in told["by_drive"])
    drift = told["poses"]["after"] or told["poses"]["before"]
    off = f"{100 * drift['horizontal_m']:.1f} cm" if drift else "one pass"
    rows = (
        (f"{quality['doubled_walls']['per_thousand']:.1f}", "doubled of 1,000 walls"),
        (f"{quality['doubled_road']['per_thousand']:.1f}", "doubled of 1,000 pieces of road"),
        (f"{100 * quality['plane_sd_m']['p50']:.1f} cm", "thickness of planes (median sd)"),
        (off, "passes off each other (median)"),
        (_share(told["points_of_movers"], points), "points left out as moving"),
        (_share(told["points_of_bodywork"], points), "points left out as the vehicle itself"),
        (_share(told["scans_skipped"], told["scans"] + told["scans_skipped"]), "scans without a pose"),
        (f"{quality['voxels_with_points']:,}", f"voxels with points, {told['gaussians']:,} dense enough"),
    )
    return card_list(rows)


def _surfaces(quality: dict[str, Any]) -> str:
    rows = []
    for name, key in (("walls", "doubled_walls"), ("road", "doubled_road")):
        one = quality[key]
        apart = "" if one["apart_m_p50"] is None else f"{one['apart_m_p50']:.2f} m"
        rows.append((name, f"{one['surfaces']:,}", f"{one['doubled']:,}", f"{one['per_thousand']:.1f}", apart))
    return text_table(("", "surfaces", "doubled", "of 1,000", "apart (median)"), rows)


def _poses(built: BuiltMap) -> str:
    poses = built.poses
    done = "refined in a graph" if poses.refined else "kept as they were"
    text = f"<p>The poses were {done}: {escape(poses.reason)}.</p>"
    if poses.candidates is not None:
        tried = poses.candidates
        text += (
            f"<p>{tried.tried} pairs of places were compared: {tried.found} sure loops, {tried.poor} fit badly, "
            f"{tried.ambiguous} fit in two places, {tried.one_way} only one way, {tried.alone} had no neighbour that "
            f"agreed; the graph left out {poses.loops_left_out} loops and {poses.fixes_left_out} of {poses.fixes} GNSS "
            f"fixes, and moved places by up to {poses.moved_m:.2f} m.</p>"
        )
    rows = [_drift(name, drift) for name, drift in (("before", poses.before), ("after", poses.after)) if drift]
    header = ("passes off each other", "places", "horizontal", "95 %", "height", "angle", "95 %")
    return text + (text_table(header, rows) if rows else "")


def _drift(name: str, drift: PassDrift) -> tuple[str, ...]:
    return (
        name,
        str(drift.loops),
        f"{100 * drift.horizontal_m:.1f} cm",
        f"{100 * drift.horizontal_p95_m:.1f} cm",
        f"{100 * drift.vertical_m:.1f} cm",
        f"{drift.angle_deg:.2f}°",
        f"{drift.angle_p95_deg:.2f}°",
    )


def _drives(drives: Sequence[dict[str, Any]]) -> str:
    rows = []
    for one in drives:
        mount, missing = one["mount"], one["scans_without_pose"]
        seen = "not seen" if mount["seen_m"] is None else f"{mount['seen_m']:.2f} m"
        why = ", ".join(f"{n} {reason}" for reason, n in missing.items()) or "none"
        rows.append(
            (
                one["drive"],
                f"{one['way_m']:.0f} m",
                str(one["scans"]),
                why,
                _share(one["points_of_movers"], one["points"]),
                _share(one["points_of_bodywork"], one["points"]),
                f"{mount['header_m']:.2f} m",
                seen,
            )
        )
    header = ("drive", "way", "scans", "without pose", "movers", "bodywork", "LiDAR over road, header", "seen")
    return text_table(header, rows)


def _share(part: int, whole: int) -> str:
    return f"{100 * part / max(whole, 1):.2f} %"
