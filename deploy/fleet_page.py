"""The page of a running fleet: a process beside the others, whose failure is told and harms nobody."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from gnd.deploy.errors import DeployError
from gnd.deploy.ports import claim_port
from gnd.deploy.processes import ProcessSpec
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.site import SiteFrame
from gnd.extras import MissingExtra, explained

PAGE_PORT: Final = 8480
"""Of `gnd serve`; a fleet takes it if it is free, so that a browser goes on with the same address when it has ended."""


def page(run: Path, connect: str, port: int, *, stop: threading.Event) -> None:
    """Show a run in the browser until it ends."""
    from gnd.deploy.serve.command import PageSource, serve_page  # it needs the extra `serve`
    from gnd.deploy.serve.guard import PageAddress

    serve_page(PageSource(run, connect=connect), PageAddress(port=port), stop)


def page_process(folder: RunFolder, site: SiteFrame, tell: Callable[[str], None]) -> ProcessSpec | None:
    """The process of the page, which is not started again; None: there can be none, and `tell` was told why.

    Args:
        folder: the run.
        site: where its router is.
        tell: called with the page's address, or with what is missing.
    """
    try:
        with explained():
            import starlette  # noqa: F401  (whether it is there)
            import uvicorn  # noqa: F401
            import websockets  # noqa: F401
        port = _port()
    except (MissingExtra, DeployError) as error:
        tell(f"no live map in the browser: {error}")
        return None
    tell(f"live map: http://127.0.0.1:{port}/ (when the run has ended: gnd serve {folder.root})")
    spec = ProcessSpec("page", page, (folder.root, site.connect, port), restart=False)
    return replace(spec, identity=site.identity_of("fleet"))


def _port() -> int:
    try:
        return claim_port(PAGE_PORT)
    except DeployError:
        return claim_port(0)
