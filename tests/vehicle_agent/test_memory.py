"""What is freed goes back to the system."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from gnd.vehicle_agent.memory import _unwritten, keep_small

PROGRAM = textwrap.dedent(
    """
    import numpy as np, psutil
    from gnd.vehicle_agent.memory import keep_small, trim
    small = {small}
    if small:
        assert keep_small()
    rss = lambda: psutil.Process().memory_info().rss
    start, kept = rss(), []
    for size in (100_000, 400_000) * 40:
        scan = np.ones(size)  # 0.8 and 3.2 MB
        kept.append(np.ones(20_000))
    held = sum(a.nbytes for a in kept)
    windows = [np.ones(1_500_000) for _ in range(4)]
    del scan, windows
    if small:
        trim()
    print(rss() - start - held)
    """
)


@pytest.mark.skipif(not keep_small(), reason="the C library is not glibc")
def test_a_process_that_frees_windows_and_scans_shrinks_again() -> None:
    run = [sys.executable, "-c", PROGRAM.format(small=True)]
    left = int(subprocess.run(run, capture_output=True, text=True, check=True).stdout)
    assert left < 8_000_000


CODE = """
import gtsam
import numpy as np
from gnd.vehicle_agent.memory import give_back_code, resident_mb

def pose():
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([1.0, 2.0, 3.0])), noise))
    values.insert(0, gtsam.Pose3())
    return gtsam.LevenbergMarquardtOptimizer(graph, values).optimize().atPose3(0).matrix().tobytes()

expected, before = pose(), resident_mb()
given, after = give_back_code(), resident_mb()
print(given, before - after, pose() == expected, resident_mb() < before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_code_that_ran_once_is_given_back_and_runs_again() -> None:
    told = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True).stdout.split()
    assert int(told[0]) > 20e6
    assert float(told[1]) > 10.0
    assert told[2:] == ["True", "True"]


SMAPS = """\
7f00-7f10 r-xp 00001000 fe:00 12 {tail}/lib/libone.so.1
Rss: 8 kB
Anonymous:             0 kB
7f10-7f20 r--p 00011000 fe:00 12 /lib/libone.so.1
Anonymous:             4 kB
7f20-7f30 rw-p 00021000 fe:00 12 /lib/libone.so.1
Anonymous:             0 kB
7f30-7f40 r-xp 00000000 00:00 0 [vdso]
Anonymous:             0 kB
7f40-7f50 r--p 00000000 fe:00 13 /data/store.sqlite
Anonymous:             0 kB
7f50-7f60 r--p 00000000 fe:00 14 /lib/my folder/two.cpython-311-x86_64-linux-gnu.so
Anonymous:             0 kB
7f60-7f70 r--p 00000000 fe:00 15 /lib/cut.so
"""


def test_what_was_written_to_and_what_is_no_library_stays(tmp_path: Path) -> None:
    """Relocated pages would be lost; a recording that is mapped is somebody else's."""
    (tmp_path / "smaps").write_text(SMAPS.format(tail=" " * 20))
    assert _unwritten(tmp_path / "smaps") == [(0x7F00, 0x7F10), (0x7F50, 0x7F60)]
    assert _unwritten(tmp_path / "none") == []
