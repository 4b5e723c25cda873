"""An import that is killed or interrupted goes on where it was, and the drive is the same to the bit."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_testing import scan_of, write_bin

from gnd.gnd_map.se3 import exp_so3
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import import_recording
from gnd.vehicle_agent.importers import journal as journal_module
from gnd.vehicle_agent.importers import lidar_odometry as odometry_module
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.journal import FoundPose, ImportJournal, journal_of, kept_scans, key_of
from gnd.vehicle_agent.importers.lidar_odometry import lidar_odometry
from gnd.vehicle_agent.importers.recording import NOMINAL, Recording, RecordingAnchor

SCANS = 14
ANCHOR = RecordingAnchor(49.0, 8.4, 116.0, 90.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Bins of a room; the fifth scan is damaged."""
    folder = tmp_path_factory.mktemp("recorded") / "sweeps"
    folder.mkdir()
    for k in range(SCANS):
        write_bin(folder / f"{1_700_000_000_000 + 100 * k}.bin", scan_of(k, 14_000))
    (folder / f"{1_700_000_000_000 + 400}.bin").write_bytes(b"\0" * 17)
    return folder


@pytest.fixture(scope="module")
def whole(folder, tmp_path_factory) -> bytes:
    out = tmp_path_factory.mktemp("whole") / "drive.mcap"
    done = import_recording("auto", folder, out, anchor=ANCHOR)
    assert (done.scans, len(done.bad)) == (SCANS - 1, 1)
    assert [path.name for path in out.parent.iterdir()] == ["drive.mcap"]
    return out.read_bytes()


def started(folder: Path, out: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "gnd.deploy.cli", "import", "auto", str(folder), "-o", str(out)]
    command += ["--anchor", "49,8.4,116,90"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended_at(process: subprocess.Popen, out: Path, kept: int, sign: int) -> tuple[str, float]:
    """What the process said that was ended as soon as so many scans were kept (below 0: as soon as it writes), and the
    seconds that it took to end.
    """
    until = time.monotonic() + 120.0
    while process.poll() is None and time.monotonic() < until:
        writing = any(out.parent.glob(f".{out.name}.*.partial"))
        if writing if kept < 0 else journal_of(out).exists() and kept_scans(out) >= kept:
            process.send_signal(sign)
            break
        time.sleep(0.002)
    begin = time.monotonic()
    said = process.communicate(timeout=60.0)[1]
    assert process.returncode not in (0, None), said
    return said, time.monotonic() - begin


@pytest.mark.slow
def test_killed_at_several_places_the_drive_is_the_same_to_the_bit(folder, whole, tmp_path):
    """Killed in the odometry twice and while the drive is written, each time going on; then it is whole."""
    out = tmp_path / "drive.mcap"
    for kept in (3, 8, -1):
        ended_at(started(folder, out), out, kept, signal.SIGKILL)
        assert not out.exists()
        assert kept_scans(out) >= abs(kept)
    done = started(folder, out)
    printed, said = done.communicate(timeout=120.0)
    assert done.returncode == 0, said
    assert f"resumes at scan {SCANS} of {SCANS} of LiDAR odometry" in said
    assert "passed over" in printed  # the damaged scan, although its turn in the odometry was before the kill
    assert out.read_bytes() == whole
    assert [path.name for path in tmp_path.iterdir()] == ["drive.mcap"]


@pytest.mark.slow
def test_ctrl_c_ends_within_three_seconds_and_says_how_to_go_on(folder, whole, tmp_path):
    out = tmp_path / "drive.mcap"
    process = started(folder, out)
    said, took_s = ended_at(process, out, 5, signal.SIGINT)
    assert process.returncode == 130
    assert took_s < 3.0
    assert "drive.mcap is not written; the same command goes on after" in said
    assert kept_scans(out) >= 5
    assert not any(tmp_path.glob("*.partial"))
    import_recording("auto", folder, out, choices=Choices(anchor=RecordingAnchor(49.0, 8.4, 116.0, 90.0)))
    assert out.read_bytes() == whole


def interrupted(monkeypatch, folder: Path, out: Path, after: int, **how) -> None:
    """An import that is interrupted once so many scans are kept."""
    add = ImportJournal.add

    def stop(self, pose: FoundPose) -> None:
        add(self, pose)
        if kept_scans(out) == after:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ImportJournal, "add", stop)
        with pytest.raises(KeyboardInterrupt):
            import_recording("auto", folder, out, anchor=ANCHOR, **how)
    assert kept_scans(out) == after


def registered(monkeypatch) -> list[int]:
    """Numbers of the scans that are matched from now on."""
    seen: list[int] = []
    add = odometry_module._Odometry.add
    monkeypatch.setattr(odometry_module._Odometry, "add", lambda self, scan, i: (seen.append(i), add(self, scan, i))[1])
    return seen


def test_only_what_is_missing_is_matched_again(monkeypatch, folder, whole, tmp_path):
    out = tmp_path / "drive.mcap"
    interrupted(monkeypatch, folder, out, 9)
    with monkeypatch.context() as patch:
        seen = registered(patch)
        done = import_recording("auto", folder, out, anchor=ANCHOR)
    assert seen[-4:] == [10, 11, 12, 13]  # 9 poses are those of scans 0 ... 9 without the damaged one
    assert set(seen[:-4]) <= set(range(SCANS))
    assert len(done.bad) == 1
    assert out.read_bytes() == whole


