"""A drive through an unchanged street whose poses are off: what the vehicle's own pipeline makes of it stays out of the
map, and the vehicle is named.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.merge import merge_tile
from gnd.cloud_merger.statements import statements_of
from gnd.cloud_merger.stored import report_of
from gnd.cloud_merger.work import Worker
from gnd.fleet_sim.drives import PERFECT, DriveConfig, DriveSimulation, simulate_drive
from gnd.fleet_sim.prepare import mapping_configs
from gnd.fleet_sim.street import street
from gnd.schemas.changes import ChangeReport, split
from gnd.schemas.drive import ReferencePose
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig
from studies.simulation.base_map import BaseMap
from studies.simulation.options import MethodParameters, PoseSource
from studies.simulation.result import VoxelRows
from studies.simulation.vehicle import VehicleTask, drive

SEED, SCANS = 41, 60
OFF_M = (0.1, 0.3)  # forward, left


@pytest.fixture(scope="module")
def world():
    return street(SEED)


@pytest.fixture
def store(tmp_path, world):
    mapping = replace(mapping_configs(SEED)[0], scans=SCANS)
    simulate_drive(world, mapping, tmp_path / "mapper.mcap")
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        build_map([tmp_path / "mapper.mcap"], store)
        yield store


def off(T):
    wrong = np.eye(4)
    wrong[:2, 3] = OFF_M
    return T @ wrong


def reports_from_wrong_poses(world, tiles, *, own_gate):
    """What the vehicle would send, had its localiser not noticed."""
    config = DriveConfig("car", "HDL-32E", state="before", seed=5, car_share=0.0, errors=PERFECT, scans=SCANS)
    simulation = DriveSimulation(world, config)
    items = (
        ReferencePose(item.t_ns, off(item.T_map_vehicle)) if isinstance(item, ReferencePose) else item
        for item in simulation.items()
    )
    nowhere, method = Path(), MethodParameters()
    method = replace(method, report=replace(method.report, check_poses=own_gate))
    task = VehicleTask(nowhere, nowhere, nowhere, "hdl32e", config, PoseSource.parse("true"), method, nowhere, "test")
    nothing = VoxelRows(np.zeros(0, np.int64), np.zeros(0, np.int32))
    return drive(simulation.header(), items, BaseMap(tiles), nothing, task).reports


def put(store, bodies):
    for body in bodies:
        report = ChangeReport.decode(body)
        for change, (tile, part) in zip(report.tiles, split(report), strict=True):
            row = ReportRow(report.report_id, "ndt", tile, "car", report.last_ns, part, base_sha=change.base_sha)
            store.put_reports([row])


def changed_by_votes_alone(store, tiles, config):
    """Voxels that the merge without the gates would change."""
    found = 0
    for tile, base in tiles.items():
        journal = store.in_play("ndt", tile)
        epoch, rows = journal.epoch, journal.reports
        reports = [report_of(row.body, config.merge) for row in rows]
        if epoch is not None and reports:
            statements = statements_of(base, reports, {epoch.sha: base})
            found += len(merge_tile(base, statements, config.merge).changed)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("own_gate", [False, True])
def test_a_drive_with_wrong_poses_through_an_unchanged_street(store, world, own_gate):
    tiles = {head.tile: store.get("ndt", head.tile).decode_gaussians().gaussians for head in store.heads()}
    before = {head.tile: head.sha for head in store.heads()}
    put(store, reports_from_wrong_poses(world, tiles, own_gate=own_gate))
    config = ShardConfig(store_path=store.path)
    worker = Worker(store, config)
    while claims := store.claim("one", 16, 60.0):
        store.publish(worker.merge(claims))
    by_votes = changed_by_votes_alone(store, tiles, config)
    assert by_votes > 500 or own_gate
    assert {head.tile: head.sha for head in store.heads() if head.tile in before} == before
    assert store.shifted_vehicles() == {"car"}
    (account,) = store.vehicle_accounts()
    assert account.length_m == pytest.approx(np.hypot(*OFF_M), abs=0.06)
