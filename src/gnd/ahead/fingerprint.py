"""What the machine code of a kernel depends on, as one number: the kernel, all that it calls, all that it reads."""

import hashlib
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final

import numpy as np

from gnd.gnd_map.jit import kernel_of

FORMAT: Final = "1"
_OF_NUMBA: Final = ("numpy", "math", "cmath")
"""Modules whose functions numba replaces by its own; of which version, the library tells."""
_known: Final[dict[Callable[..., Any], bytes]] = {}


def fingerprint(function: Callable[..., Any]) -> str:
    """SHA-256, as hex, of the byte code of a plain function, of the functions that it calls and of the global values
    that it reads; with the options of each kernel.

    Comments, and lines above it, do not change it. It is one of this version of Python only: so is machine code that is
    called from Python.
    """
    return hashlib.sha256(FORMAT.encode() + b"".join(_reached(function, set()))).hexdigest()


def _reached(function: Callable[..., Any], seen: set[Callable[..., Any]]) -> Iterator[bytes]:
    """The digests of a function and of all functions under it, in the order in which they are met."""
    if function in seen:
        return
    seen.add(function)
    yield _own(function)
    for value in _values(function).values():
        inner = _function_of(value)
        if inner is not None:
            yield from _reached(inner, seen)


def _own(function: Callable[..., Any]) -> bytes:
    """Digest of a function without those that it calls; remembered."""
    if function not in _known:
        kernel = kernel_of(function)
        options = sorted(kernel.options.items()) if kernel is not None else None
        values = {name: _written(value) for name, value in sorted(_values(function).items())}
        told = (function.__qualname__, _code(function.__code__), options, function.__defaults__, values)
        _known[function] = hashlib.sha256(repr(told).encode()).digest()
    return _known[function]


def _code(code: CodeType) -> tuple[Any, ...]:
    """What of a code object decides what it computes: not where it stands in its file."""
    consts = tuple(_code(one) if isinstance(one, CodeType) else _written(one) for one in code.co_consts)
    named = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    return (code.co_code.hex(), code.co_exceptiontable.hex(), consts, named, code.co_argcount, code.co_flags)


def _values(function: Callable[..., Any]) -> dict[str, Any]:
    """Global and enclosed values that a function reads, by name; those of modules with the module's name."""
    code, home = function.__code__, function.__globals__
    names = sorted(set(_names(code)))  # in an order that is the same in every process
    found = {name: home[name] for name in names if name in home}
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        found[name] = cell.cell_contents
    for name, module in list(found.items()):
        if isinstance(module, ModuleType) and module.__name__.split(".")[0] not in _OF_NUMBA:
            found.update({f"{name}.{one}": getattr(module, one) for one in names if hasattr(module, one)})
    return found


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from _names(one)


def _function_of(value: Any) -> Callable[..., Any] | None:
    """The plain function behind a kernel, whatever stands for it, or behind itself."""
    plain = value if isinstance(value, FunctionType) else getattr(value, "py_func", None)
    return plain if isinstance(plain, FunctionType) else None


def _written(value: Any) -> str:
    """A value as text that is the same in every process."""
    if _function_of(value) is not None:
        return "function"  # told by itself
    if isinstance(value, np.ndarray):
        return f"array {value.dtype.str} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, type):
        return f"type {value.__module__}.{value.__qualname__} {getattr(value, '_fields', '')}"
    if isinstance(value, ModuleType):
        return f"module {value.__name__}"
    if isinstance(value, tuple | list):
        return f"{type(value).__name__}({', '.join(_written(one) for one in value)})"
    if isinstance(value, frozenset | set):
        return f"set({', '.join(sorted(_written(one) for one in value))})"
    if isinstance(value, float):
        return f"{type(value).__name__} {value.hex()}"
    return f"{type(value).__name__} {value!r}"  # one with an address in it is never valid: numba compiles then
