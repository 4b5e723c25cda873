"""The surveyor: begins where the road leaves the map, ends where it has come back, and reports what lies between.

While the map covers the road ahead nothing is done but to look at it from above. Where it does not, scans are placed by
odometry, and submaps are made of them. Those of a stretch on which the map covered the road after all are forgotten.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.drive import DriveItem, GnssFix, Scan
from gnd.schemas.keys import change_key
from gnd.schemas.limits import MAX_PARTS_OF_SURVEY, MAX_SUBMAPS_OF_SURVEY_PART, MAX_SURVEY_REPORT_BYTES
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.survey import SurveyReport
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.localise.localiser import Localiser
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.report.sink import ReportSink
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from gnd.vehicle_agent.segment.segmenter import MotionSegmenter
from gnd.vehicle_agent.survey.chain import ClosedSubmap, SubmapChain
from gnd.vehicle_agent.survey.coverage import AHEAD_M, BARE, COVERED, HERE_M, LOOK_EVERY_M, RoadCoverage, WayOffTheMap
from gnd.vehicle_agent.survey.odometry import OdometryScan, SurveyOdometry

_SETTLED_NS: Final = 12_000_000_000
"""Final poses of the localiser, and what moves, are known so long after a scan."""
_PART_BYTES: Final = MAX_SURVEY_REPORT_BYTES // 3
_PART_SUBMAPS: Final = MAX_SUBMAPS_OF_SURVEY_PART // 2


@dataclass(slots=True, eq=False)
class _Survey:
    """A survey under way."""

    number: int
    start_ns: int
    odometry: SurveyOdometry
    chain: SubmapChain
    T_map_odom: F64
    district: District
    off: WayOffTheMap = field(default_factory=WayOffTheMap)
    waiting: list[ClosedSubmap] = field(default_factory=list)
    parts: int = 0
    survey_id: str = ""

    def at(self, t_ns: int) -> F64:
        """(4, 4) T_map_vehicle by odometry since the map was left."""
        return np.asarray(self.T_map_odom @ self.odometry.to_now(t_ns))


class Surveyor:
    """Takes what the pipeline takes, after the localiser has; puts parts of surveys into the outbox.

    Args:
        T_vehicle_lidar: (4, 4) the mount of the header. Where the localiser has put it right, nothing is surveyed.
        local_map: the tiles around.
        localiser: gives motion as it has been learnt, and poses while it knows them.
        segment: how what moves is found.
        identity: who reports.
        outbox: where parts go.

    Attributes:
        counts: surveys, parts, submaps, bytes; and what was begun in vain.
    """

    def __init__(
        self,
        T_vehicle_lidar: F64,
        local_map: LocalMap,
        localiser: Localiser,
        segment: SegmentParameters,
        identity: Identity,
        outbox: ReportSink,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._mount, self._map, self._localiser, self._segment = T_vehicle_lidar, local_map, localiser, segment
        self._who, self._outbox, self._coverage = identity, outbox, RoadCoverage(local_map)
        self._survey: _Survey | None = None
        self._begun, self._looked_m = 0, -np.inf

    def push(self, item: DriveItem, place: Place) -> None:
        """Take the next measurement; `place` is where the vehicle knows itself to be."""
        if self._survey is None:
            if isinstance(item, Scan) and self._leaves_the_map(place):
                self._survey = self._begin(item, place)
            return
        self._follow(self._survey, item)
        if self._survey is not None and isinstance(item, Scan):
            self._look(self._survey, item.t_ns)

    def take_final(self, estimate: PoseEstimate) -> None:
        """Take a final pose of the localiser; one where the map has no road is worth nothing."""
        if self._survey is not None and (self._share(estimate.T_map_vehicle, HERE_M) or 0.0) >= COVERED:
            self._survey.chain.take_final(estimate)

    def finish(self) -> None:
        """The drive has ended."""
        if self._survey is not None:
            self._end(self._survey)

    def account(self) -> dict[str, Any]:
        """The results of the drive, as plain values."""
        return dict(self.counts)

    # --- begin and end ---------------------------------------------------------------------------------------------

    def _leaves_the_map(self, place: Place) -> bool:
        """Whether the map has no road here or ahead; looked at after every few metres."""
        if place.heading_rad is None or place.odometer_m - self._looked_m < LOOK_EVERY_M:
            return False
        self._looked_m = place.odometer_m
        if not np.array_equal(self._localiser.drive.mounting.T_used, self._mount):
            return False
        strips = [self._coverage.share(place.position_map_m, place.heading_rad, s) for s in (HERE_M, AHEAD_M)]
        return any(share is not None and share <= BARE for share in strips)

    def _begin(self, scan: Scan, place: Place) -> _Survey:
        drive = self._localiser.drive
        odometry = SurveyOdometry(drive.motion, self._mount, drive.teacher.sigmas_between)
        online, T = self._localiser.online, np.eye(4)
        if online is not None and online.health != "lost":
            T = online.T_map_vehicle @ drive.motion.delta(online.t_ns, scan.t_ns)
        else:
            yaw = place.heading_rad or 0.0
            T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
            T[:3, 3] = place.position_map_m
        district = TileId.from_geodetic(*place.geodetic).district
        chain = SubmapChain(MotionSegmenter(self._segment), self._map.grid_frame.frame)
        survey = _Survey(self._begun, scan.t_ns, odometry, chain, T, district)
        self._begun += 1
        self._follow(survey, scan)
        return survey

    def _follow(self, survey: _Survey, item: DriveItem) -> None:
        if isinstance(item, GnssFix):
            survey.chain.take_fix(item, survey.odometry.to_now(item.t_ns))
            return
        for placed in survey.odometry.take(item if isinstance(item, Scan) else None):
            survey.chain.take(placed)
            online = self._localiser.online
            if online is not None and online.health == "good" and online.t_ns == placed.t_ns:
                survey.T_map_odom = online.T_map_vehicle @ np.linalg.inv(placed.T_odom_vehicle)
            self._measure(survey, placed)

    def _measure(self, survey: _Survey, scan: OdometryScan) -> None:
        """Count the way on the map and off it."""
        if survey.off.is_due(scan.way_m):
            place = survey.T_map_odom @ scan.T_odom_vehicle
            held = self._coverage.share_held(place[:3, 3], transform(survey.T_map_odom, scan.points_m))
            survey.off.look(scan.way_m, self._share(place, HERE_M), held)

    def _look(self, survey: _Survey, now_ns: int) -> None:
        """End what has come back to the map, or never left it; report what is settled."""
        if survey.off.is_vain or (survey.off.is_back and self._is_covered_ahead(survey, now_ns)):
            self._end(survey)
        elif survey.off.is_worth:
            survey.waiting += survey.chain.closed(now_ns - _SETTLED_NS)
            self._report(survey, is_last=False)

    def _is_covered_ahead(self, survey: _Survey, now_ns: int) -> bool:
        share = self._share(survey.at(now_ns), AHEAD_M)
        return share is not None and share > BARE

    def _share(self, T_map_vehicle: F64, stretch_m: tuple[float, float]) -> float | None:
        heading_rad = float(np.arctan2(T_map_vehicle[1, 0], T_map_vehicle[0, 0]))
        return self._coverage.share(T_map_vehicle[:3, 3], heading_rad, stretch_m)

    def _end(self, survey: _Survey) -> None:
        self._survey, self._looked_m = None, self._looked_m + LOOK_EVERY_M
        if not survey.off.is_worth:
            self.counts["in_vain"] += 1
            return
        survey.waiting += survey.chain.closed(None)
        while survey.waiting:
            self._report(survey, is_last=True)
        self.counts["surveys"] += 1
        self.counts["bare_m"] += round(survey.off.bare_m)

    # --- parts -----------------------------------------------------------------------------------------------------

    def _report(self, survey: _Survey, *, is_last: bool) -> None:
        """Report what waits, if it is enough for a part, or the last one."""
        chosen, size = 0, 0
        for one in survey.waiting:
            if chosen and (size + one.size > _PART_BYTES or chosen >= _PART_SUBMAPS):
                break
            chosen, size = chosen + 1, size + one.size
        is_full = chosen < len(survey.waiting)
        if not (is_full or is_last) or not chosen or survey.parts >= MAX_PARTS_OF_SURVEY:
            if survey.parts >= MAX_PARTS_OF_SURVEY:
                self.counts["submaps_dropped"] += len(survey.waiting)
                survey.waiting.clear()
            return
        some, survey.waiting = survey.waiting[:chosen], survey.waiting[chosen:]
        self._put(survey, some, is_last=is_last and not survey.waiting)

    def _put(self, survey: _Survey, some: list[ClosedSubmap], *, is_last: bool) -> None:
        who = self._who
        names = who.vehicle, who.drive_id, who.layer, "survey", str(survey.number), str(survey.parts)
        report_id = deterministic_report_id(who.begun_ns(survey.start_ns) // 1_000_000, *names)
        survey.survey_id = survey.survey_id or report_id
        report = SurveyReport(
            report_id=report_id,
            survey_id=survey.survey_id,
            part=survey.parts,
            is_last=is_last,
            vehicle=who.vehicle,
            sensor_model=who.sensor_model,
            software=who.software,
            layer=who.layer,
            district=survey.district,
            first_ns=some[0].submap.t_ns,
            last_ns=some[-1].last_ns,
            submaps=tuple(one.submap for one in some),
            fixes=tuple(fix for one in some for fix in one.fixes),
            anchors=tuple(one.anchor for one in some if one.anchor is not None),
        )
        body = report.encode()
        survey.parts += 1
        if self._outbox.put(report_id, change_key(report.layer, report.district), body):
            self.counts["parts"] += 1
            self.counts["submaps"] += len(some)
            self.counts["bytes"] += len(body)
        else:
            self.counts["parts_known"] += 1  # this agent was restarted: its first statement stands
