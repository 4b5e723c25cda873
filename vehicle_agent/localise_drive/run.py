"""One recorded drive through the localiser: what it made of every scan, online and refined."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import DriveHeader, DriveItem, DriveTrack, GnssFix, GnssTrack
from gnd.schemas.drive_mcap import drive_counts, load_track, read_drive, read_header
from gnd.schemas.errors import SchemaError
from gnd.vehicle_agent.config import DownloadParameters, PipelineParameters
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.calibration import MotionCalibration
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise_drive.tiles import StoreMap
from gnd.vehicle_agent.pipeline import Pipeline
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand

DRIVE_ENDING: Final = ".mcap"

Progress = Callable[[int, int], None]
"""Called with the scans done and the scans in all."""


@dataclass(frozen=True, slots=True)
class Moment:
    """How it stood with the online pose at one scan, or when it changed between scans."""

    t_ns: int
    """Start of the sweep, or when it changed."""
    way_m: float
    """Driven since the recording's start, by the wheels."""
    health: Health
    cause: Cause
    degenerate: tuple[str, ...] = ()
    of_scan: bool = True
    """False: between scans, such as when they stop coming."""


@dataclass(frozen=True, slots=True, eq=False)
class DriveTotals:
    """What happened on the way."""

    scans: int
    bad: dict[str, int]
    """Items that could not be used, by their state."""
    dropped: int
    """Scans without a final pose, as the localiser counts them."""
    initialisations: int
    speed_scale: float
    yaw_bias_radps: float
    wall_s: float
    finished: bool
    """False: it was stopped, or the recording is damaged."""
    damage: str = ""
    calibration: MotionCalibration | None = None
    nis: float | None = None
    """Of matches against the prediction, over degrees of freedom; None without any."""
    points_travelling_along: int = 0
    """Sampled points that were left out because they keep their place relative to the vehicle."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalisedDrive:
    """A drive on the map. All poses are T_map_vehicle; map = ENU at the drive's own anchor, as its reference is."""

    header: DriveHeader
    refined: tuple[PoseEstimate, ...]
    online: tuple[PoseEstimate, ...]
    moments: tuple[Moment, ...]
    reference: Trajectory | None
    gnss: GnssTrack
    used: Mapping[TileId, int]
    """Tiles and their versions."""
    absent: frozenset[TileId]
    counts: DriveTotals

    @property
    def start_ns(self) -> int:
        """Start of the first scan; 0 without scans."""
        return self.moments[0].t_ns if self.moments else 0


def localise_drive(
    path: Path,
    tiles: StoreMap,
    parameters: LocaliserParameters | None = None,
    *,
    progress: Progress | None = None,
    stop: threading.Event | None = None,
) -> LocalisedDrive:
    """Localise one drive; memory holds the tiles around the vehicle and the poses, whatever its length.

    A recording that turns out to be damaged on the way, and `stop`, end it there: what was found is returned.

    Raises:
        LocaliseError: `path` is no drive of ours, has no scan or no GNSS fix, or the map has no tiles there.
        DriveError: the recording cannot be read at all.
        StoreError: the store cannot be read.
    """
    check_is_drive(path)
    header, track, total = read_header(path), load_track(path), drive_counts(path).scans
    if not total:
        raise LocaliseError(f"{path} has no scans: there is nothing to localise")
    if not len(track.gnss.t_ns):
        raise LocaliseError(f"{path} has no GNSS fix: nothing says where on the map to begin")
    tiles.check_covers(track.gnss.lat_rad, track.gnss.lon_rad, DownloadParameters().near_m)
    fix, items = first_fix(read_drive(path), path)
    run = _LocaliseRun(header, fix, tiles, parameters or LocaliserParameters())
    run.to_the_end(items, lambda done: progress(done, total) if progress else None, stop)
    return run.result(track)


def check_is_drive(path: Path) -> None:
    """Refuse what has to be imported first.

    Raises:
        LocaliseError: a folder, or a file that is no MCAP.
    """
    if path.is_dir() or (path.exists() and path.suffix != DRIVE_ENDING):
        what = "a folder" if path.is_dir() else "no MCAP file"
        raise LocaliseError(
            f"{path} is {what}, a drive is one MCAP file of ours: turn a recording into one with"
            f" `gnd import auto {path} -o {path.stem or 'drive'}{DRIVE_ENDING}`"
        )


@dataclass(slots=True)
class _Record:
    """What is kept of a run."""

    refined: list[PoseEstimate] = field(default_factory=list)
    online: list[PoseEstimate] = field(default_factory=list)
    moments: list[Moment] = field(default_factory=list)
    waiting: tuple[int, float] | None = None
    """Time and way of the newest scan, whose moment is not yet known."""


