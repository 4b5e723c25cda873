"""What the tests of the bus share: waiting with a deadline, router processes, scripts in processes of their own."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
from suite_ports import new_port

from gnd.fleet_bus.bus import Bus

REPOSITORY = Path(__file__).resolve().parents[2]
DEADLINE_S = 15.0


def wait_for(condition: Callable[[], object], what: str, timeout_s: float = DEADLINE_S) -> None:
    """Waits until the condition holds; fails with `what` at the deadline."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {timeout_s:g} s: {what}"
        time.sleep(0.005)


def stays(condition: Callable[[], object], what: str, for_s: float = 0.3) -> None:
    """Checks that the condition holds all the time."""
    end_s = time.monotonic() + for_s
    while time.monotonic() < end_s:
        assert condition(), what
        time.sleep(0.01)


def new_endpoint() -> str:
    """An endpoint at which nobody listened a moment ago."""
    return f"tcp/127.0.0.1:{new_port()}"


PROBE = b"is anybody there?"


class Inbox:
    """A callback that keeps (key, payload) of what it gets, leaving out probes."""

    def __init__(self, then: Callable[[str, bytes], None] = lambda _key, _payload: None) -> None:
        self.items: list[tuple[str, bytes]] = []
        self._then = then
        self._probed = threading.Event()

    def __call__(self, key: str, payload: bytes) -> None:
        if payload == PROBE:
            self._probed.set()
            return
        self.items.append((key, payload))
        self._then(key, payload)

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, payload in self.items]

    def wait_connected(self, sender: Bus, key: str) -> None:
        """Publishes probes until one arrives: before that, the routers may not know the subscription yet."""
        deadline_s = time.monotonic() + DEADLINE_S
        while not self._probed.wait(0.01):
            assert time.monotonic() < deadline_s, f"nothing published on {key} arrives"
            sender.publish(key, PROBE, kind="control")


class Script:
    """A Python process of the test; its standard output is read line by line."""

    def __init__(self, code: str, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=REPOSITORY,
            env=os.environ | {"PYTHONPATH": str(REPOSITORY / "src"), "PYTHONUNBUFFERED": "1"},
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))

    def wait_line(self, start: str) -> None:
        wait_for(
            lambda: any(line.startswith(start) for line in self.lines) or self.process.poll() is not None,
            f"a line {start!r} of {self.lines}",
        )
        assert any(line.startswith(start) for line in self.lines), f"ended without {start!r}: {self.lines}"

    def kill(self) -> None:
        """kill -9."""
        self.process.kill()
        self.process.wait(DEADLINE_S)

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def wait(self) -> int:
        code = self.process.wait(DEADLINE_S)
        self._reader.join(DEADLINE_S)
        return code

    def close(self) -> None:
        if self.process.poll() is None:
            self.kill()
        self._reader.join(DEADLINE_S)
        assert self.process.stdout is not None
        self.process.stdout.close()


@contextmanager
def script(code: str, *arguments: str) -> Iterator[Script]:
    running = Script(code, *arguments)
    try:
        yield running
    finally:
        running.close()


class RouterProcess:
    """`gnd router` as a process that can be killed and started again at the same endpoint."""

    def __init__(self, endpoint: str, connect: tuple[str, ...] = ()) -> None:
        self.endpoint, self._connect = endpoint, connect
        self._running: Script | None = None

    def start(self) -> Script:
        links = [word for other in self._connect for word in ("--connect", other)]
        running = Script("from gnd.fleet_bus.cli import router; router()", "--listen", self.endpoint, *links)
        self._running = running
        running.wait_line("router listens")
        return running

    @property
    def pid(self) -> int:
        assert self._running is not None
        return self._running.process.pid

    def kill(self) -> None:
        assert self._running is not None
        self._running.kill()
        self._running.close()
        self._running = None

    def close(self) -> None:
        if self._running is not None:
            self._running.close()


def sockets_to(port: int) -> list[int]:
    """Descriptors of this process's TCP connections to a local port."""
    connections = psutil.Process().net_connections("tcp")
    return [c.fd for c in connections if c.raddr and c.raddr.port == port and c.status == psutil.CONN_ESTABLISHED]
