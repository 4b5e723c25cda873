"""Every command of the runbook, in its order, on a real store with the parts of the systemd units."""

import datetime as dt
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from console_pages import ShownCommand, check_printed, commands_of
from manifests import DEPLOY, unit_environment, unit_words
from suite_ports import new_port

from gnd.deploy.cli import gnd
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE, MemberName
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import DriveHeader, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter

PAGE = DEPLOY.parent / "docs" / "runbook.md"
GND = [sys.executable, "-m", "gnd.deploy.cli"]
TILE = TileId(497353963154)
SETTLES_S = 240.0  # kernels may have to be compiled
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def write_drive(path: Path, range_m: float) -> None:
    """A vehicle that stands before a wall."""
    rng = np.random.default_rng(0)
    header = DriveHeader("wall", "car-1", "test", LocalFrame(*TILE.centre_rad, 0.0), np.eye(4), "made by a test")
    with DriveWriter(path, header) as writer:
        for k in range(3):
            wall = np.stack([np.full(3000, range_m), rng.uniform(-4, 4, 3000), rng.uniform(0, 3, 3000)], axis=1)
            t_ns = 1_700_000_000_000_000_000 + k * 100_000_000
            writer.scan(Scan(t_ns, wall.astype(np.float32), np.zeros(3000, np.uint32)))
            writer.reference(ReferencePose(t_ns, np.eye(4)))


Done = tuple[int, str, str]
"""Exit code, standard output, standard error."""


@dataclass
class Server:
    """A server of the runbook: its folders below one of the test, its units as plain processes."""

    folder: Path
    port: int = field(default_factory=new_port)
    metrics: dict[str, int] = field(default_factory=dict)
    running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def here(self, text: str) -> str:
        """What a page says, on this machine."""
        text = re.sub(r"/(?=etc/gnd|var/lib/gnd)", f"{self.folder}/", text).replace(":7447", f":{self.port}")
        return text.replace("0.0.0.0", "127.0.0.1")

    def there(self, text: str) -> str:
        """What is printed here, as on the page."""
        return text.replace(f"{self.folder}/", "/").replace(f":{self.port}", ":7447")

    def systemctl(self, verb: str, units: list[str]) -> None:
        for unit in (one for one in units if not one.startswith("--")):
            if verb == "start":
                self._start(unit)
                continue
            process = self.running.pop(unit)
            process.send_signal(signal.SIGKILL if verb == "kill" else signal.SIGTERM)
            assert process.wait(timeout=60) == (-signal.SIGKILL if verb == "kill" else 0), self.log(unit)

    def _start(self, unit: str) -> None:
        name, _, instance = unit.partition("@")
        text = (DEPLOY / "systemd" / f"{name}{'@' * bool(instance)}.service").read_text()
        environment = unit_environment(text, instance, "") | {"NUMBA_CACHE_DIR": ""}
        words = [self.here(word) for word in unit_words(text, instance, environment)]
        words[words.index("--metrics-port") + 1] = str(self.metrics.setdefault(unit, new_port()))
        kept = {name: value for name, value in environment.items() if value}
        with (self.folder / f"{unit}.log").open("ab") as log:
            self.running[unit] = subprocess.Popen(
                [*GND, *words], stdout=log, stderr=log, cwd=self.folder, env=os.environ | kept
            )

    def log(self, unit: str) -> str:
        return (self.folder / f"{unit}.log").read_text()

    def run(self, command: ShownCommand) -> None:
        """Run a command; what it prints is what the page shows. A check is repeated until it says so."""
        words = shlex.split(self.here(command.line), comments=True)
        if words[0] == "systemctl":
            self.systemctl(words[1], words[2:])
            return
        until_s = time.monotonic() + (SETTLES_S if words[:2] == ["gnd", "status"] else 0.0)
        while True:
            done = self._gnd(words[1:]) if words[0] == "gnd" else self._shell(words)
            try:
                self.check(command, done)
            except AssertionError:
                if time.monotonic() > until_s:
                    raise
                time.sleep(1.0)  # between two looks; the deadline above bounds the wait
            else:
                return

    def _gnd(self, words: list[str]) -> Done:
        """Within this process, which has imported everything already."""
        kept = os.environ.get(IDENTITY_VARIABLE)
        done = CliRunner().invoke(gnd, words)
        os.environ.pop(IDENTITY_VARIABLE, None)
        if kept is not None:
            os.environ[IDENTITY_VARIABLE] = kept
        if isinstance(done.exception, GndError):  # as `gnd.deploy.cli.main` says it
            return 2, done.stdout, f"gnd: {done.exception}\n"
        assert done.exception is None or isinstance(done.exception, SystemExit), words
        return done.exit_code, done.stdout, done.stderr

    def _shell(self, words: list[str]) -> Done:
        done = subprocess.run(words, cwd=self.folder, capture_output=True, text=True, timeout=60)
        return done.returncode, done.stdout, done.stderr

    def check(self, command: ShownCommand, done: Done) -> None:
        code, out, err = done
        is_ill = any(line.startswith(("CRITICAL", "gnd: ")) for line in command.shown)
        assert (code != 0) == is_ill, f"$ {command.line}\n{out}\n{err}"
        said = out + (err if is_ill else "")
        check_printed(command, self.there(said))


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.chdir(tmp_path)
    made = Server(tmp_path)
    for name in ("etc/gnd", "var/lib/gnd"):
        (tmp_path / name).mkdir(parents=True)
    write_drive(tmp_path / "monday.mcap", 5.3)
    yield made
    for process in made.running.values():
        process.kill()
        process.wait()


def a_bad_survey(server: Server) -> None:
    """The tile of the runbook gets a version that nobody wants."""
    write_drive(server.folder / "bad.mcap", 7.9)
    server.run(ShownCommand("gnd map build -o /var/lib/gnd/store.sqlite --identity anna bad.mcap", ("...",)))


def an_expired_certificate(server: Server) -> None:
    begins = dt.datetime.now(dt.UTC) - dt.timedelta(days=9)
    authority = Authority(server.folder / "authority")
    authority.issue(
        MemberName("tiles", "store"), server.folder / "etc/gnd/store", begins=begins, ends=begins + dt.timedelta(days=2)
    )


BEFORE: dict[str, Callable[[Server], None]] = {
    "gnd map history": a_bad_survey,
    "gnd certs list": an_expired_certificate,
}
"""What happens to the server before a command, by its beginning."""


def test_every_command_of_the_runbook_does_what_it_shows(server: Server) -> None:
    commands = commands_of(PAGE)
    assert len(re.findall(r"^## ", PAGE.read_text(), re.M)) == 8
    assert len(commands) > 35
    happened = set()
    for command in commands:
        for begin, happens in BEFORE.items():
            if command.line.startswith(begin):
                happens(server)
                happened.add(begin)
        server.run(command)
    assert happened == set(BEFORE)
    assert set(server.running) == {"gnd-router", "gnd-store", "gnd-merger@0"}
    assert {unit: one.poll() for unit, one in server.running.items()} == dict.fromkeys(server.running)
