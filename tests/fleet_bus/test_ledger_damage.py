"""Ledgers that are damaged, empty, or of another version: named, with numbers; what is whole is still read."""

import json
import random
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.ledger import LEDGER_VERSION, Ledger
from gnd.fleet_bus.ledger_file import read_ledger, read_run
from gnd.fleet_bus.ledger_rows import parse_rows
from gnd.fleet_bus.links import LinkProfile, load_link
from gnd.fleet_bus.traffic import agent_traffic
from gnd.fleet_bus.wire import WireBytes

LINES_OF_VERSION_1 = """\
{"agent":"vehicle-00","session":"18ea-2449","t_ns":1795271920172767542,"odometer_m":1.435,"drive_ns":1570838399980000000,\
"direction":"up","kind":"tile","app_bytes":5,"tile":"13033/03021/23030/31321"}
{"agent":"vehicle-00","session":"18ea-2449","t_ns":1795271920217287819,"odometer_m":1.435,"drive_ns":1570838399980000000,\
"direction":"down","kind":"tile","app_bytes":34523,"tile":"13033/03021/23030/31321"}
{"agent":"vehicle-00","session":"18ea-2449","t_ns":1795271971271363452,"odometer_m":197.743,\
"drive_ns":1570838422400000000,"wire_up":169,"wire_down":35001}
"""


def written(file: Path, count: int = 20) -> Path:
    ledger = Ledger("a", file, now_ns=iter(range(10**9, 10**12, 10**9)).__next__)
    ledger.begin(load_link("3g"))
    for number in range(count):
        ledger.set_position(10.0 * number, 10**18 + number * 10**9)
        ledger.record("down", "tile", 100 + number, "13033/03021/23030/31321", head_bytes=70, took_s=0.01)
        ledger.record_wire(WireBytes(up=number, down=200 * number, segment_bytes=1448, header_bytes=52))
    return file


def test_a_ledger_of_the_first_version_is_read(tmp_path):
    (tmp_path / "v1.jsonl").write_text(LINES_OF_VERSION_1)
    read = read_ledger(tmp_path / "v1.jsonl")
    assert (read.agent, read.drive_m, read.drive_s, read.ignored_lines) == ("vehicle-00", 197.743, 22.42, 0)
    assert (read.wire_up, read.wire_down, read.link) == (169, 35_001, None)
    assert [(b.app_bytes, b.head_bytes, b.took_s) for b in read.bookings] == [(5, None, None), (34_523, None, None)]
    report = agent_traffic(read, ())
    assert (report.up_wire_bytes, report.down_wire_bytes) == (169, 35_001)
    assert report.estimated_wire_bytes == 0


def test_a_ledger_of_a_later_version_is_refused_with_its_number(tmp_path):
    file = written(tmp_path / "a.jsonl")
    lines = file.read_text().splitlines()
    lines.insert(7, json.dumps({"ledger": LEDGER_VERSION + 1, "agent": "a", "session": "later", "link": None}))
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(
        LedgerError,
        match=rf"a\.jsonl, line 8: ledger of version {LEDGER_VERSION + 1}; .* versions 1 to {LEDGER_VERSION}",
    ):
        read_ledger(file)


@pytest.mark.parametrize(
    "content", [b"", b"\n\n", b"\x00" * 500, b"not json\n" * 3, b"[1,2]\n17\nnull\n", b'{"agent":"a"}\n']
)
def test_a_file_without_one_ledger_line_is_refused(tmp_path, content):
    (tmp_path / "a.jsonl").write_bytes(content)
    with pytest.raises(LedgerError, match=r"a\.jsonl holds no ledger lines \(\d lines read\)"):
        read_ledger(tmp_path / "a.jsonl")


@pytest.mark.parametrize(
    "damage",
    [
        {"app_bytes": -1}, {"app_bytes": "many"}, {"app_bytes": 1e3}, {"app_bytes": True}, {"app_bytes": 1 << 70},
        {"direction": "sideways"}, {"kind": "gossip"}, {"kind": ["tile"]}, {"tile": 5}, {"odometer_m": "far"},
        {"odometer_m": -3}, {"odometer_m": 1e999}, {"t_ns": None}, {"drive_ns": 1.5}, {"messages": -1},
        {"head_bytes": "x"}, {"took_s": "long"}, {"session": None}, {"agent": 7},
    ],
)  # fmt: skip
def test_a_line_with_an_impossible_value_is_left_out_and_counted(tmp_path, damage):
    file = written(tmp_path / "a.jsonl", 3)
    lines = file.read_text().splitlines()
    lines[1] = json.dumps(json.loads(lines[1]) | damage)
    file.write_text("\n".join(lines) + "\n")
    read = read_ledger(file)
    assert (read.ignored_lines, read.total_bytes("down")) == (1, 101 + 102)


