"""Take the four pictures of the page of `gnd serve` for the documents: `python -m tools.page_pictures RUN OUT`.

RUN is the folder of a run of a simulated street, OUT gets page_dark.jpg, page_compare.jpg, page_light.jpg and
page_decide.jpg. Nothing is decided: the run stays as it is. Needs Chromium, see studies/frame/browser.py.
"""

import io
import math
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click

from gnd.deploy.serve.command import PageSource
from gnd.gnd_map.errors import GndError
from studies.frame.browser import WINDOW, opened_browser, opened_window, served_page, until
from studies.frame.errors import BrowserError

PATIENCE_S: Final = 120.0
MOST_BYTES: Final = 190_000
QUALITIES: Final = (90, 86, 82, 78, 74, 70)
"""Of JPEG: the first that gives no more than `MOST_BYTES`."""
FINER: Final = 2
"""So many times more pixels each way are drawn than the picture has: edges come out smooth."""
SOMEBODY: Final = "operator@office"
"""Who looks, in the pictures: whose machine draws them is nobody's concern."""
MOST_CLICKS: Final = 60
_SETTLED_MS: Final = 700
_SINGLY: Final = "Object.assign(gndPage.tiles, {near_m: 250, disc_m: 500, fine_m: 600, block_m: 900})"
"""However slow the machine is, each Gaussian in the picture is an ellipsoid."""
_LOADED: Final = "document.getElementById('veil').hidden && gndPage.state.gaussians > 0 && !gndPage.state.isLoading"
_WHOLE_ROWS: Final = """() => {
  const panel = document.querySelector('.panel:not([hidden])'), end = panel.getBoundingClientRect().bottom;
  const parts = [...panel.querySelectorAll('tr, .card, label, dt, dd, h2, p')];
  const rows = parts.map(one => [one, one.getBoundingClientRect()]);
  const isWhole = at => rows.every(([, box]) => box.top > at - 6.5 || box.bottom < at);
  const ends = rows.filter(([one]) => one.tagName !== 'H2').map(([, box]) => box.bottom + 6).filter(isWhole);
  return Math.min(...ends.map(at => at - end).filter(by => by > -60), 400);
}"""
"""Pixels by which the window has to be taller for the panel to end after a whole row that is no title."""


@dataclass(frozen=True, slots=True)
class Look:
    """A view of the street, seen from the middle of what has changed.

    Attributes:
        along_m: so far down the street lies what one looks at, in the direction of driving.
        left_m: so far to the left of it.
        far_m: distance of the camera.
        turn_deg: direction of view, clockwise from the direction of driving.
        tilt_deg: so far down one looks.
    """

    along_m: float
    left_m: float
    far_m: float
    turn_deg: float
    tilt_deg: float


@dataclass(frozen=True, slots=True)
class PagePicture:
    """A picture of the page.

    Attributes:
        name: of its file.
        show: brings a tab with the page to what is to be seen.
        scheme: "dark" or "light".
        tall_px: of the window, give or take a row of its panel.
        may_decide: whether who looks may decide about changes.
    """

    name: str
    show: Callable[[Any], None]
    scheme: str = "dark"
    tall_px: int = 800
    may_decide: bool = False


DARK: Final = Look(36.0, 0.0, 80.0, -16.0, 34.0)
COMPARE: Final = Look(0.0, 4.0, 50.0, -62.0, 38.0)
LIGHT: Final = Look(2.0, 4.0, 40.0, -30.0, 40.0)
DECIDE: Final = Look(26.0, 4.0, 50.0, -62.0, 38.0)
"""What is decided about stands beside the question, not behind it."""


@dataclass(frozen=True, slots=True)
class Street:
    """Where the street of a run has changed.

    Attributes:
        middle_m: of the changes, weighted by their voxels, in the map's frame.
        heading_rad: of driving, from east to north.
    """

    middle_m: tuple[float, float, float]
    heading_rad: float

    @classmethod
    def of(cls, tab: Any) -> "Street":
        """As the page's own data tell it.

        Raises:
            BrowserError: nothing has changed there, or no way of a vehicle is known.
        """
        told = tab.evaluate(
            "async () => [(await (await fetch('api/changes')).json()).changes, await (await fetch('api/ways')).json()]"
        )
        changes, ways = told[0], [way for way in told[1].values() if len(way) > 1]
        if not changes or not ways:
            raise BrowserError(f"the run has {len(changes)} changes and {len(ways)} ways of vehicles, need both")
        weight = sum(one["voxels"] for one in changes)
        x, y, z = (sum(one["voxels"] * one["at_m"][i] for one in changes) / weight for i in range(3))
        first, last = ways[0][0], ways[0][-1]
        return cls((x, y, z), math.atan2(last[2] - first[2], last[1] - first[1]))

    def place(self, look: Look) -> tuple[list[float], list[float]]:
        """What is looked at, and the eye, m in the map's frame."""
        along, aside = (math.cos(self.heading_rad), math.sin(self.heading_rad)), self.heading_rad + math.pi / 2
        x, y, z = self.middle_m
        x += look.along_m * along[0] + look.left_m * math.cos(aside)
        y += look.along_m * along[1] + look.left_m * math.sin(aside)
        towards, tilt = self.heading_rad - math.radians(look.turn_deg), math.radians(look.tilt_deg)
        flat_m = look.far_m * math.cos(tilt)
        eye = [x - flat_m * math.cos(towards), y - flat_m * math.sin(towards), z + look.far_m * math.sin(tilt)]
        return [x, y, z], eye


