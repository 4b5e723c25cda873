"""The library of kernels that was compiled ahead of time: found, checked, loaded, and asked for single kernels.

Nothing of it is believed before it has been checked: a digest at the end of the file (damage, truncation), the version
of Python and of numpy, the processor, and for each kernel a fingerprint of all source that its machine code came from.
What does not fit is left to numba.
"""

import hashlib
import json
import logging
import os
import platform
import sysconfig
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.ahead.fingerprint import fingerprint
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.jit import LazyKernel

MARK: Final = b"gnd-kernels-1 "
"""Begins the end of the file; the SHA-256 of all before follows, as hex, and a line feed."""
VARIABLE: Final = "GND_KERNELS"
"""Of the environment: `numba`: no library; a path: this library instead of the one that was installed."""
_TAIL_BYTES: Final = len(MARK) + 64 + 1
_MODULE: Final = "_kernels"


class UnfitLibrary(GndError):
    """A library of kernels is not used: it is damaged, or was made for another machine or another Python."""


@dataclass(frozen=True, slots=True)
class KernelLibrary:
    """A library that has been checked and loaded.

    Attributes:
        path: of the file.
        cpu: that it was compiled for, as LLVM calls it.
        made_with: versions of what made it.
        kernels: by "module:name": its fingerprint, and by entry the types of its arguments.
        module: the extension module.
    """

    path: Path
    cpu: str
    made_with: dict[str, str]
    kernels: dict[str, dict[str, Any]]
    module: Any = field(repr=False)

    def compiled(self, kernel: LazyKernel) -> Any | None:
        """What calls the machine code of a kernel; None where there is none of its present source."""
        overloads = self._overloads(kernel)
        return None if overloads is None else self.module.make_kernel(kernel, kernel.otherwise, overloads)

    def is_valid_for(self, kernel: LazyKernel) -> bool:
        """Whether it has machine code of a kernel as its source is now."""
        return self._overloads(kernel) is not None

    def _overloads(self, kernel: LazyKernel) -> tuple[tuple[int, tuple[Any, ...]], ...] | None:
        """By entry the types that it takes; None where source or types are others than when it was compiled."""
        found = self.kernels.get(name_of(kernel))
        if found is None or found["fingerprint"] != fingerprint(kernel.plain):
            return None
        try:
            return tuple((one["number"], _specs(one["arguments"])) for one in found["entries"])
        except _OtherType:
            return None


class _OtherType(Exception):
    """A class of arguments is no longer what it was."""


def name_of(kernel: LazyKernel) -> str:
    """How a library names a kernel."""
    return f"{kernel.plain.__module__}:{kernel.plain.__qualname__}"


def compiled_kernel(kernel: LazyKernel) -> Any | None:
    """What calls machine code of `kernel` that was made ahead of time; None: numba is to compile it."""
    library = installed_library()
    return None if library is None else library.compiled(kernel)


@cache
def installed_library() -> KernelLibrary | None:
    """The library that this process uses, None where there is none or where it does not fit; the log says why."""
    path = library_path()
    if path is None or not path.is_file():
        return None
    try:
        library = load(path)
        logging.getLogger(__name__).info("%d kernels, compiled ahead of time: %s", len(library.kernels), path)
        return library
    except UnfitLibrary as error:
        logging.getLogger(__name__).warning("kernels are compiled by numba: %s", error)
        return None


def library_path() -> Path | None:
    """Where the library is looked for; None where the environment asks for numba."""
    asked = os.environ.get(VARIABLE, "")
    if asked == "numba":
        return None
    return Path(asked) if asked else Path(__file__).parent / file_name()


def file_name() -> str:
    """Name of the file, for this version of Python and this kind of machine."""
    return f"{_MODULE}{sysconfig.get_config_var('EXT_SUFFIX')}"


def load(path: Path) -> KernelLibrary:
    """Check and load a library.

    Raises:
        UnfitLibrary: it is damaged, or made for others; no code of its kernels has run.
    """
    _check_digest(path)
    loader = ExtensionFileLoader(_MODULE, str(path))
    spec = spec_from_loader(_MODULE, loader)
    assert spec is not None
    try:
        module = module_from_spec(spec)
        loader.exec_module(module)
        told = json.loads(module.describe())
        _check_fits(path, told, runs_here=module.runs_here())
        return KernelLibrary(path, told["cpu"], told["made_with"], told["kernels"], module)
    except (ImportError, AttributeError, ValueError, KeyError, TypeError) as error:
        raise UnfitLibrary(f"{path}: not a library of kernels for this Python: {error}") from None


def sealed(machine_code: bytes) -> bytes:
    """A library's file with the digest at its end."""
    return machine_code + MARK + hashlib.sha256(machine_code).hexdigest().encode() + b"\n"


def _check_digest(path: Path) -> None:
    """Read the whole file: what is loaded next is what was written, or nothing is."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UnfitLibrary(f"{path}: cannot be read: {error.strerror}") from None
    if len(content) < _TAIL_BYTES or sealed(content[:-_TAIL_BYTES]) != content:
        raise UnfitLibrary(f"{path}: damaged: its {len(content)} bytes do not end with their digest")


def environment() -> dict[str, str]:
    """What machine code that is called from Python depends on, beside the processor."""
    return {
        "python": str(sysconfig.get_config_var("SOABI")),
        "machine": platform.machine(),
        "system": platform.system(),
        "numpy": np.__version__.split(".")[0],
    }


def _check_fits(path: Path, told: dict[str, Any], *, runs_here: bool) -> None:
    for name, here in environment().items():
        if told["environment"].get(name) != here:
            raise UnfitLibrary(f"{path}: made for {name} {told['environment'].get(name)}; this is {here}")
    if not runs_here:
        raise UnfitLibrary(f"{path}: made for processors of {told['cpu']}, which this one is not")


def _specs(arguments: list[list[Any]]) -> tuple[tuple[Any, ...], ...]:
    """Types of arguments as the extension module reads them, with their classes."""
    return tuple(_spec(*one) for one in arguments)


def _spec(
    what: str, kind: str, layout: str, writeable: int, itemsize: int, ndim: int, type_name: str, parts: list[list[Any]]
) -> tuple[Any, ...]:
    found = _type_of(type_name) if type_name else None
    return (what, kind or " ", layout or " ", writeable, itemsize, ndim, found, _specs(parts))


def type_name(cls: type) -> str:
    """How a library names a class of arguments: where it is, and the names of its fields in their order."""
    return f"{cls.__module__}:{cls.__qualname__}:{','.join(getattr(cls, '_fields', ()))}"


@cache
def _type_of(name: str) -> type:
    module, qualname, _ = name.split(":")
    try:
        found: Any = import_module(module)
        for part in qualname.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError):
        raise _OtherType(name) from None
    if not isinstance(found, type) or type_name(found) != name:
        raise _OtherType(name)
    return found
