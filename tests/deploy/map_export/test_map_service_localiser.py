"""A localiser that knows the map from the service alone finds the pose that it finds on the whole export."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from autoware_client import AutowareClient
from export_testing import Ndt, PlaneFrame, apart, beside, read_export, scans_of, vgicp

from gnd.deploy.map_export.map_service import MapService
from gnd.deploy.map_export.serve import follow
from gnd.deploy.map_export.served_map import ServedMap
from gnd.deploy.map_export.tile_feeds import open_feed
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ros2 import RosNode
from gnd.fleet_bus.router import open_router
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.insert_drive import rewrite_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.importer import import_recording
from gnd.vehicle_agent.importers.recording import NOMINAL

RANGE_M = 60.0
"""The scans have no point that is farther away."""


def ndt_of(cloud: np.ndarray) -> Ndt:
    return Ndt.of_moments(cloud, np.zeros((1, 3, 3)), np.ones(len(cloud)), 2.0, 6)


def check_drive(folder: Path, drive: Path, every: int, every_m: float, endpoint: str) -> None:
    """Drive along on the cells that the service gives, asked for after so many metres, and on the whole export."""
    stop, scans, rng, rows = threading.Event(), list(scans_of(drive, every)), np.random.default_rng(1), []
    asked_m, moved = np.full(2, np.inf), 0
    with open_feed(str(folder / "base.sqlite"), "ndt", "") as feed, AutowareClient(endpoint) as client:
        served = ServedMap(folder / "autoware", feed.all(), None, "samples")
        with RosNode(open_bus(BusConfig(connect=(endpoint,))), 0, "gnd_map") as node:
            MapService(node, served)
            following = threading.Thread(target=follow, args=(feed, served, stop, print))
            following.start()
            client.wait_served()
            projection, whole = read_export(folder / "autoware")
            plane, on_whole, ndt_on_whole = PlaneFrame(scans[0][2], projection), vgicp(whole), ndt_of(whole)
            for points, T, _ in scans:
                start = plane.pose(beside(T, rng))
                x, y = start[:2, 3]
                if not np.hypot(*(asked_m - (x, y))) < every_m:
                    began_s = time.monotonic()
                    answer = client.update(float(x), float(y), RANGE_M + every_m)
                    size_mb = sum(cell.points.nbytes for cell in answer.new.values()) / 1e6
                    print(f"{len(answer.new)} cells, {size_mb:.2f} MB, in {1e3 * (time.monotonic() - began_s):.0f} ms")
                    held, asked_m, moved = np.concatenate(list(client.held.values())), np.array((x, y)), moved + 1
                    on_held, ndt_on_held = vgicp(held.astype(float)), ndt_of(held.astype(float))
                few = points[rng.permutation(len(points))[:3000]]
                rows.append(
                    (
                        on_held(points, start),
                        on_whole(points, start),
                        ndt_on_held.align(few, start),
                        ndt_on_whole.align(few, start),
                        plane.pose(T),
                    )
                )
            stop.set()
            following.join()
    vgicp_held, vgicp_whole, ndt_held, ndt_whole, true = (np.stack(column) for column in zip(*rows, strict=True))
    assert moved >= 2
    for name, a, b in (("VGICP", vgicp_held, vgicp_whole), ("NDT", ndt_held, ndt_whole)):
        off_m = np.linalg.norm(apart(a, b), axis=1)
        error_m = np.linalg.norm(apart(a, true)[:, :2], axis=1)
        print(
            f"{name}, {len(rows)} scans, {moved} requests: off the whole export at most {1e3 * off_m.max():.2f} mm,"
            f" off the reference {1e3 * np.median(error_m):.1f} mm (median)"
        )
        assert off_m.max() < 0.005  # the issue asks for 2 cm
        assert np.median(error_m) < 0.1


@pytest.fixture
def endpoint(free_port: int):
    with open_router((f"tcp/127.0.0.1:{free_port}",)):
        yield f"tcp/127.0.0.1:{free_port}"


@pytest.mark.slow
def test_a_localiser_drives_on_what_the_service_gives(tmp_path: Path, endpoint: str) -> None:
    world = street(1005, StreetOptions(length_m=100.0))
    mapping = DriveConfig("mapper", "HDL-32E", "before", errors=PERFECT, car_share=0.0, cruise_mps=10.0, scans=30)
    with SqliteStore(tmp_path / "base.sqlite") as opened:
        build_map([simulate_drive(world, mapping, tmp_path / "mapping.mcap")], opened)
    config = DriveConfig("car", "HDL-32E", "before", seed=3, scans=60, car_share=0.0, cruise_mps=10.0)
    check_drive(tmp_path, simulate_drive(world, config, tmp_path / "drive.mcap"), 6, 20.0, endpoint)  # as Autoware


@pytest.mark.slow
def test_a_localiser_drives_on_what_the_service_gives_on_a_real_street(
    shared_data: Path, tmp_path: Path, endpoint: str
) -> None:
    import_recording("kitti", shared_data / "kitti00_start16", tmp_path / "whole.mcap", anchor=NOMINAL)
    rewrite_drive(tmp_path / "whole.mcap", tmp_path / "mapped.mcap", [], slice(0, None, 2))
    rewrite_drive(tmp_path / "whole.mcap", tmp_path / "driven.mcap", [], slice(1, None, 2))
    with SqliteStore(tmp_path / "base.sqlite") as opened:
        build_map([tmp_path / "mapped.mcap"], opened)
    check_drive(tmp_path, tmp_path / "driven.mcap", 3, 2.0, endpoint)
