"""The vehicle as one object: measurements go in, poses and reports come out (GND, Figure 1).

    pipeline = Pipeline(header, fix, tiles, outbox=outbox, identity=identity)
    for item in source:
        output = pipeline.push(item)
    output = pipeline.finish()

No file, no bus, no thread and no clock is in it: tiles come from a `Tiles`, reports go to a `ReportSink`, time is that
of the items. The agent, `gnd localise`, the studies, the tests and the API drive the same object.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import TileChange
from gnd.schemas.course import Course
from gnd.schemas.drive import Detections, DriveHeader, DriveItem, GnssFix, ReferencePose, Scan
from gnd.schemas.sweep_distortion import distortion_of
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.detect.classify import Classification
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.local_map import LocalMap, Touched
from gnd.vehicle_agent.localise.calibration import MotionCalibration
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate, RefinedScan
from gnd.vehicle_agent.localise.localiser import Localiser
from gnd.vehicle_agent.localise.remount import header_sigma
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.report.reporter import Identity, Reporter, statement_on_lattice
from gnd.vehicle_agent.report.sink import NewReports, OutgoingReport, ReportList, ReportSink
from gnd.vehicle_agent.result import HealthTimeline
from gnd.vehicle_agent.scans import Guard
from gnd.vehicle_agent.segment.segmenter import MotionSegmenter, SegmentedScan
from gnd.vehicle_agent.survey.surveyor import Surveyor
from gnd.vehicle_agent.waiting import ScanRoom

if TYPE_CHECKING:
    from gnd.vehicle_agent.features.layers import FeatureLayers

KNOWN_COURSE_RAD = 2e-3
_ROOM_MS: Final = 50.0
"""With one scan, for what is not done with every scan, and for all that can wait."""
_WINDOW_MS: Final = 20.0
"""To make the window of a map that has changed, and what is derived of it."""
_SEGMENTED_A_MS: Final = 15_000.0
"""Rays."""
COUNTS = (
    "scans_used", "scans_uncertain", "scans_disagreeing", "scans_shifted", "scans_taken_back", "points",
    "moving_points", "rays", "changed_voxels", "tiles_doubtful", "tiles_held_back", "changes_held_back",
    "voxels_beyond_map",
)  # fmt: skip
"""What the reporter counts, as `account` names it."""


class Tiles(Protocol):
    """Keeps the local map in step with the vehicle: tiles that are near are held, those far behind are let go."""

    def follow(self, place: Place) -> None:
        """Called before each scan."""


class FeatureTiles(Protocol):
    """Brings the tiles of feature layers around and ahead."""

    def follow(self, place: Place) -> Iterable[tuple[str, FeatureTile]]:
        """Called before each scan; gives layers and tiles of which a new version has come."""


class Localisation(Protocol):
    """Turns measurements into scans with final poses; `Localiser` does, and what a study puts in its place."""

    @property
    def online(self) -> PoseEstimate | None:
        """The newest pose."""

    @property
    def state(self) -> tuple[Health, Cause]:
        """Health and cause now."""

    def push(self, item: DriveItem) -> Iterable[RefinedScan]:
        """Take the next measurement; gives the scans whose poses have become final, to be used up before the next."""

    def flush(self) -> Iterable[RefinedScan]:
        """The drive has ended: gives the scans that are still held."""


@dataclass(frozen=True, slots=True)
class Parts:
    """Parts that a study replaces to measure what another one would do; the product leaves them as they are, and only
    listens to what is `placed`.

    Attributes:
        localisation: made for a local map; None: the localiser of this vehicle.
        detector: made for a local map.
        statement: makes the content of a report about a tile.
        placed: each is called with every scan whose pose has become final.
        watch: each is called with every scan that is judged.
    """

    localisation: Callable[[LocalMap], Localisation] | None = None
    detector: Callable[[LocalMap, DetectParameters], ChangeDetector] = ChangeDetector
    statement: Callable[[Classification], TileChange] = statement_on_lattice
    placed: tuple[Callable[[RefinedScan], object], ...] = ()
    watch: tuple[Callable[[SegmentedScan], object], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Output:
    """The results of one measurement.

    Attributes:
        poses: that have become final, T_map_vehicle, oldest first; some seconds behind the scans.
        reports: that were decided.
        online: newest pose; None before the first.
        health, cause: of it.
    """

    poses: tuple[PoseEstimate, ...]
    reports: tuple[OutgoingReport, ...]
    online: PoseEstimate | None
    health: Health
    cause: Cause


@dataclass(frozen=True, slots=True)
class HeldBack:
    """What is not reported because a pose may be wrong, so far.

    Attributes:
        scans: taken back or shifted.
        tiles: held back.
        doubtful: tiles that are reported as doubtful.
        reasons: tiles by reason of doubt.
    """

    scans: int = 0
    tiles: int = 0
    doubtful: int = 0
    reasons: Counter[str] = field(default_factory=Counter)


class VehiclePipeline(Protocol):
    """What an agent feeds: a `Pipeline`, or for a vehicle without LiDAR a `CameraPipeline` or `GraphPipeline`."""

    place: Place
    guard: Guard

    def push(self, item: DriveItem) -> Output:
        """Take the next measurement."""

    def finish(self) -> Output:
        """The drive has ended."""

    @property
    def held_back(self) -> HeldBack:
        """What is not reported because a pose may be wrong."""

    def tile(self, tile_id: TileId) -> Tile | None:
        """The tile of the voxel map that is held."""

    def account(self) -> dict[str, Any]:
        """The results of the drive, as plain values."""


TilesT = TypeVar("TilesT", bound=Tiles)


class Pipeline(Generic[TilesT]):
    """One drive of one vehicle. Poses are in the map frame: ENU at the tile of the first position.

    Args:
        header: sensor, mount, and what is known of the sweeps.
        fix: the first position, which lays the map frame.
        tiles: makes what brings the tiles, from the local map that it is to fill and whether a tile is `Touched`.
        parameters: of localisation, segmentation, detection, reports and feature layers.
        identity: who reports; None: the vehicle only localises.
        outbox: where reports go; None: nowhere but into the `Output`.
        feature_tiles: brings the map's feature layers; None: there are none.
        local_map: one that is filled already; its frame is the map frame then.
        parts: what a study replaces.

    Attributes:
        place: where the vehicle is, as well as it knows.
        local_map: the tiles that are held.
        guard: what could not be used, by its state.
        timeline: when the health changed.
        scans: usable ones so far.
        surveyor: maps roads that the map does not have; None where the vehicle only localises.
    """

    def __init__(
        self,
        header: DriveHeader,
        fix: GnssFix,
        tiles: Callable[[LocalMap, Touched], TilesT],
        parameters: PipelineParameters | None = None,
        *,
        identity: Identity | None = None,
        outbox: ReportSink | None = None,
        feature_tiles: FeatureTiles | None = None,
        local_map: LocalMap | None = None,
        parts: Parts | None = None,
    ) -> None:
        self.parameters, parts = parameters or PipelineParameters(), parts or Parts()
        start = TileId.from_geodetic(fix.lat_rad, fix.lon_rad)
        self.local_map = local_map or LocalMap(GridFrame.around(LocalFrame.of_tile(start), [start]))
        self.place = Place(self.local_map.grid_frame.frame, fix)
        self.guard, self.timeline, self.scans = Guard(), HealthTimeline(), 0
        self.localisation: Localisation
        if parts.localisation is None:
            self.localisation = Localiser(
                self.local_map,
                header.T_vehicle_lidar,
                self.parameters.localise,
                distortion_of(header),
                header_sigma(header),
            )
        else:
            self.localisation = parts.localisation(self.local_map)
        self._new_reports = NewReports(ReportList() if outbox is None else outbox)
        self.change: ChangeDetection | None = None
        if identity is not None:
            self.change = ChangeDetection.of(
                self.local_map, self.parameters, identity, self._new_reports, fix.t_ns, self.course, parts
            )
        touched: Touched = (lambda _: False) if self.change is None else self.change.detector.touched
        self.tiles = tiles(self.local_map, touched)
        self.layers = self._feature_layers(identity, fix.t_ns)
        self.surveyor: Surveyor | None = None
        if identity is not None and isinstance(self.localisation, Localiser):
            mount, segment = header.T_vehicle_lidar, self.parameters.segment
            self.surveyor = Surveyor(mount, self.local_map, self.localisation, segment, identity, self._new_reports)
        self._feature_tiles, self._placed = feature_tiles, parts.placed
        self._generation = 0  # of the local map with the scan before

    def push(self, item: DriveItem) -> Output:
        """Take the next measurement; items come in time order. One that cannot be used is counted and left out."""
        if not self.guard.admits(item):
            return self._output([])
        if isinstance(item, Scan):
            self.scans += 1
            self._follow()  # position -> the tiles around and ahead, and what others changed
        if isinstance(item, Detections) and self.layers is not None:
            self.layers.wait(item)  # what a camera detects waits for its pose
        poses: list[PoseEstimate] = []
        placed = self.localisation.push(item)  # measurements + tiles -> scans with final poses
        room = self._room()
        for refined in placed:
            self._take_pose(refined, poses)
            if self.change is not None:
                room.takes(len(refined) / _SEGMENTED_A_MS, must=True)
                for scan in self.change.segmenter.push(refined):  # rays against rays of other scans -> which move
                    self.change.take(scan)
                    self._judge(scan)  # observations + feature tiles -> what exists, is gone, is new -> reports
        if self.change is not None and isinstance(item, Scan):
            # rays + tiles -> evidence and new Gaussians -> classes of tiles that were left -> reports
            self.change.go_on(self.place.odometer_m, room)
        self._note(item)
        if self.surveyor is not None:
            self.surveyor.push(item, self.place)  # where the map has no road: scans -> submaps -> surveys
        return self._output(poses)

    def finish(self) -> Output:
        """The drive has ended: judge the scans that wait in the lags, decide and report everything."""
        poses: list[PoseEstimate] = []
        for scan in self._rest(poses):
            if self.change is not None:
                self.change.take(scan)
                self.change.reporter.go_on()
                self._judge(scan)
        if self.change is not None:
            self.change.reporter.report_all(self.place.odometer_m)
        if self.layers is not None:
            self.layers.finish()
        if self.surveyor is not None:
            self.surveyor.finish()
        return self._output(poses)

    @property
    def reporter(self) -> Reporter:
        """What decides the tiles and makes the reports.

        Raises:
            TypeError: this pipeline only localises.
        """
        if self.change is None:
            raise TypeError("this pipeline only localises: it was made without an identity")
        return self.change.reporter

    @property
    def localiser(self) -> Localiser:
        """The vehicle's own localiser.

        Raises:
            TypeError: a study has put something else in its place.
        """
        if not isinstance(self.localisation, Localiser):
            raise TypeError(f"this pipeline localises by {type(self.localisation).__name__}, not by its own localiser")
        return self.localisation

    def start_at(self, t_ns: int, T_map_vehicle: F64, *, trusted: bool = False) -> None:
        """Take a pose (4, 4) from outside; see `Localiser.start_at`."""
        self.localiser.start_at(t_ns, T_map_vehicle, trusted=trusted)

    def course(self) -> Course | None:
        """Where the vehicle drives in its own frame, for reports; None while it is not known well."""
        if not isinstance(self.localisation, Localiser):
            return None
        return known_course(self.localisation.calibration)

    @property
    def held_back(self) -> HeldBack:
        """What is not reported because a pose may be wrong."""
        counts, reasons = self.reporter.counts, self.reporter.doubts
        scans = counts["scans_shifted"] + counts["scans_taken_back"]
        return HeldBack(scans, counts["tiles_held_back"], counts["tiles_doubtful"], reasons)

    def tile(self, tile_id: TileId) -> Tile | None:
        """The tile that is held."""
        return self.local_map.tile(tile_id)

    def account(self) -> dict[str, Any]:
        """The results of the drive, as plain values."""
        reporter, localiser = self.reporter, self.localiser
        return {
            "scans": self.scans,
            "scans_dropped": localiser.dropped_scans,
            **{name: reporter.counts[name] for name in COUNTS},
            "classes": dict(reporter.classes),
            "doubts": reporter.account(),
            "layers": {} if self.layers is None else self.layers.account(),
            "looks": {} if self.layers is None else dict(self.layers.counts),
            "health": self.timeline.as_json(),
            "nis": localiser.innovations.mean,
            "points_travelling_along": localiser.points_travelling_along,
            "calibration": localiser.calibration.as_json(),
            "surveys": {} if self.surveyor is None else self.surveyor.account(),
        }

    def _room(self) -> ScanRoom:
        """What is left after that which was done with the newest scan already, and is not done with every scan."""
        used_ms = self.localisation.seldom_ms if isinstance(self.localisation, Localiser) else 0.0
        if self._generation != self.local_map.generation:
            self._generation = self.local_map.generation
            used_ms += _WINDOW_MS
        return ScanRoom(_ROOM_MS - used_ms)

    def _follow(self) -> None:
        self.tiles.follow(self.place)
        if self.layers is not None and self._feature_tiles is not None:
            for layer, tile in self._feature_tiles.follow(self.place):
                self.layers.hold(layer, tile)

    def _rest(self, poses: list[PoseEstimate]) -> Iterator[SegmentedScan]:
        """The scans that wait in the lags of localisation and segmentation; `poses` gets theirs."""
        for refined in self.localisation.flush():
            self._take_pose(refined, poses)
            if self.change is not None:
                yield from self.change.segmenter.push(refined)
        if self.change is not None:
            yield from self.change.segmenter.flush()

    def _take_pose(self, scan: RefinedScan, poses: list[PoseEstimate]) -> None:
        poses.append(scan.estimate)
        if self.surveyor is not None:
            self.surveyor.take_final(scan.estimate)
        for placed in self._placed:
            placed(scan)

    def _judge(self, scan: SegmentedScan) -> None:
        """Judge the features in view of a scan; a district left behind is reported."""
        if self.layers is not None and self.change is not None:
            self.layers.doubt(self.change.reporter.take_shifted())
            self.layers.take(scan, self.place.odometer_m)

    def _note(self, item: DriveItem) -> None:
        """Keep the books on place and health; where a pose turns out to be wrong, take back what rests on it."""
        if isinstance(item, ReferencePose):
            return  # nothing that a vehicle has
        self.place.take(item, self.localisation.online)
        if self.timeline.note(item.t_ns, self.place.health):
            if self.change is not None:
                self.change.reporter.take_back(item.t_ns)  # since when it was wrong is not known
            if self.layers is not None:
                self.layers.take_back()

    def _output(self, poses: list[PoseEstimate]) -> Output:
        return Output(tuple(poses), self._new_reports.take(), self.localisation.online, *self.localisation.state)

    def _feature_layers(self, identity: Identity | None, start_ns: int) -> "FeatureLayers | None":
        """The feature layers' part; a vehicle that knows voxels only does not even load it."""
        if identity is None or not self.parameters.features.layers:
            return None
        from gnd.vehicle_agent.features.layers import FeatureLayers
        from gnd.vehicle_agent.report.feature_report import FeatureReporter

        longest_m = self.parameters.report.unchanged_m
        reporters = [
            FeatureReporter(self._new_reports, replace(identity, layer=layer.name), start_ns, longest_m)
            for layer in self.parameters.features.layers
        ]
        return FeatureLayers(self.parameters.features, self.parameters.report, self.place.frame, reporters)


