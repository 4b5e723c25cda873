"""Whether a library of kernels computes what numba computes on this machine, bit for bit: `gnd kernels check`."""

import importlib
import logging
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.ahead.build import SCENES
from gnd.ahead.library import KernelLibrary, name_of
from gnd.gnd_map.jit import LazyKernel, record_calls

CALLS: Final = 3
"""Calls of each kernel and tuple of types that are compared."""
TIMES: Final = 7
"""Each of these is timed so often, in turns; the shortest counts."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """What was compared.

    Attributes:
        kernels: that were called in the library, by name: calls.
        unequal: those whose results, or arguments after the call, differ in any bit from numba's.
        by_numba: kernels that the scenes call and the library does not have.
        times_us: by kernel, microseconds of its calls together: in the library, and compiled by numba for this
            processor.
    """

    kernels: dict[str, int]
    unequal: tuple[str, ...]
    by_numba: tuple[str, ...]
    times_us: dict[str, tuple[float, float]]


def check(library: KernelLibrary, scenes: Sequence[str] = SCENES) -> Agreement:
    """Run the scenes with numba, then each recorded call once more in the library and once more with numba.

    In a process that has called no kernel yet, and with GND_KERNELS=numba.
    """
    calls: list[tuple[LazyKernel, tuple[Any, ...]]] = []
    met: Counter[tuple[str, tuple[Any, ...]]] = Counter()

    def record(kernel: LazyKernel, arguments: tuple[Any, ...]) -> None:
        key = (name_of(kernel), tuple(kernel.dispatcher.typeof_pyval(one) for one in arguments))
        met[key] += 1
        if met[key] <= CALLS:
            calls.append((kernel, _copied(arguments)))

    record_calls(record)
    for name in scenes:
        importlib.import_module(name).warm_up()
    return _compared(library, calls)


def _compared(library: KernelLibrary, calls: Sequence[tuple[LazyKernel, tuple[Any, ...]]]) -> Agreement:
    compared: Counter[str] = Counter()
    unequal, by_numba = [], set()
    times_us: dict[str, tuple[float, float]] = {}
    for kernel, arguments in calls:
        ahead = library.compiled(kernel)
        ours, numbas = _copied(arguments), _copied(arguments)
        found = None if ahead is None else ahead(*ours)
        if ahead is None or not sum(ahead.calls_ahead.values()):
            by_numba.add(name_of(kernel))
            continue
        compared[name_of(kernel)] += 1
        if _bits((found, ours)) != _bits((kernel.dispatcher(*numbas), numbas)):
            unequal.append(name_of(kernel))
            logging.getLogger(__name__).error("%s: other bits than numba's", name_of(kernel))
        before = times_us.get(name_of(kernel), (0.0, 0.0))
        took = _timed((ahead, kernel.dispatcher), arguments)
        times_us[name_of(kernel)] = (before[0] + took[0], before[1] + took[1])
    return Agreement(dict(compared), tuple(unequal), tuple(sorted(by_numba)), times_us)


def _timed(called: tuple[Any, Any], arguments: tuple[Any, ...]) -> list[float]:
    """The shortest time of a call of each, microseconds; in turns, each with arguments of its own."""
    best_ns = [2**62, 2**62]
    for _ in range(TIMES):
        for k, function in enumerate(called):
            own = _copied(arguments)
            begun_ns = time.perf_counter_ns()
            function(*own)
            best_ns[k] = min(best_ns[k], time.perf_counter_ns() - begun_ns)
    return [round(one / 1e3, 2) for one in best_ns]


def _copied(value: Any) -> Any:
    """A copy with the same layout of arrays, which is part of their type."""
    if isinstance(value, np.ndarray):
        if value.flags.c_contiguous or value.flags.f_contiguous:
            copy = value.copy(order="C" if value.flags.c_contiguous else "F")
        else:
            copy = np.empty((*value.shape, 2), value.dtype)[..., 0]
            copy[...] = value
        copy.flags.writeable = value.flags.writeable
        return copy
    if isinstance(value, tuple):
        parts = [_copied(one) for one in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def _bits(value: Any) -> list[Any]:
    """All bits of a value, with types and shapes."""
    return list(_each_bits(value))


def _each_bits(value: Any) -> Iterator[Any]:
    yield type(value)
    if isinstance(value, tuple):
        for one in value:
            yield from _each_bits(one)
    elif value is not None:
        array = np.asarray(value)
        yield (array.dtype, array.shape, array.tobytes())
