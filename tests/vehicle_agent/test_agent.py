"""The whole agent against a real router, tile server and merger shard, on a simulated street."""

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from waiting import wait_until

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.merger import run_shard
from gnd.fleet_bus.bus import Bus
from gnd.fleet_sim.street import street
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import DriveWriter, read_drive, read_header
from gnd.schemas.errors import DriveError
from gnd.schemas.keys import traffic_key
from gnd.schemas.traffic import TrafficSample
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.agent import AgentConfig, run_agent
from gnd.vehicle_agent.cli import agent as agent_command
from gnd.vehicle_agent.errors import VehicleError

SEED = 101
NEVER = threading.Event()


class Cloud:
    """Tile server and one merger shard over a copy of the map."""

    def __init__(self, bus: Bus, endpoint: str, recordings: Path, folder: Path) -> None:
        self.path = folder / "store.sqlite"
        with SqliteStore(recordings / "map.sqlite") as base, SqliteStore(self.path) as copy:
            entries = base.heads("ndt")
            copy.put_tiles([found.decode() for e in entries if (found := base.get("ndt", e.tile)) is not None])
        self.store = SqliteStore(self.path)
        self.server = TileServer(self.store, bus).start()
        self.stop = threading.Event()
        shard = ShardConfig(store_path=self.path, connect=(endpoint,))
        self.shard = threading.Thread(target=run_shard, args=(shard, self.stop))
        self.shard.start()

    def close(self) -> None:
        self.stop.set()
        self.shard.join()
        self.server.close()
        self.store.close()

    def reports(self) -> dict[str, list[ChangeReport]]:
        """What counts: of each tile of a report its part 1 where there is one, else part 0."""
        newest = {(row.report_id, row.tile): row for row in sorted(self.store.reports("ndt"), key=lambda row: row.part)}
        found: dict[str, list[ChangeReport]] = {}
        for row in newest.values():
            found.setdefault(row.report_id, []).append(ChangeReport.decode(row.body))
        return found


@pytest.fixture
def cloud_of(cloud: Bus, endpoint: str, recordings: Path, tmp_path: Path) -> Iterator[Cloud]:
    opened = Cloud(cloud, endpoint, recordings, tmp_path)
    yield opened
    opened.close()


@pytest.fixture
def config(endpoint: str, recordings: Path, tmp_path: Path) -> AgentConfig:
    return AgentConfig(
        vehicle="probe", drive=recordings / "probe.mcap", work_dir=tmp_path / "agents" / "probe", connect=(endpoint,)
    )


@pytest.mark.slow
def test_a_drive_ends_with_everything_acknowledged_and_a_second_life_sends_nothing_again(
    cloud_of: Cloud, cloud: Bus, config: AgentConfig
) -> None:
    samples: list[TrafficSample] = []
    cloud.subscribe(traffic_key("probe"), lambda _k, body: samples.append(TrafficSample.decode(body)), kind="control")
    result = run_agent(config, NEVER)

    assert result == json.loads((config.work_dir / "result.json").read_text())
    assert result["finished"]
    assert result["scans"] == 55
    assert result["scans_used"] > 45
    assert result["tiles_downloaded"] == len(cloud_of.store.heads("ndt"))
    assert result["reports_sent"] == result["reports_acknowledged"] == len(cloud_of.reports()) >= 1
    assert result["reports_pending"] == result["reports_quarantined"] == 0
    messages = {form: n for form, n in result["report_messages"].items() if form != "questions"}
    assert messages == {"flags": result["reports_sent"], "gaussians": result["reports_sent"]}
    assert cloud_of.store.quarantined() == []
    assert result["changed_voxels"] == sum(
        len(c.changed) for r in cloud_of.reports().values() for p in r for c in p.tiles
    )
    assert 0.03 < result["distance_km"] < 0.06
    assert result["localisation"]["n"] == result["scans_refined"]
    assert result["localisation"]["lateral_p95_m"] < 0.1
    assert len(result["localisation"]["lateral_m"]) == result["scans_refined"]
    assert result["health"][-1]["health"] == "good"
    assert result["memory_mb"]["pss_peak"] >= result["memory_mb"]["pss"] > 10
    wait_until(lambda: samples and samples[-1].reports == result["reports_acknowledged"])
    assert samples[-1].odometer_m == pytest.approx(1000 * result["distance_km"], abs=0.01)
    lines = [json.loads(line) for line in config.ledger_path.read_text().splitlines()]
    assert sum(line.get("app_bytes", 0) for line in lines if line.get("kind") == "tile") > 10_000
    wait_until(lambda: cloud_of.store.dirty_count() == 0)
    assert cloud_of.store.counts().versions > result["tiles_downloaded"], "the merger published nothing"

    again = run_agent(config, NEVER)
    assert again["reports_sent"] == result["reports_sent"]
    assert again["changed_voxels"] == 0
    assert cloud_of.store.counts().reports == result["reports_sent"]
    held = again["tiles"].get("unchanged", 0) + again["tiles"].get("delta", 0)
    assert held + again["tiles_downloaded"] == result["tiles_downloaded"]