@dataclass(slots=True)
class ChangeDetection:
    """What follows localisation where a vehicle reports: points that move, voxels that have changed, reports.

    Attributes:
        newest: final pose, of the scans that were taken.
    """

    segmenter: MotionSegmenter
    detector: ChangeDetector
    reporter: Reporter
    watch: tuple[Callable[[SegmentedScan], object], ...]
    newest: PoseEstimate | None = None

    @classmethod
    def of(
        cls,
        local_map: LocalMap,
        parameters: PipelineParameters,
        identity: Identity,
        outbox: ReportSink,
        start_ns: int,
        course: Callable[[], Course | None],
        parts: Parts,
    ) -> "ChangeDetection":
        """Put the parts together."""
        detector = parts.detector(local_map, parameters.detect)
        reporter = Reporter(detector, outbox, identity, start_ns, parameters.report, course, parts.statement)
        return cls(MotionSegmenter(parameters.segment), detector, reporter, parts.watch)

    def take(self, scan: SegmentedScan) -> None:
        """Take a scan whose pose is final and whose movers are known; its rays are counted later."""
        for watch in self.watch:
            watch(scan)
        self.newest = scan.scan.estimate
        self.reporter.take(scan)

    def go_on(self, odometer_m: float, room: ScanRoom) -> None:
        """As far as there is room: decide the tiles that the newest pose has left behind, report what has waited long
        enough, test poses, and count the rays of scans that have stood the test.
        """
        if self.newest is not None:
            self.reporter.leave_behind(self.newest, odometer_m, room)
        self.reporter.go_on(room)


def known_course(known: MotionCalibration) -> Course | None:
    """The course for reports; None while it is not known well."""
    return Course.of(known.course_rad, known.course_sigma_rad) if known.course_sigma_rad < KNOWN_COURSE_RAD else None
