"""The outbox keeps its promises: durable before sending, first body stands, acknowledged is never sent again."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import apsw
import numpy as np
import pytest

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.report_states import ReportState, ReportStatus
from gnd.vehicle_agent.errors import OutboxError
from gnd.vehicle_agent.link.outbox import MAX_ANSWERS, PATIENT_ASK_S, Outbox, OutboxCounts

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
    assert outbox.counts() == OutboxCounts(pending=0, acknowledged=1, quarantined=0, held=1)
    outbox.told(ReportState(A, "released"), 0)
    assert outbox.counts() == OutboxCounts(pending=0, acknowledged=1, quarantined=0)


def test_what_is_wanted_is_due_until_acknowledged_and_the_report_held_until_released(
    outbox: Outbox,
) -> None:
    outbox.put(A, "key/a", b"body", b"short", [tile(5)])
    outbox.answered(A, "stored")
    outbox.told(ReportState(A, "wanted", b"mask"), 7)
    (letter,) = outbox.due(7)
    assert (letter.wanted, letter.packed, letter.body) == (b"mask", b"short", b"body")
    outbox.answered(A, "stored", now_ns=8, wanted=letter.wanted)
    assert outbox.due(10**18) == []
    assert len(outbox.bases_of(A)) == 1, "it may be asked again"
    outbox.told(ReportState(A, "released"), 9)
    assert (outbox.bases_of(A), outbox.counts().held) == ({}, 0)


def test_the_ack_of_the_flags_may_come_after_the_notice_of_what_is_wanted(outbox: Outbox) -> None:
    outbox.put(A, "key/a", b"body", b"short", [tile(5)])
    outbox.told(ReportState(A, "wanted", b"mask"), 7)
    outbox.answered(A, "stored", now_ns=8)
    assert [letter.wanted for letter in outbox.due(8)] == [b"mask"]
    outbox.told(ReportState(A, "released"), 9)
    outbox.answered(A, "duplicate", now_ns=10, wanted=b"mask")
    assert outbox.states() == {A: "released"}


@pytest.mark.parametrize("status", ["resend", "quarantined"])
def test_the_ack_of_a_half_says_nothing_once_the_report_is_to_go_whole(outbox: Outbox, status: ReportStatus) -> None:
    outbox.put(A, "key/a", b"body", b"short", [tile(5)])
    outbox.told(ReportState(A, status, reason="why"), 7)
    outbox.answered(A, "stored", now_ns=8, is_short=True)
    assert [(letter.packed, letter.body) for letter in outbox.due(8)] == [(b"", b"body")]
    outbox.answered(A, "stored", now_ns=9)
    assert outbox.counts().held == 1


def test_who_hears_nothing_asks_after_four_seconds_and_then_ever_less_often(outbox: Outbox) -> None:
    outbox.put(A, "key/a", b"body")
    outbox.answered(A, "stored", now_ns=0)
    now_s, waits = 0, []
    for _ in range(6):
        wait_s = next(s for s in range(100) if outbox.unheard((now_s + s) * SECOND))
        now_s += wait_s
        waits.append(wait_s)
        assert outbox.unheard(now_s * SECOND) == [A]
        outbox.asked([A], now_s * SECOND)
    assert waits == [4, 4, 8, 16, 32, 60]
    outbox.retry_now()
    assert outbox.unheard(0) == [A]


@pytest.mark.parametrize(
    ("status", "state"),
    [("waiting", "stored"), ("unknown", "pending"), ("resend", "pending"), ("quarantined", "quarantined")],
)
def test_what_the_cloud_says_of_a_whole_report(outbox: Outbox, status: ReportStatus, state: str) -> None:
    outbox.put(A, "key/a", b"body")
    outbox.answered(A, "stored")
    outbox.told(ReportState(A, status, reason="why"), 7)
    assert outbox.states() == {A: state}


@pytest.mark.parametrize(
    ("status", "packed"),
    [("unknown", b"short"), ("resend", b""), ("quarantined", b"")],
)
def test_only_whole_reports_are_refused_and_what_is_forgotten_is_sent_again(
    outbox: Outbox, status: ReportStatus, packed: bytes
) -> None:
    outbox.put(A, "key/a", b"body", b"short", [tile(5)])
    outbox.answered(A, "stored")
    outbox.told(ReportState(A, status, reason="why"), 7)
    assert outbox.counts() == OutboxCounts(pending=1, acknowledged=0, quarantined=0)
    assert [(letter.packed, letter.wanted) for letter in outbox.due(7)] == [(packed, b"")]


def test_gaussians_that_are_asked_for_again_and_again_make_the_report_go_whole(outbox: Outbox) -> None:
    outbox.put(A, "key/a", b"body", b"short", [tile(5)])
    outbox.answered(A, "stored")
    for _ in range(MAX_ANSWERS):
        outbox.told(ReportState(A, "wanted", b"mask"), 7)
        assert [letter.wanted for letter in outbox.due(7)] == [b"mask"]
        outbox.answered(A, "duplicate", now_ns=8, wanted=b"mask")
    outbox.told(ReportState(A, "wanted", b"mask"), 9)
    assert [(letter.packed, letter.wanted) for letter in outbox.due(9)] == [(b"", b"")]


def test_at_the_end_of_a_drive_patience_ends_and_pauses_between_questions_stay(outbox: Outbox) -> None:
    for report_id in (A, B):
        outbox.put(report_id, "key/a", b"body")
    outbox.answered(A, "stored", now_ns=0, ask_s=PATIENT_ASK_S)
    outbox.answered(B, "stored", now_ns=0)
    outbox.asked([B], 69 * SECOND)
    assert outbox.unheard(72 * SECOND) == []
    outbox.ask_soon(70 * SECOND)  # 50 s before the first would be asked after
    assert outbox.unheard(71 * SECOND) == []
    assert outbox.unheard(72 * SECOND) == [A]
    assert outbox.unheard(73 * SECOND) == [A, B]


@pytest.mark.parametrize("status", ["waiting", "wanted", "released", "unknown", "resend", "quarantined"])
def test_word_of_reports_that_are_not_here_or_done_with_changes_nothing(outbox: Outbox, status: ReportStatus) -> None:
    outbox.put(A, "key/a", b"body")
    outbox.answered(A, "quarantined", "why")
    for report_id in (A, B):
        outbox.told(ReportState(report_id, status, b"mask" if status == "wanted" else b""), 7)
    assert outbox.states() == {A: "quarantined"}


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
    assert outbox.bases_of(A) == {t.sha: t.gaussians for t in (one, both)}, "the cloud may ask yet"
    outbox.told(ReportState(A, "released"), 0)
    assert outbox.bases_of(A) == {}
    assert outbox.bases_of(B) == {t.sha: t.gaussians for t in (both, two)}
    outbox.answered(B, "quarantined", "its letter is not sent again")
    assert [outbox._db.run(f"SELECT * FROM {table}") for table in ("base", "needs")] == [[], []]
    # First halves stay beside their reports: a kept drive can be sent again as it was.
    assert outbox._db.run("SELECT report_id, body FROM packed ORDER BY 1") == [(A, b"short a"), (B, b"short b")]
    assert not outbox.due(1 << 62)
    assert not outbox.unheard(1 << 62)


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


def test_an_outbox_of_an_older_release_keeps_its_reports_and_what_was_acknowledged_there_is_done_with(
    tmp_path: Path,
) -> None:
    path = tmp_path / "outbox.sqlite"
    old = apsw.Connection(str(path))
    old.execute(
        """
        CREATE TABLE report (report_id TEXT PRIMARY KEY, key TEXT NOT NULL, body BLOB NOT NULL,
            state TEXT NOT NULL CHECK (state IN ('pending', 'stored', 'duplicate', 'quarantined')),
            reason TEXT NOT NULL, attempts INTEGER NOT NULL, next_ns INTEGER NOT NULL) STRICT, WITHOUT ROWID;
        CREATE INDEX report_pending ON report (next_ns) WHERE state = 'pending';
        """
    )
    states = {A[:-1] + str(n): state for n, state in enumerate(("pending", "stored", "duplicate", "quarantined"))}
    for report_id, state in states.items():
        old.execute("INSERT INTO report VALUES (?, 'key/a', x'01', ?, 'why', 3, 5)", (report_id, state))
    old.close()
    for _ in range(2):  # opened again, it is no older one any more
        outbox = Outbox(path)
        assert list(outbox.states().values()) == ["pending", "released", "released", "quarantined"]
        assert [(x.report_id, x.attempts) for x in outbox.due(5)] == [(A, 3)]
        assert outbox.unheard(10**18) == []
        outbox.close()


def test_what_was_put_survives_kill_9(tmp_path: Path) -> None:
    path = tmp_path / "outbox.sqlite"
    program = textwrap.dedent(
        f"""
        import sys, time
        from pathlib import Path
        from gnd.vehicle_agent.link.outbox import Outbox
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
