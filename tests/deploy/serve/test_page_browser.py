"""The page in a real browser: it draws, follows, compares, tells what one clicks on, and is not fooled by names."""

import io
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from page_testing import EAST, HERE, LiveStreet, ServedPage, live_street, served, street_tile

from studies.frame.browser import chromium, opened_browser

pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
AXE = Path(__file__).parents[3] / "page" / "node_modules" / "axe-core" / "axe.min.js"
PATIENCE_S = 120.0
"""For a machine on which others work; how fast the page is, `python -m studies serve` measures."""

VERMILION = (213, 94, 0)
FORGERY = """<!doctype html><iframe name=hidden></iframe>
<form action="TARGET" method=post enctype="text/plain" target=hidden>
<input name='{"judgement": "roll_back", "why": "' value='"}'></form>
<script>
const body = JSON.stringify({judgement: "roll_back", why: "forged"});
const send = how => fetch("TARGET", {method: "POST", body, credentials: "include", ...how}).catch(() => 0);
document.forms[0].submit();
Promise.all([send({mode: "no-cors"}), send({mode: "cors", headers: {"content-type": "application/json"}})])
  .then(() => document.body.append(Object.assign(document.createElement("p"), {id: "tried"})));
</script>"""
"""What another site's page may try: a form, a request without asking first, and one that has to ask."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(chromium() is None, reason="no chromium is installed"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with opened_browser() as opened:
        yield opened


class Window:
    """A window of the browser with the page in it; whatever it complains of is kept."""

    def __init__(self, browser: Any, url: str, **context: Any) -> None:
        self.context = browser.new_context(viewport={"width": 900, "height": 640}, **context)
        self.tab = self.context.new_page()
        self.complaints: list[str] = []
        self.tab.on(
            "console", lambda one: self.complaints.append(one.text) if one.type in ("error", "warning") else None
        )
        self.tab.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.tab.goto(url)

    def state(self) -> dict[str, Any]:
        told: dict[str, Any] = self.tab.evaluate("window.gndPage ? gndPage.state : {}")
        return told

    def until(self, holds: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            state = self.state()
            if state and holds(state):
                return state
            assert time.monotonic() < deadline_s, f"not within {PATIENCE_S} s: {what}; {state}; {self.complaints}"
            self.tab.wait_for_timeout(50)

    def drawn(self) -> dict[str, Any]:
        return self.until(lambda state: state["gaussians"] > 0 and not state["isLoading"], "the map is drawn")

    def pixels(self) -> np.ndarray:
        """(H, W, 3) what the map's window shows."""
        from matplotlib.image import imread

        picture = self.tab.locator("#map").screenshot(type="png")
        return np.round(imread(io.BytesIO(picture))[:, :, :3] * 255).astype(int)

    def close(self) -> None:
        self.context.close()


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Window]]:
    windows: list[Window] = []

    def begin(url: str, **context: Any) -> Window:
        windows.append(Window(browser, url, **context))
        return windows[-1]

    yield begin
    for window in windows:
        window.close()


@pytest.fixture
def street(tmp_path: Path) -> Iterator[LiveStreet]:
    with live_street(tmp_path) as opened:
        yield opened


@pytest.fixture
def page(street: LiveStreet) -> Iterator[ServedPage]:
    with served(street.path, "--connect", street.endpoint) as opened:
        yield opened


