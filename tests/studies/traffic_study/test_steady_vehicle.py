"""The account of a vehicle that knows its street: what is asked of it, and that it says when it is missed."""

import pytest
from click.testing import CliRunner

from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.ledger_file import read_ledger
from gnd.fleet_bus.traffic import agent_traffic
from gnd.fleet_bus.wire import WireBytes
from studies.cli import reproduce
from studies.frame.errors import ReproduceError
from studies.traffic_study.steady import SteadyOptions, account, sheet_of_account


def driven(tmp_path, up: int, down: int):
    """2 km: a question about a tile, a report, many notices, some keep-alives."""
    ledger = Ledger("v")
    ledger.set_position(0.0, 10**18)
    ledger.record("up", "tile", 40, head_bytes=50)
    ledger.record("down", "tile", 10, head_bytes=50, took_s=0.1)
    ledger.set_position(2000.0, 10**18 + 180 * 10**9)
    ledger.record("up", "change", 300, head_bytes=50)
    ledger.record("down", "update", down - 1000, head_bytes=50)
    parts = {
        "up_acks": 104,
        "down_acks": 104,
        "up_opening": 200,
        "down_opening": 180,
        "up_alive": 110,
        "down_alive": 55,
    }
    ledger.record_wire(WireBytes(up=up, down=down, segment_bytes=1448, header_bytes=52, **parts))
    ledger.write_jsonl(tmp_path / "v.jsonl")
    return account(agent_traffic(read_ledger(tmp_path / "v.jsonl"), ()), 200.0)


@pytest.mark.parametrize(
    ("wire", "met", "aim_met", "said"),
    [
        ((1300, 1000), True, True, "aim met"),
        ((1300, 3900), True, False, "must met"),
        ((1300, 6900), False, False, "missed"),
    ],
)
def test_must_and_aim_are_judged_by_all_bytes_but_tiles(tmp_path, wire, met, aim_met, said):
    found = driven(tmp_path, *wire)
    tiles = 40 + 50 + 52 + 10 + 50 + 2 * 52
    assert found["all_kB_per_km"] == sum(wire) / 2000
    assert 0 < found["tiles_kB_per_km"] * 2000 - tiles <= 208, "with their acknowledgements, of which there are four"
    assert found["other_kB_per_km"] == pytest.approx(found["all_kB_per_km"] - found["tiles_kB_per_km"])
    assert (found["met"], found["aim_met"]) == (met, aim_met)
    assert sum(row["wire_bytes"] for row in found["rows"]) == sum(wire)
    assert f"aim 1: {said}" in sheet_of_account(found).markdown()


def test_what_comes_once_a_drive_is_told_apart(tmp_path):
    found = driven(tmp_path, 1300, 1000)
    rest = sum(row["wire_bytes"] for row in found["rows"] if row["kind"] == "session")
    assert found["once_a_drive_bytes"] == 200 + 180 + rest
    assert found["under_way_kB_per_km"] == pytest.approx(found["other_kB_per_km"] - found["once_a_drive_bytes"] / 2000)


@pytest.mark.parametrize("wrong", [{"speed_kmh": 0.0}, {"pace": -1.0}, {"sensor": "eyes"}])
def test_what_cannot_be_driven_is_refused(wrong):
    with pytest.raises(ReproduceError):
        SteadyOptions(**wrong)


def test_the_command_is_there():
    told = CliRunner().invoke(reproduce, ["steady-vehicle", "--help"])
    assert told.exit_code == 0
    assert "--parking" in told.output
