"""`gnd traffic`: what a run cost and what mobile links make of it."""

import json

import pytest
from click.testing import CliRunner

from gnd.deploy.traffic_cli import traffic
from gnd.fleet_bus.errors import LedgerError, LinkError
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.ledger_file import read_run
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES
from gnd.fleet_bus.traffic import agent_traffic
from gnd.fleet_bus.traffic_links import link_use
from gnd.fleet_bus.wire import WireBytes

LINK = LinkProfile("test", down_bit_s=80_000, up_bit_s=8_000, delay_ms=250, burst_bytes=0)


@pytest.fixture
def run(tmp_path):
    """Two agents drive 2 km in 100 s: one tile in five messages of 840 B at the start, one report at the end."""
    for name in ("car-1", "car-2"):
        ledger = Ledger(name)
        ledger.set_position(0.0, 10**18)
        ledger.record("up", "tile", 0, "t")
        for _ in range(5):
            ledger.record("down", "tile", 1000 - MESSAGE_OVERHEAD_BYTES, "t")
        ledger.set_position(1900.0, 10**18 + 95 * 10**9)
        ledger.record("up", "change", 2000 - MESSAGE_OVERHEAD_BYTES, "t")
        ledger.record("down", "ack", 40)
        ledger.set_position(2000.0, 10**18 + 100 * 10**9)
        ledger.record_wire(WireBytes(3000, 6000, 1))
        ledger.write_jsonl(tmp_path / "run" / "ledger" / f"{name}.jsonl")
    return tmp_path / "run"


def test_figures_of_a_drive_by_hand(run):
    ledger, _ = read_run(run)
    report = agent_traffic(ledger, (LINK,))
    assert (report.agent, report.drive_km, report.drive_s) == ("car-1", 2.0, 100.0)
    assert (report.up_bytes, report.down_bytes) == (1840, 5 * 840 + 40)
    assert report.kB_per_km_up == pytest.approx(0.92)
    assert report.kB_per_km_down == pytest.approx(2.12)
    assert (report.up_wire_bytes, report.down_wire_bytes) == (3000, 6000)
    # 160 B up at 1000 B/s, 1000 B down at 10,000 B/s, twice 250 ms.
    assert report.tile_arrival_s == {"test": pytest.approx(0.16 + 0.1 + 0.5)}
    assert report.along[0] == (0.0, 0.0, 0, 0)
    assert report.along[-1] == (95.0, 1900.0, 4240, 1840)


def test_use_of_a_link_by_hand(run):
    ledger, _ = read_run(run)
    down, up = link_use(ledger, LINK, "down", 6000), link_use(ledger, LINK, "up", 3000)
    assert down.sending_s == pytest.approx(0.6)
    assert down.share == pytest.approx(0.006)
    # The five messages of the start queue up: the last one takes half a second and the delay.
    assert down.longest_wait_s == pytest.approx(0.5 + 0.25)
    assert up.sending_s == pytest.approx(3.0)
    assert up.longest_wait_s == pytest.approx(2.0 + 0.25)


def test_the_table_names_agents_kinds_and_links(run):
    result = CliRunner().invoke(traffic, [str(run)], catch_exceptions=False)
    assert result.exit_code == 0
    for word in ("car-1", "car-2", "change", "acknowledgement", "3g", "4g", "5g", "2 agents, 4.00 km", "on the wire"):
        assert word in result.output


def test_json_holds_the_same_and_the_sources(run):
    result = CliRunner().invoke(traffic, [str(run), "--json"], catch_exceptions=False)
    report = json.loads(result.output)
    assert report["fleet"]["up_bytes"] == 2 * 1840
    assert report["fleet"]["kB_per_km_down"] == pytest.approx(2.12)
    assert [agent["agent"] for agent in report["agents"]] == ["car-1", "car-2"]
    assert {use["link"] for use in report["agents"][0]["links"]} == {"3g", "4g", "5g"}
    assert report["links"]["5g"]["rate_source"].startswith("quoted: ")
    assert report["agents"][0]["links"][0]["share"] < 0.01


def test_a_link_of_ones_own_can_be_compared(run, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("[satellite]\ndown_bit_s = 1e6\nup_bit_s = 2e5\n")
    result = CliRunner().invoke(traffic, [str(run), "--link", str(file), "--json"], catch_exceptions=False)
    assert list(json.loads(result.output)["links"]) == ["satellite"]


def test_infinite_links_are_compared_too(run):
    result = CliRunner().invoke(traffic, [str(run), "--link", "none"], catch_exceptions=False)
    assert result.exit_code == 0


def test_a_long_drive_is_thinned_to_its_ends(tmp_path):
    ledger = Ledger("a")
    for number in range(1000):
        ledger.set_position(number, 10**18 + number * 10**9)
        ledger.record("down", "update", 10)
    ledger.write_jsonl(tmp_path / "r" / "ledger" / "a.jsonl")
    along = agent_traffic(read_run(tmp_path / "r")[0], (LINK,)).along
    assert len(along) == 100
    assert (along[0][2], along[-1]) == (10, (999.0, 999.0, 10_000, 0))


def test_an_agent_that_never_drove_is_reported_without_km(tmp_path):
    ledger = Ledger("parked")
    ledger.record("down", "catalog", 10)
    ledger.write_jsonl(tmp_path / "r" / "ledger" / "parked.jsonl")
    result = CliRunner().invoke(traffic, [str(tmp_path / "r")], catch_exceptions=False)
    assert "parked" in result.output
    assert "–" in result.output


def test_a_crash_while_writing_is_mentioned(run):
    file = run / "ledger" / "car-1.jsonl"
    file.write_bytes(file.read_bytes()[:-10])
    result = CliRunner().invoke(traffic, [str(run)], catch_exceptions=False)
    assert "1 unfinished ledger line left out" in result.output


def test_unknown_runs_and_links_are_errors(run, tmp_path):
    with pytest.raises(LedgerError, match=r"no run at .*nowhere"):
        CliRunner().invoke(traffic, [str(tmp_path / "nowhere")], catch_exceptions=False)
    (tmp_path / "bare").mkdir()
    with pytest.raises(LedgerError, match=r"no ledgers in .*bare/ledger"):
        CliRunner().invoke(traffic, [str(tmp_path / "bare")], catch_exceptions=False)
    with pytest.raises(LinkError):
        CliRunner().invoke(traffic, [str(run), "--link", "6g"], catch_exceptions=False)


def test_a_run_is_found_by_its_name(run, monkeypatch, tmp_path):
    (tmp_path / "runs").mkdir()
    run.rename(tmp_path / "runs" / "monday")
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(traffic, ["monday"], catch_exceptions=False)
    assert "car-2" in result.output
