"""The traffic account: totals, lines that survive a crash, places along the drive."""

import json
import threading
from pathlib import Path

import pytest

from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.ledger import Ledger, LedgerLine
from gnd.fleet_bus.ledger_file import read_ledger
from gnd.fleet_bus.wire import WireBytes
from gnd.gnd_map.tile_id import TileId

TILE = TileId.from_path("13033/03021/23031/22102")


def test_messages_add_up_by_kind_direction_and_tile():
    ledger = Ledger("a")
    ledger.record("up", "tile", 10, TILE)
    ledger.record("down", "tile", 1000, TILE)
    ledger.record("down", "tile", 500)
    ledger.record("up", "change", 70, "13033/03021/23031/22103")
    assert ledger.totals() == (
        LedgerLine("change", "up", 1, 70),
        LedgerLine("tile", "down", 2, 1500),
        LedgerLine("tile", "up", 1, 10),
    )
    assert (ledger.total_bytes("up"), ledger.total_bytes("down")) == (80, 1500)
    assert ledger.by_tile() == {TILE.path: (2, 1010), "13033/03021/23031/22103": (1, 70)}


@pytest.mark.parametrize(("direction", "kind"), [("up", "tiles"), ("sideways", "tile")])
def test_unknown_kinds_and_directions_are_refused(direction, kind):
    with pytest.raises(LedgerError, match=f"no such ledger line: {direction} {kind}; kinds are tile, delta"):
        Ledger("a").record(direction, kind, 1)


def test_many_threads_lose_no_message(tmp_path):
    ledger = Ledger("a", tmp_path / "a.jsonl")
    threads = [threading.Thread(target=lambda: [ledger.record("up", "tile", 3) for _ in range(500)]) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    ledger.flush()
    assert ledger.totals() == (LedgerLine("tile", "up", 4000, 12_000),)
    assert read_ledger(tmp_path / "a.jsonl").lines() == ledger.totals()


def test_lines_say_when_where_and_about_what(tmp_path):
    file = tmp_path / "runs" / "x" / "ledger" / "a.jsonl"
    ledger = Ledger("a", now_ns=lambda: 7_000_000_000)
    ledger.set_position(0.0, 1_000_000_000)
    ledger.record("up", "tile", 5, TILE)
    ledger.set_position(20.0, 3_000_000_000)
    ledger.record("down", "tile", 500, TILE)
    ledger.set_position(35.5, 4_000_000_000)
    ledger.record_wire(WireBytes(100, 900, 1))
    ledger.write_jsonl(file)
    read = read_ledger(file)
    assert [(b.drive_s, b.odometer_m, b.direction, b.app_bytes, b.tile) for b in read.bookings] == [
        (0.0, 0.0, "up", 5, TILE.path),
        (2.0, 20.0, "down", 500, TILE.path),
    ]
    assert (read.drive_m, read.drive_s, read.wire_up, read.wire_down) == (35.5, 3.0, 100, 900)
    assert ledger.odometer_m == 35.5


def test_writing_twice_writes_each_message_once(tmp_path):
    ledger = Ledger("a")
    ledger.record("up", "tile", 1)
    ledger.write_jsonl(tmp_path / "a.jsonl")
    ledger.record("up", "tile", 2)
    ledger.write_jsonl(tmp_path / "a.jsonl")
    ledger.write_jsonl(tmp_path / "a.jsonl")
    assert read_ledger(tmp_path / "a.jsonl").lines() == (LedgerLine("tile", "up", 2, 3),)


@pytest.mark.parametrize("cut", [1, 20, 60])
def test_a_line_cut_by_a_crash_is_left_out_and_nothing_else(tmp_path, cut):
    file = tmp_path / "a.jsonl"
    before = Ledger("a")
    for size in (1, 2, 3):
        before.record("up", "tile", size)
    before.write_jsonl(file)
    file.write_bytes(file.read_bytes()[:-cut])
    restarted = Ledger("a")
    restarted.record("up", "tile", 10)
    restarted.write_jsonl(file)
    read = read_ledger(file)
    # A line that lacks only its newline is whole.
    kept = 1 + 2 + (3 if cut == 1 else 0) + 10
    assert read.total_bytes("up") == kept
    assert read.ignored_lines == (0 if cut == 1 else 1)


def test_a_line_that_is_json_but_no_booking_is_left_out(tmp_path):
    file = tmp_path / "a.jsonl"
    ledger = Ledger("a")
    ledger.record("up", "tile", 1)
    ledger.write_jsonl(file)
    booked = json.loads(file.read_text().splitlines()[1])
    with file.open("a") as lines:
        lines.write('17\n{"agent": "a"}\n\n' + json.dumps(booked | {"kind": "gossip"}) + "\n")
    read = read_ledger(file)
    assert (read.total_bytes("up"), read.ignored_lines) == (1, 3)


def test_wire_bytes_of_restarted_sessions_add_up(tmp_path):
    clock = iter(range(1, 1000))
    for up in (100, 40):
        ledger = Ledger("a", now_ns=lambda: next(clock))
        ledger.record_wire(WireBytes(up // 2, up, 1))
        ledger.record_wire(WireBytes(up, 2 * up, 1))
        ledger.write_jsonl(tmp_path / "a.jsonl")
    read = read_ledger(tmp_path / "a.jsonl")
    assert (read.wire_up, read.wire_down) == (140, 280)


def test_unreadable_and_unwritable_files_are_named(tmp_path):
    with pytest.raises(LedgerError, match=r"cannot read the ledger .*absent.jsonl: No such file"):
        read_ledger(tmp_path / "absent.jsonl")
    (tmp_path / "empty.jsonl").write_text("\n")
    with pytest.raises(LedgerError, match="holds no ledger lines"):
        read_ledger(tmp_path / "empty.jsonl")
    (tmp_path / "file").write_text("")
    ledger = Ledger("a")
    ledger.record("up", "tile", 1)
    with pytest.raises(LedgerError, match="cannot write the ledger"):
        ledger.write_jsonl(Path(tmp_path / "file" / "a.jsonl"))
    ledger.write_jsonl(tmp_path / "a.jsonl")
    assert read_ledger(tmp_path / "a.jsonl").total_bytes("up") == 1, "a failed write keeps the lines"


def test_a_ledger_with_a_path_has_each_message_at_once(tmp_path):
    file = tmp_path / "a.jsonl"
    ledger = Ledger("a", file)
    for count in range(1, 4):
        ledger.record("up", "control", 1)
        assert len(file.read_text().splitlines()) == 1 + count, "the head of the session, and the messages"


def test_a_full_disk_stops_no_message_and_loses_no_line(tmp_path):
    """A folder in the place of the file stands for a disk that cannot be written."""
    file = tmp_path / "a.jsonl"
    file.mkdir()
    ledger = Ledger("a", file)
    for _ in range(3):
        ledger.record("up", "control", 1)
    with pytest.raises(LedgerError, match="cannot write the ledger"):
        ledger.flush()
    file.rmdir()
    ledger.flush()
    assert read_ledger(file).total_bytes("up") == 3
