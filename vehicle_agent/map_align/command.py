"""`gnd map align`: a thin command over the library."""

from pathlib import Path
from typing import Any

import click
from rich.console import Console

from gnd.fleet_bus.identity.options import identity_option
from gnd.tile_store import tables
from gnd.tile_store.cli import PATH, json_option, layer_option, show
from gnd.tile_store.options import bars
from gnd.tile_store.values import DEFAULT_CODEC, MAP_CODECS

REFUSED = 1


@click.command(short_help="Lay a map or drive onto another map.")
@click.argument("a", type=PATH)
@click.argument("b", type=PATH)
@click.option("--out", "-o", type=PATH, help="Write B, moved onto A: a drive or a new store, as B is.")
@click.option("--within", "shift_m", default=10.0, show_default=True, type=click.FloatRange(1, 50), help="Search [m].")
@click.option("--turn", "turn_deg", default=5.0, show_default=True, type=click.FloatRange(0.1, 20), help="Search [°].")
@click.option("--picture", type=PATH, help="Draw both from above, before and after (PNG).")
@click.option("--codec", default=DEFAULT_CODEC, show_default=True, type=click.Choice(MAP_CODECS), help="Of --out.")
@layer_option
@json_option
@identity_option
@click.pass_context
def align(
    context: click.Context, a: Path, b: Path, out: Path | None, shift_m: float, turn_deg: float, picture: Path | None,
    codec: str, layer: str, as_json: bool,
) -> None:  # fmt: skip
    """Find where B lies on A, both a map (store) or a drive (MCAP), from where their GNSS puts them. One of them may be
    a vector HD map (Lanelet2, OpenDRIVE, GeoJSON): its poles, lamps and signs are laid on the posts of the other.

    A stays. Exit status 1, and nothing is written, when B does not fit: too little overlap, more than one place,
    residuals too high, or B is bent against A.
    """
    # loaded here: they load numba, scipy and matplotlib, which the other commands do without
    from gnd.vehicle_agent.map_align.align import align_clouds
    from gnd.vehicle_agent.map_align.candidates import Reach
    from gnd.vehicle_agent.map_align.cloud import cloud_of_tiles
    from gnd.vehicle_agent.map_align.move import moved_drive, write_moved
    from gnd.vehicle_agent.map_align.posts import is_vector_map
    from gnd.vehicle_agent.map_align.sources import AlignError, frame_of, open_side
    from gnd.vehicle_agent.map_align.vector import align_vector

    if out is not None and out.exists():
        raise AlignError(f"{out} exists; --out writes a new file")
    reach = Reach(shift_m, turn_deg, max(shift_m, 5.0))
    if is_vector_map(a) or is_vector_map(b):
        if picture is not None:
            raise AlignError("--picture draws two LiDAR maps; of an HD map it draws nothing")
        with bars() as progress:
            posts = align_vector(a, b, layer, reach, progress, writes=out is not None)
            written = posts.write(out, codec, layer) if out is not None and posts.found.fits else None
        values = posts.as_dict() | {"written": str(written) if written else None}
        show(values, as_json, lambda console: _print_posts(console, values))
        if not posts.found.fits:
            context.exit(REFUSED)
        return
    with bars() as progress:
        sides = [open_side(path, layer, progress) for path in (a, b)]
        frame = frame_of(sides[1])
        cloud_a, cloud_b = (cloud_of_tiles(side.tiles, frame) for side in sides)
        found = align_clouds(cloud_a, cloud_b, reach, progress)
    if picture is not None:
        from gnd.vehicle_agent.map_align.picture import draw_alignment

        draw_alignment(cloud_a, cloud_b, found, picture)
    if out is not None and found.fits:
        if sides[1].kind == "drive":
            moved_drive(b, out, frame, found.T_a_b, f"moved onto {a.name} by gnd map align: {_motion(found)}")
        else:
            write_moved(sides[1], out, frame, found.T_a_b, codec, layer)
    values = {"a": str(a), "b": str(b), "frame": {"lat_rad": frame.lat_rad, "lon_rad": frame.lon_rad}}
    values |= found.as_dict() | {"written": str(out) if out is not None and found.fits else None}
    show(values, as_json, lambda console: _print(console, values))
    if not found.fits:
        context.exit(REFUSED)


def _motion(found: Any) -> str:
    east, north, up = found.shift_m.tolist()
    return f"{east:.3f} m east, {north:.3f} m north, {up:.3f} m up, {found.rotation_deg[2]:.4f} degrees left"


def _print(console: Console, values: dict[str, Any]) -> None:
    shift, sigma, overlap = values["shift_m"], values["sigma_m"], values["overlap"]
    share, residual = values["matched_share"], values["residual_m"]
    plain = {name: f"{shift[name]:.3f} m, sigma {100 * sigma[name]:.1f} cm" for name in ("east", "north", "up")} | {
        "heading": f"{values['heading_deg']:.3f} degrees",
        "tilt": f"{values['tilt_deg']['about_east']:.3f}, {values['tilt_deg']['about_north']:.3f} degrees",
        "overlap": f"{overlap['area_m2']:.0f} m2, {overlap['upright']} upright and {overlap['level']} level surfaces",
        "matched": f"{100 * share['upright']:.0f} % of the upright, {100 * share['level']:.0f} % of the level ones",
        "residual": f"{100 * residual['p50']:.1f} cm (median), {100 * residual['p90']:.1f} cm (p90)",
        "second best place": f"{100 * values['second_best']['worth']:.0f} % of the best",
        "parts off their place": f"at most {100 * values['bend_m']:.1f} cm in 85 % of {len(values['blocks'])} blocks",
    }
    _print_verdict(console, values, plain)


def _print_posts(console: Console, values: dict[str, Any]) -> None:
    shift, posts = values["shift_m"], values["posts"]
    plain = {name: f"{shift[name]:.3f} m, sigma {100 * values['sigma_m']:.1f} cm" for name in ("east", "north")} | {
        "up": "not compared",
        "heading": f"{values['heading_deg']:.3f} degrees, sigma {values['sigma_deg']:.3f}",
        "posts": f"{posts['matched']} of {posts['seen']} of the HD map that the LiDAR map should hold",
        "residual": f"{100 * values['residual_m']:.1f} cm (median)",
        "second best place": f"{100 * values['second_best']:.0f} % of the best",
        "mirror image": f"{100 * values['mirror_image']:.0f} % of the best",
    }
    _print_verdict(console, values, plain)


def _print_verdict(console: Console, values: dict[str, Any], plain: dict[str, str]) -> None:
    console.print(tables.fields(f"{values['b']} on {values['a']}", plain))
    for reason in values["reasons"]:
        console.print(f"does not fit: {reason}", style="red", highlight=False)
    if values["fits"]:
        console.print("fits" + (f", written: {values['written']}" if values["written"] else ""), highlight=False)
