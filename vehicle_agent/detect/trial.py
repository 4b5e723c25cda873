"""Scans wait here until it is known that their poses were right: then they are evidence, else they are taken back.

Scans are put together into short segments. A segment that is complete is asked whether a common shift lays it better
onto the map (`shift`). It becomes evidence only after the segment behind it has passed, too: what was concluded since
the last good moment is taken back when a pose turns out to be wrong, and after a wrong one two in a row must be good.
"""

import math
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.vehicle_agent.detect.recent_map import recent_map
from gnd.vehicle_agent.detect.shift import OF_SCANS, Shift, find_shift, gain
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan, WaitingRays
from gnd.vehicle_agent.localise.level import looked_at, spreads
from gnd.vehicle_agent.localise.match_map import MatchMap, MatchMapCache
from gnd.vehicle_agent.localise.parameters import SamplingParameters
from gnd.vehicle_agent.localise.sampling import sample_candidates, sample_scan, stride_of
from gnd.vehicle_agent.segment.segmenter import SegmentedScan
from gnd.vehicle_agent.waiting import ScanRoom, few_of

Verdict = Literal["good", "shifted", "unchecked"]

SEGMENT_NS: Final = 500_000_000
"""A segment ends when a scan comes this long after its first: some 5 m in town."""
_POINTS_OF_SEGMENT: Final = 3000
_LEAST_POINTS_OF_SCAN: Final = 300
POINTS_OF_POOR_SCAN: Final = 300
_MAX_RANGE_M: Final = 50.0
_MOST_AT_ONCE: Final = 2
"""Scans whose rays are counted with one scan: one comes with each, and a segment at most comes at once."""
_MOST_WAITING: Final = 10
"""Where more have stood the test, one is given, room or not."""
_RAYS_A_MS: Final = 8000.0
"""That are counted."""
_TEST_MS: Final = 6.0
_MISFITS_MS: Final = 90.0
"""The test of a segment that fits the map everywhere, and what one would take besides that fits it nowhere."""
_EVERY_RECENT: Final = 2
"""So many of the last good segment's points are enough to compare with."""


@dataclass(frozen=True, slots=True, eq=False)
class _TrialScan:
    """A scan that waits."""

    t_ns: int
    estimate: PoseEstimate
    rays: WaitingRays
    moving: NDArray[np.bool_]

    @classmethod
    def of(cls, segmented: SegmentedScan) -> "_TrialScan":
        scan = segmented.scan
        return cls(scan.t_ns, scan.estimate, scan.rays.packed(), segmented.moving)

    def restore(self) -> SegmentedScan:
        """The scan as it came."""
        return SegmentedScan(RefinedScan(self.t_ns, self.rays, self.estimate), self.moving)

    def some(self, n: int) -> F64:
        """(K, 3) about n of its points that stand within range, map frame; only their candidates are placed."""
        stands = np.flatnonzero(~self.moving)
        candidates = self.rays.points_at(stands[:: stride_of(len(stands), n)])
        return np.asarray(candidates[sample_candidates(candidates, _sampling(n))] + self.rays.centre_m)

    def looked_at(self) -> F32:
        """(K, 3) those of its points, from the centre, that tell how its rays spread."""
        return self.rays.points_at(looked_at(np.arange(len(self.rays))))


@dataclass(frozen=True, slots=True, eq=False)
class Tried:
    """A segment and its verdict.

    Attributes:
        shift: what the shift test found.
        verdict: "shifted": its poses are wrong; "unchecked": too little of the map is there to tell.
        points_map_m: (N, 3) sampled points that stand still.
        T_map_vehicle: (4, 4) a pose in its middle.
        scans: how many.
        pose: uncertainty of the poses as estimated, the worst of them.
    """

    shift: Shift
    verdict: Verdict
    points_map_m: F64
    T_map_vehicle: F64
    scans: int
    pose: PoseUncertainty


