"""Who waits for a kernel that the disk does not hold yet hears it; who finds it there hears nothing."""

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
from gnd.deploy.compiling import say_once
from gnd.gnd_map.jit import kernel, tell_compiling
names = []
tell_compiling(names.append)
tell_compiling(say_once())
from own_kernels import outer
print(outer(2), sorted(set(names)))
"""
KERNELS = """
from gnd.gnd_map.jit import kernel

@kernel
def inner(x):
    return x + 1

@kernel
def outer(x):
    return 2 * inner(x)
"""


def test_the_first_run_says_so_once_and_the_second_nothing(tmp_path: Path) -> None:
    (tmp_path / "own_kernels.py").write_text(KERNELS)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(tmp_path)])}
    runs = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        for _ in range(2)
    ]
    assert runs[0].stdout.strip() == "6 ['inner', 'outer']"
    assert runs[0].stderr.count("compiling kernels for this machine") == 1
    assert runs[1].stdout.strip() == "6 []"
    assert runs[1].stderr == ""