def take(run: Path, out: Path) -> dict[str, int]:
    """Take the pictures; returns the bytes of each.

    Args:
        run: folder of a run.
        out: folder that gets them.

    Raises:
        BrowserError: there is no browser, the page does not come to what is to be seen, or it complains.
        GndError: it is no run.
    """
    out.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(32)
    sizes = {}
    with opened_browser() as browser:
        for one in PICTURES:
            with served_page(PageSource(run), token if one.may_decide else "") as url:
                sizes[one.name] = _write(_taken(browser, url, one), out / one.name)
    return sizes


def _taken(browser: Any, url: str, one: PagePicture) -> bytes:
    """PNG of the page."""
    from playwright.sync_api import Error  # for developers alone

    context = {"device_scale_factor": FINER, "color_scheme": one.scheme, "reduced_motion": "reduce"}
    tab, complaints = opened_window(browser, **context)
    try:
        tab.route("**/api/map", _as_somebody)
        tab.goto(url)
        until(tab, _LOADED, PATIENCE_S)
        tab.evaluate(_SINGLY)
        one.show(tab)
        _settle(tab, one.tall_px)
        drawn: bytes = tab.screenshot(type="png")
    except Error as error:
        what = error.message.splitlines()[0]
        raise BrowserError(f"{one.name}: {what}; the page complains of {complaints}") from error
    if complaints:
        raise BrowserError(f"{one.name}: the page complains {len(complaints)} times, first: {complaints[0]}")
    tab.close()
    return drawn


def _as_somebody(route: Any) -> None:
    told = route.fetch()
    route.fulfill(response=told, json=told.json() | {"viewer": SOMEBODY})


def _settle(tab: Any, tall_px: int) -> None:
    """Wait until all is loaded and drawn, with a window in which the last row of the panel is whole."""
    size = {"width": WINDOW["width"], "height": tall_px}
    tab.set_viewport_size(size)
    tab.set_viewport_size(size | {"height": tall_px + round(tab.evaluate(_WHOLE_ROWS))})
    tab.evaluate("gndPage.view.redraw()")
    tab.wait_for_timeout(_SETTLED_MS)
    until(tab, _LOADED, PATIENCE_S)
    tab.wait_for_timeout(_SETTLED_MS)


def _look(tab: Any, look: Look) -> None:
    places = Street.of(tab).place(look)
    tab.evaluate("at => gndPage.view.place(...at.map(one => new gndPage.Place(...one)))", places)
    tab.wait_for_timeout(_SETTLED_MS)
    until(tab, _LOADED, PATIENCE_S)


def _open_changes(tab: Any, pictures: int) -> None:
    """The work list, with the pictures of its first changes."""
    tab.click("#tab-changes")
    tab.locator("#changes canvas[data-drawn]").nth(2 * pictures - 1).wait_for(timeout=PATIENCE_S * 1000)


def _dark(tab: Any) -> None:
    _look(tab, DARK)
    _open_changes(tab, 3)


def _compare(tab: Any) -> None:
    _look(tab, COMPARE)
    tab.keyboard.press("b")


def _light(tab: Any) -> None:
    """A voxel of which two vehicles have told: from the middle of the free half of the map, outwards."""
    _look(tab, LIGHT)
    tab.click("#tab-traffic")
    tab.locator("#traffic tr").first.wait_for(timeout=PATIENCE_S * 1000)
    map_box = tab.locator("#map").bounding_box()
    for turn in range(MOST_CLICKS):
        away_px, angle = 9.0 * math.sqrt(turn), 2.4 * turn
        x = map_box["x"] + 0.32 * map_box["width"] + away_px * math.cos(angle)
        y = map_box["y"] + 0.55 * map_box["height"] + away_px * math.sin(angle)
        tab.mouse.click(x, y)
        tab.wait_for_timeout(100)
        if tab.evaluate("gndPage.state.selected === null"):
            continue
        tab.locator("#inspectbody .step").first.wait_for(timeout=PATIENCE_S * 1000)
        if tab.locator("#inspectbody .step").first.locator("li", has_text="says").count() >= 2:
            return
    raise BrowserError(f"none of {MOST_CLICKS} clicks met a voxel that two reports speak of")


def _decide(tab: Any) -> None:
    _open_changes(tab, 2)
    _look(tab, DECIDE)
    card = tab.locator("#changes .card").first
    card.get_by_role("button", name="Doubt").click()
    tab.fill("#decidewhy", "A building site: gone by Friday.")


PICTURES: Final = (
    PagePicture("page_dark.jpg", _dark),
    PagePicture("page_compare.jpg", _compare),
    PagePicture("page_light.jpg", _light, scheme="light"),
    PagePicture("page_decide.jpg", _decide, tall_px=720, may_decide=True),
)


def _write(drawn: bytes, path: Path) -> int:
    """A JPEG of usual size, as good as its bytes allow; returns them."""
    from PIL import Image

    with Image.open(io.BytesIO(drawn)) as picture:
        size = (picture.width // FINER, picture.height // FINER)
        small = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    for quality in QUALITIES:
        small.save(path, quality=quality, optimize=True, progressive=True)
        if path.stat().st_size <= MOST_BYTES:
            break
    return path.stat().st_size


@click.command(help=__doc__)
@click.argument("run", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
def main(run: Path, out: Path) -> None:
    """Take them."""
    try:
        sizes = take(run, out)
    except GndError as error:
        raise click.ClickException(str(error)) from None
    for name, size in sizes.items():
        click.echo(f"{name}: {size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