def test_damage_anywhere_loses_no_other_line(tmp_path):
    """600 random changes of bytes: what is read is never more than was written, and nothing raises but LedgerError."""
    whole = written(tmp_path / "a.jsonl").read_bytes()
    rows = whole.count(b"\n")
    dice = random.Random(5)
    for _ in range(600):
        damaged = bytearray(whole)
        for _ in range(dice.randint(1, 5)):
            damaged[dice.randrange(len(damaged))] = dice.randrange(256)
        raw = [line for line in bytes(damaged).splitlines() if line.strip()]
        try:
            got = parse_rows(raw, tmp_path / "a.jsonl")
        except LedgerError as error:
            assert "ledger of version" in str(error)  # noqa: PT017 - the other outcome is checked below
            continue
        assert rows - 10 <= len(got) <= rows


NAMES = st.sampled_from(["agent", "session", "ledger", "link", "kind", "wire_up"])
PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)


@given(st.recursive(PLAIN, lambda inner: st.lists(inner) | st.dictionaries(NAMES, inner), max_leaves=10))
def test_any_json_is_a_row_or_none(value):
    try:
        assert len(parse_rows([json.dumps(value).encode()], Path("x"))) <= 1
    except LedgerError as error:
        assert "ledger of version" in str(error)  # noqa: PT017


def test_deeply_nested_json_is_left_out():
    assert parse_rows([b"[" * 100_000 + b"]" * 100_000], Path("x")) == []


def test_a_session_that_sent_nothing_is_an_empty_account(tmp_path):
    ledger = Ledger("idle", tmp_path / "idle.jsonl")
    ledger.begin(LinkProfile("mine", 1e6, 1e5))
    ledger.flush()
    read = read_ledger(tmp_path / "idle.jsonl")
    assert (read.agent, read.bookings, read.drive_s, read.link) == ("idle", (), 0.0, LinkProfile("mine", 1e6, 1e5))


def test_a_link_without_limits_comes_back_without_limits(tmp_path):
    ledger = Ledger("a", tmp_path / "a.jsonl")
    ledger.begin(load_link("none"))
    ledger.flush()
    assert "Infinity" not in (tmp_path / "a.jsonl").read_text()
    assert read_ledger(tmp_path / "a.jsonl").link == load_link("none")


def test_a_link_with_a_field_of_a_later_program_is_read(tmp_path):
    head = {
        "ledger": LEDGER_VERSION,
        "agent": "a",
        "session": "s",
        "link": {"name": "6g", "up_bit_s": 5e9, "colour": 3},
    }
    (tmp_path / "a.jsonl").write_text(json.dumps(head) + "\n")
    link = read_ledger(tmp_path / "a.jsonl").link
    assert link is not None
    assert (link.name, link.up_bit_s) == ("6g", 5e9)


def test_what_was_sent_before_the_drive_began_counts_as_its_beginning(tmp_path):
    """The agent joins the bus before its first scan: then there is no time of the recording yet."""
    ledger = Ledger("a", tmp_path / "a.jsonl")
    ledger.record("up", "catalog", 5)
    ledger.set_position(0.0, 10**18)
    ledger.record("up", "tile", 5)
    ledger.set_position(30.0, 10**18 + 3 * 10**9)
    ledger.record("up", "tile", 5)
    read = read_ledger(tmp_path / "a.jsonl")
    assert [b.drive_s for b in read.bookings] == [0.0, 0.0, 3.0]
    assert read.drive_s == 3.0


def test_a_run_with_one_ledger_beyond_reading_names_the_file(tmp_path):
    written(tmp_path / "ledger" / "good.jsonl")
    (tmp_path / "ledger" / "worse.jsonl").write_bytes(b"\xff\xfe")
    with pytest.raises(LedgerError, match=r"worse\.jsonl holds no ledger lines"):
        read_run(tmp_path)


def test_a_folder_in_the_place_of_a_ledger_is_named(tmp_path):
    (tmp_path / "ledger" / "a.jsonl").mkdir(parents=True)
    with pytest.raises(LedgerError, match=r"cannot read the ledger .*a\.jsonl: Is a directory"):
        read_run(tmp_path)
    with pytest.raises(LedgerError, match="no run at"):
        read_run(tmp_path / "file")
