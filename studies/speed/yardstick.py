"""The ray kernel in C, compiled on the spot: how fast the machine is at this walk."""

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.vehicle_agent.detect.kernel import KernelParameters

SOURCE: Final = Path(__file__).with_name("ray_walk.c")
# No contraction to fused multiply-adds, which round otherwise than our kernel: counts must be equal to the bit.
FLAGS: Final = ("-O3", "-march=native", "-ffp-contract=off", "-shared", "-fPIC")


class _Parameters(ctypes.Structure):
    """`KernelParameters`, in their order."""

    _fields_ = [(name, ctypes.c_int64 if name == "rule" else ctypes.c_double) for name in KernelParameters._fields]


def compiler() -> str | None:
    """The path of gcc, None where there is none."""
    return shutil.which("gcc")


def compiled(folder: Path) -> Callable[..., int]:
    """Compile the walk into a folder; a function that takes what `cast_rays` of our kernel takes.

    Raises:
        subprocess.CalledProcessError: gcc refuses the source.
    """
    library = folder / "ray_walk.so"
    subprocess.run([compiler() or "gcc", *FLAGS, str(SOURCE), "-o", str(library), "-lm"], check=True)  # noqa: S603
    function = ctypes.CDLL(str(library)).cast_rays
    function.restype = ctypes.c_int64

    def cast_rays(
        points: Any, origins: Any, anchor_m: Any, A: Any, b: Any, state: Any, shape: tuple[int, int, int], words: Any,
        records: Any, block: Any, p: KernelParameters, moving: Any, kept: Any,
    ) -> int:  # fmt: skip
        parameters, sides = _Parameters(*p), np.array(shape, np.int64)
        inputs = (np.ascontiguousarray(one, np.float64) for one in (points, origins, anchor_m, A, b))
        points, origins, anchor_m, A, b = inputs
        assert np.shares_memory(words, records), "the records are the words, read as float32"
        return int(
            function(
                ctypes.c_int64(len(points)), _at(points), ctypes.c_int64(len(origins)), _at(origins), _at(anchor_m),
                _at(A), _at(b), _at(state), _at(sides), _at(words), _at(block), ctypes.byref(parameters), _at(moving),
                _at(kept),
            )
        )  # fmt: skip

    return cast_rays


def _at(array: Any) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
