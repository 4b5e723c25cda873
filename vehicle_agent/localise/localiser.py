"""The localiser: finds the first pose, follows it, gives it up; poses are final when the lag has passed (GND, 3 (ii)).

While the pose is known, `TrackedPose` follows it scan by scan; what outlives a track is a `DriveState`.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.schemas.drive import DriveItem, GnssFix, MotionSample, MountSigma, Scan
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.calibration import MotionCalibration
from gnd.vehicle_agent.localise.consistency import Innovations
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate, RefinedScan
from gnd.vehicle_agent.localise.first_pose import FirstPose, SearchPlace
from gnd.vehicle_agent.localise.initialise import INITIALISE_RADIUS_SIGMAS
from gnd.vehicle_agent.localise.mount import near_points
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.registration import RegistrationResult
from gnd.vehicle_agent.localise.remount import TRUSTED, Mounting
from gnd.vehicle_agent.localise.sampling import sample_scan
from gnd.vehicle_agent.localise.sweep import Distortion, SampledScan, end_ns, reference_ns
from gnd.vehicle_agent.localise.tracked_pose import MAX_GNSS_AGE_NS, DriveState, FinalScan, TrackedPose
from gnd.vehicle_agent.waiting import next_few

_LOST_GAP_S: Final = 15.0
"""After so long without scans it is lost."""
_OUTSIDE_M: Final = 0.1
_OUTSIDE_RAD: Final = 0.01
"""One sigma of a pose from outside."""
_PAST_NS: Final = 1_000_000_000
_MOST_FROM_PAST: Final = 5
"""So many scans in a row that are older than the newest by more: the clock was wrong before."""


@dataclass(frozen=True, slots=True, eq=False)
class _OutsidePose:
    t_ns: int
    T_map_vehicle: F64
    trusted: bool


class Localiser:
    """Takes motion, GNSS and scans in time order; holds the scans of the last `lag_s` seconds and nothing older.

    A scan waits until the motion to its end is known, is matched then, and comes out as `RefinedScan` when its pose is
    final. Scans taken while the pose is not known (before the first, or while lost) are dropped and counted.

    Args:
        local_map: on which poses are sought.
        T_vehicle_lidar: (4, 4) the header's mount.
        parameters: of every step.
        distortion: what speed and turn do to the points, where they do.
        mount_sigma: how well the mount is known.

    Attributes:
        online: newest pose, for progress and for choosing tiles; its health is `lost` until it is found again.
        dropped_scans: so far.
        initialisations: first poses found by search so far.
    """

    def __init__(
        self,
        local_map: LocalMap,
        T_vehicle_lidar: F64,
        parameters: LocaliserParameters | None = None,
        distortion: Distortion | None = None,
        mount_sigma: MountSigma = TRUSTED,
    ) -> None:
        self.parameters = parameters or LocaliserParameters()
        self.local_map = local_map
        self.online: PoseEstimate | None = None
        self.dropped_scans = 0
        self.initialisations = 0
        self._drive = DriveState(local_map, self.parameters, Mounting(T_vehicle_lidar, mount_sigma), distortion)
        self._fix: GnssFix | None = None
        self._pending: Scan | None = None
        self._newest_scan_ns = -1
        self._ready: deque[FinalScan] = deque()
        self._first = FirstPose(self.parameters)
        self._last_ns: int | None = None  # of the newest scan that was processed
        self._last_raw_m = np.empty((0, 3), np.float32)
        self._from_past = 0  # scans in a row
        self._outside: _OutsidePose | None = None
        self._track: TrackedPose | None = None

    def push(self, item: DriveItem) -> Iterator[RefinedScan]:
        """Take the next measurement; return the scans whose poses became final, oldest first, each placed when it is
        asked for: a whole lag that becomes final at once is large. Items of other kinds are ignored.
        """
        if isinstance(item, Scan):
            return self.take_scan(item)
        if isinstance(item, MotionSample):
            self.push_motion(item)
        elif isinstance(item, GnssFix):
            self.push_gnss(item)
        return iter(())

    def push_motion(self, sample: MotionSample) -> None:
        """Take a sample of wheel speed and yaw rate; a scan that waited for it is matched."""
        self._drive.motion.push(sample.t_ns, sample.speed_mps, sample.yaw_rate_radps)
        self._note_gap(sample.t_ns)
        self._process_if_covered()

    def push_gnss(self, fix: GnssFix) -> None:
        """Take a GNSS fix: it starts the search for the first pose, bounds drift, and shows a wrong pose."""
        if np.isfinite([fix.lat_rad, fix.lon_rad, fix.height_m, fix.sigma_m]).all() and fix.sigma_m > 0:
            self._fix = fix

    def take_scan(self, scan: Scan) -> Iterator[RefinedScan]:
        """Take a scan; return the scans whose poses became final. One that is empty, or not later than the one before,
        is dropped and counted.
        """
        if len(scan) == 0 or scan.t_ns <= self._newest_scan_ns:
            self.dropped_scans += 1
            self._note_past(scan)
            return self._take_ready()
        self._newest_scan_ns, self._from_past = scan.t_ns, 0
        self._process()
        self._pending = scan
        self._process_if_covered()
        return self._take_ready()

    def start_at(self, t_ns: int, T_map_vehicle: F64, *, trusted: bool = False) -> None:
        """Take a pose (4, 4) from outside, such as that of the last parking, instead of the present one or of a search.

        It is judged like any other; `trusted` spares it the first good match, but not the proof that no other place
        looks the same, nor later doubts.
        """
        self._lose("searching")
        self._outside = _OutsidePose(t_ns, np.array(T_map_vehicle, np.float64), trusted)

    def flush(self) -> Iterator[RefinedScan]:
        """Finish: return the scans that are still held, with their poses as they stand, one by one (they are large)."""
        self._process()
        track, self._track = self._track, None
        if track is not None:
            self._ready.extend(track.flush())
        while self._ready:
            yield self._drive.output.final(*self._ready.popleft())

    @property
    def state(self) -> tuple[Health, Cause]:
        """Health and cause now, also while there has been no pose yet."""
        return ("lost", self._first.cause) if self.online is None else (self.online.health, self.online.cause)

    @property
    def seldom_ms(self) -> float:
        """How long that took, as `ScanRoom` counts, which is not done with every scan, but was with the newest."""
        return 0.0 if self._track is None else self._track.seldom_ms

    @property
    def drive(self) -> DriveState:
        """What outlives a track: the sensors as learnt."""
        return self._drive

    @property
    def innovations(self) -> Innovations:
        """Of believed matches against the prediction: NIS."""
        return self._drive.innovations

    @property
    def speed_scale(self) -> float:
        """Factor of the wheel speed, as learnt from the map."""
        return self._drive.motion.speed_scale

    @property
    def yaw_bias_radps(self) -> float:
        """Bias of the yaw rate, as learnt from the map."""
        return self._drive.motion.yaw_bias_radps

    @property
    def points_travelling_along(self) -> int:
        """Sampled points so far that were left out because they travel along with the vehicle."""
        return self._drive.co_moving.left_out

    @property
    def calibration(self) -> MotionCalibration:
        """What is known of clock, wheels, gyro and mount so far, with sigmas."""
        return self._drive.teacher.calibration

    # --- one scan --------------------------------------------------------------------------------------------------

    def _process_if_covered(self) -> None:
        motion = self._drive.motion
        if self._pending is not None and len(motion) and motion.last_ns >= end_ns(self._pending):
            self._process()

    def _process(self) -> None:
        scan, self._pending = self._pending, None
        if scan is None:
            return
        self._watch_mount(scan)
        sampled = self._sampled(scan)
        if self._last_ns is not None and (scan.t_ns - self._last_ns) * 1e-9 > _LOST_GAP_S:
            self._lose("gap")
        if self._track is None:
            self._start(sampled)
        else:
            self._ready.extend(self._track.step(sampled, self._fix))
            self._fix, self.online = None, self._track.online
            if self.online.health == "lost":
                self._lose(self.online.cause)
        self._last_ns = sampled.t_ns

    def _sampled(self, scan: Scan) -> SampledScan:
        """The points to match, without those on what travels along with the vehicle."""
        drive, t_ns = self._drive, reference_ns(scan)
        repeated = np.array_equal(self._last_raw_m, scan.points_m)
        self._last_raw_m = scan.points_m
        chosen = sample_scan(scan.points_m, self.parameters.sampling)
        points = drive.sweeps.deskewed(scan, chosen)
        moved = self._moved_to(t_ns)
        stands = ~drive.co_moving.see(scan.points_m, scan.t_offset_ns, scan.t_ns, t_ns, chosen, points, moved)
        return SampledScan(scan, t_ns, chosen[stands], points[stands], repeated)

    def _moved_to(self, t_ns: int) -> F64:
        """(4, 4) the motion since the scan before."""
        return self._drive.motion.delta(t_ns if self._last_ns is None else self._last_ns, t_ns)

    def _watch_mount(self, scan: Scan) -> None:
        """Watch the mount. What is known of it by now counts as soon as no track is torn by that."""
        t_ns, mounting = reference_ns(scan), self._drive.mounting
        if mounting.watch.due(t_ns):
            mounting.see(t_ns, self._drive.sweeps.deskewed(scan, near_points(scan.points_m)))
        if self._track is not None and self.online is not None and mounting.torn:
            outside = _OutsidePose(self.online.t_ns, self.online.T_map_vehicle, trusted=False)
            self._lose("mount")
            self._outside = outside
        if self._track is None and not self._ready:
            self._remount()

    def _remount(self) -> None:
        """Go on in the axes of the mount as it is known by now; what is in the old ones is converted or dropped."""
        drive = self._drive
        before = drive.mounting.T_used
        T_now_before = drive.mounting.remount()
        if np.array_equal(before, drive.mounting.T_used):
            return
        drive.teacher.remounted(T_now_before)
        drive.co_moving.remounted(drive.mounting.T_used)
        self._first = FirstPose(self.parameters)

    # --- the first pose, and the last --------------------------------------------------------------------------------

    def _start(self, scan: SampledScan) -> None:
        """Search for the pose, and follow the candidates until one has won."""
        drive = self._drive
        if self._outside is not None:
            outside, self._outside = self._outside, None
            T = outside.T_map_vehicle @ drive.motion.delta(outside.t_ns, scan.t_ns)
            covariance = np.diag([_OUTSIDE_RAD**2] * 3 + [_OUTSIDE_M**2] * 3)
            fit = 1.0 if outside.trusted else 0.0
            T = drive.output.tracked(T)
            self._begin(scan, RegistrationResult(T, covariance, 0.0, fit, 1.0, 0, True, np.empty((0, 6))), fit)
            return
        if drive.mounting.waits:
            self._first.cause = "mount"
        else:
            place = self._place(scan.t_ns)
            found = self._first.see(scan.t_ns, scan.points_m, self._moved_to(scan.t_ns), place, drive.matcher.maps)
            if found is not None:
                self.initialisations += 1
                self._begin(scan, found.registration, found.fit)
                return
        self.dropped_scans += 1
        self._note_lost(scan.t_ns, self._first.cause)

    def _begin(self, scan: SampledScan, first: RegistrationResult, fit: float) -> None:
        """Track from this pose on."""
        self._first = FirstPose(self.parameters)
        self._track = TrackedPose(self._drive, scan, first, fit, self._place(scan.t_ns))
        self.online = self._track.online

    def _place(self, t_ns: int) -> SearchPlace | None:
        """Where the last fix puts the vehicle; in which direction it has driven since is not known."""
        fix = self._fix
        if fix is None or abs(t_ns - fix.t_ns) > MAX_GNSS_AGE_NS:
            return None
        moved_m = abs(self._drive.motion.speed_mps * (t_ns - fix.t_ns) * 1e-9)
        reach_m = INITIALISE_RADIUS_SIGMAS * fix.sigma_m + moved_m
        return SearchPlace(self._drive.p_map_m(fix), float(np.hypot(fix.sigma_m, moved_m)), reach_m)

    def _lose(self, cause: Cause) -> None:
        """Give up the track, if there is one: its held scans must not become evidence. The search begins with the
        rivals of the pose, if one has beaten it.
        """
        track, self._track = self._track, None
        if track is None:
            return
        self.dropped_scans += len(track.held)
        self._drive.teacher.forget()
        self._first = FirstPose(self.parameters)
        if track.judge.monitor.beaten:
            self._first.hypotheses = track.judge.challenger.rivals
        if self.online is not None:
            self._note_lost(self.online.t_ns, cause)

    def _note_lost(self, t_ns: int, cause: Cause) -> None:
        """Move the last pose on by odometry: it only shows roughly where the vehicle is."""
        if self.online is not None:
            T = self.online.T_map_vehicle @ self._drive.motion.delta(self.online.t_ns, t_ns)
            self.online = replace(
                self.online, t_ns=t_ns, T_map_vehicle=T, health="lost", cause=cause, matching_ratio=0.0
            )

    def _note_gap(self, now_ns: int) -> None:
        """Scans have stopped coming: the newest pose grows old."""
        if self._track is None or self.online is None or self._pending is not None:
            return
        age_s = (now_ns - self.online.t_ns) * 1e-9
        if age_s > self.parameters.health.degraded_after_s:
            health: Health = "lost" if age_s > _LOST_GAP_S else "degraded"
            self.online = replace(self.online, health=health, cause="gap")

    def _note_past(self, scan: Scan) -> None:
        """Scans from the past are dropped; when they go on, the clock was wrong before, and all begins anew."""
        if scan.t_ns >= self._newest_scan_ns - _PAST_NS:
            return
        self._from_past += 1
        if self.online is not None:
            self.online = replace(self.online, health="degraded", cause="bad_time")
        if self._from_past < _MOST_FROM_PAST:
            return
        self._drive.motion.clear()
        self._drive.teacher.clock.forget()
        self._drive.co_moving.forget()
        self._fix = self._pending = self._last_ns = None
        self._newest_scan_ns, self._from_past = -1, 0
        self._lose("bad_time")

    def _take_ready(self) -> Iterator[RefinedScan]:
        """Some of the scans whose poses are final: several become so at once, and who works them off must not be late
        for the next scan.
        """
        for ready in next_few(self._ready):
            yield self._drive.output.final(*ready)
