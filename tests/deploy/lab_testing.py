"""What the tests of labs share: who may run them, names of their own, processes on both sides of a link."""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gnd.deploy.lab.lab import namespaces_of
from gnd.deploy.lab.tools import TUN_DEVICE
from gnd.fleet_bus import BusConfig, Ledger, open_bus
from gnd.fleet_bus.router import run_router, wait_for_stop

DEADLINE_S = 60.0
KEY = "gnd/v1/lab/test"

needs_root = pytest.mark.skipif(
    os.geteuid() != 0 or not all(map(shutil.which, ("ip", "tc", "ss"))) or not TUN_DEVICE.is_char_device(),
    reason="needs root, iproute2 and /dev/net/tun",
)


def own_name() -> str:
    """A lab's name that no other test run has."""
    return f"t{uuid.uuid4().hex[:10]}"


def gnd_lab(*arguments: str, **options: object) -> subprocess.Popen[str]:
    return _gnd("lab", *arguments, **options)


def _gnd(*arguments: str, **options: object) -> subprocess.Popen[str]:
    return subprocess.Popen(  # type: ignore[call-overload, no-any-return]
        [sys.executable, "-m", "gnd.deploy.cli", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options,
    )  # fmt: skip


@contextmanager
def started(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A `gnd lab` that does not outlive the test, and removes its lab, whatever happens."""
    with started_gnd("lab", *arguments) as process:
        yield process


@contextmanager
def started_gnd(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """The same of any `gnd` that makes a lab."""
    process = _gnd(*arguments)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        end_surely(process)


def end_surely(process: subprocess.Popen[str]) -> None:
    """Wait for its end; one that does not obey is killed and its lab removed, so that the next test finds none."""
    try:
        process.communicate(timeout=DEADLINE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        gnd_lab("clean").communicate(timeout=DEADLINE_S)
        raise


def finished(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=DEADLINE_S)
    return process.returncode, out, err


def wait_until(condition: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {DEADLINE_S} s: {what}"
        time.sleep(0.02)  # between two looks; the deadline above bounds the wait


def has_namespaces(lab: str) -> bool:
    return len(namespaces_of(lab)) > 0


def profile_file(folder: Path, text: str, name: str = "links.toml") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def router_role(listen: str, *, stop: threading.Event) -> None:
    """The router, without the imports of `gnd.deploy.roles`."""
    run_router((listen,), stop=stop)


def echo_role(connect: str, *, stop: threading.Event) -> None:
    """Answers every request with its payload twice."""
    with open_bus(BusConfig(connect=(connect,)), name="echo") as bus, bus.serve(KEY, lambda r: r.payload * 2):
        wait_for_stop(stop)


def asking_role(connect: str, ledger: Path, rounds: int, size: int, *, stop: threading.Event) -> None:
    """Asks some rounds of random bytes and keeps the ledger of a vehicle."""
    with open_bus(BusConfig(connect=(connect,)), ledger=Ledger("vehicle-00", ledger), name="asking") as bus:
        for _ in range(rounds):
            payload = os.urandom(size)
            assert bus.request(KEY, payload, kind="tile", timeout_s=DEADLINE_S) == payload * 2
            if stop.is_set():
                return
