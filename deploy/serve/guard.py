"""Who may ask: only pages of our own address, on this machine, or whoever has the token.

A page of somebody else's that a browser on this machine has open may send requests here, under a name of its own that
leads to this address (DNS rebinding): the name that it asks for tells it from ours. A WebSocket names the page that
opens it, and so does whatever would change something: without our own address as its origin it is refused.
"""

import hmac
import ipaddress
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from gnd.deploy.errors import ServeError
from gnd.deploy.serve.rights import PageRights, Viewer
from gnd.fleet_bus.config import PLAIN_VARIABLE

COOKIE: Final = "gnd_page"
LEAST_TOKEN: Final = 24
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS: Final = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
_REFUSED_SOCKET: Final = 1008


@dataclass(frozen=True, slots=True)
class PageAddress:
    """Where the page is, and who may ask.

    Attributes:
        host: address to listen at.
        port: its port; 0 takes a free one.
        names: host names under which it may be asked for, beside the address itself.
        token: what every request must bring; "": nothing.
        certificate: PEM of the server's certificate; None: plain HTTP.
        key: PEM of its key.
        roles: identity folder of the fleet whose members may ask by their certificates; None: the token tells.
    """

    host: str = "127.0.0.1"
    port: int = 0
    names: tuple[str, ...] = ()
    token: str = field(default="", repr=False)
    certificate: Path | None = None
    key: Path | None = None
    roles: Path | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65_535:
            raise ServeError(f"port {self.port} is not in 0 … 65535")
        if (self.certificate is None) != (self.key is None):
            raise ServeError("a certificate needs its key, and a key its certificate")
        if self.token and len(self.token) < LEAST_TOKEN:
            raise ServeError(f"the token has {len(self.token)} characters, need {LEAST_TOKEN}: `openssl rand -hex 32`")
        if self.roles is not None and self.certificate is None:
            raise ServeError("members of a fleet show their certificates in TLS alone: --roles needs --certificate")
        if self.is_loopback:
            return
        if not self.token and self.roles is None:
            raise ServeError(
                f"{self.host} reaches beyond this machine: whoever gets there would see the map; give --token-file,"
                " or --roles"
            )
        if self.certificate is None and os.environ.get(PLAIN_VARIABLE) != "1":
            raise ServeError(
                f"{self.host} reaches beyond this machine and plain HTTP shows the token to all on the way: give"
                f" --certificate and --key, or set {PLAIN_VARIABLE}=1 in a network that you trust"
            )

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine reaches it."""
        try:
            return self.host == "localhost" or ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def url(self, port: int) -> str:
        """The page's address for people."""
        host = self.names[0] if self.names else self.host
        return f"{'http' if self.certificate is None else 'https'}://{f'[{host}]' if ':' in host else host}:{port}/"


def token_of(path: Path) -> str:
    """The token in a file.

    Raises:
        ServeError: it cannot be read, or others can read it, too.
    """
    try:
        if path.stat().st_mode & 0o077:
            raise ServeError(f"{path}: others can read the token; chmod 600 {path}")
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ServeError(f"cannot read the token {path}: {error}") from error


class PageGuard:
    """Refuses what is not asked of our own address, or without the token; gives every answer its headers.

    Args:
        app: what is behind it; it finds who asks as `viewer` in the request's state.
        address: where the page is.
        rights: who may do what.
    """

    def __init__(self, app: ASGIApp, address: PageAddress, rights: PageRights) -> None:
        self._app, self._address, self._rights = app, address, rights
        own = ("localhost", "127.0.0.1", "::1") if address.is_loopback else ()
        self._names = {one.lower() for one in (*own, address.host, *address.names)}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or hand it on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        viewer = self._rights.viewer(scope.get("state", {}))
        scope.setdefault("state", {})["viewer"] = viewer
        refusal = self._refusal(scope, headers, viewer)
        if refusal is None:
            await self._app(scope, receive, send if scope["type"] == "websocket" else _with_headers(send))
        elif scope["type"] == "websocket":
            await WebSocketClose(_REFUSED_SOCKET, refusal[1])(scope, receive, send)
        elif self._brings_token(scope):
            await self._cookie(scope)(scope, receive, _with_headers(send))
        else:
            status, text = refusal
            await JSONResponse({"error": text}, status)(scope, receive, _with_headers(send))

    def _refusal(self, scope: Scope, headers: Headers, viewer: Viewer) -> tuple[int, str] | None:
        if self._name_of(headers.getlist("host")) not in self._names:
            return 421, "this host name is not ours: --name gives the page another"
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc.lower() != headers["host"].lower():
            return 403, "another site's page asks"
        is_question = scope["type"] != "http" or scope["method"] in ("GET", "HEAD")
        if not is_question and not (scope["method"] == "POST" and self._rights.allow_changes):
            return 405, "the map is only shown: GET"
        is_known = viewer.is_member or (self._has_token(headers) if self._address.token else self._rights.roles is None)
        if not is_known:
            return (
                401,
                "open the page with ?token=… once" if self._address.token else "bring a certificate of the fleet",
            )
        return None if is_question else self._refusal_to_change(scope, headers, viewer)

    def _refusal_to_change(self, scope: Scope, headers: Headers, viewer: Viewer) -> tuple[int, str] | None:
        """A form of another site's sends neither our origin nor JSON, and a script of its has to ask first (CORS)."""
        if headers.get("origin", "").lower() != f"{scope['scheme']}://{headers['host']}".lower():
            return 403, "whoever changes something says from which page: ours"
        if headers.get("sec-fetch-site", "same-origin") != "same-origin":
            return 403, "another site's page asks"
        if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            return 415, "what changes something is JSON"
        return None if viewer.may_decide else (403, f"{viewer.name} only looks: operators decide")

    def _name_of(self, hosts: Iterable[str]) -> str:
        named = list(hosts)
        try:
            return (urlsplit(f"//{named[0]}").hostname or "").lower() if len(named) == 1 else ""
        except ValueError:
            return ""

    def _has_token(self, headers: Headers) -> bool:
        told = headers.get("authorization", "").removeprefix("Bearer ")
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
        except CookieError:
            cookie = None
        given = (told, "" if cookie is None else cookie.value)
        return any(hmac.compare_digest(one.encode(), self._address.token.encode()) for one in given)

    def _brings_token(self, scope: Scope) -> bool:
        """Whether this is the page's own address with the right token, asked for under one of our names."""
        if scope["path"] != "/" or scope["method"] != "GET" or not self._address.token:
            return False
        if self._name_of(Headers(scope=scope).getlist("host")) not in self._names:
            return False
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        return hmac.compare_digest(given.encode(), self._address.token.encode())

    def _cookie(self, scope: Scope) -> RedirectResponse:
        """The page without the token in its address, and the token as a cookie that no script can read."""
        answer = RedirectResponse("/", 303)
        is_secure = scope["scheme"] == "https"
        answer.set_cookie(COOKIE, self._address.token, httponly=True, samesite="strict", secure=is_secure)
        return answer


def _with_headers(send: Send) -> Send:
    async def sent(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers[name] = value
            headers.setdefault("cache-control", "no-store")
        await send(message)

    return sent
