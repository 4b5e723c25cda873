"""Every byte is told once: whoever shows the traffic of a run shows the same bytes, those of the connections."""

import json
from pathlib import Path

from account_testing import assert_one_account

from gnd.deploy.account import account_traffic
from gnd.deploy.live_traffic import LiveLedgers, traffic_lines
from gnd.deploy.ports import claim_port
from gnd.deploy.run_folder import RunFolder
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.router import open_router
from gnd.fleet_bus.wire import WireBytes
from gnd.gnd_map.tile_id import TileId

TILE = TileId.from_path("13033/03021/23031/22102")


def drive(folder: Path, name: str, at: str, reports: int) -> WireBytes:
    """A vehicle that asks for tiles, reports, speaks of itself and hears of a change; what TCP_INFO counted last."""
    ledger = Ledger(name, folder / "ledger" / f"{name}.jsonl")
    ledger.set_position(0.0, 10**18)
    bus = open_bus(BusConfig(connect=(at,), link="4g"), ledger, name)
    bus.declare_alive(f"alive/{name}")
    with bus:
        bus.subscribe("update/**", lambda _key, _payload: None)
        for number in range(reports):
            bus.request("tile/1", bytes(30), kind="tile", tile=TILE)
            bus.request("change/1", bytes(100 + number), kind="change")
            ledger.set_position(500.0 * (number + 1), 10**18 + 45 * 10**9 * (number + 1))
            bus.wire()
        bus.publish(f"traffic/{name}", bytes(70), kind="telemetry")
    return bus.wire()


def test_summary_page_terminal_and_csv_tell_the_bytes_of_the_connections(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "ledger").mkdir(parents=True)
    at = f"tcp/127.0.0.1:{claim_port(0)}"
    with open_router([at]), open_bus(BusConfig(connect=(at,))) as cloud:
        cloud.serve("tile/*", lambda _request: bytes(9000))
        cloud.serve("change/*", lambda _request: bytes(20), kind="change")
        counted = {name: drive(run, name, at, reports) for name, reports in (("car-1", 2), ("car-2", 3))}
        counted["car-1"] += drive(run, "car-1", at, 1)  # started again: a second session, the same ledger
    traffic = account_traffic(RunFolder(run))
    assert_one_account(run, traffic)
    for name, wire in counted.items():
        sizes = traffic["by_vehicle"][name]
        assert (sizes["up_wire_bytes"], sizes["down_wire_bytes"]) == (wire.up, wire.down)
    assert traffic["drive_km"] == 2.5
    rows = {(row["kind"], row["direction"]): row for row in traffic["by_kind"]}
    assert rows["telemetry", "up"]["app_bytes"] == 3 * 70
    assert rows["change", "up"]["app_bytes"] == 100 + 101 + 100 + 101 + 102 + 100
    # Whatever is no message of ours has a name; and what none of the names fits is little (declarations).
    assert rows["opening", "up"]["wire_bytes"] > 0
    assert rows["session", "up"]["wire_bytes"] < 3 * 600
    assert rows.get(("session", "down"), {"wire_bytes": 0})["wire_bytes"] < 3 * 200
    lines = traffic_lines(traffic)
    assert f"{traffic['up_wire_bytes'] + traffic['down_wire_bytes']:,} B" in lines[0]
    assert f"{traffic['down_bytes']:,} B down, {traffic['up_bytes']:,} B up" in lines[1]


def test_parts_of_the_headline_are_the_whole(tmp_path: Path) -> None:
    run = tmp_path / "run"
    ledger = Ledger("car-1", run / "ledger" / "car-1.jsonl")
    ledger.set_position(0.0, 10**18)
    ledger.record("up", "tile", 100, head_bytes=50)
    ledger.record("down", "tile", 2000, TILE, head_bytes=50)
    ledger.record("up", "change", 300, head_bytes=50)
    ledger.set_position(2000.0, 10**18 + 10**10)
    ledger.record("up", "telemetry", 70, head_bytes=37)
    parts = {
        "up_acks": 520,
        "down_acks": 104,
        "up_opening": 200,
        "down_opening": 180,
        "up_alive": 110,
        "down_alive": 55,
    }
    ledger.record_wire(WireBytes(up=3000, down=4000, segment_bytes=1448, header_bytes=52, **parts))
    found = account_traffic(RunFolder(run))
    assert found["all_kB_per_km"] == 3.5
    assert round(found["tiles_kB_per_km"] + found["other_kB_per_km"], 6) == 3.5
    assert round(found["other_up_kB_per_km"] + found["other_down_kB_per_km"], 4) == found["other_kB_per_km"]
    assert found["keep_alives_kB_per_km"] == 0.0825
    assert found["telemetry_kB_per_km"] == round((70 + 37 + 52) / 2000, 4)


def test_the_table_of_a_running_fleet_is_read_anew_now_and_then(tmp_path: Path) -> None:
    now_s = 100.0
    live = LiveLedgers(tmp_path, clock=lambda: now_s)
    live.refresh()
    assert live.agents == {}, "no ledger yet"
    ledger = Ledger("car-1", tmp_path / "ledger" / "car-1.jsonl")
    ledger.record("up", "change", 300)
    ledger.record_wire(WireBytes(up=1000, down=500))
    live.refresh()
    assert live.agents == {}, "it is not time yet"
    now_s += 5.0
    live.refresh()
    assert live.agents["car-1"].up_wire_bytes == 1000
    ledger.record_wire(WireBytes(up=5000, down=2500))
    now_s += 4.0
    live.refresh()
    assert (live.rates["car-1"].up_byte_s, live.rates["car-1"].down_byte_s) == (1000.0, 500.0)
    with (tmp_path / "ledger" / "car-1.jsonl").open("a") as file:
        file.write('{"agent":"car-1","session":"')  # it is being written just now
    live.refresh(now=True)
    assert json.dumps(live.agents["car-1"].up_wire_bytes) == "5000"
