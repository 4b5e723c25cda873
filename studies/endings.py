"""How soon each command that takes long ends on Ctrl-C and on SIGTERM, in early and late phases; and what it leaves.

`python -m studies endings` prints the slowest end of each command. Times count from when the program has begun, after
Python itself. Ctrl-C goes to all processes of a command at once,
as from a terminal; SIGTERM to the command alone, as from `kill`, systemd or Docker.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gnd.deploy.ports import claim_port
from gnd.fleet_bus.router import open_router
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from studies.frame.measure import Figure
from studies.frame.options import check, option

MARK: Final = "GND_ENDINGS_MARK"
SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
AFTER_S: Final = (0.3, 2.0, 6.0)
LONGEST_S: Final = 60.0
ENDS_IN_S: Final = 20.0
"""A test on a busy machine asks for no more; on a free one it is meant to be 3 s."""
LEFT_S: Final = 5.0
"""So long after a command has ended its helpers may still be about to end."""
_LOOK_S: Final = 0.02
_SEED, _SCANS = 11, 60


@dataclass(frozen=True, slots=True)
class EndingCase:
    """A command of the table.

    Attributes:
        name: of the case.
        words: after `gnd`; {base}, {drive}, {out} and {router} are filled in, {port} is a free port.
        codes: exit codes besides 130 and 143 that are documented: of those that a signal ends in the usual way.
    """

    name: str
    words: str
    codes: tuple[int, ...] = ()

    @property
    def is_possible(self) -> bool:
        """Whether it can run here: a lab needs root and iproute2."""
        return not self.words.startswith("lab") or (os.geteuid() == 0 and shutil.which("ip") is not None)


SERVES: Final = (0,)
"""A server that is told to end has done its work."""
CASES: Final = (
    EndingCase("router", "router --listen tcp/127.0.0.1:{port}", SERVES),
    EndingCase("store", "store --path {base} --connect {router}", SERVES),
    EndingCase("merger", "merger --store {base} --connect {router}", SERVES),
    EndingCase("agent", "agent --drive {drive} --connect {router} --work-dir {out}", SERVES),
    EndingCase("watch", "watch ** --connect {router}", SERVES),
    EndingCase("play", "play {drive} --zenoh --connect {router}", SERVES),
    EndingCase("fleet-of-drives", "fleet --drives {drive} --map {base} --out {out}"),
    EndingCase("fleet-simulated", "fleet --agents 2 --out {out}"),
    EndingCase("load", "load --vehicles 4"),
    EndingCase("chaos", "chaos --kills 20 --out {out}", (0, 1)),
    EndingCase("lab-check", "lab check --links 3g --name e{port}"),
    EndingCase("map-build", "map build {drive} -o {out}.sqlite"),
    EndingCase("map-verify", "map verify {base}"),
    EndingCase("map-check", "map check {base} --all-versions"),
    EndingCase("localise", "localise {drive} --map {base} --out {out}"),
    EndingCase("sim-drive", "sim drive {world} {out}.mcap --sensor hdl64e"),
    EndingCase("view", "view {base} --save {out}.rrd"),
    EndingCase("reproduce", "reproduce simulation --out {out}"),
)


@dataclass(frozen=True, slots=True)
class EndingWorld:
    """What the commands work on: a map, a drive, a street, and a router."""

    base: Path
    drive: Path
    street: Path
    router: str

    def words(self, case: EndingCase, out: Path) -> list[str]:
        """The words of a case, filled in."""
        names = {"base": self.base, "drive": self.drive, "world": self.street, "router": self.router, "out": out}
        return case.words.format(**names, port=claim_port(0)).split()


@dataclass(frozen=True, slots=True)
class Ending:
    """How a command ended.

    Attributes:
        case: which.
        signal: that it got.
        after_s: so long after it was started.
        took_s: from the signal to its end, s; 0 where it had ended by itself before.
        code: its exit code; below 0 a signal.
        by_itself: whether it had ended before the signal.
        left: processes of it that were still there, some words of each.
        said: of its standard error, the end.
    """

    case: EndingCase
    signal: signal.Signals
    after_s: float
    took_s: float
    code: int
    by_itself: bool
    left: tuple[str, ...]
    said: str

    @property
    def wrong(self) -> list[str]:
        """What is not as it should be, but for the time that it took."""
        found = []
        expected = (128 + self.signal, *self.case.codes, *((0,) if self.by_itself else ()))
        if self.code not in expected:
            found.append(f"exit code {self.code}, not one of {expected}")
        if re.search(r"Traceback|Exception ignored|Warning: |^KeyboardInterrupt|FATAL|core dumped", self.said, re.M):
            found.append("a traceback")
        if self.left:
            found.append(f"left behind: {'; '.join(self.left)}")
        return found


@contextmanager
def ending_world(folder: Path) -> Iterator[EndingWorld]:
    """A short street, mapped and driven, and a router; until the end of the block."""
    world = street(_SEED)
    mapping = DriveConfig("mapper", "VLP-16", "before", errors=PERFECT, car_share=0.0, scans=_SCANS, cruise_mps=7.0)
    mapped = simulate_drive(world, mapping, folder / "mapper.mcap")
    with SqliteStore(folder / "base.sqlite") as store:
        build_map([mapped], store)
    drive = simulate_drive(world, DriveConfig("car-0", "VLP-16", seed=_SEED, scans=_SCANS), folder / "car-0.mcap")
    subprocess.run([*_GND, "sim", "world", "write", str(folder / "street.json"), "--seed", str(_SEED)], check=True)  # noqa: S603
    endpoint = f"tcp/127.0.0.1:{claim_port(0)}"
    with open_router([endpoint]):
        yield EndingWorld(folder / "base.sqlite", drive, folder / "street.json", endpoint)


_GND: Final = (sys.executable, "-m", "gnd.deploy.cli")


def endings(case: EndingCase, world: EndingWorld, folder: Path, after_s: Sequence[float] = AFTER_S) -> list[Ending]:
    """End a command by each signal after each time; one after the other, so that none slows another."""
    return [_ended(case, world, folder, number, one) for number in SIGNALS for one in after_s]


def _ended(case: EndingCase, world: EndingWorld, folder: Path, number: signal.Signals, after_s: float) -> Ending:
    mark, out = uuid.uuid4().hex, folder / f"{case.name}-{number.name}-{after_s:g}"
    log, place = folder / f"{out.name}.log", folder / f"{out.name}-in"
    place.mkdir()
    base = folder / f"{out.name}-base.sqlite"
    shutil.copyfile(world.base, base)  # each its own: a merger that still ends must not hold that of the next
    own = EndingWorld(base, world.drive, world.street, world.router)
    with log.open("wb") as err:
        process = subprocess.Popen(  # noqa: S603 - words of the table
            [*_GND, *own.words(case, out)], stdout=subprocess.DEVNULL, stderr=err, stdin=subprocess.DEVNULL,
            start_new_session=True, env={**os.environ, MARK: mark}, cwd=place,
        )  # fmt: skip
    try:
        _wait_begun(process.pid)
        try:
            process.wait(after_s)
            by_itself = True
        except subprocess.TimeoutExpired:
            by_itself = False
        began_s = time.monotonic()
        if not by_itself:
            _send(process, number)
        code = process.wait(LONGEST_S)
        took_s = 0.0 if by_itself else time.monotonic() - began_s
        left = _left(mark)
    except subprocess.TimeoutExpired:
        code, took_s, left = -9, LONGEST_S, ()
    finally:
        _clean(mark)
        process.wait()
    return Ending(case, number, after_s, took_s, code, by_itself, left, log.read_text(errors="replace")[-4000:])


def _wait_begun(pid: int) -> None:
    """Until the program takes SIGTERM: before that Python itself starts, which is no phase of ours."""
    deadline_s = time.monotonic() + LONGEST_S
    while time.monotonic() < deadline_s:
        try:
            status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
        except OSError:
            return
        caught = re.search(r"^SigCgt:\s*([0-9a-f]+)", status, re.M)
        if caught is None or int(caught[1], 16) >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(_LOOK_S)


def _send(process: "subprocess.Popen[bytes]", number: signal.Signals) -> None:
    if number == signal.SIGINT:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)


def _left(mark: str) -> tuple[str, ...]:
    """Processes of a command that do not end within a few seconds."""
    deadline_s = time.monotonic() + LEFT_S
    while (found := _marked(mark)) and time.monotonic() < deadline_s:
        time.sleep(_LOOK_S)
    return tuple(found.values())


def _clean(mark: str) -> None:
    for pid in _marked(mark):
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue


def _marked(mark: str) -> dict[int, str]:
    """Command lines of the living processes that have the mark in their environment, by process id."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if f"{MARK}={mark}".encode() in (folder / "environ").read_bytes():
                words = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                if words:  # of one that has ended and is not yet waited for nothing is told
                    found[int(folder.name)] = words[:120]
        except OSError:
            continue
    return found


