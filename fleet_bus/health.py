"""The pages by which a process is watched: /metrics for Prometheus, /healthz for who asks whether it can do its work.

/livez answers as long as the process does, whatever it depends on: a restart mends no database that is away. All answer
from threads of their own; a check that hangs makes the process ill, not the page.
"""

import errno
import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final, Self

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from gnd.fleet_bus.build_info import register_build
from gnd.fleet_bus.errors import PortInUse

CHECK_S: Final = 3.0
"""A check that takes longer has failed."""
REMEMBERED_S: Final = 1.0
"""Answers of checks are used again for so long, whoever asks how often."""
CLIENT_S: Final = 10.0
_LOG = logging.getLogger(__name__)

Check = Callable[[], str | None]
"""None when all is well, else what is not; what it raises is that, too."""


class HealthServer:
    """Serves the pages until closed.

    Args:
        port: where; 0 takes a free one.
        registry: of the metrics; those of the process itself, its versions and its clock are added.
        checks: by name, what has to be well.
        host: address to listen at; the default is this machine's own alone.

    Raises:
        PortInUse: the port is taken, or may not be taken.
    """

    def __init__(
        self, port: int, registry: CollectorRegistry, checks: Mapping[str, Check], *, host: str = "127.0.0.1"
    ) -> None:
        ProcessCollector(registry=registry)
        register_build(registry)
        self._registry = registry
        self._checks = {name: _Watched(check) for name, check in checks.items()}
        try:
            self._server = _Server((host, port), self)
        except OSError as error:
            why = "port in use" if error.errno == errno.EADDRINUSE else error.strerror or str(error)
            raise PortInUse(f"cannot serve metrics at {host}:{port}: {why}") from None
        self._thread = threading.Thread(target=self._server.serve_forever, name="health", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.server_address[1])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End it."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def page(self, path: str) -> tuple[int, str, bytes]:
        """Status, content type and body of one page."""
        if path == "/metrics":
            return 200, CONTENT_TYPE_LATEST, generate_latest(self._registry)
        if path == "/livez":
            return 200, "text/plain; charset=utf-8", b"ok\n"
        if path == "/healthz":
            found = {name: check.answer() for name, check in self._checks.items()}
            ill = {name: why for name, why in found.items() if why is not None}
            told = {"healthy": not ill, "checks": {name: why or "ok" for name, why in found.items()}}
            return (503 if ill else 200), "application/json", json.dumps(told, indent=1).encode() + b"\n"
        return 404, "text/plain; charset=utf-8", b"there are /metrics, /healthz and /livez\n"


class _Watched:
    """One check, run by one thread at a time and never waited for longer than `CHECK_S`."""

    def __init__(self, check: Check) -> None:
        self._check = check
        self._lock = threading.Lock()
        self._running: threading.Thread | None = None
        self._found: str | None = None
        self._found_at_s = -REMEMBERED_S

    def answer(self) -> str | None:
        with self._lock:
            if time.monotonic() - self._found_at_s < REMEMBERED_S:
                return self._found
            if self._running is None or not self._running.is_alive():
                self._running = threading.Thread(target=self._run, name="health-check", daemon=True)
                self._running.start()
            running = self._running
        running.join(CHECK_S)
        if running.is_alive():
            return f"no answer within {CHECK_S:.0f} s"
        return self._found

    def _run(self) -> None:
        try:
            found = self._check()
        except Exception as error:
            found = f"{type(error).__name__}: {error}"
        self._found, self._found_at_s = found, time.monotonic()


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], health: HealthServer) -> None:
        self.health = health
        super().__init__(address, _Handler)


class _Handler(BaseHTTPRequestHandler):
    timeout = CLIENT_S
    server: _Server

    def do_GET(self) -> None:
        try:
            status, kind, body = self.server.health.page(self.path.partition("?")[0])
        except Exception:
            _LOG.exception("no page %s", self.path)
            status, kind, body = 500, "text/plain; charset=utf-8", b"the page cannot be made; see the log\n"
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002  (the standard library's name)
        _LOG.debug(format, *arguments)
