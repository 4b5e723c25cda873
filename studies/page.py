"""How fast the page of `gnd serve` is in a real browser with software GL: first picture, updates, frames, a city."""

import gzip
import json
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.deploy.chaos.street import read_street
from gnd.deploy.load.cpu import children, cpu_s
from gnd.deploy.serve.app import PAGE
from gnd.deploy.serve.command import PageSource
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import update_key
from gnd.schemas.updates import TileUpdate
from gnd.tile_store.sqlite_store import SqliteStore
from studies.frame.browser import PATIENCE_S, opened_browser, opened_window, served_page, until
from studies.frame.errors import BrowserError
from studies.frame.measure import Figure
from studies.frame.options import check, option

AS_DRAWN: Final = "{}"
ELLIPSOIDS: Final = "{near_m: 1e6, disc_m: 1e6, fine_m: 1e6}"
SINGLY: Final = "{fine_m: 1e6}"
"""What the page draws how (m, see `Tiles` in page/src): as it does by itself, all as ellipsoids, nothing merged."""
STREET_M: Final = 40.0
"""From so far somebody looks at a place in a street."""
_BATCH: Final = 2_000


@dataclass(frozen=True, slots=True)
class PageOptions:
    """How much is shown, and how long it is looked at."""

    gaussians: int = option(50_000, "Ellipsoids in view.", span=(1_000, 1_000_000))
    crowd: int = option(250_000, "Gaussians of a larger map; 0: none.", span=(0, 2_000_000))
    most: int = option(1_000_000, "Gaussians of the largest map; 0: none.", span=(0, 2_000_000))
    tiles: int = option(100_000, "Tiles of the city; 0: no city.", span=(0, 1_000_000))
    updates: int = option(40, "Versions published while the page looks on.", span=(1, 10_000))
    fleet: str = option("", "Arguments of a `gnd fleet` that is watched from its start; empty: none is.")
    seconds: float = option(5.0, "So long frames are counted.", span=(0.5, 600))

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = PageOptions


def run(options: PageOptions | None = None) -> list[Figure]:
    """Measure in Chromium."""
    options = options or PageOptions()
    with tempfile.TemporaryDirectory() as name, opened_browser() as browser:
        folder = Path(name)
        found = [_size(), *_street(browser, folder, options)]
        if options.fleet:
            found += _fleet(browser, folder, options.fleet)
        for n in (options.crowd, options.most):
            found += _crowd(browser, folder, n, options.seconds) if n else []
        return [*found, *_city(browser, folder, options)] if options.tiles else found


def _size() -> Figure:
    folder = files("gnd.deploy.serve") / "page"
    sizes = [len(gzip.compress((folder / name).read_bytes(), 9)) for name in PAGE]
    return Figure("the page's own bytes", sum(sizes) / 1000, "kB", "in gzip")


def _moved(tile: Tile, to: TileId) -> Tile:
    """The same Gaussians in another tile of the same row."""
    return replace(tile, tile_id=to)


