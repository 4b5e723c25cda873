"""Which programs made something: our version, and those of what decides results or what travels."""

import platform
from importlib import metadata
from typing import Final

_NAMED: Final = ("gnd-fleet", "eclipse-zenoh", "numpy", "numba", "apsw", "protobuf", "gtsam", "small_gicp")


def software() -> dict[str, str]:
    """Versions by name; of what is not installed "not installed"."""
    return {"Python": platform.python_version(), **{name: version_of(name) for name in _NAMED}}


def version_of(distribution: str) -> str:
    """Version of an installed distribution."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"
