"""The vehicle as one object: what goes in, what comes out, and that the agent is this and a link."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_bus.bus import Bus
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.schemas.changes import ChangeReport
from gnd.schemas.drive import DriveItem, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.tile_store.build import build_map
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.agent import run_agent
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.localise_drive.tiles import StoreMap
from gnd.vehicle_agent.outbox import Outbox
from gnd.vehicle_agent.pipeline import Output, Parts, Pipeline
from gnd.vehicle_agent.report import Identity
from gnd.vehicle_agent.report_sink import ReportList
from gnd.vehicle_agent.segment import SegmentedScan
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand

pytestmark = pytest.mark.slow
SEED = 101


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of the first part of a street, and a later drive through it."""
    folder, world = tmp_path_factory.mktemp("street"), street(SEED)
    mapper = DriveConfig("mapper", "HDL-32E", state="before", errors=PERFECT, car_share=0.0, scans=60)
    simulate_drive(world, mapper, folder / "mapper.mcap")
    simulate_drive(world, DriveConfig("probe", "VLP-16", seed=4, scans=45), folder / "probe.mcap")
    with SqliteStore(folder / "map.sqlite") as store:
        build_map([folder / "mapper.mcap"], store)
    return folder


def pipeline_of(
    folder: Path, store: SqliteStore, *, reports: bool, parts: Parts | None = None
) -> Pipeline[TilesAtHand]:
    header, path = read_header(folder / "probe.mcap"), folder / "probe.mcap"
    fix, _ = first_fix(read_drive(path), path)
    who = Identity("probe", header.drive_id, header.sensor_model, "ndt") if reports else None
    return Pipeline(header, fix, lambda m, t: TilesAtHand(StoreMap(store), m, t), identity=who, parts=parts)


def fed(pipeline: Pipeline[TilesAtHand], items: list[DriveItem]) -> list[Output]:
    return [*(pipeline.push(item) for item in items), pipeline.finish()]


def bodies(outputs: list[Output]) -> dict[str, bytes]:
    return {report.report_id: report.body for output in outputs for report in output.reports}


def told(reports: dict[str, bytes]) -> dict[str, list[tuple[object, ...]]]:
    """What reports say of which voxels; poses differ in the last bits, since tiles come at other times."""
    decoded = {one: ChangeReport.decode(body) for one, body in reports.items()}
    return {
        one: [(c.tile, c.base_sha, c.observed.tobytes(), c.changed.voxel_id.tobytes()) for c in report.tiles]
        for one, report in decoded.items()
    }


def test_the_agent_reports_what_the_pipeline_does(folder: Path, bus: Bus, endpoint: str, tmp_path: Path) -> None:
    items = list(read_drive(folder / "probe.mcap"))
    with SqliteStore(folder / "map.sqlite") as store, TileServer(store, bus):
        config = AgentConfig(
            vehicle="probe",
            drive=folder / "probe.mcap",
            work_dir=tmp_path / "probe",
            connect=(endpoint,),
            report=replace(AgentConfig("v", folder, folder).report, drain_s=0.2),  # nobody acknowledges here
        )
        result = run_agent(config, threading.Event())
        outputs = fed(pipeline_of(folder, store, reports=True), items)
    outbox = Outbox(config.work_dir / "outbox.sqlite")
    kept = {letter.report_id: letter.body for letter in outbox.due(2**62, 100)}
    outbox.close()
    assert told(kept) == told(bodies(outputs))
    assert sum(len(c.changed) for body in kept.values() for c in ChangeReport.decode(body).tiles) > 50
    assert result["scans_refined"] == sum(len(output.poses) for output in outputs)


def test_what_cannot_be_used_is_counted_and_changes_nothing(folder: Path) -> None:
    items = list(read_drive(folder / "probe.mcap"))
    bad: list[DriveItem] = []
    for item in items:
        bad.append(item)
        if isinstance(item, Scan):
            bad.append(replace(item, t_ns=item.t_ns + 1, points_m=np.ones_like(item.points_m)))
        if isinstance(item, MotionSample):
            bad.append(item)  # twice
        if isinstance(item, ReferencePose):
            bad.append(replace(item, T_map_vehicle=np.eye(4)))  # nothing that a vehicle has
    with SqliteStore(folder / "map.sqlite") as store:
        clean, dirty = (pipeline_of(folder, store, reports=True) for _ in range(2))
        assert bodies(fed(clean, items)) == bodies(fed(dirty, bad))
    assert dirty.guard.bad["constant"] == clean.scans == dirty.scans
    assert dirty.guard.bad["time-backwards"] > 100


def test_without_an_identity_it_only_localises(folder: Path) -> None:
    with SqliteStore(folder / "map.sqlite") as store:
        pipeline = pipeline_of(folder, store, reports=False)
        outputs = fed(pipeline, list(read_drive(folder / "probe.mcap")))
    assert bodies(outputs) == {}
    assert sum(len(output.poses) for output in outputs) > 40
    assert outputs[-1].health == "good"
    assert pipeline.tiles.used
    with pytest.raises(TypeError, match="only localises"):
        _ = pipeline.reporter


def test_a_study_sees_every_scan_that_is_judged_and_one_that_is_known_already_is_no_new_report(folder: Path) -> None:
    seen: list[SegmentedScan] = []
    items = list(read_drive(folder / "probe.mcap"))
    header, (fix, _) = read_header(folder / "probe.mcap"), first_fix(items, "probe")
    kept, who = ReportList(), Identity("probe", header.drive_id, header.sensor_model, "ndt")
    with SqliteStore(folder / "map.sqlite") as store:
        for watch in ((seen.append,), ()):
            pipeline = Pipeline(
                header,
                fix,
                lambda m, t: TilesAtHand(StoreMap(store), m, t),
                identity=who,
                outbox=kept,
                parts=Parts(watch=watch),
            )
            outputs = fed(pipeline, items)
            assert len(bodies(outputs)) == (len(kept.reports) if watch else 0)
    assert len(seen) == pipeline.reporter.counts["scans_used"] + pipeline.reporter.counts["scans_uncertain"]


def test_a_drive_without_a_position_is_refused_by_name(folder: Path) -> None:
    with pytest.raises(VehicleError, match="probe has no GNSS fix"):
        first_fix([item for item in read_drive(folder / "probe.mcap") if isinstance(item, Scan)], "probe")
