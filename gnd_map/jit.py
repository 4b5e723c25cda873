"""The one way in which this project compiles a kernel."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` with numba on its first call and keep the machine code on disk beside its module.

    Kernels run without the GIL: other threads go on. No fast-math: results must not depend on how a compiler orders sums. Division by zero gives inf or NaN, as in numpy.
    """
    return cast("F", numba.njit(cache=True, error_model="numpy", nogil=True)(function))


def inlined(function: F) -> F:
    """As `kernel`, laid into its callers: for the few lines that run a hundred times a voxel."""
    return cast("F", numba.njit(cache=True, error_model="numpy", nogil=True, forceinline=True)(function))
