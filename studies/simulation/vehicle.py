"""One vehicle from measurements to uploads, in one process: localise, segment, detect, report, as the agent does."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import TileChange
from gnd.schemas.drive import DriveHeader, DriveItem, ReferencePose, Scan
from gnd.vehicle_agent.detect.classify import Classification, tile_change
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import PoseEstimate, localisation_error
from gnd.vehicle_agent.outbox import Outbox
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.report import Identity, Reporter
from gnd.vehicle_agent.scans import Guard
from gnd.vehicle_agent.segment import MotionSegmenter, SegmentedScan
from studies.frame.pool import Tick
from studies.simulation.base_map import BaseMap, read_base
from studies.simulation.baseline import CloudVehicle, read_cloud
from studies.simulation.held_tiles import HeldTiles
from studies.simulation.masses import Watch, Watcher
from studies.simulation.options import MethodParameters, PoseSource
from studies.simulation.poses import FromReference, Localisation, Localising
from studies.simulation.result import (
    MoverLabels,
    RecordingDetector,
    VehicleResult,
    VoxelRows,
    evidence_columns,
    write_result,
)
from studies.simulation.streams import as_recorded, first_fix, recorded, ticking

_ALL_LETTERS = 1_000_000


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
        watch: voxels to write down scan by scan.
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
    watch: Watch | None = None
    recording: Path | None = None
    cloud: Path | None = None
    rounded: bool = True


class MeasuredReporter(Reporter):
    """The reporter, without the lattice: what it says is as it was measured."""

    def _said(self, found: Classification) -> TileChange:
        return tile_change(found)


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
        ReproduceError: the drive has no GNSS fix.
    """
    started_s = process_time()
    with TemporaryDirectory() as folder:
        outbox = Outbox(Path(folder) / "outbox.sqlite")
        try:
            run = _Run(header, items, base, outbox, task, labels)
            run.to_the_end()
            letters = outbox.due(2**62, _ALL_LETTERS)
        finally:
            outbox.close()
    row, evidence = voxels.columns(run.detector.taken, lambda found: evidence_columns(found, task.method))
    pcd, pcd_bytes = run.pcd_report()
    stats = run.stats() | {"pcd_bytes": pcd_bytes, "cpu_s": round(process_time() - started_s, 2)}
    reports, packed = tuple(letter.body for letter in letters), tuple(letter.packed for letter in letters)
    return VehicleResult(task.drive.vehicle, task.sensor, reports, row, evidence, stats, run.watched(), pcd, packed)


class _Run:
    """The parts of one vehicle, put together as `gnd.vehicle_agent.vehicle` does."""

    def __init__(
        self,
        header: DriveHeader,
        items: Iterable[DriveItem],
        base: BaseMap,
        outbox: Outbox,
        task: VehicleTask,
        labels: MoverLabels | None,
    ) -> None:
        fix, self._items = first_fix(iter(items))
        start = TileId.from_geodetic(fix.lat_rad, fix.lon_rad)
        frame, method = LocalFrame.of_tile(start), task.method
        local_map = LocalMap(GridFrame.around(frame, [start]))
        self.detector = RecordingDetector(local_map, method.detect)
        self.detector.taken = []
        self._held = HeldTiles(base, local_map, self.detector)
        self._place = Place(frame, fix)
        self._guard = Guard()
        self._localisation = _localisation(header, local_map, task)
        self._segmenter = MotionSegmenter(method.segment)
        who = Identity(header.vehicle, header.drive_id, header.sensor_model, "ndt", "gnd reproduce simulation")
        reporter = Reporter if task.rounded else MeasuredReporter
        self._reporter = reporter(self.detector, outbox, who, fix.t_ns, method.report)
        self._watcher = Watcher(task.watch, base, local_map.grid_frame, method.detect) if task.watch else None
        self._cloud = CloudVehicle(read_cloud(task.cloud), frame) if task.cloud else None
        self._labels = labels
        self._estimates: list[PoseEstimate] = []
        self._reference: list[ReferencePose] = []
        self._T_map_anchor = frame.T_self_other(header.anchor)
        self._counts: Counter[str] = Counter()

    def to_the_end(self) -> None:
        """The loop of `gnd.vehicle_agent.agent`, with the base map at hand and the outbox as the end."""
        for item in self._guard.usable(self._items):
            if isinstance(item, ReferencePose):
                self._reference.append(item)
            if isinstance(item, Scan):
                self._counts["scans"] += 1
                self._held.follow(self._place)
            for refined in self._localisation.push(item):
                for scan in self._segmenter.push(refined):
                    self._detect(scan)
            self._place.take(item, self._localisation.online)
        for scan in self._rest():
            self._detect(scan)
        self._reporter.report_all(self._place.odometer_m)

    def _rest(self) -> Iterator[SegmentedScan]:
        for refined in self._localisation.flush():
            yield from self._segmenter.push(refined)
        yield from self._segmenter.flush()

    def _detect(self, segmented: SegmentedScan) -> None:
        self._estimates.append(segmented.scan.estimate)
        self._reporter.add_scan(segmented)
        if self._labels is not None:
            self._labels.compare(segmented)
        if self._watcher is not None:
            self._watcher.add_scan(segmented)
        if self._cloud is not None:
            self._cloud.add_scan(segmented)
        self._reporter.leave_behind(segmented.scan.estimate, self._place.odometer_m)

    def watched(self) -> tuple[Any, Any]:
        """What the watcher saw, empty without one."""
        if self._watcher is None:
            return np.zeros(0, np.int64), np.zeros((0, 0, 4), np.int32)
        return self._watcher.history()

    def pcd_report(self) -> tuple[bytes, Mapping[str, int]]:
        """What the point-cloud baseline uploads, and its size by codec; nothing without it."""
        return (b"", {}) if self._cloud is None else self._cloud.report()

    def stats(self) -> dict[str, Any]:
        """Counts of the drive and errors of its poses."""
        counts = self._reporter.counts
        names = ("scans_used", "scans_uncertain", "points", "moving_points", "rays", "changed_voxels", "reports")
        found: dict[str, Any] = {"scans": self._counts["scans"], **{name: counts[name] for name in names}}
        found["way_m"] = round(self._place.odometer_m, 2)
        found["classes"] = dict(self._reporter.classes)
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


def _localisation(header: DriveHeader, local_map: LocalMap, task: VehicleTask) -> Localisation:
    if task.poses.kind == "estimated":
        return Localising(header, local_map, task.method.localise)
    return FromReference(header, local_map, task.poses, task.drive.seed)
