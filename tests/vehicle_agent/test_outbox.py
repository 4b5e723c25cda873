"""The outbox keeps its promises: durable before sending, first body stands, acknowledged is never sent again."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from gnd_map.gaussian import Gaussians
from gnd_map.tile import Tile
from gnd_map.tile_id import TileId
from vehicle_agent.errors import OutboxError
from vehicle_agent.outbox import Outbox, OutboxCounts

A, B = "01DTEXKZZZ0000000000000000", "01DTEXKZZZ0000000000000001"
SECOND = 1_000_000_000


@pytest.fixture
def outbox(tmp_path: Path) -> Outbox:
    return Outbox(tmp_path / "outbox.sqlite")


def test_a_report_is_due_until_it_is_answered(outbox: Outbox) -> None:
    assert outbox.put(A, "key/a", b"body a")
    assert [(x.report_id, x.key, x.body, x.attempts) for x in outbox.due(0)] == [(A, "key/a", b"body a", 0)]
    outbox.answered(A, "stored")
    assert outbox.due(10**18) == []
    assert outbox.counts() == OutboxCounts(pending=0, acknowledged=1, quarantined=0)


def test_a_known_id_keeps_its_first_body_and_its_answer(outbox: Outbox) -> None:
    outbox.put(A, "key/a", b"first")
    assert not outbox.put(A, "key/a", b"second")
    assert outbox.due(0)[0].body == b"first"
    outbox.answered(A, "duplicate")
    assert not outbox.put(A, "key/a", b"third")
    assert outbox.due(10**18) == []


def test_failed_attempts_wait_longer_each_time_and_are_retried_at_once_after_a_restart(outbox: Outbox) -> None:
    outbox.put(A, "key/a", b"body")
    now_ns, waits = 0, []
    for _ in range(8):
        letter = outbox.due(now_ns)[0]
        next_ns = outbox.failed(letter, now_ns, "no router")
        assert outbox.due(next_ns - 1) == []
        waits.append((next_ns - now_ns) / SECOND)
        now_ns = next_ns
    assert waits == [0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 15.0, 15.0]
    outbox.failed(outbox.due(now_ns)[0], now_ns, "no router")
    outbox.retry_now()
    assert outbox.due(0)[0].attempts == 9


def test_a_refused_report_is_kept_with_its_reason_and_not_sent_again(outbox: Outbox) -> None:
    outbox.put(A, "key/a", b"body")
    outbox.put(B, "key/b", b"body")
    outbox.answered(A, "quarantined", "tile 7 is unknown")
    assert [x.report_id for x in outbox.due(0)] == [B]
    assert outbox.refused() == [(A, "tile 7 is unknown")]
    assert outbox.counts().total == 2


def test_an_unknown_answer_is_an_error(outbox: Outbox) -> None:
    outbox.put(A, "key/a", b"body")
    with pytest.raises(OutboxError, match="unknown answer 'perhaps'"):
        outbox.answered(A, "perhaps")
    assert outbox.counts().pending == 1


def tile(voxels: int, number: int = 0) -> Tile:
    """Plain floats, on no lattice."""
    cov = np.tile(np.float32([0.07, 0.001, 0.0, 0.05, 0.0, 0.0003]), (voxels, 1))
    mean = np.linspace(-0.4, 0.4, 3 * voxels, dtype=np.float32).reshape(voxels, 3)
    ids, count = np.arange(voxels, dtype=np.int32), np.full(voxels, 77, np.int32)
    return Tile(TileId(497353963154 + number), 1, Gaussians(ids, count, count // 2, mean, cov))


def test_base_tiles_stay_as_long_as_a_pending_report_needs_them(outbox: Outbox) -> None:
    one, both, two = tile(5), tile(7, 1), tile(9, 2)
    assert outbox.put(A, "key/a", b"body a", b"short a", [one, both])
    assert outbox.put(B, "key/b", b"body b", b"short b", [both, two])
    assert [letter.packed for letter in outbox.due(0)] == [b"short a", b"short b"]
    assert outbox.bases_of(A) == {t.sha: t.gaussians for t in (one, both)}
    outbox.answered(A, "stored")
    assert outbox.bases_of(A) == {}
    assert outbox.bases_of(B) == {t.sha: t.gaussians for t in (both, two)}
    outbox.answered(B, "quarantined", "its letter is not sent again")
    assert [outbox._db.run(f"SELECT * FROM {table}") for table in ("base", "needs", "packed")] == [[], [], []]


def test_a_known_report_brings_no_base_tiles(outbox: Outbox) -> None:
    outbox.put(A, "key/a", b"body")
    assert not outbox.put(A, "key/a", b"body", b"short", [tile(5)])
    assert (outbox.due(0)[0].packed, outbox.bases_of(A)) == (b"", {})


def test_a_base_tile_that_is_damaged_on_the_disk_is_left_out(outbox: Outbox) -> None:
    one, two = tile(5), tile(9, 2)
    outbox.put(A, "key/a", b"body", b"short", [one, two])
    outbox._db.run("UPDATE base SET body = x'0102' WHERE sha = ?", (one.sha,))
    assert outbox.bases_of(A) == {two.sha: two.gaussians}
    outbox._db.run("UPDATE base SET morton = morton + 1 WHERE sha = ?", (two.sha,))
    assert outbox.bases_of(A) == {}


def test_what_an_older_release_left_here_is_sent_whole(tmp_path: Path) -> None:
    path = tmp_path / "outbox.sqlite"
    old = Outbox(path)
    old.put(A, "key/a", b"body")
    for table in ("packed", "base", "needs"):
        old._db.run(f"DROP TABLE {table}")
    old.close()
    assert [(x.report_id, x.body, x.packed) for x in Outbox(path).due(0)] == [(A, b"body", b"")]


def test_what_was_put_survives_kill_9(tmp_path: Path) -> None:
    path = tmp_path / "outbox.sqlite"
    program = textwrap.dedent(
        f"""
        import sys, time
        from pathlib import Path
        from vehicle_agent.outbox import Outbox
        outbox = Outbox(Path({str(path)!r}))
        outbox.put({A!r}, "key/a", b"body" * 1000)
        print("durable", flush=True)
        time.sleep(60)
        """
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"durable\n"
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    again = Outbox(path)
    assert [(x.report_id, len(x.body)) for x in again.due(0)] == [(A, 4000)]


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(OutboxError, match=r"cannot open .*file/outbox.sqlite"):
        Outbox(tmp_path / "file" / "outbox.sqlite")


def test_a_file_that_is_no_database_is_named(tmp_path: Path) -> None:
    (tmp_path / "outbox.sqlite").write_bytes(b"this is not a database, and long enough to be looked at" * 20)
    with pytest.raises(OutboxError, match="not a database"):
        Outbox(tmp_path / "outbox.sqlite")
