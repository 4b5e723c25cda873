"""A vehicle at a region's router, shard and store at the hub: the region's router is killed while reports are sent."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from merger_processes import Cloud, wait_for
from merger_world import GROUND, POLE, TILE, WALL, change_of, gaussians_of, report_of, tile_of_states
from suite_ports import new_port

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.schemas.changes import ChangeReport
from gnd.schemas.keys import change_key, update_keys
from gnd.schemas.updates import TileUpdate
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.link.sending import SenderThread

STATES = {0: GROUND, 1: WALL}
BASE = gaussians_of(STATES)
REPORTS, KILLED_AFTER = 40, 8


@pytest.fixture
def cloud(tmp_path: Path, free_port: int) -> Iterator[Cloud]:
    cloud = Cloud(tmp_path, free_port)
    cloud.open()
    cloud.store.put_tiles([tile_of_states(STATES)])
    yield cloud
    cloud.close()


@pytest.fixture
def region(cloud: Cloud) -> Iterator["Region"]:
    region = Region(cloud.endpoint)
    yield region
    region.kill()


class Region:
    """The region's router, a process that is linked with the hub."""

    def __init__(self, hub: str) -> None:
        self.endpoint = f"tcp/127.0.0.1:{new_port()}"
        command = ["-m", "gnd.deploy.cli", "router", "--listen", self.endpoint, "--connect", hub]
        self._process = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        assert "listens" in self._process.stdout.readline()
        self._process.stdout.close()

    def kill(self) -> None:
        """kill -9."""
        self._process.kill()
        self._process.wait()


def made_reports() -> list[ChangeReport]:
    """What a vehicle has met: again and again a pole where the map has nothing."""
    return [report_of(n, change_of(BASE, [0, 1, 2], {2: POLE}), vehicle="car") for n in range(REPORTS)]


@pytest.mark.slow
def test_reports_of_a_vehicle_whose_router_is_killed_are_all_stored_once(tmp_path, cloud, region):
    cloud.start("hub-shard")
    reports, heard = made_reports(), list[TileUpdate]()
    outbox = Outbox(tmp_path / "outbox.sqlite")
    with open_bus(BusConfig(connect=(region.endpoint, cloud.endpoint), link="3g"), name="car") as bus:
        bus.subscribe(update_keys("ndt"), lambda _key, payload: heard.append(TileUpdate.decode(payload)), history=True)
        for report in reports[:KILLED_AFTER]:
            outbox.put(report.report_id, change_key("ndt", report.district), report.encode())
        sender = SenderThread(bus, outbox, "car")
        wait_for("the first reports are acknowledged", lambda: outbox.counts().acknowledged > 0)
        for report in reports[KILLED_AFTER:]:
            outbox.put(report.report_id, change_key("ndt", report.district), report.encode())
        region.kill()
        wait_for("every report is released", lambda: outbox.counts().open == 0)
        wait_for("everything is merged and announced", cloud.is_settled)
        stored = [row.report_id for row in cloud.store.reports(vehicle="car")]
        assert sorted(stored) == sorted(report.report_id for report in reports)
        assert not outbox.refused()
        assert bus.connections == 2
        last = cloud.store.history("ndt", TILE)[-1].version
        wait_for("the vehicle hears of the newest version", lambda: heard and heard[-1].version == last)
        versions = [update.version for update in heard]
        assert versions == sorted(set(versions)), "each once, in order"
        sender.close()
