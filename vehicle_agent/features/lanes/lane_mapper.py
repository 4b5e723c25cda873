"""The borders of lanes along one drive: found, held against the map's, and told tile by tile.

A border is found in windows along the way (`fitting`), from the LiDAR's and from the camera's points apart. Where both
see it, their difference tells how far the camera is off on this drive; what is left is fused by information. Each
window gives the piece of the grid at its middle (`gnd.gnd_map.features.lane_pieces`).

What a drive does not say, because it cannot know it:
- nothing at all when it sees most borders of the map shifted to one side alike: then it is itself off;
- nothing of a border it misses where it misses most others, too: a wet road, snow, a blinded sensor.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import Existence, Feature, FeatureTile, hit, miss, six_of
from gnd.gnd_map.features.lane_pieces import LanePiece, beside, left_of
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId, tile_coordinates
from gnd.schemas.feature_change import GRID, FeatureChange, Found, Seen
from gnd.schemas.feature_layer import LayerParameters
from gnd.vehicle_agent.features.errors import BadPose
from gnd.vehicle_agent.features.lanes.fitting import BIN_ALONG_M, HALF_WINDOW_M, LEAST_LOOKS, FittedLine, fitted_lines
from gnd.vehicle_agent.features.lanes.lane_windows import LaneWindow, SeenGround, windows_along
from gnd.vehicle_agent.features.lanes.looks import BorderLook
from gnd.vehicle_agent.features.lanes.paint import PaintLook

MARKINGS: Final = LayerParameters("markings", "lidar", ("lane_marking",), geometry="line", range_m=20.0, reach_m=1.5)
"""The layer."""
SIGMA_LIDAR_M: Final = 0.02
"""How far a LiDAR is off across the way for a whole drive: its mount."""
SIGMA_CAMERA_M: Final = 0.10
"""The same of a camera that nothing calibrates; its bearing errs by some tenths of a degree."""
SIGMA_CALIBRATED_M: Final = 0.03
"""The same of a camera whose offset against the LiDAR has been found on this drive."""
_LEAST_PAIRS: Final = 10
_PAIR_M: Final = 0.5
_SIGMA_ALONG_M: Final = 1.0
_SIGMA_UP_M: Final = 0.15
_SOLID_SHARE: Final = 0.7
_GAP_M: Final = 6.5
"""Between dashes."""
_LEAST_SHARE: Final = 0.4
"""A line is seen by so many of the scans that saw the road there, or it is texture."""
_IN_PIECE_M: Final = 2.5
_SAME_M: Final = 0.25
"""Nearer than this a border is the map's."""
_NEAR_M: Final = 1.0
_LEAST_MATCHED: Final = 8
_DOUBT_M: Final = 0.12
_DOUBT_SIGMAS: Final = 3.0
_WORKS_M: Final = 40.0
_WORKS_SHARE: Final = 0.5
_SEEN_SHARE: Final = 0.7
_LIKE_M: Final = 20.0
_BESIDE_M: Final = 0.4
_RUN_M: Final = 14.0
_LEAST_RUN: Final = 3
"""A border has so many pieces within this distance, itself among them: a shorter one is a patch, an arrow, a kerb."""
_PASSED_M: Final = 3.5
_PASSED_BESIDE_M: Final = 8.0
_FOUND: Final = 0.9
_MISSED: Final = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class DrivenBorder:
    """A piece of a border that the drive has found.

    Attributes:
        piece: where, in its tile's frame.
        along_m, left_m: of the window's middle on the way, and how far left of it the border is.
        sigma_m: one sigma of its place across.
        looks: scans and looks that saw it.
        marking: solid or dashed; "" where neither is clear.
        colour: as the camera takes it; "" without camera.
        heading_rad: of the way there, map frame.
    """

    piece: LanePiece
    along_m: float
    left_m: float
    sigma_m: float
    looks: int
    marking: str
    colour: str
    heading_rad: float


