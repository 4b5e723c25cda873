"""`gnd serve`: a map in the browser."""

import contextlib
import logging
import secrets
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click
import uvicorn
from starlette.applications import Starlette

from gnd.deploy.errors import ServeError
from gnd.deploy.interruption import ending_in_order
from gnd.deploy.map_export.scene import store_of
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.serve.app import SAYS_BYTES, PageParts, page_app
from gnd.deploy.serve.browsers import BrowserHub
from gnd.deploy.serve.follower import PageFollower
from gnd.deploy.serve.guard import PageAddress, token_of
from gnd.deploy.serve.page_map import PageMap
from gnd.deploy.serve.page_vehicles import PageVehicles, run_is_going
from gnd.deploy.serve.panels import Panels
from gnd.deploy.serve.rights import PageRights, PeerProtocol
from gnd.fleet_bus.identity.options import identity_option
from gnd.gnd_map.features import is_feature_layer
from gnd.tile_store.location import LOCATION, StoreLocation, open_store, shown
from gnd.tile_store.options import layer_option
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import DEFAULT_LAYER

END_S: Final = 2
"""So long browsers get to leave."""
MOST_AT_ONCE: Final = 256
_POLL_S: Final = 0.1
PATH: Final = click.Path(path_type=Path)


@dataclass(frozen=True, slots=True)
class PageSource:
    """What is shown.

    Attributes:
        source: a store, or the folder of a run.
        layer: of Gaussians.
        connect: endpoint of the fleet's router; None: that of the run, if it is going.
        replay: how many times faster the run is played.
    """

    source: StoreLocation
    layer: str = DEFAULT_LAYER
    connect: str | None = None
    replay: float = 0.0

    def __post_init__(self) -> None:
        if is_feature_layer(self.layer):
            raise ServeError(
                f"layer {self.layer!r} holds features: --layer is of Gaussians, those of features come along"
            )

    @property
    def run(self) -> RunFolder | None:
        """The run, if it is the folder of one."""
        is_folder = isinstance(self.source, Path) and self.source.is_dir()
        return RunFolder(Path(self.source)) if is_folder else None

    @property
    def endpoint(self) -> str | None:
        """Of the router to listen to."""
        run = self.run
        if self.connect is not None or run is None or not run_is_going(run):
            return self.connect
        with contextlib.suppress(OSError, UnicodeDecodeError):
            return run.endpoint.read_text(encoding="utf-8").strip() or None
        return None


class PageServer(uvicorn.Server):
    """uvicorn without handlers of signals of its own."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals to the command."""
        yield


def serve_page(
    source: PageSource,
    address: PageAddress,
    stop: threading.Event,
    tell: Callable[[str], None] = lambda _: None,
    *,
    allow_changes: bool = False,
) -> None:
    """Show a map until `stop` is set.

    Args:
        source: what is shown.
        address: where.
        stop: ends it.
        tell: called with the page's address when it can be opened.
        allow_changes: whether who has the token, or an operator's certificate, may decide about changes of the map.

    Raises:
        StoreUnavailable: there is no such store.
        ServeError: the port is taken, or the built page is missing.
    """
    with ExitStack() as stack:
        opened = stack.enter_context(open_store(store_of(source.source), create=False, read_only=True))
        title = source.run.root.resolve().name if source.run else Path(shown(source.source)).name
        page_map, hub = PageMap(opened, source.layer, title), BrowserHub()
        vehicles = PageVehicles(source.run, page_map.place, page_map.ground_m)
        rights = PageRights(allow_changes, address.roles)
        panels = Panels.of(page_map, source.run, stack.enter_context(_writing(source)) if allow_changes else None)

        def status() -> dict[str, Any]:
            return panels.status.get() if hub.count else {}

        follower = PageFollower(page_map, vehicles, hub.tell, connect=source.endpoint, run=source.run, status=status)
        app = page_app(PageParts(page_map, vehicles, panels, source.replay), hub, follower, address, rights)
        listening = stack.enter_context(_listening(address))
        port = int(listening.getsockname()[1])
        _run(_server_of(app, address, rights), listening, stop, lambda: tell(address.url(port)))


def _writing(source: PageSource) -> SqlStore:
    """The store to decide in: what is published there is signed by this process's identity, where it has one."""
    return open_store(store_of(source.source), create=False, signing=Signing.of_environment())


