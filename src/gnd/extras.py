"""What `pip install gnd-fleet` leaves out, and which extra brings it."""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Final

from gnd.gnd_map.errors import GndError

OF_THE_PAGE: Final = frozenset(("starlette", "uvicorn", "websockets"))
"""Modules of `gnd serve`; a fleet goes without them, and says so."""
LEFT_OUT: Final = OF_THE_PAGE | {"gtsam", "matplotlib", "mpl_toolkits", "psutil", "scipy", "sklearn", "small_gicp"}
"""Modules of other projects that only extras bring; pyproject.toml has the same table by extra."""
_EXTRA_OF_MODULE: Final = {**dict.fromkeys(OF_THE_PAGE, "serve"), "small_gicp": "lanes"}
"""What one extra alone brings; small_gicp has no wheel for every machine that all others have one for."""
OF_A_FLEET: Final = LEFT_OUT - _EXTRA_OF_MODULE.keys()
"""What a whole fleet cannot run without."""
OF_A_VEHICLE: Final = frozenset(("gtsam", "scipy"))
"""What one cannot run without: much of it only where it finds poles, new roads or lanes, and then it is too late."""
OF_A_SHARD: Final = frozenset(("scipy", "sklearn"))
"""The same of a shard: where it merges features, or follows the paper's rules."""
EXTRA_OF: Final = {
    "gnd.vehicle_agent": "vehicle",
    "gnd.cloud_merger": "cloud",
    "gnd.tile_store": "cloud",
    "gnd.fleet_sim": "sim",
}
"""By the package that wanted one of them; any other: all."""


class MissingExtra(GndError):
    """A part of this project is used whose extra is not installed; the message says which."""


def missing_extra(error: ModuleNotFoundError) -> MissingExtra | None:
    """The error in words of ours, where it is about a module that an extra brings; else None."""
    module = (error.name or "").split(".")[0]
    if module not in LEFT_OUT:
        return None
    packages = [".".join(name.split(".")[:2]) for name in _modules(error.__traceback__)]
    extra = next((EXTRA_OF[package] for package in reversed(packages) if package in EXTRA_OF), "all")
    extra = _EXTRA_OF_MODULE.get(module, extra)
    return MissingExtra(f"{module} is not installed; it comes with: pip install 'gnd-fleet[{extra}]'")


def need_all() -> None:
    """For commands that run every part of a fleet: refuse to begin where one is not installed.

    Raises:
        MissingExtra: with the modules that are missing.
    """
    if missing := _missing(OF_A_FLEET):
        raise MissingExtra(f"{', '.join(missing)}: not installed; this command needs: pip install 'gnd-fleet[all]'")


def need_vehicle() -> None:
    """For who drives: refuse to begin where something is missing that may be needed on the road.

    Raises:
        MissingExtra: with the module that is missing.
    """
    if missing := _missing(OF_A_VEHICLE):
        raise MissingExtra(f"{missing[0]} is not installed; it comes with: pip install 'gnd-fleet[vehicle]'")


def need_shard() -> None:
    """For who merges: refuse to begin where something is missing that a report may need.

    Raises:
        MissingExtra: with the module that is missing.
    """
    if missing := _missing(OF_A_SHARD):
        raise MissingExtra(f"{missing[0]} is not installed; it comes with: pip install 'gnd-fleet[cloud]'")


def _missing(modules: frozenset[str]) -> list[str]:
    return sorted(name for name in modules if not _is_there(name))


def _is_there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


@contextmanager
def explained() -> Iterator[None]:
    """Say which extra to install where an import inside fails for want of one.

    Raises:
        MissingExtra: one is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = missing_extra(error)
        if missing is None:
            raise
        raise missing from error


def _modules(trace: TracebackType | None) -> Iterator[str]:
    """Names of the modules that an error went through, from the outermost."""
    while trace is not None:
        yield str(trace.tb_frame.f_globals.get("__name__", ""))
        trace = trace.tb_next
