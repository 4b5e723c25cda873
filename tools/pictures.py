"""Draw the pictures of the documents anew: `make pictures`, or `make pictures ARGS="world healing"` for some.

The table of docs/pictures.md is this list (`--page` writes it, a test compares them). Pictures of long studies are
drawn only when they are named, or with --all: their studies take from eight minutes to hours.
"""

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click

from tools.changelog import ROOT

PICTURES: Final = ROOT / "docs" / "pictures"
PAGE: Final = ROOT / "docs" / "pictures.md"
DATA: Final = ROOT.parent / "shared" / "data"


class PictureError(Exception):
    """A picture cannot be drawn; the message says which command failed and how."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """How some pictures are made.

    Attributes:
        name: by which they are asked for.
        commands: one after the other in an empty folder; `DATA` stands for the folder of recordings.
        made: picture in docs/pictures by the file that the commands leave.
        long: it is drawn only when it is named.
        wide_px: it is made so wide, 0: as it comes.
    """

    name: str
    commands: tuple[str, ...]
    made: dict[str, str]
    long: bool = False
    wide_px: int = 0


def _family(name: str) -> Recipe:
    commands = (
        f"gnd sim world write {name}.json --seed 3 --length 100 --family {name}",
        f"gnd sim world picture {name}.json {name}.png --dpi 50",
    )
    return Recipe(name, commands, {f"{name}.png": f"families/{name}.png"})


_PAPER_MODE: Final = ("f1", "localisation", "upload", "as_printed", "observers")
RECIPES: Final = (
    Recipe(
        "world",
        (
            "gnd sim world write world.json --seed 31 --length 400 --site wangsimni",
            "gnd sim world picture world.json world.png --dpi 75",
        ),
        {"world.png": "world.png"},
    ),
    *map(_family, ("suburb", "avenue", "motorway", "snow", "car_park", "construction", "roundabout", "tunnel")),
    Recipe(
        "road",
        ("gnd sim road picture motorway road.png --seed 11 --drive 1",),
        {"road.png": "road_motorway.png"},
    ),
    Recipe("healing", ("gnd fleet --world-seed 21 --no-page --out run",), {"run/healing.png": "healing.png"}),
    Recipe(
        "page",
        ("gnd fleet --agents 2 --no-page --out run", "python -m tools.page_pictures run taken"),
        {f"taken/page_{name}.jpg": f"page_{name}.jpg" for name in ("dark", "compare", "light", "decide")},
    ),
    Recipe(
        "localise",
        (
            "gnd sim world write street.json --seed 11",
            "gnd sim drive street.json mapping.mcap --sensor hdl32e --state before --cars 0",
            "gnd sim drive street.json drive.mcap --sensor vlp16 --traffic urban",
            "gnd map build -o base.sqlite mapping.mcap",
            "gnd localise drive.mcap --map base.sqlite --out poses",
        ),
        {"poses/map.png": "localise_map.png", "poses/errors.png": "localise_errors.png"},
        wide_px=1260,
    ),
    Recipe(
        "tutorial",
        (
            "gnd import auto DATA/kitti_raw_0027 -o drive.mcap --scans 0:32",
            "gnd map build -o map.sqlite drive.mcap",
            "gnd fleet --drives drive.mcap --agents 2 --map map.sqlite --made-up 4 --no-page --out healed",
        ),
        {"healed/map_after.png": "tutorial_kitti.png"},
        wide_px=1000,
    ),
    Recipe(
        "lanes",
        ("gnd reproduce lanes --seeds 1001 --vehicles 5 --jobs 1 --out lanes",),
        {"lanes/lanes_street.png": "lanes_street.png"},
    ),
    Recipe(
        "poles",
        ("python -m studies poles --sensors none --recordings DATA --pictures drawn",),
        {
            "drawn/kitti_raw_0060_38.png": "poles_kitti_junction.png",
            "drawn/radiate_fog_30.png": "poles_radiate_fog.png",
        },
    ),
    Recipe(
        "moving-objects",
        ("python -m studies.moving_objects DATA/kitti_raw_0060 moving.png",),
        {"moving.png": "moving_objects.png"},
    ),
    Recipe(
        "fog",
        ("gnd reproduce real-localisation --scans DATA/radiate_fog --jobs 1 --out fog",),
        {"fog/radiate_fog_localised.png": "real_fog.png"},
    ),
    Recipe(
        "georeferenced",
        ("gnd reproduce real-localisation --scans DATA/flexmap_georef --jobs 1 --out earth",),
        {"earth/flexmap_georef_georeferenced.png": "real_georeferenced.png"},
    ),
    Recipe(
        "codec",
        ("gnd reproduce codec --recordings DATA --families street,roundabout --out codec",),
        {"codec/codec.png": "codec_rates.png"},
    ),
    Recipe(
        "simulation",
        ("gnd reproduce simulation --world-seed 401 --out simulation",),
        {"simulation/f1_by_vehicles.png": "f1_by_vehicles.png", "simulation/merged.png": "map_changes.png"},
        long=True,
    ),
    Recipe(
        "localisation",
        ("gnd reproduce localisation --world-seed 501 --trials 10 --out localisation",),
        {"localisation/scala_submaps.png": "localisation_submaps.png"},
        long=True,
    ),
    Recipe(
        "paper-mode",
        ("gnd reproduce paper-mode --world-seed 2001 --vehicles 1,5,9,20 --out paper",),
        {f"paper/paper_mode_{name}.png": f"paper_mode_{name}.png" for name in _PAPER_MODE},
        long=True,
    ),
    Recipe(
        "traffic",
        ("gnd reproduce traffic --world-seed 601 --drives 16 --out traffic",),
        {"traffic/download.png": "traffic_download.png", "traffic/upload_fleet.png": "traffic_upload.png"},
        long=True,
    ),
    Recipe(
        "slamcu",
        ("gnd reproduce slamcu --seeds 801 --drives 2 --out slamcu",),
        {f"slamcu/slamcu_{name}.png": f"slamcu_{name}.png" for name in ("masses", "position_errors")},
        long=True,
    ),
    Recipe(
        "new-layer",
        ("gnd reproduce new-feature-layer --seeds 801,802 --out layer",),
        {
            "layer/new_layer_by_drives.png": "new_layer_by_drives.png",
            "layer/new_layer_lights_motorway.png": "new_layer_lights_motorway.png",
        },
        long=True,
    ),
)
BY_HAND: Final = {
    "architecture.svg": "written by hand, as text",
}
"""Pictures that no command draws, and how they came to be."""


def draw(recipe: Recipe, out: Path) -> float:
    """Run the commands of a recipe and put its pictures into a folder; returns the seconds that it took.

    Raises:
        PictureError: a command fails, or leaves no picture.
    """
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="gnd-picture-") as folder:
        for command in recipe.commands:
            _run(command, Path(folder))
        for source, target in recipe.made.items():
            drawn = Path(folder) / source
            if not drawn.is_file():
                raise PictureError(f"{recipe.name}: {recipe.commands[-1]} left no {source}")
            (out / target).parent.mkdir(parents=True, exist_ok=True)
            _put(drawn, out / target, recipe.wide_px)
    return time.monotonic() - started_s


def _run(command: str, folder: Path) -> None:
    words = shlex.split(command.replace("DATA", str(DATA)))
    program = [sys.executable, "-m", "gnd.deploy.cli"] if words[0] == "gnd" else [sys.executable]
    path = os.pathsep.join((str(ROOT / "src"), str(ROOT)))
    done = subprocess.run(
        [*program, *words[1:]],
        check=False, cwd=folder, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        raise PictureError(f"{command} ended with {done.returncode}:\n{done.stdout[-1500:]}\n{done.stderr[-1500:]}")


def _put(drawn: Path, target: Path, wide_px: int) -> None:
    """Copy a picture, made smaller where it is wider than asked for."""
    from PIL import Image

    with Image.open(drawn) as picture:
        if not wide_px or picture.width <= wide_px:
            shutil.copy(drawn, target)
            return
        tall_px = round(picture.height * wide_px / picture.width)
        picture.convert("RGB").resize((wide_px, tall_px), Image.Resampling.LANCZOS).save(target, optimize=True)


def table() -> str:
    """The table of docs/pictures.md."""
    lines = ["| asked for as | pictures | commands |", "|---|---|---|"]
    for recipe in RECIPES:
        pictures = ", ".join(f"[{name}](pictures/{name})" for name in recipe.made.values())
        commands = "<br>".join(f"`{command}`" for command in recipe.commands)
        lines.append(f"| {recipe.name}{' (long)' if recipe.long else ''} | {pictures} | {commands} |")
    lines += [f"| – | [{name}](pictures/{name}) | {how} |" for name, how in BY_HAND.items()]
    return "\n".join(lines)


def page(text: str) -> str:
    """The page with the table of today in place of the one that it has."""
    before, _, rest = text.partition("| asked for as")
    _, _, after = rest.partition("\n\n")
    return f"{before}{table()}\n\n{after}" if after else f"{before}{table()}\n"


@click.command(help=__doc__)
@click.argument("names", nargs=-1, type=click.Choice([one.name for one in RECIPES]), metavar="[NAME]…")
@click.option("--all", "everything", is_flag=True, help="The long ones, too.")
@click.option("--out", type=click.Path(path_type=Path), default=PICTURES, help="Instead of docs/pictures.")
@click.option("--page", "only_page", is_flag=True, help="Write the table into docs/pictures.md, and end.")
def main(names: tuple[str, ...], *, everything: bool, out: Path, only_page: bool) -> None:
    """Draw."""
    if only_page:
        PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
        return
    chosen = [one for one in RECIPES if one.name in names or (not names and (everything or not one.long))]
    for recipe in chosen:
        try:
            took_s = draw(recipe, out)
        except PictureError as error:
            raise click.ClickException(str(error)) from None
        click.echo(f"{recipe.name}: {', '.join(recipe.made.values())} in {took_s:.0f} s")
    if not names and not everything:
        left = ", ".join(one.name for one in RECIPES if one.long)
        click.echo(f"not drawn, for their studies are long: {left}; name them, or --all")


if __name__ == "__main__":
    main()