NAMES: Final = tuple(case.name for case in CASES)


@dataclass(frozen=True, slots=True)
class EndingOptions:
    """What is measured."""

    cases: tuple[str, ...] = option(NAMES, "Which commands.", known=NAMES)

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = EndingOptions


def run(options: EndingOptions | None = None) -> list[Figure]:
    """Measure; every command alone."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in scripts; what is started would not hear it either
        signal.signal(signal.SIGINT, signal.default_int_handler)
    chosen = [case for case in CASES if case.is_possible and case.name in (options or EndingOptions()).cases]
    with tempfile.TemporaryDirectory(prefix="gnd-endings-") as folder, ending_world(Path(folder)) as world:
        return [_figure(case, endings(case, world, Path(folder))) for case in chosen]


def _figure(case: EndingCase, found: Sequence[Ending]) -> Figure:
    times = ", ".join("by itself" if one.by_itself else f"{one.took_s:.2f} s" for one in found)
    wrong = [f"{one.signal.name} after {one.after_s:g} s: {what}" for one in found for what in one.wrong]
    detail = f"{' and '.join(number.name for number in SIGNALS)}: {times}{f'; {wrong}' if wrong else ''}"
    return Figure(f"{case.name}: slowest end", max(one.took_s for one in found), "s", detail)
