"""What is installed: Python, libraries against their pinned versions, kernels."""

import os
import re
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import gnd
from gnd.ahead.library import KernelLibrary, UnfitLibrary, library_path, load
from gnd.deploy.doctor.finding import Finding
from gnd.extras import OF_A_FLEET, OF_THE_PAGE
from gnd.gnd_map import jit
from gnd.gnd_map.jit import LazyKernel

_OLDEST: Final = (3, 11)
_SHOWN: Final = 6
_NAME: Final = re.compile(r"[\w.-]+")
DISTRIBUTION: Final = "gnd-fleet"


def programs() -> list[Finding]:
    """All that is looked at of what is installed."""
    return [python(), *packages(), extras(), kernels()]


def python() -> Finding:
    """Whether this Python is new enough."""
    says = f"{sys.version.split()[0]} at {sys.executable}"
    if sys.version_info >= _OLDEST:
        return Finding("Python", "ok", says)
    return Finding("Python", "fault", says, f"install Python {_OLDEST[0]}.{_OLDEST[1]} or newer")


def packages() -> Iterator[Finding]:
    """Whether what is needed is there, and in the versions that this release was tested with."""
    missing = [name for name in _needed() if not _version(name)]
    if missing:
        yield Finding("packages", "fault", f"not installed: {', '.join(missing)}", f"pip install {DISTRIBUTION}")
    pins = _pins()
    if pins is None:
        says = "nothing to compare versions with: not a checkout (no constraints.txt)"
        yield Finding("versions", "ok", says)
        return
    other = [f"{name} {own} instead of {pin}" for name, pin in pins.items() if (own := _version(name)) not in ("", pin)]
    if not other:
        yield Finding("versions", "ok", f"all that is installed is as in constraints.txt ({len(pins)} lines)")
        return
    more = f" and {len(other) - _SHOWN} more" if len(other) > _SHOWN else ""
    says = f"{len(other)} other than in constraints.txt: {', '.join(other[:_SHOWN])}{more}"
    yield Finding("versions", "warning", says, "make setup, or pip install -c constraints.txt -e '.[dev]'")


def extras() -> Finding:
    """Whether the libraries of vehicles, shards and the simulator are there."""
    missing = sorted(name for name in OF_A_FLEET | OF_THE_PAGE if find_spec(name) is None)
    if not missing:
        return Finding("extras", "ok", "vehicle, cloud and simulator can run here")
    says = f"not installed: {', '.join(missing)}"
    return Finding(
        "extras", "warning", says, f"where vehicles, shards or simulations run: pip install '{DISTRIBUTION}[all]'"
    )


def kernels() -> Finding:
    """Whether there is machine code of the kernels, so that no command has to compile."""
    known, library = all_kernels(), _library()
    if isinstance(library, UnfitLibrary):
        return Finding("kernels", "warning", f"not used: {library}", "gnd kernels build, or remove the file")
    ahead = [one.plain for one in known if library is not None and library.is_valid_for(one)]
    cached = sum(is_cached(one.plain) for one in known if one.plain not in ahead)
    if library is not None and ahead:
        says = f"compiled ahead of time: {len(ahead)} of {len(library.kernels)} in {library.path} are as their source"
        return Finding("kernels", "ok", f"{says}; {cached} more in numba's cache")
    says = f"{cached} of {len(known)} are compiled for this Python, in numba's cache"
    if cached:  # no machine needs them all: how many depends on what runs here
        return Finding("kernels", "ok", says)
    do = "nothing: the first command compiles for a minute or two, once; or gnd kernels build, with a C compiler"
    return Finding("kernels", "warning", says, do)


def _library() -> KernelLibrary | UnfitLibrary | None:
    """The library that was compiled ahead of time, why it is not used, or None where there is none."""
    path = library_path()
    if path is None or not path.is_file():
        return None
    try:
        return load(path)
    except UnfitLibrary as error:
        return error


def all_kernels() -> tuple[LazyKernel, ...]:
    """The kernels of the parts that run in a fleet, as far as they are installed."""
    for module in ("gnd.gnd_map.codec", "gnd.cloud_merger.warm", "gnd.vehicle_agent.warm"):
        try:
            __import__(module)
        except ImportError:  # an extra that is not installed; `extras` says so
            continue
    return jit.kernels()


def is_cached(function: Callable[..., Any]) -> bool:
    """Whether numba's index of a kernel is there and no older than the source.

    The file is `MODULE.NAME-LINE.pyXY.nbi`, beside the module or, where nothing can be written there, in a folder of
    the user's (numba.core.caching).
    """
    source = Path(function.__code__.co_filename)
    stem = f"{source.stem}.{function.__qualname__}-{function.__code__.co_firstlineno}."
    tag = f"py{sys.version_info.major}{sys.version_info.minor}"
    for folder in (Path(os.environ.get("NUMBA_CACHE_DIR", source.parent / "__pycache__")), _of_user()):
        for index in folder.rglob(f"{stem}{tag}*.nbi") if folder.is_dir() else ():
            if index.stat().st_mtime >= source.stat().st_mtime:
                return True
    return False


def _of_user() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "numba"


def _needed() -> list[str]:
    """What the base installation needs."""
    try:
        told = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return []
    return [found[0] for one in told if "extra ==" not in one and (found := _NAME.match(one)) is not None]


def _pins() -> dict[str, str] | None:
    """Versions of constraints.txt of the checkout, None without one."""
    file = Path(gnd.__file__).resolve().parents[2] / "constraints.txt"
    if not file.is_file():
        return None
    lines = (line.partition("#")[0].partition(";")[0].strip() for line in file.read_text(encoding="utf-8").splitlines())
    pairs = (line.split("==") for line in lines if line.count("==") == 1)
    return {name.partition("[")[0].strip(): version.strip() for name, version in pairs}


def _version(name: str) -> str:
    """Version of what is installed, "" where it is not."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""
