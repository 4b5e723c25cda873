"""A router is killed under many sessions that all ask: in how narrow a time do their questions come when it is back?"""

import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np

from gnd.deploy import roles
from gnd.deploy.ports import claim_port
from gnd.deploy.processes import ProcessSpec, Supervisor, start_fork_server
from gnd.deploy.repeating import repeated
from gnd.fleet_bus import requesting
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.serving import Request
from studies.frame.measure import Figure

SESSIONS: Final = 100
KEY: Final = "studies/herd"
BIN_S: Final = 0.05
READY_S: Final = 30.0


def run() -> list[Figure]:
    """Measure with the spread that clients have, and without any."""
    usual_s = requesting.RETURN_SPREAD_S
    try:
        requesting.RETURN_SPREAD_S = 0.0  # type: ignore[misc]  # how it was before
        before = _measured("without spread")
    finally:
        requesting.RETURN_SPREAD_S = usual_s  # type: ignore[misc]
    return [*before, *_measured(f"spread over {usual_s:g} s")]


def _measured(how: str) -> list[Figure]:
    start_fork_server()
    connect, came_s, told = f"tcp/127.0.0.1:{claim_port(0)}", list[float](), list[float]()

    def answer(request: Request) -> bytes:
        came_s.append(time.monotonic())
        return request.payload

    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        supervisor = Supervisor(Path(folder), Path(folder) / "pids.json")
        stack.callback(supervisor.stop)
        supervisor.start(ProcessSpec("router", roles.router, (connect,)))
        stack.enter_context(repeated(lambda _number: supervisor.poll(), 0.02))
        config = BusConfig(connect=(connect,), open_timeout_s=READY_S)
        server = stack.enter_context(open_bus(config, name="server"))
        server.serve(KEY, answer)
        buses = [stack.enter_context(open_bus(config, name=f"client-{n}")) for n in range(SESSIONS)]
        killed_s = _kill(supervisor, buses)
        threads = [threading.Thread(target=_ask, args=(bus, told)) for bus in buses]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    at_s = np.sort(np.array(came_s))
    most = max(int(np.searchsorted(at_s, one + BIN_S) - n) for n, one in enumerate(at_s))
    detail = f"{SESSIONS} sessions, {len(told)} answered, {len(came_s)} questions came, {how}"
    return [
        Figure(f"most questions within {1e3 * BIN_S:.0f} ms, {how}", most, "", detail),
        Figure(f"first to last question, {how}", float(at_s[-1] - at_s[0]), "s", detail),
        Figure(f"kill to last answer, {how}", max(told) - killed_s, "s", detail),
    ]


def _kill(supervisor: Supervisor, buses: list[Bus]) -> float:
    killed_s = time.monotonic()
    supervisor.kill("router")
    while any(bus.is_connected() for bus in buses) and time.monotonic() - killed_s < 1.0:
        time.sleep(0.005)
    return killed_s


def _ask(bus: Bus, told: list[float]) -> None:
    bus.request(KEY, b"", kind="control", timeout_s=READY_S)
    told.append(time.monotonic())
