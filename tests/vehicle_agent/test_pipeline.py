"""The vehicle as one object: what goes in, what comes out, and that the agent is this and a link."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_bus.bus import Bus
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.drive import DriveItem, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.agent import run_agent
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.localise_drive.tiles import StoreMap
from gnd.vehicle_agent.pipeline import Output, Parts, Pipeline
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.report.sink import ReportList
from gnd.vehicle_agent.segment import SegmentedScan
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand

pytestmark = pytest.mark.slow


def pipeline_of(
    recordings: Path, store: SqliteStore, *, reports: bool, parts: Parts | None = None
) -> Pipeline[TilesAtHand]:
    header, path = read_header(recordings / "probe.mcap"), recordings / "probe.mcap"
    fix, _ = first_fix(read_drive(path), path)
    who = Identity("probe", header.drive_id, header.sensor_model, "ndt") if reports else None
    return Pipeline(header, fix, lambda m, t: TilesAtHand(StoreMap(store), m, t), identity=who, parts=parts)


def fed(pipeline: Pipeline[TilesAtHand], items: list[DriveItem]) -> list[Output]:
    return [*(pipeline.push(item) for item in items), pipeline.finish()]


def bodies(outputs: list[Output]) -> dict[str, bytes]:
    return {report.report_id: report.body for output in outputs for report in output.reports}


def changes_of(reports: dict[str, bytes]) -> dict[tuple[str, TileId], TileChange]:
    decoded = {one: ChangeReport.decode(body) for one, body in reports.items()}
    return {(one, change.tile): change for one, report in decoded.items() for change in report.tiles}


def test_the_agent_reports_what_the_pipeline_does(recordings: Path, bus: Bus, endpoint: str, tmp_path: Path) -> None:
    items = list(read_drive(recordings / "probe.mcap"))
    with SqliteStore(recordings / "map.sqlite") as store, TileServer(store, bus):
        config = AgentConfig(
            vehicle="probe",
            drive=recordings / "probe.mcap",
            work_dir=tmp_path / "probe",
            connect=(endpoint,),
            report=replace(AgentConfig("v", recordings, recordings).report, drain_s=0.2),  # nobody acknowledges here
        )
        result = run_agent(config, threading.Event())
        outputs = fed(pipeline_of(recordings, store, reports=True), items)
    outbox = Outbox(config.work_dir / "outbox.sqlite")
    kept = {letter.report_id: letter.body for letter in outbox.due(2**62, 100)}
    outbox.close()
    by_agent, by_pipeline = changes_of(kept), changes_of(bodies(outputs))
    assert by_agent.keys() == by_pipeline.keys()
    observed, differ = 0, 0
    for where, one in by_agent.items():
        other = by_pipeline[where]
        assert (one.base_sha, one.changed.voxel_id.tolist()) == (other.base_sha, other.changed.voxel_id.tolist())
        observed += len(one.observed)
        differ += len(np.setxor1d(one.observed, other.observed))
    assert differ <= 1e-3 * observed  # tiles come at other times, and rows are summed in another order
    assert sum(len(c.changed) for body in kept.values() for c in ChangeReport.decode(body).tiles) > 50
    assert result["scans_refined"] == sum(len(output.poses) for output in outputs)


def test_what_cannot_be_used_is_counted_and_changes_nothing(recordings: Path) -> None:
    items = list(read_drive(recordings / "probe.mcap"))
    bad: list[DriveItem] = []
    for item in items:
        bad.append(item)
        if isinstance(item, Scan):
            bad.append(replace(item, t_ns=item.t_ns + 1, points_m=np.ones_like(item.points_m)))
        if isinstance(item, MotionSample):
            bad.append(item)  # twice
        if isinstance(item, ReferencePose):
            bad.append(replace(item, T_map_vehicle=np.eye(4)))  # nothing that a vehicle has
    with SqliteStore(recordings / "map.sqlite") as store:
        clean, dirty = (pipeline_of(recordings, store, reports=True) for _ in range(2))
        assert bodies(fed(clean, items)) == bodies(fed(dirty, bad))
    assert dirty.guard.bad["constant"] == clean.scans == dirty.scans
    assert dirty.guard.bad["time-backwards"] > 100


def test_without_an_identity_it_only_localises(recordings: Path) -> None:
    with SqliteStore(recordings / "map.sqlite") as store:
        pipeline = pipeline_of(recordings, store, reports=False)
        outputs = fed(pipeline, list(read_drive(recordings / "probe.mcap")))
    assert bodies(outputs) == {}
    assert sum(len(output.poses) for output in outputs) > 40
    assert outputs[-1].health == "good"
    assert pipeline.tiles.used
    with pytest.raises(TypeError, match="only localises"):
        _ = pipeline.reporter


def test_a_study_sees_every_scan_that_is_judged_and_one_that_is_known_already_is_no_new_report(
    recordings: Path,
) -> None:
    seen: list[SegmentedScan] = []
    items = list(read_drive(recordings / "probe.mcap"))
    header, (fix, _) = read_header(recordings / "probe.mcap"), first_fix(items, "probe")
    kept, who = ReportList(), Identity("probe", header.drive_id, header.sensor_model, "ndt")
    with SqliteStore(recordings / "map.sqlite") as store:
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


def test_a_drive_without_a_position_is_refused_by_name(recordings: Path) -> None:
    with pytest.raises(VehicleError, match="probe has no GNSS fix"):
        first_fix([item for item in read_drive(recordings / "probe.mcap") if isinstance(item, Scan)], "probe")