@pytest.mark.parametrize("what", ["choices", "input", "torn", "flipped", "other file"])
def test_a_journal_of_something_else_or_damaged_is_not_believed(monkeypatch, folder, whole, tmp_path, what):
    out, held = tmp_path / "drive.mcap", journal_of(tmp_path / "drive.mcap")
    interrupted(monkeypatch, folder, out, 6, choices=Choices(sensor="other") if what == "choices" else Choices())
    if what == "input":
        path = next(folder.iterdir())
        os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns + 1))
    elif what == "torn":
        held.write_bytes(held.read_bytes()[:-50])
    elif what == "flipped":
        data = bytearray(held.read_bytes())
        data[-300] ^= 1
        held.write_bytes(data)
    elif what == "other file":
        held.write_bytes(b"something else" * 99)
    journal = ImportJournal(out, key_of("auto", (folder,), Choices(anchor=ANCHOR)))
    found = [pose.number for pose in journal.found]
    journal.close(keep=True)
    assert found == {"torn": [0, 1, 2, 3, 5], "flipped": [0, 1, 2]}.get(what, [])[: len(found)]
    assert len(found) == {"torn": 5, "flipped": 3}.get(what, 0)
    if what in ("torn", "other file"):
        import_recording("auto", folder, out, anchor=ANCHOR)
        assert out.read_bytes() == whole
        assert not held.exists()


def test_one_import_at_a_time_and_leftovers_of_the_dead_are_removed(folder, tmp_path):
    out = tmp_path / "drive.mcap"
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    dead, alive = (tmp_path / f".drive.mcap.{process}.partial" for process in (gone.pid, os.getpid()))
    dead.write_bytes(b"half")
    alive.write_bytes(b"half")
    journal = ImportJournal(out, b"\0" * 32)
    assert (dead.exists(), alive.exists()) == (False, True)
    with pytest.raises(ImportDriveError, match=r"drive\.mcap: is being imported by another process"):
        import_recording("auto", folder, out, anchor=ANCHOR)
    journal.close(keep=True)
    assert not journal_of(out).exists()  # it held nothing


def test_a_refused_import_leaves_nothing(folder, tmp_path):
    with pytest.raises(ImportDriveError, match="nothing says where"):
        import_recording("auto", folder, tmp_path / "drive.mcap")
    assert list(tmp_path.iterdir()) == []


def long_recording(n: int, bad: frozenset[int] = frozenset()) -> Recording:
    """Sparse scans of a vehicle that drives 950 m out and a third of the way back, 12 m a scan."""
    rng = np.random.default_rng(0)
    points = [rng.uniform([-70, -30, -2], [70, 30, 3], (300, 3)).astype(np.float32) for _ in range(n)]

    def read(number: int) -> RawScan | Scan:
        if number in bad:
            return RawScan(number * 10**8, np.zeros((0, 3), np.float32), np.zeros(0, np.uint32))
        return RawScan(number * 10**8, points[number], np.zeros(300, np.uint32))

    return Recording("long", "x", "x", np.eye(4), np.arange(n) * 10**8, read, NOMINAL)


def test_what_was_forgotten_is_not_read_again_and_the_map_is_the_same(monkeypatch, tmp_path):
    """The map after going on holds the same voxels to the bit, wherever it was interrupted, also on the way back."""
    n, bad = 105, frozenset({20, 91})
    way = np.concatenate([12.0 * np.arange(80), 12.0 * np.arange(78, 53, -1)])
    poses = []
    for k in range(n):
        T = np.eye(4)
        T[:3, :3], T[:2, 3] = exp_so3([0, 0, 0.002 * k]), (way[k], 3.0 * np.sin(0.1 * k))
        poses.append(T)
    monkeypatch.setattr(odometry_module._Odometry, "_aligned", lambda self, points, t_ns, number: poses[number])
    recording = long_recording(n, bad)
    maps, journal = {}, ImportJournal(tmp_path / "a.mcap", b"\0" * 32)
    stand = odometry_module._Odometry._stand_at

    def watch(self, t_ns, T):
        stand(self, t_ns, T)
        maps[len(self._T)] = self._map._points.moments()

    with monkeypatch.context() as patch:
        patch.setattr(odometry_module._Odometry, "_stand_at", watch)
        track = lidar_odometry(recording, lambda *_: None, journal)
    journal.close(keep=True)
    again_open = ImportJournal(tmp_path / "a.mcap", b"\0" * 32)
    found = again_open.found
    again_open.close(keep=True)
    assert [pose.number for pose in found] == [k for k in range(n) if k not in bad]
    counts = {}
    for kept in (1, 2, 6, 19, 20, 21, 33, 50, 51, 68, 80, 90, 91, 99, len(found)):
        read: list[int] = []
        counting = replace_read(recording, read)
        again = odometry_module._Odometry(counting)
        again.resume(found[:kept], lambda *_: None)
        expected, voxels = maps[kept], again._map._points.moments()
        np.testing.assert_array_equal(voxels[0], expected[0])
        for name in ("count", "cells", "sum_m", "outer_m2"):
            np.testing.assert_array_equal(getattr(voxels[1], name), getattr(expected[1], name))
        np.testing.assert_array_equal(again._T, track.T_dst_vehicle[:kept])
        counts[kept] = len(read)
    assert counts[6] == 6
    assert max(counts.values()) < 70 < len(found)  # of some hundred metres of way, whatever lies before
    assert counts[80] < counts[51] + 10


def replace_read(recording: Recording, read: list[int]) -> Recording:
    return replace(recording, read=lambda number: (read.append(number), recording.read(number))[1])


def test_scans_that_changed_since_are_refused(tmp_path):
    recording = long_recording(5)
    odometry = odometry_module._Odometry(recording)
    with pytest.raises(ImportDriveError, match="scan 0 changed since the import began"):
        odometry.resume([FoundPose(0, 17, np.eye(4))], lambda *_: None)


def test_the_record_is_as_long_as_it_says():
    assert journal_module._RECORD.size == 148
