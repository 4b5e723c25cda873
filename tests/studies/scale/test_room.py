"""Room on a shared machine: control groups that are made, bound what enters them, and are gone afterwards."""

import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from studies.frame.errors import OptionError
from studies.scale import room as room_module
from studies.scale.room import GROUPS, room
from studies.scale.yardstick import units_beside

can_make_groups = pytest.mark.skipif(
    os.geteuid() != 0 or not os.access(GROUPS / "cpu.shares", os.W_OK), reason="control groups (version 1), as root"
)
BUSY = [sys.executable, "-c", "while True: pass"]


def group_of(pid: int) -> str:
    lines = Path(f"/proc/{pid}/cgroup").read_text(encoding="ascii").splitlines()
    return next(line.rpartition(":")[2] for line in lines if ":cpu:" in line)


@can_make_groups
def test_what_is_started_in_a_room_is_in_it_and_nothing_is_left_behind() -> None:
    before, cores = group_of(os.getpid()), os.sched_getaffinity(0)
    with room() as made, subprocess.Popen(BUSY) as started:
        assert group_of(started.pid) == group_of(os.getpid()) == f"/{made.group.name}"
        assert os.sched_getaffinity(started.pid) == made.cores == {max(cores)}
        started.kill()
    assert (group_of(os.getpid()), os.sched_getaffinity(0)) == (before, cores)
    assert not made.group.exists()


@can_make_groups
def test_a_bounded_process_gets_no_more_than_its_share() -> None:
    with room() as made, subprocess.Popen(BUSY) as started:
        made.bound("one", 0.1, started.pid)
        before = psutil.Process(started.pid).cpu_times().user
        began_s = time.monotonic()
        time.sleep(2.0)
        took_s, used_s = time.monotonic() - began_s, psutil.Process(started.pid).cpu_times().user - before
        started.kill()
    assert 0.0 < used_s < 0.1 * took_s + 0.1


@can_make_groups
def test_units_of_the_yardstick_are_done_in_the_room_beside_the_work() -> None:
    with room() as made, units_beside(made) as units:
        begun_s = time.monotonic()
        time.sleep(1.3)
    assert units.mean_ms() > 0.0
    assert units.mean_ms(begun_s, begun_s + 1.3) > 0.0
    with pytest.raises(OptionError, match=r"no unit of work was done beside it in 1\.0 s"):
        units.mean_ms(0.0, 1.0)
    assert not made.group.exists()


@can_make_groups
def test_a_command_ends_as_it_does_alone() -> None:
    command = [sys.executable, "-m", "studies.scale.room", "--", sys.executable, "-c", "raise SystemExit(7)"]
    done = subprocess.run(command, cwd=Path(__file__).parents[3], check=False, timeout=60)
    assert done.returncode == 7


def test_where_no_groups_can_be_made_it_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(room_module, "GROUPS", tmp_path / "nothing")
    with pytest.raises(OptionError, match="no control group can be made"), room():
        pass