@pytest.mark.slow
def test_an_agent_killed_on_the_way_is_started_again_and_loses_nothing(cloud_of: Cloud, config: AgentConfig) -> None:
    program = "from gnd.vehicle_agent.cli import agent; agent()"
    arguments = ["--vehicle", "probe", "--drive", str(config.drive), "--work-dir", str(config.work_dir)]
    arguments += ["--connect", config.connect[0], "--pace", "0.5"]
    with subprocess.Popen([sys.executable, "-c", program, *arguments]) as process:
        cache = config.work_dir / "cache.sqlite-wal"
        wait_until(lambda: cache.exists() and cache.stat().st_size > 50_000, timeout_s=40.0)
        process.kill()
    result = run_agent(config, NEVER)
    assert result["tiles"].get("unchanged", 0) > 0, "what was cached is not downloaded again"
    assert result["reports_acknowledged"] == result["reports_sent"] == len(cloud_of.reports()) >= 1


@pytest.mark.slow
def test_a_vehicle_with_lidar_asks_for_neither_scipy_nor_gtsam(cloud_of: Cloud, config: AgentConfig) -> None:
    """Whoever imports it is told; numba does where it compiles, and that is not ours. To look whether it is installed
    (``importlib.util.find_spec``, before a drive begins) loads nothing."""
    program = """
import sys
asked = set()
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("scipy", "small_gicp", "gtsam"):
            frame = sys._getframe(1)
            while "importlib" in frame.f_code.co_filename:
                if frame.f_globals["__name__"] == "importlib.util":
                    return
                frame = frame.f_back
            asked.add(frame.f_globals["__name__"].split(".")[0])
sys.meta_path.insert(0, Watch())
from gnd.vehicle_agent.cli import agent
agent(standalone_mode=False)
print("imported by", sorted(asked - {"scipy", "numba"}), "numba" in sys.modules or "scipy" not in sys.modules)
"""
    arguments = ["--vehicle", "probe", "--drive", str(config.drive), "--work-dir", str(config.work_dir)]
    command = [sys.executable, "-c", program, *arguments, "--connect", config.connect[0]]
    told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=400).stdout
    assert told.splitlines()[-1] == "imported by [] True"
    assert json.loads((config.work_dir / "result.json").read_text())["scans_used"] > 45


@pytest.mark.slow
def test_bad_scans_are_counted_and_the_drive_goes_on(cloud_of: Cloud, config: AgentConfig, tmp_path: Path) -> None:
    path, constant, empty = tmp_path / "bad.mcap", 0, 0
    with DriveWriter(path, read_header(config.drive)) as writer:
        for number, item in enumerate(read_drive(config.drive)):
            if isinstance(item, Scan) and number % 7 == 0:
                constant += 1
                item = Scan(item.t_ns, np.full_like(item.points_m, 4.0), item.t_offset_ns)
            elif isinstance(item, Scan) and number % 7 == 1:
                empty += 1
                item = Scan(item.t_ns, item.points_m[:10].copy(), item.t_offset_ns[:10].copy())
            writer.add(item)
    result = run_agent(replace(config, drive=path), NEVER)
    assert constant > 2
    assert result["scans_bad"] == {"constant": constant, "empty": empty}
    assert result["scans"] == 55 - constant - empty
    assert result["scans_used"] > 0.8 * result["scans"]
    assert result["reports_pending"] == 0