@contextmanager
def elsewhere(page: str) -> Iterator[str]:
    """Another site on this machine, with a page of its own."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("content-type", "text/html")
            self.end_headers()
            self.wfile.write(page.encode())

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def near(pixels: np.ndarray, colour: tuple[int, int, int], within: float = 0.12) -> int:
    """How many pixels have a hue, whatever the light on them."""
    length = np.linalg.norm(pixels, axis=2) + 1e-9
    wanted = np.array(colour) / np.linalg.norm(colour)
    is_lit = length > 60
    return int((is_lit & (np.linalg.norm(pixels / length[:, :, None] - wanted, axis=2) < within)).sum())


def test_it_draws_the_map_follows_it_and_stays_over_a_lost_router(
    open_page: Callable[..., Window], street: LiveStreet, page: ServedPage
) -> None:
    window, tiles = open_page(page.url), (street_tile(HERE), street_tile(EAST, wall=False))
    both = sum(len(tile.gaussians) for tile in tiles)
    window.until(lambda state: state["gaussians"] == both, "both tiles are drawn")
    before = window.pixels()
    assert near(before, (174, 181, 186)) > 0.02 * before[:, :, 0].size, "the ground is grey"
    assert near(before, VERMILION) == 0, "nothing is new"

    street.merge(street_tile(EAST, wall=True))
    window.until(lambda state: any(one["drawn_ms"] for one in state["updates"]), "an update is drawn")
    window.tab.wait_for_timeout(3500)  # the flash is over
    window.drawn()
    assert near(window.pixels(), VERMILION) > 200, "the new wall is vermilion"

    street.stop_router()
    street.start_router()
    version = street.merge(street_tile(EAST, wall=True, hump=0.3))
    window.until(
        lambda state: any(one["version"] == version and one["drawn_ms"] for one in state["updates"]), "another"
    )
    assert window.complaints == []


def test_a_server_that_comes_back_is_followed_on(open_page: Callable[..., Window], street: LiveStreet) -> None:
    with served(street.path, "--connect", street.endpoint) as page:
        window = open_page(page.url)
        window.drawn()
        port = page.port
    window.until(lambda state: not state["open"], "the line is lost")
    assert window.tab.locator("#badge").inner_text() == "connecting …"
    street.merge(street_tile(EAST, wall=True))
    with served(street.path, "--connect", street.endpoint, "--port", str(port)):
        window.until(lambda state: state["open"], "the line is back")
        wanted = len(street_tile(HERE).gaussians) + len(street_tile(EAST, wall=True).gaussians)
        window.until(lambda state: state["gaussians"] == wanted, "what was missed is there")


def test_a_click_tells_what_the_server_knows_of_the_voxel(
    open_page: Callable[..., Window], street: LiveStreet, page: ServedPage
) -> None:
    street.merge(street_tile(HERE, hump=0.3), "vehicle-42")
    lat, lon = np.degrees(HERE.centre_rad)
    window = open_page(f"{page.url}#at={lat - 0.000143},{lon - 0.00006},30,20,0,80&colour=height")
    window.drawn()
    box = window.tab.locator("#map").bounding_box()
    window.tab.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    selected = window.until(lambda state: state["selected"] is not None, "something is selected")["selected"]
    window.tab.locator("#inspectbody .step").first.wait_for(timeout=60_000)
    story = page.value(f"/api/voxel/{selected['tile']}/{selected['voxel']}?version={selected['version']}")
    text = window.tab.locator("#inspectbody").inner_text()
    assert story["path"] in text
    assert f"{story['gaussian']['points']}" in text
    assert [step["version"] for step in story["steps"]] == [1, 2]
    assert "vehicle-42" in text
    assert "says modified" in text
    window.tab.keyboard.press("Escape")
    assert window.state()["selected"] is None


def test_before_and_after_show_the_versions_that_the_server_has(
    open_page: Callable[..., Window], street: LiveStreet, page: ServedPage
) -> None:
    street.merge(street_tile(EAST, wall=True))
    window = open_page(page.url)
    window.drawn()
    window.tab.click("#compare")
    assert window.state()["split"] == 0.5
    version = "s => s.mesh.visible ? s.loaded.packed.version : 0"
    shown = f"[...gndPage.tiles.tiles.values()].map(t => [t.info.id, t.slots.map({version})])"
    told = page.value("/api/tiles?box=-100,-100,100,100")["tiles"]
    wanted = {one["id"]: [one["versions"][0][0], one["versions"][-1][0]] for one in told}
    window.until(lambda _: dict(window.tab.evaluate(shown)) == wanted, "both versions are shown")
    window.tab.focus("#divider")
    window.tab.keyboard.press("ArrowLeft")
    assert window.state()["split"] == pytest.approx(0.48)
    window.tab.locator("#after").fill("0")
    first = {one["id"]: [one["versions"][0][0]] * 2 for one in told}
    window.until(lambda _: dict(window.tab.evaluate(shown)) == first, "then it was as before")
    window.tab.click("#compare")
    window.tab.click("#now")
    assert window.state()["time_ms"] is None or window.state()["time_ms"] == float("inf")
    assert window.complaints == []


def test_the_work_list_flies_to_a_change(
    open_page: Callable[..., Window], street: LiveStreet, page: ServedPage
) -> None:
    street.merge(street_tile(EAST, wall=True))
    window = open_page(page.url)
    window.drawn()
    window.tab.click("#tab-changes")
    item = window.tab.locator("#changes button.item").first
    item.wait_for(timeout=60_000)
    (change,) = page.value("/api/changes")["changes"]
    assert "New wall" in item.inner_text()
    item.click()
    target = "gndPage.view.controls.target.toArray()"
    window.until(
        lambda _: np.allclose(window.tab.evaluate(target)[:2], change["at_m"][:2], atol=0.5), "it looks at the change"
    )
    for tab in ("fleet", "traffic", "cloud", "view"):
        window.tab.click(f"#tab-{tab}")
    assert window.complaints == []


def shots_of(window: Window, what: str) -> list[np.ndarray]:
    """(H, W, 3) the pictures before and after of a change of the list."""
    card = window.tab.locator("#changes .card", has_text=what).first
    card.locator("canvas[data-drawn]").nth(1).wait_for(timeout=60_000)
    found = card.locator("canvas").evaluate_all(
        "all => all.map(c => [c.width, ...c.getContext('2d').getImageData(0, 0, c.width, c.height).data])"
    )
    return [np.array(one[1:]).reshape(-1, one[0], 4)[:, :, :3] for one in found]


def test_changes_are_decided_from_the_work_list_with_pictures(
    open_page: Callable[..., Window], street: LiveStreet
) -> None:
    street.merge(street_tile(EAST, wall=True), quietly=True)
    street.merge(street_tile(HERE, wall=False), quietly=True)
    hostile = '<img src=x onerror="window.hacked=1">'
    with served(street.path, "--allow-changes") as page:
        window = open_page(page.url)
        with_wall = window.drawn()["gaussians"]
        window.tab.click("#tab-changes")
        before, after = shots_of(window, "New wall")
        assert (near(before, VERMILION), near(after, VERMILION) > 500) == (0, True), "it is in the second picture alone"
        before, after = shots_of(window, "Deleted wall")
        assert np.abs(before - after).max() > 60

        window.tab.get_by_role("button", name="Roll back: New wall").click()
        assert window.tab.locator("#decideok").is_disabled(), "a reason is wanted"
        window.tab.fill("#decidewhy", hostile)
        window.tab.click("#decideok")
        window.tab.locator("#changes .record", has_text=hostile).wait_for(timeout=60_000)
        assert window.tab.locator("#changes .card", has_text="New wall").count() == 0
        assert window.tab.evaluate("[document.querySelectorAll('#changes img').length, window.hacked]") == [0, None]
        window.until(lambda state: state["gaussians"] == with_wall - 120, "the map follows")
        assert street.store.history("ndt", EAST)[-1].kind == "rollback"

        window.tab.get_by_role("button", name="Accept: Deleted wall").focus()
        window.tab.keyboard.press("Enter")
        window.tab.keyboard.press("Tab")
        window.tab.keyboard.press("Tab")
        window.tab.keyboard.press("Enter")
        window.tab.locator("[data-filter=accepted]", has_text="Accepted 1").wait_for(timeout=60_000)
        assert window.tab.locator("[data-filter=open]").inner_text() == "Open 0"
        assert window.complaints == []

        before_forgery = [one.version for one in street.store.head_lines("ndt")]
        key = page.value("/api/changes")["changes"][0]["key"]
        with elsewhere(FORGERY.replace("TARGET", f"http://127.0.0.1:{page.port}/api/changes/{key}")) as url:
            evil = window.context.new_page()  # with the page's cookie in the same browser
            evil.goto(url)
            evil.locator("#tried").wait_for(state="attached", timeout=60_000)
            evil.wait_for_timeout(500)
        assert [one.version for one in street.store.head_lines("ndt")] == before_forgery
        assert len(page.value("/api/changes")["decided"]) == 2


def test_names_are_shown_as_they_are_and_never_run(
    open_page: Callable[..., Window], street: LiveStreet, page: ServedPage, tmp_path: Path
) -> None:
    hostile = '<img src=x onerror="window.hacked=1">'
    window = open_page(page.url)
    window.drawn()
    message = {"type": "vehicles", "vehicles": [{"name": hostile, "at": [0, 0, 0, 0], "heading_rad": None,
               "odometer_m": 1, "health": hostile, "tiles": 0, "reports": 0, "doubts": 0}]}  # fmt: skip
    window.tab.evaluate("message => gndPage.hear(message)", message)
    window.tab.click("#tab-fleet")
    assert hostile in window.tab.locator("#fleet").inner_text()
    assert window.tab.locator("#fleet img, #labels img").count() == 0
    report = {"id": "1", "vehicle": hostile, "driven_ms": 0, "says": hostile, "rays": {hostile: 1}}
    step = {"version": 1, "kind": "merged", "what": hostile, "created_ms": 0, "merger": hostile, "reports": [report]}
    place = {"tile": 1, "path": hostile, "voxel": 1, "version": 1, "lat_deg": 0, "lon_deg": 0, "height_m": 0}
    story = place | {"gaussian": None, "steps": [step]}
    window.tab.route("**/api/voxel/**", lambda route: route.fulfill(json=story))
    window.tab.evaluate(
        "gndPage.select({tile: {id: 1}, version: 1, packed: {voxel: [1]}, row: 0, at: gndPage.view.controls.target})"
    )
    window.tab.locator("#inspectbody .step").first.wait_for(timeout=60_000)
    assert hostile in window.tab.locator("#inspectbody").inner_text()
    assert window.tab.evaluate("document.querySelectorAll('#inspect img').length") == 0
    assert window.tab.evaluate("window.hacked") is None


def test_a_store_with_a_hostile_name_is_a_title_like_any_other(
    open_page: Callable[..., Window], tmp_path: Path, street: LiveStreet
) -> None:
    folder = tmp_path / "<b onclick=alert(1)>map"
    folder.mkdir()
    copy = folder / "<script>alert(1)<"
    street.store.backup(copy)
    with served(copy) as page:
        window = open_page(page.url)
        window.drawn()
        assert window.tab.locator("#title").inner_text() == copy.name
        assert window.complaints == []


def test_labels_of_vehicles_at_one_place_do_not_cover_each_other(
    open_page: Callable[..., Window], page: ServedPage
) -> None:
    window = open_page(page.url)
    window.drawn()
    at = window.tab.evaluate("gndPage.view.controls.target.toArray()")
    vehicles = [{"name": f"vehicle-{n:02d}", "at": [0, at[0] + 0.5 * n, *at[1:]], "heading_rad": None, "odometer_m": 1,
                 "health": "good", "tiles": 0, "reports": 0, "doubts": 0} for n in range(4)]  # fmt: skip
    window.tab.evaluate("message => gndPage.hear(message)", {"type": "vehicles", "vehicles": vehicles})
    window.tab.locator("#labels .label:not([hidden])").nth(3).wait_for(timeout=60_000)
    window.tab.wait_for_timeout(500)
    boxes = [label.bounding_box() for label in window.tab.locator("#labels .label").all()]
    for a, b in itertools.combinations(boxes, 2):
        is_beside = a["x"] + a["width"] <= b["x"] or b["x"] + b["width"] <= a["x"]
        assert is_beside or a["y"] + a["height"] <= b["y"] or b["y"] + b["height"] <= a["y"], (a, b)
    assert max(box["y"] for box in boxes) - min(box["y"] for box in boxes) < 120, "they stand close together"


RISING = """message => {
  let seen = 0, lowest = Infinity;
  for (let up = 0; up < 60; up += 0.0317) {
    const lifted = message.map(one => ({...one, at: one.at.map((x, i) => i === 3 ? x + up : x)}));
    gndPage.hear({type: 'vehicles', vehicles: lifted});
    gndPage.vehicles.draw(Infinity, gndPage.view.camera, 1280, 800);
    const labels = [...document.querySelectorAll('#labels .label:not([hidden])')];
    seen += labels.length;
    for (const label of labels) lowest = Math.min(lowest, Number(label.style.transform.match(/, ([-0-9.]+)px/)[1]));
  }
  return [seen, lowest];
}"""
"""Vehicles rise until their labels leave the window: rounded, one label less 24 pixels is not always 24 less."""


def test_labels_that_leave_the_window_above_do_not_stop_the_page(
    open_page: Callable[..., Window], page: ServedPage
) -> None:
    window = open_page(page.url)
    window.drawn()
    at = window.tab.evaluate("gndPage.view.controls.target.toArray()")
    vehicles = [{"name": f"vehicle-{n:02d}", "at": [0, *at], "heading_rad": None, "odometer_m": 1, "ended": False,
                 "health": "good", "tiles": 0, "reports": 0, "doubts": 0} for n in range(4)]  # fmt: skip
    seen, lowest = window.tab.evaluate(RISING, vehicles)
    assert seen > 400
    assert lowest < -60, "some stood above the window"
    assert window.complaints == []


@pytest.mark.parametrize("scheme", ["dark", "light"])
@pytest.mark.parametrize("width", [900, 390])
def test_axe_finds_nothing(open_page: Callable[..., Window], street: LiveStreet, scheme: str, width: int) -> None:
    if not AXE.is_file():
        pytest.skip("axe-core is not installed: npm ci in page/")
    street.merge(street_tile(EAST, wall=True))
    with served(street.path, "--allow-changes") as page:
        _look_with_axe(open_page(page.url, color_scheme=scheme, bypass_csp=True), scheme, width)


def _look_with_axe(window: Window, scheme: str, width: int) -> None:
    """At each panel, and at the question why."""

    def look(where: str) -> None:
        found = window.tab.evaluate("axe.run(document, {resultTypes: ['violations']})")
        told = [(one["id"], [node["html"][:120] for node in one["nodes"]]) for one in found["violations"]]
        assert told == [], f"{where}: {told}"

    window.tab.set_viewport_size({"width": width, "height": 780})
    window.drawn()
    assert window.tab.evaluate("document.documentElement.dataset.theme") == scheme
    window.tab.add_script_tag(content=AXE.read_text(encoding="utf-8"))
    if width < 800:
        window.tab.click("#sidebutton")
    for tab in ("view", "changes", "fleet", "traffic", "cloud"):
        window.tab.click(f"#tab-{tab}")
        window.tab.wait_for_timeout(300)
        look(tab)
        if tab == "changes":
            window.tab.get_by_role("button", name="Doubt: New wall").click()
            look("why")
            window.tab.keyboard.press("Escape")
    assert window.tab.evaluate("document.documentElement.scrollWidth <= innerWidth"), "nothing stands out sideways"


def test_a_link_leads_to_a_place_and_a_time(
    open_page: Callable[..., Window], street: LiveStreet, page: ServedPage
) -> None:
    street.merge(street_tile(EAST, wall=True))
    first_ms = page.value("/api/map")["first_ms"]
    lat, lon = np.degrees(EAST.centre_rad)
    window = open_page(f"{page.url}#at={lat:.6f},{lon:.6f},30,40,0,50&colour=surface&time={first_ms + 1}")
    window.drawn()
    assert window.state()["time_ms"] == first_ms + 1
    (east,) = (one for one in page.value("/api/tiles?box=-100,-100,100,100")["tiles"] if one["id"] == EAST.morton)
    target = window.tab.evaluate("gndPage.view.controls.target.toArray()")
    assert np.allclose(target[:2], east["place"][:2], atol=0.5)
    assert window.tab.get_attribute("[data-mode=surface]", "aria-checked") == "true"


def test_a_run_is_played_from_its_begin(open_page: Callable[..., Window], street: LiveStreet) -> None:
    street.merge(street_tile(EAST, wall=True))
    with served(street.path, "--replay", "0.05") as page:  # the one second that there is takes twenty
        window = open_page(page.url)
        first = window.until(lambda state: np.isfinite(state["time_ms"]), "it plays")["time_ms"]
        assert first < page.value("/api/map")["last_ms"]
        window.until(lambda state: first < state["time_ms"] < np.inf, "time goes on")
        window.tab.click("#play")
        stopped = window.state()["time_ms"]
        window.tab.wait_for_timeout(500)
        assert window.state()["time_ms"] == stopped
