"""Processes of a fleet run: started from a warmed fork server, watched, restarted, stopped.

The fork server imports the heavy libraries and loads the compiled kernels once; each process forked from it shares
those pages (4 MB and 30 ms instead of 75 MB and a second). Threads and Zenoh sessions begin only after the fork.
"""

import json
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing import connection, resource_tracker
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, Final

from gnd.deploy.errors import ProcessDied
from gnd.deploy.lab.namespaces import enter_namespace
from gnd.ending import ctrl_c_withheld
from gnd.fleet_bus.config import PLAIN_VARIABLE
from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE

PRELOAD: Final = ("gnd.deploy.preload",)
STOP_GRACE_S: Final = 10.0
MAX_RESTARTS: Final = 5  # within `RESTARTS_SPAN_S`: a part that dies more often by itself will not live
RESTARTS_SPAN_S: Final = 60.0
RESTART_DELAY_S: Final = 0.3  # times the number of deaths in a row that came at once
STEADY_S: Final = 2.0  # a process that has lived so long is started again without delay

Role = Callable[..., None]

_context = multiprocessing.get_context("forkserver")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One process of a run.

    Attributes:
        name: unique within the run, also the name of its log file.
        role: a module-level function `role(*args, stop=Event)` that returns when its work is done or `stop` is set.
        args: picklable arguments of the role.
        restart: start it again when it ends with an exit code other than 0.
        namespace: the network namespace that it enters first of all; None stays in the launcher's.
        identity: its identity folder; None: it has none.
        environment: variables that it has beside those of the launcher, and what it starts, too.
    """

    name: str
    role: Role
    args: tuple[Any, ...]
    restart: bool = True
    namespace: str | None = None
    identity: Path | None = None
    environment: tuple[tuple[str, str], ...] = ()


@dataclass(slots=True)
class _Running:
    spec: ProcessSpec
    process: ForkServerProcess
    restarts: int = 0
    restart_at_s: float | None = None
    started_s: float = field(default_factory=time.monotonic)
    early_deaths: int = 0
    deaths_s: deque[float] = field(default_factory=deque)
    is_killed: bool = False

    def pause_s(self) -> float:
        """How long to wait before it is started again: one that dies at once would die for ever."""
        steady = self.is_killed or time.monotonic() - self.started_s >= STEADY_S
        self.early_deaths = 0 if steady else self.early_deaths + 1
        return RESTART_DELAY_S * self.early_deaths

    def count_death(self) -> int:
        """How often it has died by itself within the span that counts, this time included."""
        now_s = time.monotonic()
        if not self.is_killed:
            self.deaths_s.append(now_s)
        while self.deaths_s and self.deaths_s[0] < now_s - RESTARTS_SPAN_S:
            self.deaths_s.popleft()
        return len(self.deaths_s)


@dataclass
class Supervisor:
    """Starts processes, restarts those that die, and ends them all.

    Attributes:
        log_dir: folder of one log file per process.
        pid_file: JSON object from process name to process id, rewritten at every start.
        on_restart: called with the name and the exit code of a process that is started again.
        restarts: how often each process was started again.
        deaths: how often it had died by itself, not by `kill`.
    """

    log_dir: Path
    pid_file: Path
    on_restart: Callable[[str, int], None] = lambda name, code: None  # noqa: ARG005  (the default ignores both)
    _running: dict[str, _Running] = field(default_factory=dict)
    restarts: dict[str, int] = field(default_factory=dict)
    deaths: Counter[str] = field(default_factory=Counter)

    def start(self, spec: ProcessSpec) -> None:
        """Start one process."""
        self._running[spec.name] = _Running(spec, self._spawn(spec))
        self._write_pids()

    def kill(self, name: str) -> None:
        """End a process by SIGKILL, so that it is started again: a death that says nothing about the process."""
        running = self._running[name]
        if running.process.is_alive():
            running.is_killed = True
            running.process.kill()

    def poll(self) -> None:
        """Start dead processes again, at once where they lived for a while; call it a few times a second.

        Raises:
            ProcessDied: when a process has died by itself more than `MAX_RESTARTS` times within `RESTARTS_SPAN_S`.
        """
        for running in self._running.values():
            code = running.process.exitcode
            if code is not None and code != 0 and running.spec.restart:
                self._restart(running, code)

    def finished(self, prefix: str) -> bool:
        """Tell whether every process whose name begins with `prefix` has ended with exit code 0."""
        group = [r for name, r in self._running.items() if name.startswith(prefix)]
        return all(r.process.exitcode == 0 for r in group)

    def pids(self) -> dict[str, int]:
        """Return the process ids by name."""
        return {name: r.process.pid for name, r in self._running.items() if r.process.pid is not None}

    def stop(self, names: tuple[str, ...] = ()) -> None:
        """End the named processes (all when none is named): SIGTERM, a grace period, then SIGKILL."""
        chosen = [r for name, r in self._running.items() if not names or name in names]
        for running in chosen:
            if running.process.is_alive():
                running.process.terminate()
        deadline_s = time.monotonic() + STOP_GRACE_S
        for running in chosen:
            self._join(running.process, deadline_s - time.monotonic())
            self._running.pop(running.spec.name)
        self._write_pids()

    def _join(self, process: ForkServerProcess, timeout_s: float) -> None:
        process.join(max(0.05, timeout_s))
        if process.is_alive():
            _log.warning("%s did not end within %.0f s: killed", process.name, STOP_GRACE_S)
            process.kill()
            process.join()

    def _restart(self, running: _Running, code: int) -> None:
        name = running.spec.name
        if running.restart_at_s is None:  # seen dead for the first time
            self.deaths[name] += not running.is_killed
            deaths = running.count_death()
            if deaths > MAX_RESTARTS:
                raise ProcessDied(
                    f"{name} ended {deaths} times within {RESTARTS_SPAN_S:.0f} s, last with exit code {code}: read"
                    f" {self.log_dir / name}.log"
                )
            running.restart_at_s = time.monotonic() + running.pause_s()
        if time.monotonic() < running.restart_at_s:
            return
        running.restarts += 1
        running.restart_at_s, running.is_killed = None, False
        self.restarts[name] = running.restarts
        self.on_restart(name, code)
        running.process, running.started_s = self._spawn(running.spec), time.monotonic()
        self._write_pids()

    def _spawn(self, spec: ProcessSpec) -> ForkServerProcess:
        process = _context.Process(
            target=_run_role, args=(spec, str(self.log_dir / f"{spec.name}.log")), name=spec.name
        )
        process.start()
        return process

    def _write_pids(self) -> None:
        temporary = self.pid_file.with_suffix(".tmp")
        temporary.write_text(json.dumps(self.pids(), indent=2) + "\n", encoding="utf-8")
        temporary.replace(self.pid_file)


def start_fork_server() -> None:
    """Start the fork server and warm it: libraries imported, compiled kernels loaded.

    Call it before any thread or Zenoh session exists in this process.
    """
    _context.set_forkserver_preload(list(PRELOAD))
    probe = _context.Process(target=_nothing, name="warm-up")
    resource_tracker.ensure_running()  # where it starts this itself, it lets Ctrl-C through again
    with ctrl_c_withheld():  # it may come while kernels are compiled; who started the fork server ends it
        probe.start()
    probe.join()


def _nothing() -> None:
    pass


def _run_role(spec: ProcessSpec, log_path: str) -> None:
    """Run a role inside its process: log file, signals, network namespace, exit code."""
    stop = threading.Event()
    threading.Thread(target=_end_with_launcher, args=(stop,), name="launcher-watch", daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the launcher turns Ctrl-C into an orderly end
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    _log_to(log_path)
    os.environ.update(spec.environment)
    try:
        if spec.namespace is not None:
            enter_namespace(spec.namespace)  # before any thread of Zenoh's: threads are born where their maker is
            os.environ[PLAIN_VARIABLE] = "1"  # a lab's namespaces reach nobody else
        if spec.identity is not None:
            os.environ[IDENTITY_VARIABLE] = str(spec.identity)  # for the processes that it starts, too
        spec.role(*spec.args, stop=stop)
    except Exception:
        logging.getLogger(spec.role.__module__).exception("%s failed", spec.role.__name__)
        sys.exit(1)


def _end_with_launcher(stop: threading.Event) -> None:
    """Stop when the launcher is gone, however it died; called in a thread of its own."""
    launcher = multiprocessing.parent_process()
    if launcher is not None:
        connection.wait([launcher.sentinel])
        stop.set()
        time.sleep(STOP_GRACE_S)  # a daemon thread: it ends with the process if that ends in time
        os._exit(1)


def _log_to(path: str) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s", force=True
    )