@pytest.mark.slow
def test_a_recording_damaged_on_the_way_is_reported_as_far_as_it_goes(
    cloud_of: Cloud, config: AgentConfig, tmp_path: Path
) -> None:
    content = bytearray(config.drive.read_bytes())
    middle = int(0.8 * len(content))
    content[middle : middle + 64] = bytes(64)
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    with pytest.raises(DriveError):
        run_agent(replace(config, drive=damaged), NEVER)
    result = json.loads((config.work_dir / "result.json").read_text())
    assert not result["finished"]
    assert 20 < result["scans"] < 55
    assert result["reports_acknowledged"] == len(cloud_of.reports()) >= 1


def test_a_stopped_agent_ends_at_once_in_order(cloud_of: Cloud, config: AgentConfig) -> None:
    stop = threading.Event()
    stop.set()
    result = run_agent(config, stop)
    assert not result["finished"]
    assert result["scans"] == 0
    assert cloud_of.reports() == {}


def offline(config: AgentConfig, port: int) -> AgentConfig:
    nowhere = (f"tcp/127.0.0.1:{port}",)
    return replace(config, connect=nowhere, open_timeout_s=0.2, report=replace(config.report, drain_s=0.2))


def test_an_agent_starts_without_a_router_and_says_so(
    recordings: Path, tmp_path: Path, free_port: int, caplog: pytest.LogCaptureFixture
) -> None:
    config = offline(AgentConfig("probe", recordings / "probe.mcap", tmp_path / "w"), free_port)
    stop = threading.Event()
    stop.set()
    assert run_agent(config, stop)["scans"] == 0
    assert f"no router at tcp/127.0.0.1:{free_port} for 0.2 s" in caplog.text


@pytest.mark.slow
def test_without_a_router_the_agent_drives_on_its_cache_and_reports_later(cloud_of: Cloud, config: AgentConfig) -> None:
    before = run_agent(config, NEVER)
    (config.work_dir / "outbox.sqlite").rename(config.work_dir / "old.sqlite")
    without = run_agent(offline(config, 1), NEVER)  # nobody listens at port 1
    assert without["finished"]
    assert without["tiles"].keys() <= {"cached", "failed"}
    assert without["scans_used"] > 0.9 * before["scans_used"]
    assert without["reports_pending"] == without["reports_sent"] >= 1
    stop = threading.Event()
    stop.set()
    later = run_agent(replace(config), stop)
    wait_until(lambda: cloud_of.reports() != {})
    assert later["reports_sent"] == without["reports_sent"]


def test_a_recording_that_is_cut_off_is_one_clear_error(endpoint: str, recordings: Path, tmp_path: Path) -> None:
    whole = (recordings / "probe.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    arguments = ["--drive", str(cut), "--connect", endpoint, "--work-dir", str(tmp_path / "w")]
    failed = CliRunner().invoke(agent_command, arguments)
    assert isinstance(failed.exception, DriveError)
    assert len(str(failed.exception).splitlines()) == 1
    assert not (tmp_path / "w" / "result.json").exists()


def test_a_recording_without_satellites_cannot_be_placed(endpoint: str, recordings: Path, tmp_path: Path) -> None:
    path = tmp_path / "blind.mcap"
    with DriveWriter(path, read_header(recordings / "probe.mcap")) as writer:
        writer.add(next(item for item in read_drive(recordings / "probe.mcap") if isinstance(item, Scan)))
    with pytest.raises(VehicleError, match="no GNSS fix"):
        run_agent(AgentConfig("probe", path, tmp_path / "w", connect=(endpoint,)), NEVER)


def test_the_tiles_of_the_street_lie_where_the_agent_looks(recordings: Path) -> None:
    with SqliteStore(recordings / "map.sqlite") as store:
        tiles = [e.tile for e in store.heads("ndt")]
    lat, lon = street(SEED).lat_rad, street(SEED).lon_rad
    here = TileId.from_geodetic(lat, lon)
    assert min(abs(t.lon_index - here.lon_index) + abs(t.lat_index - here.lat_index) for t in tiles) < 5