@dataclass(frozen=True, slots=True, eq=False)
class _Recent:
    """The last good segment, and the small shift X (4, 4, map axes) that lays what it saw onto the base map.

    What it saw is placed only where it is asked for, which is seldom; until the next segment is tested the scans wait
    anyway.
    """

    scans: list[_TrialScan]
    X: F64

    def near(self, p_map_m: F64, noise_m: float) -> MatchMap | None:
        """A map of what it saw within range of a place (3,); None where it saw nothing there."""
        centre, some = self.scans[0].rays.centre_m, []
        for held in self.scans:
            off = (held.rays.centre_m - centre).astype(np.float32)
            some.append(held.rays.points_m[~held.moving][::_EVERY_RECENT] + off)
        return recent_map(np.concatenate(some), noise_m, centre, p_map_m, _MAX_RANGE_M)


@dataclass(slots=True)
class _Segment:
    first_ns: int
    scans: list[_TrialScan] = field(default_factory=list)


class Trial:
    """Takes scans in time order; gives those whose poses have stood the test, some 0.5 to 2 s later.

    Args:
        match_map: the base map that is compared with.
    """

    def __init__(self, match_map: MatchMapCache) -> None:
        self.counts: Counter[str] = Counter()
        self._map = match_map
        self._open: _Segment | None = None
        self._complete: deque[_Segment] = deque()
        """Segments that wait for their test."""
        self._passed: list[_TrialScan] = []
        self._stood: deque[_TrialScan] = deque()
        """Evidence that was not given yet: a whole segment stands the test at once, and is given scan by scan."""
        self._wrong = False  # the segment before was
        self._tried: deque[Tried] = deque()
        self._refused_until_ns = -1
        self._recent: _Recent | None = None

    def push(self, segmented: SegmentedScan, room: ScanRoom | None = None) -> Iterator[SegmentedScan]:
        """Take a scan, and go on."""
        self.take(segmented)
        return self.go_on(room)

    def take(self, segmented: SegmentedScan) -> None:
        """Take a scan."""
        t_ns = segmented.scan.t_ns
        if t_ns <= self._refused_until_ns:
            self.counts["scans_taken_back"] += 1
            return
        if self._open is not None and t_ns - self._open.first_ns >= SEGMENT_NS:
            self._complete.append(self._open)
            self._open = None
        if self._open is None:
            self._open = _Segment(t_ns)
        self._open.scans.append(_TrialScan.of(segmented))

    def go_on(self, room: ScanRoom | None = None) -> Iterator[SegmentedScan]:
        """Test the segments that are complete, and give scans that are evidence now, oldest first, as far as there is
        room, by default for all that is done with one scan. A segment waits until the next is complete, not longer.
        """
        room = room or ScanRoom()
        while self._complete and room.takes(_TEST_MS, must=len(self._complete) > 1):
            shift = self._close(self._complete.popleft())
            room.takes(_MISFITS_MS * shift.misfits / max(shift.voxels, 1), must=True)
        for n in range(min(few_of(self._stood), _MOST_AT_ONCE)):
            must = n == 0 and len(self._stood) > _MOST_WAITING
            if not self._stood or not room.takes(len(self._stood[0].rays) / _RAYS_A_MS, must=must):
                return
            yield self._stood.popleft().restore()

    def flush(self) -> Iterator[SegmentedScan]:
        """The drive has ended: give what has stood the test until now."""
        for segment in self._unread():
            self._close(segment)
        self._open = None
        self._complete.clear()
        self._stood.extend(self._passed)
        self._passed = []
        while self._stood:
            yield self._stood.popleft().restore()

    @property
    def oldest(self) -> PoseEstimate | None:
        """Pose of the oldest scan that waits."""
        waiting = self._stood or self._passed or [one for segment in self._unread() for one in segment.scans]
        return waiting[0].estimate if waiting else None

    def _unread(self) -> list[_Segment]:
        """Segments that were not tested yet, the open one last."""
        return [*self._complete, *([] if self._open is None else [self._open])]

    def take_back(self, until_ns: int) -> None:
        """The pose was wrong, and it is not known since when: no scan up to this time counts."""
        self._refused_until_ns = max(self._refused_until_ns, until_ns)
        waiting = len(self._stood) + len(self._passed) + sum(len(segment.scans) for segment in self._unread())
        self.counts["scans_taken_back"] += waiting
        self._stood.clear()
        self._complete.clear()
        self._open, self._passed, self._recent, self._wrong = None, [], None, True

    def take_tried(self) -> list[Tried]:
        """The segments that were tried since the last call."""
        tried, self._tried = list(self._tried), deque()
        return tried

    def _close(self, segment: _Segment) -> Shift:
        """Test a segment; if its poses stand, those of the one before do, too. Gives what the test found."""
        tried = self._try(segment.scans)
        self._tried.append(tried)
        before, self._passed = self._passed, []
        if tried.verdict == "shifted":
            self.counts["scans_shifted"] += tried.scans
            self.counts["scans_taken_back"] += len(before)
            self._wrong = True
        elif self._wrong:
            self.counts["scans_taken_back"] += tried.scans
            self._wrong = tried.verdict == "unchecked"  # nothing is there that would prove the pose right again
        else:
            self._stood.extend(before)
            self._passed = segment.scans
        return tried.shift

    def _try(self, scans: list[_TrialScan]) -> Tried:
        """Test against the base map, and where that finds a shift against what was seen just before."""
        n = max(_LEAST_POINTS_OF_SCAN, _POINTS_OF_SEGMENT // len(scans))
        points = np.concatenate([held.some(n) for held in scans])
        T = scans[len(scans) // 2].estimate.T_map_vehicle
        points_m = transform(T_inverse(T), points)
        seen = scans[0].looked_at() @ T[:3, :3].astype(np.float32)  # along the vehicle's axes
        shift = find_shift(points_m, T, self._map.near(T[:3, 3]), planar=not spreads(seen))
        poses = [PoseUncertainty.of(held.estimate) for held in scans]
        worst = PoseUncertainty(max(p.sigma_m for p in poses), max(p.sigma_rad for p in poses))
        far = shift.is_far(OF_SCANS, worst)
        verdict: Verdict = "good" if shift.checked and not far else "unchecked"
        if far and self._sureness(points_m, T, shift) >= OF_SCANS.z:
            verdict = "shifted"
        if verdict == "good":
            self._recent = _Recent(scans, T @ shift.T @ T_inverse(T))
        elif verdict == "shifted":
            self._recent = None
        return Tried(shift, verdict, points, T, len(scans), worst)

    def _sureness(self, points_m: F64, T: F64, shift: Shift) -> float:
        """How sure a pose error is, in sigmas: by the base map, and by what was seen when the pose was last good.

        A step since then that is small needs no second witness: the error creeps in. A large one must show there, too,
        and then both count together (Stouffer's sum); where what was seen is seen where it was, the base map was met by
        chance.
        """
        if self._recent is None:
            return shift.z
        X_step = T @ shift.T @ T_inverse(T) @ T_inverse(self._recent.X)
        if replace(shift, T=T_inverse(T) @ X_step @ T).size_m < OF_SCANS.least_m:
            return shift.z
        recent = self._recent.near(T[:3, 3], self._map.noise_m)
        if recent is None:
            return shift.z
        z = gain(points_m, T, X_step @ T, recent)
        return max(shift.z, (shift.z + z) / math.sqrt(2.0)) if min(shift.z, z) > 0.0 else 0.0


def some_of(points_m: F32, centre_map_m: F64, n: int) -> F64:
    """(K, 3) about n of the points within range, map frame.

    Args:
        points_m: (N, 3) from the sensor, along map axes.
        centre_map_m: (3,) the sensor.
        n: how many.
    """
    return np.asarray(points_m[sample_scan(points_m, _sampling(n))] + centre_map_m)


def _sampling(n: int) -> SamplingParameters:
    return SamplingParameters(n_points=n, max_range_m=_MAX_RANGE_M)