def _row(tile: Tile, n: int) -> Iterator[Tile]:
    """So many tiles: a row of copies, and rows above it while voxels have the same numbers there."""
    begin = tile.tile_id
    wide = max(1, round(n**0.5))
    for i in range(n):
        yield _moved(tile, TileId.from_indices(begin.lon_index + i % wide, begin.lat_index + i // wide))


def _street(browser: Any, folder: Path, options: PageOptions) -> list[Figure]:
    """First picture, frames, updates of a map with so many ellipsoids in view."""
    some = max(read_street().tiles, key=lambda one: len(one.gaussians))
    n = -(-options.gaussians // len(some.gaussians))
    path, endpoint = folder / "street.sqlite", "tcp/127.0.0.1:27447"
    with ExitStack() as stack:
        stack.enter_context(open_router((endpoint,)))
        store = stack.enter_context(SqliteStore(path))
        bus = stack.enter_context(open_bus(BusConfig(connect=(endpoint,)), name="study"))
        store.put_tiles(list(_row(some, n)))
        url = stack.enter_context(served_page(PageSource(path, connect=endpoint)))
        tab, complaints = opened_window(browser)
        begin_s = time.monotonic()
        tab.goto(url)
        until(tab, "gndPage.firstPicture_ms > 0")
        picture_s = time.monotonic() - begin_s
        until(tab, f"!gndPage.state.isLoading && gndPage.state.gaussians >= {options.gaussians}")
        shown = int(tab.evaluate("gndPage.state.gaussians"))
        found = [
            Figure("first picture after the page was asked for", picture_s, "s", f"{shown} Gaussians"),
            *_frames(tab, shown, options.seconds),
            *_updates(tab, store, bus, some, options.updates),
        ]
        if complaints:
            raise BrowserError(f"the page complains {len(complaints)} times, first: {complaints[0]}")
        tab.close()
        return found


def _frames(tab: Any, shown: int, seconds: float) -> list[Figure]:
    """Frames a second: all as ellipsoids, and as the page draws them."""
    return [
        _rate(tab, f"frames, {shown} Gaussians, {name}", reach, seconds)
        for name, reach in (("all as ellipsoids", ELLIPSOIDS), ("as the page draws them", AS_DRAWN))
    ]


def _fleet(browser: Any, folder: Path, arguments: str) -> list[Figure]:
    """From the line in which a fleet that has just started tells the page's address to the first picture of it."""
    command = [sys.executable, "-m", "gnd.deploy.cli", "fleet", *shlex.split(arguments), "--out", str(folder / "run")]
    tab, _ = opened_window(browser)  # that nothing listens yet is no complaint
    with subprocess.Popen(  # noqa: S603  (a program of ours)
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        try:
            url = next((line.split()[2] for line in process.stderr if line.startswith("live map: ")), "")
            begin_s = time.monotonic()
            if not url:
                raise BrowserError("the fleet has ended without a page")
            threading.Thread(target=process.stderr.read, daemon=True).start()  # nobody waits on a full pipe
            _open_patiently(tab, url)
            until(tab, "gndPage.firstPicture_ms > 0")
            picture_s = time.monotonic() - begin_s
            shown = int(tab.evaluate("gndPage.state.gaussians"))
        finally:
            process.terminate()
    tab.close()
    return [
        Figure("first picture of a fleet after it has told the page's address", picture_s, "s", f"{shown} Gaussians")
    ]


def _open_patiently(tab: Any, url: str) -> None:
    """Open a page whose server is just starting."""
    from playwright.sync_api import Error  # for developers alone

    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            tab.goto(url)
            return
        except Error as error:
            if time.monotonic() > deadline_s:
                raise BrowserError(f"nothing listens at {url} within {PATIENCE_S:.0f} s") from error
            time.sleep(0.02)


def _rate(tab: Any, name: str, reach: str, seconds: float) -> Figure:
    """Frames a second and, which says more where others work on the machine, the browser's CPU time for each."""
    tab.evaluate(f"gndPage.rate(0.01, {reach})")  # loads what is to be seen
    before_s = _browser_s()
    rate = float(tab.evaluate(f"gndPage.rate({seconds}, {reach})"))
    each_ms = 1000 * (_browser_s() - before_s) / max(rate * seconds, 1.0)
    drawn = tab.evaluate("gndPage.rated")
    told = f"{each_ms:.0f} ms of CPU a frame; {drawn['gaussians']} drawn, of {drawn['tiles']} tiles"
    return Figure(name, rate, "1/s", told)


def _browser_s() -> float:
    return sum(cpu_s(child) for child in children(os.getpid()))


def _crowd(browser: Any, folder: Path, n: int, seconds: float) -> list[Figure]:
    """First picture and frames of a map of so many Gaussians: as a whole, and from a street in its middle."""
    some = max(read_street().tiles, key=lambda one: len(one.gaussians))
    path = folder / f"{n}.sqlite"
    with SqliteStore(path) as store:
        store.put_tiles(list(_row(some, -(-n // len(some.gaussians)))))
    with served_page(PageSource(path)) as url:
        tab, complaints = opened_window(browser)
        begin_s = time.monotonic()
        tab.goto(url)
        until(tab, "gndPage.firstPicture_ms > 0")
        picture_s = time.monotonic() - begin_s
        until(tab, "!gndPage.state.isLoading")
        loaded_s = time.monotonic() - begin_s
        found = [
            Figure(f"first picture, {n} Gaussians", picture_s, "s"),
            Figure(f"all in view is loaded, {n} Gaussians", loaded_s, "s"),
            _rate(tab, f"frames, {n} Gaussians, the whole map", AS_DRAWN, seconds),
            _rate(tab, f"frames, {n} Gaussians, the whole map, each drawn singly", SINGLY, seconds),
        ]
        x, y, z = tab.evaluate("gndPage.view.controls.target.toArray()")
        eye = f"{x - 0.8 * STREET_M}, {y - 0.5 * STREET_M}, {z + 0.33 * STREET_M}"
        tab.evaluate(f"gndPage.view.place(new gndPage.Place({x}, {y}, {z}), new gndPage.Place({eye}))")
        found += [
            _rate(tab, f"frames, {n} Gaussians, from a street", AS_DRAWN, seconds),
            _rate(tab, f"frames, {n} Gaussians, from a street, each drawn singly", SINGLY, seconds),
        ]
        tab.close()
    if complaints:
        raise BrowserError(f"the page complains {len(complaints)} times, first: {complaints[0]}")
    return found


def _updates(tab: Any, store: SqliteStore, bus: Bus, some: Tile, n: int) -> list[Figure]:
    """From publication (the version's own time) to the frame that shows it."""
    tab.evaluate("gndPage.tiles.quality = 1")
    known = len(tab.evaluate("gndPage.updates"))
    g = some.gaussians
    for number in range(n):
        lifted = g.mean_m.copy()
        lifted[: len(g) // 20, 2] = 0.01 * (number % 50)
        changed = Gaussians(g.voxel_id, g.count, g.cells, lifted, g.cov_m2)
        (done,) = store.put_tiles([replace(some, gaussians=changed)])
        new, old = (store.get("ndt", some.tile_id, one) for one in (done.version, done.version - 1))
        if new is None or old is None:
            raise BrowserError(f"version {done.version} is not in the store")
        update = TileUpdate(some.tile_id, "ndt", new.version, old.version, new.sha, old.sha, "base")
        bus.publish(update_key("ndt", some.tile_id), update.encode(), kind="update")
        until(tab, f"gndPage.updates.length > {known + number} && gndPage.updates.at(-1).drawn_ms > 0")
    told = tab.evaluate("gndPage.updates")[known:]
    drawn_s = [(one["drawn_ms"] - one["created_ms"]) / 1000 for one in told if one["drawn_ms"]]
    detail = f"{len(drawn_s)} updates of {len(g)} Gaussians"
    return [
        Figure("published to drawn, median", statistics.median(drawn_s), "s", detail),
        Figure("published to drawn, 95 %", float(np.quantile(drawn_s, 0.95)), "s", detail),
    ]


def _city(browser: Any, folder: Path, options: PageOptions) -> list[Figure]:
    """A city of small tiles: when the page can be used, and what its first answers weigh."""
    some = min(read_street().tiles, key=lambda one: len(one.gaussians))
    few = Tile(some.tile_id, 0, some.gaussians.take(np.arange(min(24, len(some.gaussians)))))
    path = folder / "city.sqlite"
    with SqliteStore(path) as store:
        rows = list(_row(few, options.tiles))
        for first in range(0, len(rows), _BATCH):
            store.put_tiles(rows[first : first + _BATCH])
    begin_s = time.monotonic()
    with served_page(PageSource(path)) as url:
        ready_s = time.monotonic() - begin_s
        tab, complaints = opened_window(browser)
        begin_s = time.monotonic()
        tab.goto(url)
        until(tab, "gndPage.firstPicture_ms > 0")
        usable_s = time.monotonic() - begin_s
        until(tab, "!gndPage.state.isLoading")
        whole_s = time.monotonic() - begin_s
        sizes = tab.evaluate("JSON.stringify(performance.getEntriesByType('resource').map(one => one.encodedBodySize))")
    if complaints:
        raise BrowserError(f"the page complains {len(complaints)} times, first: {complaints[0]}")
    told = f"{options.tiles} tiles"
    return [
        Figure("city: the server answers after", ready_s, "s", told),
        Figure("city: first picture after the page was asked for", usable_s, "s", told),
        Figure("city: all in view is loaded after", whole_s, "s", "the 512 nearest tiles"),
        Figure("city: bytes until then", sum(json.loads(sizes)) / 1000, "kB", told),
    ]
