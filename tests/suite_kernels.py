"""Kernels that most tests use, ready before the suite's processes start.

On a new machine each of them would compile for itself, a minute of work in as many copies; and numba takes no lock on
its index of a kernel: of two signatures written at the same moment it may mix up the files.

The suite's own processes run what numba compiles. The hundreds of programs that tests start run a library of the same
kernels, `LIBRARY`, that is compiled ahead of time where it is missing or a kernel has changed: each of them starts with
a second less of work. `tests/ahead` checks that both compute the same, to the bit.
"""

import hashlib
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

LIBRARY: Final = Path(__file__).parents[1] / "build" / "tests" / "kernels.so"
_MADE_OF: Final = LIBRARY.with_suffix(".txt")
_VARIABLE: Final = "GND_KERNELS"


def choose_kernels() -> None:
    """Numba's in this process, the library in programs that it starts, unless GND_KERNELS asks for one for all.

    Processes that this one starts for the suite choose alike.
    """
    from gnd.ahead.library import installed_library

    if os.environ.setdefault(_VARIABLE, str(LIBRARY)) == str(LIBRARY):
        os.environ[_VARIABLE] = "numba"
        installed_library()  # asks once, and remembers
        os.environ[_VARIABLE] = str(LIBRARY)


def warm_up_simulator(folder: Path) -> None:
    """A few scans through a street with cars and people in rain, a map of them, and the street's truth."""
    from gnd.fleet_sim.drives import DriveConfig, simulate_drive
    from gnd.fleet_sim.street import StreetOptions, street
    from gnd.fleet_sim.traffic import Traffic
    from gnd.fleet_sim.truth import ScanPlan, make_truth
    from gnd.tile_store.build import build_map
    from gnd.tile_store.sqlite_store import SqliteStore

    world = street(1, StreetOptions(length_m=100.0))
    busy = DriveConfig("warm", "VLP-16", scans=3, traffic=Traffic(10.0, 10.0), weather="rain", beams="real")
    plain = DriveConfig("warm", "VLP-16", scans=3)
    drives = [simulate_drive(world, config, folder / f"{n}.mcap") for n, config in enumerate((busy, plain))]
    with SqliteStore(folder / "map.sqlite") as store:
        build_map(drives, store)
    make_truth(world, plan=ScanPlan(spacing_m=16.0, step_rad=0.02))


def kernels_now() -> str:
    """A digest of all kernels as their source is now, and of what their machine code depends on beside."""
    from gnd.ahead.build import SCENES
    from gnd.ahead.fingerprint import fingerprint
    from gnd.ahead.library import environment, name_of
    from gnd.deploy.doctor.programs import all_kernels

    told = sorted((name_of(one), fingerprint(one.plain)) for one in all_kernels())
    scenes = [Path(str(import_module(name).__file__)).read_bytes() for name in SCENES]  # they say what it holds
    return hashlib.sha256(repr((environment(), told, scenes)).encode()).hexdigest()


def is_current(now: str) -> bool:
    """Whether the library was made of these kernels."""
    return LIBRARY.is_file() and _MADE_OF.is_file() and _MADE_OF.read_text(encoding="utf-8") == now


def has_library() -> bool:
    """The same, asked in a process of its own: which kernels there are depends on what was imported."""
    return subprocess.run([sys.executable, __file__, "--current"], check=False).returncode == 0


def build_library(now: str) -> None:
    """Compile the library; where it cannot be (no C compiler), say so: programs of tests then run numba's, too."""
    LIBRARY.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "gnd.deploy.cli", "kernels", "build", "--out", str(LIBRARY)]
    if subprocess.run(command, check=False).returncode == 0:
        _MADE_OF.write_text(now, encoding="utf-8")


def warm_up() -> None:
    """Have numba compile the kernels of vehicle, cloud and simulator, and keep them on the disk."""
    from gnd.cloud_merger.warm import warm_up as warm_up_cloud
    from gnd.vehicle_agent.warm import warm_up as warm_up_vehicle

    warm_up_vehicle()
    warm_up_cloud()
    with TemporaryDirectory() as made:
        warm_up_simulator(Path(made))


def main() -> None:
    """Both side by side where both are to be done: each works on one core."""
    choose_kernels()
    now, ahead = kernels_now(), None
    if os.environ[_VARIABLE] == str(LIBRARY) and not is_current(now):
        ahead = subprocess.Popen([sys.executable, __file__, "--library", now])
    warm_up()
    if ahead is not None:
        ahead.wait()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--library"]:
        build_library(sys.argv[2])
    elif sys.argv[1:2] == ["--current"]:
        sys.exit(not is_current(kernels_now()))
    else:
        main()
