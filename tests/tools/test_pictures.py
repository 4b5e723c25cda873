"""Every picture of the documents has a recipe, every recipe parses, and whatever draws does it in one style."""

import importlib.util
import re
import shlex
from pathlib import Path

import click
import pytest
from PIL import Image

from gnd.deploy.cli import gnd
from gnd.picture_style import CYCLE, DPI, styled, write_png
from tools.changelog import ROOT
from tools.pictures import BY_HAND, PAGE, PICTURES, RECIPES, PictureError, Recipe, draw, page

MADE = {target for recipe in RECIPES for target in recipe.made.values()}
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
DRAWING = re.compile(r"^\s*(?:from|import) matplotlib", re.M)
PARTS = ("fleet_sim", "vehicle_agent", "cloud_merger", "deploy", "studies", "tools")


def test_every_picture_has_a_recipe_and_stands_in_a_document() -> None:
    there = {path.relative_to(PICTURES).as_posix() for path in PICTURES.rglob("*") if path.is_file()}
    assert there == MADE | BY_HAND.keys()
    assert len(MADE) == sum(len(recipe.made) for recipe in RECIPES), "two recipes make the same picture"
    shown = {
        name
        for path in DOCUMENTS
        if path != PAGE
        for name in re.findall(r"!\[.*?pictures/([\w/.]+)\)", path.read_text())
    }
    assert shown == there


def test_the_page_is_that_of_the_recipes() -> None:
    assert page(PAGE.read_text()) == PAGE.read_text(), "run: python -m tools.pictures --page"


@pytest.mark.parametrize("line", [one for recipe in RECIPES for one in recipe.commands])
def test_the_commands_parse(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = shlex.split(line.replace("DATA", str(tmp_path)))
    if words[0] == "python":
        assert words[1] == "-m"
        assert importlib.util.find_spec(words[2]) is not None
        return
    assert words.pop(0) == "gnd"
    monkeypatch.chdir(tmp_path)
    for word in words[1:]:  # files that a command before it leaves
        if "/" not in word and re.fullmatch(r"\w+\.(json|mcap|sqlite)", word):
            (tmp_path / word).touch()
    for folder in ("radiate_fog", "flexmap_georef", "kitti_raw_0027"):
        (tmp_path / folder).mkdir()
    context, command = click.Context(gnd), gnd
    while isinstance(command, click.Group):
        name = words.pop(0)
        found = command.get_command(context, name)
        assert found is not None
        command = found  # type: ignore[assignment]
    command.make_context(name, words, parent=context)


def test_whatever_draws_has_the_one_style() -> None:
    files = [path for part in PARTS for path in (ROOT / part).rglob("*.py") if DRAWING.search(path.read_text())]
    assert len(files) >= 15
    own = [path for path in files if "picture_style import" not in path.read_text()]
    assert [path.relative_to(ROOT).as_posix() for path in own] == [
        "studies/real_localisation/flexmap.py"  # paths of polygons, no drawing
    ]


def test_a_styled_function_leaves_nothing_behind(tmp_path: Path) -> None:
    from matplotlib import rcParams
    from matplotlib.figure import Figure

    before = dict(rcParams)

    @styled
    def drawn() -> Figure:
        figure = Figure(figsize=(4.0, 2.0))
        figure.subplots().plot([0, 1])
        return figure

    figure = drawn()
    assert dict(rcParams) == before
    assert figure.axes[0].lines[0].get_color() == CYCLE[0]
    write_png(figure, tmp_path / "one.png")
    with Image.open(tmp_path / "one.png") as picture:
        assert picture.size == (4 * DPI, 2 * DPI)
        assert "Software" not in picture.info
    write_png(figure, tmp_path / "two.png")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    with pytest.raises(OSError, match="nowhere"):
        write_png(figure, tmp_path / "nowhere" / "one.png")


def test_a_recipe_draws_what_it_names_or_says_what_failed(tmp_path: Path) -> None:
    white = 'python -c \'from PIL import Image; Image.new("RGB", (400, 100)).save("x.png")\''
    assert draw(Recipe("x", (white,), {"x.png": "a/y.png"}, wide_px=200), tmp_path) > 0.0
    with Image.open(tmp_path / "a" / "y.png") as picture:
        assert picture.size == (200, 50)
    with pytest.raises(PictureError, match=r"ended with 2:(?s:.*)No such command"):
        draw(Recipe("none", ("gnd draw",), {"x.png": "x.png"}), tmp_path)
    with pytest.raises(PictureError, match=r"left no x\.png"):
        draw(Recipe("none", ("gnd --version",), {"x.png": "x.png"}), tmp_path)
