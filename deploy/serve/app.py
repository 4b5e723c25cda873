"""The page's server: the built page, the map by questions, and one WebSocket for what happens."""

import asyncio
import contextlib
import gzip
import hashlib
import json
import mimetypes
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Final

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from gnd.deploy.errors import BadQuestion, ServeError
from gnd.deploy.serve.browsers import BrowserHub
from gnd.deploy.serve.follower import PageFollower
from gnd.deploy.serve.guard import PageAddress, PageGuard
from gnd.deploy.serve.page_map import PageMap, number_of, tile_of
from gnd.deploy.serve.page_vehicles import PageVehicles
from gnd.deploy.serve.panels import Panels
from gnd.deploy.serve.rights import PageRights
from gnd.extras import MissingExtra
from gnd.gnd_map.errors import GndError
from gnd.tile_store.errors import ChangedMeanwhile, UnknownVersion
from gnd.tile_store.judging import LONGEST_WHY

PAGE: Final = ("index.html", "page.js", "page.css", "icon.svg")
FOREVER: Final = "private, max-age=31536000, immutable"
DECISION_BYTES: Final = 4096
"""A decision with its reason is no longer."""
SAYS_BYTES: Final = 1024
"""A browser says no more than this at once: it has nothing to say but that it is there."""
_LEAST_PACKED: Final = 512
_TOO_MANY: Final = 1013


@dataclass(frozen=True, slots=True)
class PageParts:
    """What a page is made of.

    Attributes:
        shown: the map.
        vehicles: who drives.
        panels: what stands beside the map.
        replay: how many times faster the page plays the run when it opens; 0: it shows the map as it is.
    """

    shown: PageMap
    vehicles: PageVehicles
    panels: Panels
    replay: float = 0.0


def page_app(
    parts: PageParts, hub: BrowserHub, follower: PageFollower, address: PageAddress, rights: PageRights
) -> Starlette:
    """The application."""
    questions = _Questions(parts, hub, follower)

    @contextlib.asynccontextmanager
    async def life(_app: Starlette) -> AsyncIterator[None]:
        hub.begin()
        follower.start()
        yield
        await asyncio.to_thread(follower.close)

    routes = [
        *_page_routes(),
        *(Route(f"/api/{path}", _answer(ask)) for path, ask in questions.table().items()),
        Route("/api/changes/{key}", questions.decide, methods=["POST"]),
        Route("/api/overview.bin", questions.overview),
        Route("/api/tiles/{tile:int}/{version:int}.bin", questions.packed),
        WebSocketRoute("/api/live", questions.live),
    ]
    return Starlette(routes=routes, middleware=[Middleware(PageGuard, address=address, rights=rights)], lifespan=life)


def _page_routes() -> list[Route]:
    """The built page, from memory.

    Raises:
        ServeError: it is not there.
    """
    folder = files("gnd.deploy.serve") / "page"
    routes = []
    for name in PAGE:
        try:
            body = (folder / name).read_bytes()
        except OSError:
            raise ServeError(f"the built page lacks {name}: run `make page` in a checkout") from None
        routes.append(Route("/" if name == "index.html" else f"/{name}", _file(name, body)))
    return routes


def _file(name: str, body: bytes) -> Callable[[Request], Response]:
    kind = {"js": "text/javascript"}.get(name.rpartition(".")[2]) or mimetypes.guess_type(name)[0] or ""
    small, tag = gzip.compress(body, 9, mtime=0), f'"{hashlib.sha256(body).hexdigest()[:20]}"'

    def answer(request: Request) -> Response:
        headers = {"etag": tag, "cache-control": "no-cache"}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=headers)
        return _compressed(request, small, kind, headers)

    return answer


def _compressed(request: Request, small: bytes, kind: str, headers: dict[str, str]) -> Response:
    """A body that lies in gzip, as the browser can take it."""
    told = headers | {"vary": "accept-encoding"}
    if "gzip" in request.headers.get("accept-encoding", ""):
        return Response(small, media_type=kind, headers=told | {"content-encoding": "gzip"})
    return Response(gzip.decompress(small), media_type=kind, headers=told)


def _answer(ask: Callable[[Request], Any]) -> Callable[[Request], Response]:
    """An endpoint of plain values: JSON, errors of ours by name. It runs in a thread of its own."""

    def answer(request: Request) -> Response:
        try:
            body = JSONResponse(ask(request)).body
        except GndError as error:
            return refusal(error)
        if len(body) < _LEAST_PACKED:
            return Response(body, media_type="application/json")
        return _compressed(request, gzip.compress(bytes(body), 4, mtime=0), "application/json", {})

    return answer


def refusal(error: GndError) -> Response:
    """An error as an answer."""
    kinds = ((UnknownVersion, 404), (BadQuestion, 400), (ChangedMeanwhile, 409), (MissingExtra, 501))
    status = next((number for kind, number in kinds if isinstance(error, kind)), 503)
    return JSONResponse({"error": str(error)}, status)


