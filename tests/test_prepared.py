"""What is prepared for several processes is made once, and whole."""

import lzma
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from prepared import made_once
from unpacked import unpacked_once

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.files import read_file

HERE = Path(__file__).parent
PROGRAM = """
import os, sys, time
from pathlib import Path
from prepared import made_once
def make(folder):
    (folder / "one.txt").write_text("half")
    Path(sys.argv[2]).write_text("begun")
    time.sleep(float(sys.argv[3]))
    (folder / "one.txt").write_text(str(os.getpid()))
print(made_once(Path(sys.argv[1]), "world", make))
"""


def asks(home: Path, begun: Path, sleep_s: float) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(home), str(begun), str(sleep_s)],
        env={**os.environ, "PYTHONPATH": str(HERE)}, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def until_there(path: Path) -> None:
    deadline_s = time.monotonic() + 60.0
    while not path.exists():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)  # between two looks; the deadline above bounds the wait


def test_one_makes_it_and_the_others_wait_for_the_whole(tmp_path: Path) -> None:
    home = tmp_path / "prepared"
    first = asks(home, tmp_path / "first", 0.3)
    until_there(tmp_path / "first")
    others = [asks(home, tmp_path / f"other-{n}", 0.0) for n in range(2)]
    answers = {one.communicate(timeout=60)[0].strip() for one in (first, *others)}
    assert answers == {str(home / "world")}
    assert (home / "world" / "one.txt").read_text() == str(first.pid)
    assert list(tmp_path.glob("other-*")) == []


def test_what_a_killed_process_left_is_not_used(tmp_path: Path) -> None:
    home = tmp_path / "prepared"
    killed = asks(home, tmp_path / "first", 300.0)
    until_there(tmp_path / "first")
    killed.send_signal(signal.SIGKILL)
    killed.communicate(timeout=60)
    second = asks(home, tmp_path / "second", 0.0)
    second.communicate(timeout=60)
    assert (home / "world" / "one.txt").read_text() == str(second.pid)


def test_who_fails_leaves_it_to_the_next(tmp_path: Path) -> None:
    def fails(folder: Path) -> None:
        (folder / "half.txt").write_text("half")
        raise ValueError(f"after {len(list(folder.iterdir()))} file")

    with pytest.raises(ValueError, match="after 1 file"):
        made_once(tmp_path, "world", fails)
    assert not (tmp_path / "world").exists()
    whole = made_once(tmp_path, "world", lambda folder: folder.joinpath("whole.txt").touch())
    assert [path.name for path in whole.iterdir()] == ["whole.txt"]


def test_a_file_of_a_recording_is_unpacked_once_and_others_as_ever(tmp_path: Path) -> None:
    recording, other = tmp_path / "recordings" / "a" / "0.bin.xz", tmp_path / "other.bin.xz"
    recording.parent.mkdir(parents=True)
    recording.write_bytes(lzma.compress(b"a scan"))
    other.write_bytes(lzma.compress(b"another"))
    link = tmp_path / "link.bin.xz"
    link.symlink_to(recording)
    with unpacked_once(tmp_path / "recordings", lambda name, make: made_once(tmp_path / "prepared", name, make)):
        assert (read_file(link), read_file(other)) == (b"a scan", b"another")
        for path in (recording, other):
            path.write_bytes(b"damaged, and no archive")
        assert read_file(recording) == read_file(link) == b"a scan"
        with pytest.raises(ImportDriveError, match="not xz"):
            read_file(other)
    with pytest.raises(ImportDriveError, match="not xz"):
        read_file(recording)