def _server_of(app: Starlette, address: PageAddress, rights: PageRights) -> PageServer:
    return PageServer(
        uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            http=PeerProtocol,
            ws="websockets-sansio",
            ws_max_size=SAYS_BYTES,
            server_header=False,
            limit_concurrency=MOST_AT_ONCE,
            timeout_graceful_shutdown=END_S,
            ssl_certfile=None if address.certificate is None else str(address.certificate),
            ssl_keyfile=None if address.key is None else str(address.key),
            ssl_ca_certs=rights.trusted,
            ssl_cert_reqs=ssl.CERT_NONE if rights.trusted is None else ssl.CERT_OPTIONAL,
        )
    )


def _run(server: PageServer, listening: socket.socket, stop: threading.Event, ready: Callable[[], None]) -> None:
    """Run the server in a thread until told to stop."""
    thread = threading.Thread(target=lambda: server.run([listening]), name="page server", daemon=True)
    thread.start()
    while thread.is_alive() and not server.started:
        time.sleep(_POLL_S / 10)
    if server.started:
        ready()
    while thread.is_alive() and not stop.wait(_POLL_S):
        pass
    is_early = not stop.is_set()
    server.should_exit = True
    thread.join()
    if is_early:
        raise ServeError("the page's server has ended: its log says why")


@contextlib.contextmanager
def _listening(address: PageAddress) -> Iterator[socket.socket]:
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((address.host, address.port))
        except OSError as error:
            raise ServeError(
                f"cannot listen at {address.host}:{address.port} ({error.strerror}): choose another --port, or 0"
            ) from error
        yield listening


@click.command(short_help="Show a map in the browser, as it is, as it was, and as it changes.")
@identity_option
@click.argument("source", metavar="RUN|STORE", type=LOCATION)
@click.option("--connect", help="Router of the fleet.  [default: that of RUN while it is going]")
@click.option("--listen", "host", default="127.0.0.1", show_default=True, help="Address to listen at.")
@click.option("--port", type=int, default=8480, show_default=True, help="Port to listen at; 0 takes a free one.")
@click.option("--name", "names", multiple=True, help="Host name under which browsers ask for the page; repeatable.")
@click.option("--token-file", type=PATH, help="File with the token that every request must bring.")
@click.option("--certificate", type=PATH, help="Certificate of the server (PEM): HTTPS.")
@click.option("--key", type=PATH, help="Its key (PEM).")
@click.option("--allow-changes", is_flag=True, help="Let who has the token accept, doubt and roll back changes.")
@click.option(
    "--roles", type=PATH, help="Identity folder (`gnd certs`): its fleet's members look, its operators decide."
)
@click.option(
    "--replay",
    type=click.FloatRange(0.0, 1000.0),
    default=0.0,
    help="Play the run so many times faster, from its begin.",
)
@layer_option
def serve(
    source: StoreLocation,
    connect: str | None,
    host: str,
    port: int,
    names: tuple[str, ...],
    token_file: Path | None,
    certificate: Path | None,
    key: Path | None,
    allow_changes: bool,
    roles: Path | None,
    replay: float,
    layer: str,
) -> None:
    """Show the map of RUN (the folder of a run) or STORE in the browser: every Gaussian, vehicles as they drive,
    updates as they are published, every version before.

    Nothing is changed by it unless --allow-changes says so: then whoever opens the page with its token (one is made up
    where --token-file gives none), or with --roles whoever brings an operator's certificate, may accept, doubt and
    roll back changes. Only this machine reaches it, unless --listen says otherwise, which needs a certificate, and a
    token or --roles. Ctrl-C ends it.
    """
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(name)s %(message)s")
    token = "" if token_file is None else token_of(token_file)
    made = secrets.token_hex(32) if allow_changes and not token and roles is None else ""
    address = PageAddress(host, port, names, token or made, certificate, key, roles)
    with ending_in_order() as stop:
        source_shown = PageSource(source, layer, connect, replay)
        serve_page(source_shown, address, stop, lambda url: _say(url, made), allow_changes=allow_changes)


def _say(url: str, token: str) -> None:
    click.echo(f"the map is at {url}{f'?token={token}' if token else ''}  (Ctrl-C ends)")