class _Questions:
    """What a browser may ask."""

    def __init__(self, parts: PageParts, hub: BrowserHub, follower: PageFollower) -> None:
        self._parts, self._hub, self._follower = parts, hub, follower

    def table(self) -> dict[str, Callable[[Request], Any]]:
        """By path, what gives plain values."""
        shown, panels, vehicles = self._parts.shown, self._parts.panels, self._parts.vehicles
        return {
            "map": self._about,
            "tiles": lambda asked: shown.tiles(_box_of(asked)),
            "tiles/{tile}": lambda asked: shown.tile(tile_of(asked.path_params["tile"])),
            "tiles/{tile}/history": lambda asked: shown.history(tile_of(asked.path_params["tile"])),
            "voxel/{tile}/{voxel}": self._voxel,
            "features/{layer}": lambda asked: shown.features(asked.path_params["layer"]),
            "changes": lambda _: panels.changes.get(),
            "traffic": lambda _: panels.traffic.get(),
            "status": lambda _: panels.status.get() | {"browsers": self._hub.count, "live": self._follower.is_live},
            "vehicles": lambda _: vehicles.all(),
            "ways": lambda _: vehicles.ways(),
        }

    def _about(self, asked: Request) -> dict[str, Any]:
        viewer = asked.state.viewer
        told = {"live": self._follower.is_live, "replay": self._parts.replay}
        return self._parts.shown.about() | told | {"viewer": viewer.name, "may_decide": viewer.may_decide}

    async def decide(self, request: Request) -> Response:
        """Somebody decides about a change; the guard has seen to it that they may."""
        work, panels = self._parts.panels.work, self._parts.panels
        try:
            judgement, why = _decision_of(await _body_of(request))
            who = request.state.viewer.name
            await asyncio.to_thread(work.decide, request.path_params["key"], judgement, who, why)
        except GndError as error:
            return refusal(error)
        finally:
            panels.changes.forget()
        self._follower.look_soon()
        self._hub.tell({"type": "decided"})
        return JSONResponse({"done": judgement})

    def overview(self, request: Request) -> Response:
        """All tiles; see `PageMap.overview`."""
        body = gzip.compress(self._parts.shown.overview(), 4, mtime=0)
        return _compressed(request, body, "application/octet-stream", {})

    def packed(self, request: Request) -> Response:
        """A version of a tile; see `packed_tile`."""
        try:
            tile = tile_of(str(request.path_params["tile"]))
            level = number_of(request.query_params, "level", 0)
            body = self._parts.shown.packed(tile, request.path_params["version"], level)
        except GndError as error:
            return refusal(error)
        return _compressed(request, body, "application/octet-stream", {"cache-control": FOREVER})

    def _voxel(self, asked: Request) -> dict[str, Any]:
        version = number_of(asked.query_params, "version", 0)
        voxel = number_of(asked.path_params, "voxel", 0)
        return self._parts.shown.voxel(tile_of(asked.path_params["tile"]), voxel, version or None)

    async def live(self, socket: WebSocket) -> None:
        """Tell a browser what happens until it goes."""
        queue = self._hub.join()
        if queue is None:
            await socket.close(_TOO_MANY, "too many browsers look on")
            return
        try:
            await socket.accept()
            telling = asyncio.ensure_future(_tell(socket, queue))
            hearing = asyncio.ensure_future(_hear(socket))
            await asyncio.wait((telling, hearing), return_when=asyncio.FIRST_COMPLETED)
            for task in (telling, hearing):
                task.cancel()
            await asyncio.gather(telling, hearing, return_exceptions=True)
        finally:
            self._hub.leave(queue)


async def _tell(socket: WebSocket, queue: "asyncio.Queue[str]") -> None:
    while True:
        await socket.send_text(await queue.get())


async def _hear(socket: WebSocket) -> None:
    """What a browser says is not looked at: it only tells that it is there."""
    with contextlib.suppress(WebSocketDisconnect):
        while True:
            await socket.receive_text()


async def _body_of(request: Request) -> bytes:
    """What was sent, if it is no longer than a decision is."""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > DECISION_BYTES:
            raise BadQuestion(f"a decision of more than {DECISION_BYTES} bytes")
    return body


def _decision_of(body: bytes) -> tuple[str, str]:
    """What is decided, and why, in one line.

    Raises:
        BadQuestion: it is no decision.
    """
    try:
        told = json.loads(body)
        judgement, why = told["judgement"], told["why"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise BadQuestion("a decision is a JSON object of judgement and why") from None
    if not isinstance(judgement, str) or not isinstance(why, str):
        raise BadQuestion("judgement and why are texts")
    line = " ".join(why.split())
    if not line.isprintable() or len(line) > LONGEST_WHY:
        raise BadQuestion(f"the reason is at most {LONGEST_WHY} characters that can be printed, not {len(line)}")
    return judgement, line


def _box_of(asked: Request) -> tuple[float, float, float, float]:
    text = asked.query_params.get("box", "")
    try:
        west, south, east, north = (float(one) for one in text.split(","))
    except ValueError:
        raise BadQuestion(f"box={text[:80]!r} is not west,south,east,north in m") from None
    return west, south, east, north
