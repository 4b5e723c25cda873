"""The page of `gnd serve` in a real browser with software GL: for measurements, and for its pictures."""

import shutil
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Final

from gnd.deploy.serve.command import PageSource, serve_page
from gnd.deploy.serve.guard import PageAddress
from studies.frame.errors import BrowserError

SOFTWARE_GL: Final = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
WINDOW: Final = {"width": 1280, "height": 800}
PATIENCE_S: Final = 600.0


def chromium() -> str | None:
    """The program; None: it is not installed."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@contextmanager
def opened_browser() -> Iterator[Any]:
    """A browser without windows.

    Raises:
        BrowserError: none is installed.
    """
    from playwright.sync_api import sync_playwright  # for developers alone

    program = chromium()
    if program is None:
        raise BrowserError("no chromium is installed: apt-get install chromium")
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=program, args=list(SOFTWARE_GL))
        yield browser
        browser.close()


@contextmanager
def served_page(source: PageSource, token: str = "") -> Iterator[str]:
    """The address of the page, served by threads of this process.

    Args:
        source: what is shown.
        token: who brings it may decide about changes; "": nobody decides, all look.

    Raises:
        GndError: the source cannot be shown.
    """
    stop, found = threading.Event(), list[str]()
    with ThreadPoolExecutor(1, "page") as pool:
        address = PageAddress(token=token)
        served = pool.submit(serve_page, source, address, stop, found.append, allow_changes=bool(token))
        while not found:
            if served.done():
                served.result()
            time.sleep(0.01)
        try:
            yield f"{found[0]}?token={token}" if token else found[0]
        finally:
            stop.set()
        served.result()


def opened_window(browser: Any, **context: Any) -> tuple[Any, list[str]]:
    """An empty tab, and what is complained of in it later on: a shader that does not compile draws quickly."""
    tab, complaints = browser.new_page(viewport=WINDOW, **context), list[str]()
    tab.on("console", lambda one: complaints.append(one.text) if one.type == "error" else None)
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    return tab, complaints


def until(tab: Any, holds: str, patience_s: float = PATIENCE_S) -> None:
    """Wait until an expression of the page is true.

    Raises:
        BrowserError: it does not become so.
    """
    deadline_s = time.monotonic() + patience_s
    while not tab.evaluate(f"!!window.gndPage && ({holds})"):
        if time.monotonic() > deadline_s:
            raise BrowserError(f"not within {patience_s:.0f} s: {holds}")
        tab.wait_for_timeout(10)
