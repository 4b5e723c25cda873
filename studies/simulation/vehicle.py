"""One vehicle from measurements to uploads, in one process: localise, segment, detect, report, as the agent does."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveHeader, DriveItem, ReferencePose
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.detect.classify import tile_change
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import PoseEstimate, localisation_error
from gnd.vehicle_agent.pipeline import Localisation, Parts, Pipeline
from gnd.vehicle_agent.report.reporter import Identity, statement_on_lattice
from gnd.vehicle_agent.report.sink import ReportList
from gnd.vehicle_agent.segment import SegmentedScan
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand
from studies.frame.pool import Tick
from studies.pcd import PcdReport
from studies.simulation.base_map import BaseMap, read_base
from studies.simulation.baseline import CloudVehicle, read_cloud
from studies.simulation.options import MethodParameters, PoseSource
from studies.simulation.poses import FromReference
from studies.simulation.result import (
    MoverLabels,
    RecordingDetector,
    VehicleResult,
    VoxelRows,
    evidence_columns,
    write_result,
)
from studies.simulation.streams import as_recorded, recorded, ticking


@dataclass(frozen=True, slots=True)
class VehicleTask:
    """One vehicle's work, as it is handed to a process.

    Attributes:
        world, base, voxels: files of the world, the base map, and the truth's voxels (their ids only).
        sensor: short name.
        drive: what is simulated.
        poses: where the poses come from.
        method: parameters of the vehicle.
        result: file to write, under `key`.
        recording: keep the drive in this MCAP file, too.
        cloud: the point-cloud baseline's map; None to run without it.
        rounded: whether new Gaussians are moved onto the lattice on which they travel, as the agent does; else the
            reports hold them as they were measured.
    """

    world: Path
    base: Path
    voxels: Path
    sensor: str
    drive: DriveConfig
    poses: PoseSource
    method: MethodParameters
    result: Path
    key: str
    recording: Path | None = None
    cloud: Path | None = None
    rounded: bool = True


def run_vehicle(task: VehicleTask, tick: Tick) -> None:
    """Simulate a drive, run the vehicle on it and write its result."""
    simulation = DriveSimulation(read_world(task.world), task.drive)
    labels = MoverLabels(task.method.detect.range_max_m)
    items = ticking(map(as_recorded, simulation.items(labels.take)), tick, simulation.scans)
    if task.recording is not None:
        items = recorded(items, simulation.header(), task.recording)
    result = drive(simulation.header(), items, read_base(task.base), VoxelRows.read(task.voxels), task, labels)
    write_result(result, task.key, task.result)


def drive(
    header: DriveHeader,
    items: Iterable[DriveItem],
    base: BaseMap,
    voxels: VoxelRows,
    task: VehicleTask,
    labels: MoverLabels | None = None,
) -> VehicleResult:
    """Run the vehicle over the measurements of one drive.

    Args:
        header: of the drive.
        items: in time order, from the simulation or from a recording: the result is the same.
        base: the map it starts with.
        voxels: the truth's voxels, about which evidence is kept for the analysis of errors.
        task: sensor, poses, parameters.
        labels: which points lie on movers, for the account of how many were found; a recording has none.

    Raises:
        VehicleError: the drive has no GNSS fix.
    """
    started_s, outbox = process_time(), ReportList()
    run = _VehicleRun(header, items, base, outbox, task, labels)
    run.to_the_end()
    reports = sorted(outbox.reports, key=lambda report: report.report_id)
    row, evidence = voxels.columns(run.detector.taken, lambda found: evidence_columns(found, task.method))
    pcd, pcd_bytes = run.pcd_report()
    stats = run.stats() | {"pcd_bytes": pcd_bytes, "cpu_s": round(process_time() - started_s, 2)}
    bodies, packed = tuple(report.body for report in reports), tuple(report.packed for report in reports)
    return VehicleResult(task.drive.vehicle, task.sensor, bodies, row, evidence, stats, pcd, packed)


class _VehicleRun:
    """A pipeline with the base map at hand, and what the study writes down beside it."""

    def __init__(
        self,
        header: DriveHeader,
        items: Iterable[DriveItem],
        base: BaseMap,
        outbox: ReportList,
        task: VehicleTask,
        labels: MoverLabels | None,
    ) -> None:
        (fix, self._items), method = first_fix(items, task.key), task.method
        self._labels = labels
        self._cloud: CloudVehicle | None = None
        self.detector: RecordingDetector
        self._pipeline = Pipeline(
            header,
            fix,
            lambda local_map, touched: TilesAtHand(base, local_map, touched),
            PipelineParameters(method.localise, method.segment, method.detect, method.report),
            identity=Identity(header.vehicle, header.drive_id, header.sensor_model, "ndt", "gnd reproduce simulation"),
            outbox=outbox,
            parts=Parts(
                localisation=_localisation(header, task),
                detector=self._recording,
                statement=statement_on_lattice if task.rounded else tile_change,
                watch=(self._see,),
            ),
        )
        grid_frame = self._pipeline.local_map.grid_frame
        self._cloud = CloudVehicle(read_cloud(task.cloud), grid_frame.frame) if task.cloud else None
        self._estimates: list[PoseEstimate] = []
        self._reference: list[ReferencePose] = []
        self._T_map_anchor = grid_frame.frame.T_self_other(header.anchor)

    def to_the_end(self) -> None:
        """Feed the pipeline; true poses go in too, for the localisation that goes by them."""
        for item in self._items:
            if isinstance(item, ReferencePose):
                self._reference.append(item)
            self._estimates += self._pipeline.push(item).poses
        self._estimates += self._pipeline.finish().poses

    def _recording(self, local_map: LocalMap, parameters: DetectParameters) -> RecordingDetector:
        self.detector = RecordingDetector(local_map, parameters)
        self.detector.taken = []
        return self.detector

    def _see(self, segmented: SegmentedScan) -> None:
        if self._labels is not None:
            self._labels.compare(segmented)
        if self._cloud is not None:
            self._cloud.add_scan(segmented)

    def pcd_report(self) -> tuple[PcdReport | None, Mapping[str, int]]:
        """What the point-cloud baseline uploads, and its size by codec; nothing without it."""
        return (None, {}) if self._cloud is None else self._cloud.report()

    def stats(self) -> dict[str, Any]:
        """Counts of the drive and errors of its poses."""
        counts = self._pipeline.reporter.counts
        names = ("scans_used", "scans_uncertain", "points", "moving_points", "rays", "changed_voxels", "reports")
        found: dict[str, Any] = {"scans": self._pipeline.scans, **{name: counts[name] for name in names}}
        found["way_m"] = round(self._pipeline.place.odometer_m, 2)
        found["classes"] = dict(self._pipeline.reporter.classes)
        found["poses"] = self._pose_errors()
        found["segmentation"] = dict(self._labels.counts) if self._labels else {}
        return found

    def _pose_errors(self) -> dict[str, float] | None:
        t_ns = np.array([pose.t_ns for pose in self._reference], np.int64)
        T = self._T_map_anchor @ np.stack([pose.T_map_vehicle for pose in self._reference])
        try:
            return {k: round(v, 5) for k, v in asdict(localisation_error(self._estimates, Trajectory(t_ns, T))).items()}
        except LocaliseError:
            return None


def _localisation(header: DriveHeader, task: VehicleTask) -> Callable[[LocalMap], Localisation] | None:
    """The poses of the reference, or None for the vehicle's own localiser."""
    if task.poses.kind == "estimated":
        return None
    return lambda local_map: FromReference(header, local_map, task.poses, task.drive.seed)
