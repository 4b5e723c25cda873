"""The outbox keeps its promises: durable before sending, first body stands, acknowledged is never sent again."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

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
