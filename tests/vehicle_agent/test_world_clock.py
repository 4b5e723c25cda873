"""Drives that are replayed at once keep their distance in time, however unequal the machine treats them."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gnd.schemas.drive import DriveItem, MotionSample
from gnd.schemas.errors import DriveError
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.sources.world_clock import SLACK_S, Departure, WorldClock, in_common_time, make_clock

NEVER = threading.Event()
HZ = 50


def drive(first_s: float, seconds: float) -> Iterator[DriveItem]:
    """The motion of a drive that is stamped for another time."""
    for n in range(round(seconds * HZ)):
        yield MotionSample(round((first_s + n / HZ) * 1e9), 8.0, 0.0)


def test_a_fast_process_waits_for_a_slow_one_and_starts_that_long_after_it(tmp_path: Path) -> None:
    clock, done = tmp_path / "clock", dict[int, bool]()
    make_clock(clock, (0.0, 2.0))
    reached: dict[int, float] = {0: 0.0, 1: 2.0}
    gaps: list[float] = []

    def run(number: int, pause_s: float) -> None:
        departure = Departure(clock, number, 2.0 * number)
        first_ns = None
        for item in in_common_time(drive(1e3 * number, 4.0), departure, NEVER):
            first_ns = item.t_ns if first_ns is None else first_ns
            reached[number] = 2.0 * number + (item.t_ns - first_ns) * 1e-9
            if reached[1] > 2.0 and not done:
                gaps.append(reached[1] - reached[0])
            time.sleep(pause_s)  # one process gets the machine, the other does not
        done[number] = True

    threads = [threading.Thread(target=run, args=one) for one in ((0, 0.005), (1, 0.0))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30.0)
    assert done == {0: True, 1: True}
    assert len(gaps) > 100
    assert max(gaps) <= SLACK_S + 2 / HZ


def test_the_slowest_waits_for_nobody_not_even_over_a_gap_of_its_recording(tmp_path: Path) -> None:
    make_clock(tmp_path / "clock", (0.0, 0.0))
    clock = WorldClock(tmp_path / "clock")
    clock.reach(0, 100_000_000, NEVER)
    clock.reach(1, 60_000_000_000, NEVER)  # nothing else is recorded before
    assert clock.now_s == pytest.approx(0.1)
    clock.reach(0, 50_000_000_000, NEVER)
    clock.reach(0, 1_000_000_000, NEVER)  # started again: what was reached stays so
    assert clock.now_s == pytest.approx(50.0)
    clock.arrive(0)
    clock.arrive(1)
    assert clock.now_s is None
    clock.close()


def test_a_drive_that_ends_lets_the_others_go_and_one_that_is_broken_off_does_not(tmp_path: Path) -> None:
    def damaged() -> Iterator[DriveItem]:
        yield MotionSample(0, 8.0, 0.0)
        raise DriveError("the recording ends here")

    for items, ends in ((drive(0.0, 0.1), None), (damaged(), DriveError)):
        make_clock(tmp_path / "clock", (0.0, 5.0))
        stream = in_common_time(items, Departure(tmp_path / "clock", 0, 0.0), NEVER)
        if ends is None:
            assert len(list(stream)) == 5
        else:
            with pytest.raises(ends):
                list(stream)
        assert WorldClock(tmp_path / "clock").now_s == 5.0
    make_clock(tmp_path / "clock", (0.0, 5.0))
    killed = in_common_time(drive(0.0, 1.0), Departure(tmp_path / "clock", 0, 0.0), NEVER)
    next(killed)
    killed.close()  # type: ignore[attr-defined]
    assert WorldClock(tmp_path / "clock").now_s == 0.0


def test_without_a_departure_nothing_is_held_and_without_a_clock_nothing_drives(tmp_path: Path) -> None:
    assert len(list(in_common_time(drive(0.0, 0.2), None, NEVER))) == 10
    with pytest.raises(AgentConfigError, match="no clock"):
        next(in_common_time(drive(0.0, 0.2), Departure(tmp_path / "none", 0, 0.0), NEVER))
    with pytest.raises(AgentConfigError, match="-1"):
        Departure(tmp_path / "clock", -1, 0.0)


def test_a_stop_ends_the_waiting(tmp_path: Path) -> None:
    make_clock(tmp_path / "clock", (0.0, 0.0))
    clock, stop = WorldClock(tmp_path / "clock"), threading.Event()
    clock.reach(1, 400_000_000, NEVER)
    stop.set()
    started_s = time.monotonic()
    clock.reach(1, 90_000_000_000, stop)
    assert time.monotonic() - started_s < 5.0
    clock.close()