@dataclass(slots=True, eq=False)
class _Points:
    """Points on borders that a sensor saw, map frame, look by look."""

    xyz: list[F64]
    look: list[F64]
    dashed: list[F64]
    yellow: list[F64]

    @classmethod
    def none(cls) -> "_Points":
        return cls([], [], [], [])

    def columns(self) -> tuple[F64, F64, F64, F64]:
        if not self.xyz:
            return np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0)
        parts = (self.xyz, self.look, self.dashed, self.yellow)
        xyz, look, dashed, yellow = (np.concatenate(part) for part in parts)
        return xyz, look, dashed, yellow


class LaneMapper:
    """One drive of one vehicle with poses from its localisation.

    Args:
        frame: the map frame.
        sigma_pose_m: one sigma of the poses across the way, of what stays with the drive.

    Attributes:
        counts: what was done and what was withheld, by name.
        camera_off_m: how far left of the LiDAR's borders the camera's lay; None: it could not be found.
    """

    def __init__(self, frame: LocalFrame, sigma_pose_m: float = 0.03) -> None:
        self._frame, self._sigma_pose_m = frame, sigma_pose_m
        self._paint, self._camera = _Points.none(), _Points.none()
        self._ground: list[F64] = []
        self._way: list[F64] = []
        self._held: dict[TileId, FeatureTile] = {}
        self._n_looks = 0
        self._borders: list[DrivenBorder] | None = None
        self._windows: list[LaneWindow] = []
        self.counts: Counter[str] = Counter()
        self.camera_off_m: float | None = None

    def hold(self, tile: FeatureTile) -> None:
        """Compare with this version of a tile; before the drive has ended."""
        self._held[tile.tile_id] = tile

    def let_go(self) -> None:
        """Compare with no map."""
        self._held.clear()

    def see_paint(self, look: PaintLook, T_map_vehicle: F64) -> None:
        """Take what a scan shows, from a pose (4, 4)."""
        T = _checked_pose(T_map_vehicle)
        self._way.append(T[:3, 3])
        self._add(self._paint, look.runs_m, T, np.zeros(len(look.runs_m)), np.zeros(len(look.runs_m)))
        ground = look.ground_m[:: max(1, len(look.ground_m) // 4000)]
        self._ground.append(ground @ T[:3, :3].T + T[:3, 3])

    def see_borders(self, look: BorderLook, T_map_vehicle: F64) -> None:
        """Take what the camera sees, from a pose (4, 4)."""
        T = _checked_pose(T_map_vehicle)
        self._way.append(T[:3, 3])
        dashed = np.array([one == "dashed" for one in look.markings], np.float64)
        yellow = np.array([one == "yellow" for one in look.colours], np.float64)
        xyz = np.column_stack([look.xy_m, np.zeros(len(look.xy_m))])
        of = (dashed[look.line], yellow[look.line]) if len(xyz) else (np.zeros(0), np.zeros(0))
        self._add(self._camera, xyz, T, *of)

    def _add(self, points: _Points, xyz: F64, T: F64, dashed: F64, yellow: F64) -> None:
        self._n_looks += 1
        points.xyz.append(xyz @ T[:3, :3].T + T[:3, 3])
        points.look.append(np.full(len(xyz), float(self._n_looks)))
        points.dashed.append(dashed)
        points.yellow.append(yellow)

    # The borders of the drive

    def borders(self) -> list[DrivenBorder]:
        """All pieces that the drive has found; found once, when the drive has ended."""
        if self._borders is None:
            self._borders = self._find()
        return self._borders

    def _find(self) -> list[DrivenBorder]:
        windows = self._windows = windows_along(self._frame, np.array(self._way).reshape(-1, 3))
        paint, camera = self._paint.columns(), self._camera.columns()
        seen = SeenGround(self._ground)
        by_paint = [_lines(window, paint) for window in windows]
        by_camera = [_lines(window, camera) for window in windows]
        self._calibrate(by_paint, by_camera)
        found = []
        for window, lines, others in zip(windows, by_paint, by_camera, strict=True):
            found += self._window(window, lines, others, (paint, camera), seen)
        self.counts["pieces"] = len(found)
        return _alike(found)

    def _calibrate(self, by_paint: Sequence[list[FittedLine]], by_camera: Sequence[list[FittedLine]]) -> None:
        """Find how far left the camera puts borders, from those that both sensors see."""
        every = [
            other.a_m - min((line.a_m for line in lines), key=other.away)
            for lines, others in zip(by_paint, by_camera, strict=True)
            for other in others
            if lines
        ]
        off = [one for one in every if abs(one) < _PAIR_M]
        self.camera_off_m = float(np.median(off)) if len(off) >= _LEAST_PAIRS else None

    def _window(
        self,
        window: LaneWindow,
        lines: list[FittedLine],
        others: list[FittedLine],
        points: tuple[tuple[F64, F64, F64, F64], tuple[F64, F64, F64, F64]],
        seen: SeenGround,
    ) -> list[DrivenBorder]:
        """The borders beside a window's middle, the sensors' fused."""
        off = self.camera_off_m or 0.0
        sigma_camera = SIGMA_CAMERA_M if self.camera_off_m is None else SIGMA_CALIBRATED_M
        left = list(others)
        found = []
        for line in lines:
            near = [one for one in left if abs(one.a_m - off - line.a_m) < _SAME_M]
            other = min(near, key=lambda one: abs(one.a_m - off - line.a_m), default=None)
            if other is not None:
                left.remove(other)
            found.append(self._border(window, line, other, sigma_camera, points, seen))
        found += [self._border(window, None, other, sigma_camera, points, seen) for other in left]
        return [one for one in found if one is not None]

    def _border(
        self,
        window: LaneWindow,
        line: FittedLine | None,
        other: FittedLine | None,
        sigma_camera_m: float,
        points: tuple[tuple[F64, F64, F64, F64], tuple[F64, F64, F64, F64]],
        seen: SeenGround,
    ) -> DrivenBorder | None:
        base = line or other
        assert base is not None
        marking, colour = "", ""
        if other is not None:
            dashed, yellow = points[1][2][other.points].mean(), points[1][3][other.points].mean()
            marking, colour = "dashed" if dashed > 0.5 else "solid", "yellow" if yellow > 0.5 else "white"
        if line is not None:
            at = _bin_places(window, line)
            was_seen = seen.scans(at) >= LEAST_LOOKS - 1
            scans = seen.scans(at)[line.painted]
            if not _is_painted_there(line, was_seen) or line.looks < _LEAST_SHARE * scans.max(initial=0):
                return None
            share = (line.painted & was_seen).sum() / max(was_seen.sum(), 1)
            marking = "solid" if share > _SOLID_SHARE else "dashed"
        left_m, variance = _fused(line, other, self.camera_off_m or 0.0, sigma_camera_m)
        s = np.arange(-HALF_WINDOW_M, HALF_WINDOW_M + 0.5, 1.0)
        d = base.d_m(s) + (left_m - base.a_m)
        z = 0.0 if line is None else _above(window, points[0][0], line)
        piece = window.piece_of(self._frame, window.line_in_map(s, d, z))
        if piece is None:
            return None
        looks = sum(one.looks for one in (line, other) if one is not None)
        sigma = float(np.sqrt(variance + self._sigma_pose_m**2))
        return DrivenBorder(piece, window.along_m, left_m, sigma, looks, marking, colour, window.heading_rad)

    # What the drive says of the map

    def leave_all(self) -> list[FeatureChange]:
        """The drive has ended: what is to be reported, tile by tile. Nothing where the drive doubts itself."""
        drawn = self.borders()
        known = {tile: [one for one in held.features if len(one.points_m) == 2] for tile, held in self._held.items()}
        if self._is_off(drawn, known):
            self.counts["doubtful"] += 1
            return []
        found, taken = _matched(drawn, known)
        seen_ground = SeenGround(self._ground)
        judged = self._judged(known, taken, seen_ground)
        works = self._works_at(drawn, judged)
        tiles = {one.piece.tile for one in drawn} | set(judged)
        viewed = self._viewed(seen_ground, works)
        tiles |= set(viewed)
        return [self._change(tile, found, judged.get(tile, []), works, viewed.get(tile, 0)) for tile in sorted(tiles)]

    def _is_off(self, drawn: Sequence[DrivenBorder], known: dict[TileId, list[Feature]]) -> bool:
        """Whether most borders of the map lie to one side of the drive's alike: the drive is off, not the paint."""
        off = []
        for one in drawn:
            near = [lateral for other in known.get(one.piece.tile, ()) if (lateral := _lateral(one, other)) is not None]
            if near:
                off.append(_to_left(one, min(near, key=abs)))
        if len(off) < _LEAST_MATCHED:
            return False
        claimed = float(np.median([one.sigma_m for one in drawn]))
        common = float(np.median(off))
        self.counts["common_shift_mm"] = round(1e3 * common)
        return abs(common) > max(_DOUBT_M, _DOUBT_SIGMAS * claimed)

    def _judged(
        self, known: dict[TileId, list[Feature]], taken: dict[tuple[TileId, int], DrivenBorder], seen: SeenGround
    ) -> dict[TileId, list[tuple[Feature, DrivenBorder | None, F64]]]:
        """Of each tile the map's pieces that the drive has found, or has looked at and not found; middle in the map."""
        judged: dict[TileId, list[tuple[Feature, DrivenBorder | None, F64]]] = {}
        for tile, features in known.items():
            T = self._frame.T_self_other(LocalFrame.of_tile(tile))
            for one in features:
                ends = one.points_m @ T[:3, :3].T + T[:3, 3]
                place = taken.get((tile, one.feature_id))
                at = ends[0] + np.linspace(0.05, 0.95, 10)[:, None] * (ends[1] - ends[0])
                was_seen = (seen.scans(at) >= LEAST_LOOKS).mean() >= _SEEN_SHARE
                if place is not None or (was_seen and self._passed(ends.mean(axis=0))):
                    judged.setdefault(tile, []).append((one, place, ends.mean(axis=0)))
        return judged

    def _passed(self, place_m: F64) -> bool:
        """Whether the drive has passed a place: before and behind its way it has looked, but not enough to tell."""
        if not self._windows:
            return False
        first, last = self._windows[0].along_m, self._windows[-1].along_m
        inner = (one for one in self._windows if first + HALF_WINDOW_M <= one.along_m <= last - HALF_WINDOW_M)
        frames = (window.own(place_m[None]) for window in inner)
        return any(abs(float(s[0])) < _PASSED_M and abs(float(d[0])) < _PASSED_BESIDE_M for s, d in frames)

    def _works_at(
        self,
        drawn: Sequence[DrivenBorder],
        judged: dict[TileId, list[tuple[Feature, DrivenBorder | None, F64]]],
    ) -> "_Working":
        rows = [(middle, place is not None) for some in judged.values() for _, place, middle in some]
        there = [self._in_map(one) for one in drawn]
        return _Working(
            np.array([middle for middle, _ in rows]).reshape(-1, 3),
            np.array([found for _, found in rows], np.bool_),
            np.array(there).reshape(-1, 3),
        )

    def _in_map(self, one: DrivenBorder) -> F64:
        T = self._frame.T_self_other(LocalFrame.of_tile(one.piece.tile))
        return np.asarray(T[:3, :3] @ one.piece.middle_m + T[:3, 3])

    def _viewed(self, seen: SeenGround, works: "_Working") -> dict[TileId, int]:
        """By tile the mask of the cells in which paint would have been found."""
        places = seen.places(LEAST_LOOKS)
        if not len(places):
            return {}
        lat, lon, _ = self._frame.geodetic_from_enu(np.column_stack([places, np.zeros(len(places))]))
        u, v = tile_coordinates(lat, lon)
        cells = np.column_stack([np.floor(u * GRID), np.floor(v * GRID)]).astype(np.int64)
        cell, first, count = np.unique(cells, axis=0, return_index=True, return_counts=True)
        full = count.max()
        masks: dict[TileId, int] = defaultdict(int)
        for (column, row), k, n in zip(cell.tolist(), first.tolist(), count.tolist(), strict=True):
            if n < _SEEN_SHARE * full or not works.at(np.array([*places[k], 0.0])):
                continue
            masks[TileId.from_geodetic(float(lat[k]), float(lon[k]))] |= 1 << (row % GRID * GRID + column % GRID)
        return dict(masks)

    def _change(
        self,
        tile: TileId,
        found: Sequence[DrivenBorder],
        judged: Sequence[tuple[Feature, DrivenBorder | None, F64]],
        works: "_Working",
        viewed: int,
    ) -> FeatureChange:
        seen = []
        for one, place, middle in sorted(judged, key=lambda row: row[0].feature_id):
            if place is not None:
                seen.append(_seen(one, place))
            elif works.at(middle):
                seen.append(Seen(one.feature_id, miss(_MISSED)))
            else:
                self.counts["blind"] += 1
        held = self._held.get(tile)
        new = tuple(_found(one) for one in found if one.piece.tile == tile)
        base = (held.version, held.sha) if held is not None and held.features else (0, b"")
        return FeatureChange(tile, *base, viewed, tuple(seen), new)


@dataclass(frozen=True, slots=True, eq=False)
class _Working:
    """Where the drive finds borders at all: the map's pieces it judged (J, 3), which it found, all it found (D, 3)."""

    judged_m: F64
    found: F64
    drawn_m: F64

    def at(self, place_m: F64) -> bool:
        """Whether it finds most of the map's borders about a place; where the map has none, any border."""
        near = np.hypot(*(self.judged_m[:, :2] - place_m[:2]).T) < _WORKS_M
        if near.sum() >= 4:
            return bool(self.found[near].mean() >= _WORKS_SHARE)
        return bool((np.hypot(*(self.drawn_m[:, :2] - place_m[:2]).T) < _WORKS_M).any())


def _checked_pose(T: F64) -> F64:
    if np.shape(T) != (4, 4) or not np.isfinite(T).all():
        raise BadPose(f"a pose of shape {np.shape(T)} that is not (4, 4) and finite")
    return np.asarray(T, np.float64)


def _lines(window: LaneWindow, columns: tuple[F64, F64, F64, F64]) -> list[FittedLine]:
    rows, s, d = window.rows(columns[0])
    lines = fitted_lines(s, d, columns[1][rows].astype(np.int64))
    return [replace(line, points=rows[line.points]) for line in lines]


def _bin_places(window: LaneWindow, line: FittedLine) -> F64:
    s = np.asarray((np.arange(len(line.painted)) + 0.5) * BIN_ALONG_M - HALF_WINDOW_M, np.float64)
    return window.line_in_map(s, line.d_m(s), 0.0)


def _is_painted_there(line: FittedLine, was_seen: NDArray[np.bool_]) -> bool:
    """Whether the paint reaches the window's middle: on it, or on both sides of it no farther than a gap of dashes."""
    s = np.asarray((np.arange(len(line.painted)) + 0.5) * BIN_ALONG_M - HALF_WINDOW_M, np.float64)
    inside = np.abs(s) < _IN_PIECE_M
    looked = inside & was_seen
    if (line.painted & inside).sum() >= 0.4 * max(looked.sum(), 1):
        return True
    return bool(
        (line.painted & (np.abs(s) < _GAP_M) & (s < 0)).any() and (line.painted & (np.abs(s) < _GAP_M) & (s > 0)).any()
    )


def _fused(
    line: FittedLine | None, other: FittedLine | None, camera_off_m: float, sigma_camera_m: float
) -> tuple[float, float]:
    """Place across and its variance, of what LiDAR and camera say."""
    terms = []
    if line is not None:
        terms.append((line.a_m, line.variance_m2 + SIGMA_LIDAR_M**2))
    if other is not None:
        terms.append((other.a_m - camera_off_m, other.variance_m2 + sigma_camera_m**2))
    information = sum(1.0 / variance for _, variance in terms)
    return sum(place / variance for place, variance in terms) / information, 1.0 / information


def _above(window: LaneWindow, xyz: F64, line: FittedLine) -> float:
    """How high above the way the line lies."""
    ahead, _ = window.own(xyz[line.points])
    return float(np.median(xyz[line.points, 2] - window.origin_m[2] - window.rise * ahead))


def _alike(found: list[DrivenBorder]) -> list[DrivenBorder]:
    """The pieces that others continue, each with the marking and the colour of most pieces of its line."""
    along, left = np.array([one.along_m for one in found]), np.array([one.left_m for one in found])
    result = []
    for one in found:
        near = np.flatnonzero((np.abs(along - one.along_m) < _LIKE_M) & (np.abs(left - one.left_m) < _BESIDE_M))
        if (np.abs(along[near] - one.along_m) < _RUN_M).sum() < _LEAST_RUN:
            continue
        marking = Counter(found[k].marking for k in near if found[k].marking).most_common(1)
        colour = Counter(found[k].colour for k in near if found[k].colour).most_common(1)
        result.append(replace(one, marking=marking[0][0] if marking else "", colour=colour[0][0] if colour else ""))
    return result


def _lateral(one: DrivenBorder, other: Feature) -> float | None:
    """How far left of a drive's piece, looking along it, the map's piece lies; None: not beside it."""
    overlap, lateral = beside(one.piece.points_m, other.points_m)
    return lateral if overlap >= 0.5 and abs(lateral) < _NEAR_M else None


def _to_left(one: DrivenBorder, lateral_m: float) -> float:
    """The same to the left of the way."""
    left = left_of(one.piece.points_m)
    way = np.array([-np.sin(one.heading_rad), np.cos(one.heading_rad)])
    return lateral_m if float(left[:2] @ way) > 0 else -lateral_m


def _matched(
    drawn: Sequence[DrivenBorder], known: dict[TileId, list[Feature]]
) -> tuple[list[DrivenBorder], dict[tuple[TileId, int], DrivenBorder]]:
    """The drive's pieces that the map has not, and by tile and id those that it has."""
    pairs = []
    for k, one in enumerate(drawn):
        for other in known.get(one.piece.tile, ()):
            lateral = _lateral(one, other)
            if lateral is not None and abs(lateral) < _SAME_M and _is_like(one, other):
                pairs.append((abs(lateral), k, (one.piece.tile, other.feature_id)))
    taken: dict[tuple[TileId, int], DrivenBorder] = {}
    used: set[int] = set()
    for _, k, key in sorted(pairs, key=lambda pair: pair[:2]):
        if k not in used and key not in taken:
            used.add(k)
            taken[key] = drawn[k]
    return _once([one for k, one in enumerate(drawn) if k not in used]), taken


def _is_like(one: DrivenBorder, other: Feature) -> bool:
    """Whether the map's piece is painted as the drive's."""
    told = dict(other.attributes)
    return not (one.marking and told.get("subtype") in ("solid", "dashed") and told["subtype"] != one.marking)


def _once(drawn: Sequence[DrivenBorder]) -> list[DrivenBorder]:
    """Each place once: a drive that passes twice keeps what more looks speak for."""
    kept: list[DrivenBorder] = []
    for one in sorted(drawn, key=lambda one: -one.looks):
        near = (other for other in kept if other.piece.tile == one.piece.tile)
        if all(_apart(one.piece, other.piece) for other in near):
            kept.append(one)
    return kept


def _apart(one: LanePiece, other: LanePiece) -> bool:
    overlap, lateral = beside(one.points_m, other.points_m)
    return overlap < 0.5 or abs(lateral) >= _SAME_M


def _covariance(points_m: F64, sigma_m: float) -> F64:
    """(6,) of a piece's vertices: `sigma_m` across it, a metre along it."""
    left = left_of(points_m)
    along = np.array([left[1], -left[0], 0.0])
    up = np.array([0.0, 0.0, 1.0])
    C = sum(s**2 * np.outer(axis, axis) for s, axis in ((sigma_m, left), (_SIGMA_ALONG_M, along), (_SIGMA_UP_M, up)))
    return six_of(np.asarray(C))


def _existence() -> Existence:
    return hit(_FOUND)


def _seen(one: Feature, place: DrivenBorder) -> Seen:
    points_m = place.piece.points_m
    return Seen(one.feature_id, _existence(), place.looks, place.piece.middle_m, _covariance(points_m, place.sigma_m))


def _found(one: DrivenBorder) -> Found:
    told = {"subtype": one.marking, "color": one.colour}
    attributes = tuple(sorted((key, value) for key, value in told.items() if value))
    points_m = one.piece.points_m
    return Found(MARKINGS.kinds[0], points_m, _covariance(points_m, one.sigma_m), _existence(), one.looks, attributes)
