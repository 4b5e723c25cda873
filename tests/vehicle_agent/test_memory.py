"""What is freed goes back to the system."""

import subprocess
import sys
import textwrap

import pytest

from gnd.vehicle_agent.memory import keep_small

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