class _LocaliseRun:
    """A pipeline that only localises, and what is kept of it."""

    def __init__(self, header: DriveHeader, fix: GnssFix, tiles: StoreMap, parameters: LocaliserParameters) -> None:
        self._header = header
        self._pipeline = Pipeline(
            header,
            fix,
            lambda local_map, touched: TilesAtHand(tiles, local_map, touched),
            PipelineParameters(localise=parameters),
        )
        self._T_anchor_map = header.anchor.T_self_other(self._pipeline.place.frame)
        self._record = _Record()
        self._finished, self._damage = False, ""
        self._started_s = time.monotonic()
        self._wall_s = 0.0

    def to_the_end(
        self, items: Iterable[DriveItem], scanned: Callable[[int], None], stop: threading.Event | None
    ) -> None:
        """Feed everything until the end, `stop`, or the damaged part of a recording."""
        try:
            for item in items:
                if stop is not None and stop.is_set():
                    break
                self._take(item)
                scanned(self._pipeline.scans)
            else:
                self._finished = True
        except SchemaError as damage:
            self._damage = str(damage)
        self._keep(self._pipeline.finish().poses)
        self._settle()
        self._note_end()
        self._wall_s = time.monotonic() - self._started_s

    def _take(self, item: DriveItem) -> None:
        scans = self._pipeline.scans
        self._keep(self._pipeline.push(item).poses)
        self._note_online()
        if self._pipeline.scans > scans:
            self._settle()
            self._record.waiting = (item.t_ns, self._pipeline.place.odometer_m)
        self._note_online()
        self._note_change(item.t_ns)

    def _keep(self, poses: Iterable[PoseEstimate]) -> None:
        self._record.refined += [self._anchored(pose) for pose in poses]

    def _note_online(self) -> None:
        online, kept = self._pipeline.localisation.online, self._record.online
        if online is not None and (not kept or online.t_ns > kept[-1].t_ns):
            kept.append(self._anchored(online))
        waiting = self._record.waiting
        if waiting is not None and online is not None and online.t_ns >= waiting[0]:
            self._settle()

    def _note_change(self, t_ns: int) -> None:
        """Note what has changed since the newest scan without another one."""
        moments = self._record.moments
        if self._record.waiting is None and moments:
            health, cause = self._pipeline.localisation.state
            if (health, cause) != (moments[-1].health, moments[-1].cause):
                moments.append(Moment(t_ns, self._pipeline.place.odometer_m, health, cause, of_scan=False))

    def _note_end(self) -> None:
        """A state in which no scan came lasts until the recording ends."""
        moments = self._record.moments
        if moments and not moments[-1].of_scan and self._pipeline.place.t_ns > moments[-1].t_ns:
            moments.append(replace(moments[-1], t_ns=self._pipeline.place.t_ns, way_m=self._pipeline.place.odometer_m))

    def _settle(self) -> None:
        """The newest scan was worked on, or will not be: note how it stands."""
        if self._record.waiting is None:
            return
        (t_ns, way_m), self._record.waiting = self._record.waiting, None
        self._record.moments.append(self._moment(t_ns, way_m))

    def _moment(self, t_ns: int, way_m: float) -> Moment:
        online, (health, cause) = self._pipeline.localisation.online, self._pipeline.localisation.state
        matched = online is not None and online.t_ns >= t_ns
        return Moment(t_ns, way_m, health, cause, online.degenerate if online is not None and matched else ())

    def _anchored(self, estimate: PoseEstimate) -> PoseEstimate:
        return replace(estimate, T_map_vehicle=self._T_anchor_map @ estimate.T_map_vehicle)

    def result(self, track: DriveTrack) -> LocalisedDrive:
        """What was found."""
        record = self._record
        return LocalisedDrive(
            header=self._header,
            refined=tuple(_in_order(record.refined)),
            online=tuple(estimate for estimate in record.online if estimate.health != "lost"),
            moments=tuple(record.moments),
            reference=_reference(track),
            gnss=track.gnss,
            used=dict(self._pipeline.tiles.used),
            absent=frozenset(self._pipeline.tiles.absent),
            counts=self._counts(),
        )

    def _counts(self) -> DriveTotals:
        localiser, bad = self._pipeline.localiser, dict(self._pipeline.guard.bad)
        return DriveTotals(
            scans=self._pipeline.scans,
            bad=bad,
            dropped=localiser.dropped_scans,
            initialisations=localiser.initialisations,
            speed_scale=float(localiser.speed_scale),
            yaw_bias_radps=float(localiser.yaw_bias_radps),
            wall_s=self._wall_s,
            finished=self._finished,
            damage=self._damage,
            calibration=localiser.calibration,
            nis=localiser.innovations.mean,
            points_travelling_along=localiser.points_travelling_along,
        )


def _in_order(estimates: list[PoseEstimate]) -> Iterator[PoseEstimate]:
    """By time, one a time."""
    newest_ns = -1
    for estimate in sorted(estimates, key=lambda e: e.t_ns):
        if estimate.t_ns > newest_ns:
            newest_ns = estimate.t_ns
            yield estimate


def _reference(track: DriveTrack) -> Trajectory | None:
    """The reference, when there is one to interpolate."""
    t_ns, T = track.reference
    later = np.ones(len(t_ns), np.bool_)
    later[1:] = t_ns[1:] > np.maximum.accumulate(t_ns)[:-1]
    return Trajectory(t_ns[later], T[later]) if later.sum() >= 2 else None


def trajectory_of(estimates: Iterable[PoseEstimate]) -> Trajectory:
    """The estimates as one trajectory; they are in order of time."""
    kept = list(estimates)
    T: F64 = np.stack([e.T_map_vehicle for e in kept]) if kept else np.empty((0, 4, 4))
    return Trajectory(np.array([e.t_ns for e in kept], np.int64), T)
