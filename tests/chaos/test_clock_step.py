"""The time of day that a chaos run sets wrong: all processes that name the file see it, leases and queues do not."""

import struct
import time
from pathlib import Path

import pytest

from gnd.tile_store import clocks

HOUR_NS = 3_600 * 10**9


def test_the_time_of_day_steps_with_the_file_and_the_clock_of_leases_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "clock"
    path.write_bytes(struct.pack("<q", 0))
    monkeypatch.setenv(clocks.OFFSET_FILE, str(path))
    for by_ns in (0, -24 * HOUR_NS, 5 * HOUR_NS):
        with path.open("r+b") as file:
            file.write(struct.pack("<q", by_ns))
        assert abs(clocks.day_ns() - time.time_ns() - by_ns) < 60 * 10**9
        assert abs(clocks.steady_ns() - time.monotonic_ns()) < 60 * 10**9
    monkeypatch.delenv(clocks.OFFSET_FILE)
    assert abs(clocks.day_ns() - time.time_ns()) < 60 * 10**9
