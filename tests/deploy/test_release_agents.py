"""Real agents on a tile on trial: each gets its version, tells how it fares, and loses what is withdrawn."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "attacks"))

from release_scene import ReleaseCloud, wait_for

from gnd.cloud_merger.release.verdict import score_of
from gnd.fleet_sim.drives import simulate_drive
from gnd.fleet_sim.prepare import agent_configs, mapping_configs
from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store import releasing
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.build import build_map
from gnd.tile_store.trials import TrialTerms, VersionTrial
from gnd.tile_store.values import Publication, ReportRow
from gnd.vehicle_agent.link.cache import TileCache
from studies.release_study.shifted import shifted
from studies.release_study.visits import tiles_driven_through

SEED, SCANS = 911, 90

pytestmark = [pytest.mark.xdist_group("fleets"), pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.fixture
def cloud(tmp_path, free_port):
    cloud = ReleaseCloud(tmp_path, free_port)
    cloud.open()
    yield cloud
    cloud.close()


@pytest.fixture
def drive(tmp_path, cloud) -> Path:
    """A drive on a street whose map the cloud holds."""
    world = street(SEED, StreetOptions(edit_share=0.0))
    mapping = replace(mapping_configs(SEED)[0], sensor="VLP-16", scans=SCANS)
    vehicle = replace(agent_configs(SEED, 1)[0], sensor="VLP-16", scans=SCANS, camera=None)
    build_map([simulate_drive(world, mapping, tmp_path / "mapping.mcap")], cloud.store)
    return simulate_drive(world, vehicle, tmp_path / "drive.mcap")


def on_trial(cloud: ReleaseCloud, tile: TileId) -> VersionTrial:
    """The tile with all that it holds half a metre off, put on trial past the merge."""
    held = cloud.store.get("ndt", tile).decode_gaussians()
    cloud.store.put_reports([ReportRow(deterministic_report_id(1, "bad"), "ndt", tile, "somebody", 1, b"x")])
    wait_for("it waits", lambda: cloud.store.ready_in_s() is not None and cloud.store.ready_in_s() <= 0)
    (claim,) = cloud.store.claim("test", 1, 30.0)
    publication = Publication(claim, held.version, shifted(held, 0.0, 0.5), trial=TrialTerms(0.5, 3600.0))
    assert cloud.store.publish([publication])[0].status == "published"
    return cloud.store.trials("ndt")[tile]


def run_agent(cloud: ReleaseCloud, drive: Path, vehicle: str, folder: Path) -> None:
    options = [
        "--drive",
        drive,
        "--vehicle",
        vehicle,
        "--connect",
        cloud.endpoint,
        "--work-dir",
        folder,
        "--link",
        "none",
    ]
    command = [sys.executable, "-c", "from gnd.deploy.cli import main; main()", "agent", *map(str, options)]
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run([*command, "--set", "report.drain_s=1"], check=True, env=env, timeout=600)


def cached(folder: Path, tile: TileId) -> Tile:
    cache: TileCache[Tile] = TileCache(folder / "cache.sqlite", "ndt")
    found = cache.get(tile)
    cache.close()
    assert found is not None
    return found


def test_agents_tell_how_they_fare_and_lose_what_is_withdrawn(cloud, drive, tmp_path):
    tile = max(tiles_driven_through(drive), key=lambda one: len(cloud.store.get("ndt", one).decode().gaussians))
    before = cloud.store.get("ndt", tile).decode()
    trial = on_trial(cloud, tile)
    cloud.start("one")
    (first,), (other,) = cloud.cars(trial, "new", 1), cloud.cars(trial, "old", 1)
    for car in (first, other):
        run_agent(cloud, drive, car, tmp_path / car)
    told = {one.vehicle: one for one in cloud.store.look(lambda c: trials.health(c, trial))}
    assert {car: one.arm for car, one in told.items()} == {first: "new", other: "old"}
    assert min(one.scans for one in told.values()) >= 5
    assert all(one.has_left for one in told.values())
    assert told[other].fit - told[first].fit > 100  # 1/1000
    assert (score_of(told[other]) or 0.0) - (score_of(told[first]) or 0.0) > 0.1
    assert cached(tmp_path / first, tile).version == trial.version
    assert cached(tmp_path / other, tile).gaussians == before.gaussians

    releasing.withdraw(cloud.store, trial, "test", "half a metre off")
    run_agent(cloud, drive, first, tmp_path / first)
    assert cached(tmp_path / first, tile).gaussians == before.gaussians
    assert cached(tmp_path / first, tile).version == trial.version + 1
