"""One feature layer on a vehicle that knows its pose: SLAMCU with given poses, where it looked, what it reports."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import atan2
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.features import Existence, FeatureTile
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.feature_layer import LayerParameters
from gnd.schemas.features import FeatureChange, Found, Seen
from gnd.vehicle_agent.features.coverage import Coverage
from gnd.vehicle_agent.features.feature_map import features_in_map, place_in_tile, with_height
from gnd.vehicle_agent.features.layer_parameters import slamcu_of, view_of
from gnd.vehicle_agent.features.look import Look, MapFeatures
from gnd.vehicle_agent.features.slamcu.sensor_model import SensorModel
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu
from gnd.vehicle_agent.features.slamcu.verdicts import KnownState, NewFeature
from gnd.vehicle_agent.features.slamcu.watched import WatchedSlamcu
from gnd.vehicle_agent.features.view import Occlusion
from gnd.vehicle_agent.surroundings import left_behind

SIGMA_HEIGHT_M: Final = 0.5
"""Of a height as a detector measures it."""
AGAIN_M: Final = 1.5
"""A detection of another kind of the same detector this near to a feature of the layer is that feature: the head of a
lamp is not seen from everywhere, and then its mast is a pole."""
LARGEST_MASS: Final = 1.0 - 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class PlacedLook:
    """A look, and where it was taken from.

    Attributes:
        look: what the detector found.
        pose: (3,) x, y [m], heading [rad] in the map frame.
        cov: (3, 3) of the pose.
        z_m: height of the vehicle's origin in the map frame.
    """

    look: Look
    pose: F64
    cov: F64
    z_m: float


class FeatureLayer:
    """Judges the features of a layer along one drive; tiles that were left give what is to be reported.

    Args:
        parameters: the layer, its sensor.
        frame: the map frame.
    """

    def __init__(
        self,
        parameters: LayerParameters,
        frame: LocalFrame,
        slamcu: Slamcu | WatchedSlamcu | None = None,
    ) -> None:
        self.parameters, self._frame, self._view = parameters, frame, view_of(parameters)
        sensor = SensorModel(parameters.detection_confidence, learns=parameters.sensor == "camera")
        self._slamcu = slamcu or Slamcu(
            slamcu_of(parameters), MapFeatures.none(), np.zeros(3), np.eye(3) * 1e-4, sensor=sensor
        )
        self._coverage = Coverage(frame, self._view, parameters.height_m)
        self._held: dict[TileId, FeatureTile] = {}
        self._ids: dict[TileId, tuple[int, ...]] = {}
        self._reported: set[int] = set()
        self._z_m = 0.0
        self._before: PlacedLook | None = None

    @property
    def tiles(self) -> list[TileId]:
        """Tiles about which there is evidence, sorted."""
        return self._coverage.tiles

    def holds(self, tile_id: TileId) -> FeatureTile | None:
        """The version of a tile that the vehicle compares with."""
        return self._held.get(tile_id)

    def hold(self, tile: FeatureTile) -> bool:
        """Compare with this version from now on, unless there is evidence against an older one already."""
        if tile.tile_id in self._held and (self._coverage.touched(tile.tile_id) or self._held[tile.tile_id] == tile):
            return False
        self._let_go(tile.tile_id)
        known = features_in_map(self._frame, tile, self.parameters.kinds)
        self._slamcu.hold(known)
        self._held[tile.tile_id] = tile
        self._ids[tile.tile_id] = tuple(int(feature_id) for feature_id in known.feature_id)
        return True

    def see(self, placed: PlacedLook, occlusion: Occlusion | None) -> None:
        """Take one look from a known pose."""
        assert isinstance(self._slamcu, Slamcu), "this layer's own filter finds the poses"
        self._drive_on(placed, self._slamcu)
        self._slamcu.set_pose(placed.pose, placed.cov, placed.z_m)
        self._slamcu.look(self._own(placed), self._view, occlusion)
        self.cover(placed.pose, occlusion)
        self._z_m = placed.z_m

    def _drive_on(self, placed: PlacedLook, slamcu: Slamcu) -> None:
        """Time and way since the look before: features settle once they are out of view and left behind."""
        before, self._before = self._before, placed
        dt_s = 0.0 if before is None else (placed.look.t_ns - before.look.t_ns) * 1e-9
        if before is not None and dt_s > 0.0:
            slamcu.predict(dt_s, float(np.hypot(*(placed.pose - before.pose)[:2])) / dt_s, 0.0)

    def look(self, look: Look, occlusion: Occlusion | None) -> None:
        """Take one look whose pose the filter finds; where it has looked comes later, by `cover`."""
        rows = np.array([i for i, kind in enumerate(look.kinds) if kind in self.parameters.kinds], np.int64)
        self._slamcu.look(taken(look, rows, [look.kinds[i] for i in rows]), self._view, occlusion)

    def cover(self, pose: F64, occlusion: Occlusion | None) -> None:
        """The vehicle has looked from a pose (3,): x, y [m], heading [rad] in the map frame."""
        x_m, y_m, heading_rad = pose.tolist()
        self._coverage.look(x_m, y_m, heading_rad, occlusion)

    def leave(self, p_map_m: F64, distance_m: float) -> list[FeatureChange]:
        """What is to be reported of the tiles farther away than `distance_m` from points (3,) or (N, 3); they are
        forgotten.
        """
        left = self.tiles
        for point in np.atleast_2d(p_map_m):
            left = list(left_behind(self._frame, left, point, distance_m))
        return self._decided(left)

    def leave_all(self) -> list[FeatureChange]:
        """The drive has ended: what is to be reported of every tile."""
        return self._decided(self.tiles)

    # What a look means for this layer

    def _own(self, placed: PlacedLook) -> Look:
        """The detections that belong to the layer, those of another kind at one of its features among them."""
        look, kinds = placed.look, self.parameters.kinds
        c, s = np.cos(placed.pose[2]), np.sin(placed.pose[2])
        ahead, left = look.range_m * np.cos(look.bearing_rad), look.range_m * np.sin(look.bearing_rad)
        xy = placed.pose[:2] + np.column_stack([c * ahead - s * left, s * ahead + c * left])
        near = self._at_features(xy)
        own = [kind if kind in kinds else near[i] for i, kind in enumerate(look.kinds)]
        rows = np.array([i for i, kind in enumerate(own) if kind], np.int64)
        return taken(look, rows, [own[i] for i in rows])

    def _at_features(self, xy_m: F64) -> list[str]:
        """The kind of the layer's feature at each of some places, empty where there is none."""
        if not len(xy_m):
            return []
        places, kinds = self._places()
        if not kinds:
            return [""] * len(xy_m)
        gap = np.linalg.norm(xy_m[:, None] - places[None], axis=2)
        nearest = gap.argmin(axis=1)
        return [kinds[j] if gap[i, j] < AGAIN_M else "" for i, j in enumerate(nearest)]

    def _places(self) -> tuple[F64, list[str]]:
        found = self._slamcu.new_features(unclassified=True)
        held = [features_in_map(self._frame, tile, self.parameters.kinds) for tile in self._held.values()]
        places = [*(one.xy_m for one in held), *(one.position_m[None] for one in found)]
        kinds = [*(kind for one in held for kind in one.kind), *(one.kind for one in found)]
        return np.concatenate(places) if kinds else np.zeros((0, 2)), kinds

    # What is reported of a tile

    def _decided(self, tiles: Sequence[TileId]) -> list[FeatureChange]:
        if not tiles:
            return []
        states, new = {one.feature_id: one for one in self._slamcu.known_states()}, self._slamcu.new_features()
        return [self._decide(tile_id, states, new) for tile_id in tiles]

    def _decide(self, tile_id: TileId, states: Mapping[int, KnownState], new: Sequence[NewFeature]) -> FeatureChange:
        base = self._held.get(tile_id)
        judged = [states[one] for one in sorted(self._ids.get(tile_id, ())) if one in states]
        change = FeatureChange(
            tile=tile_id,
            base_version=base.version if base else 0,
            base_sha=base.sha if base else b"",
            viewed=self._coverage.viewed(tile_id),
            seen=tuple(self._seen(tile_id, state) for state in judged if state.hits + state.misses),
            found=tuple(self._found(tile_id, new)),
        )
        self._coverage.forget(tile_id)
        self._let_go(tile_id)
        return change

    def _let_go(self, tile_id: TileId) -> None:
        self._slamcu.forget(self._ids.pop(tile_id, ()))
        self._held.pop(tile_id, None)

    def _seen(self, tile_id: TileId, state: KnownState) -> Seen:
        existence = of_counts(state.hits, state.misses, self.parameters.detection_confidence)
        if state.position_m is None or state.cov_m2 is None:
            return Seen(state.feature_id, existence, state.hits)
        _, point, cov = self._placed(state.position_m, state.cov_m2, state.height_m, tile_id)
        return Seen(state.feature_id, existence, state.hits, point[0], cov)

    def _found(self, tile_id: TileId, new: Sequence[NewFeature]) -> list[Found]:
        """The new features of a tile that exist, stand alone and were not reported yet."""
        found: list[Found] = []
        places = np.array([one.position_m for one in new]).reshape(-1, 2)
        for one in new:
            tile, point, cov = self._placed(one.position_m, one.cov_m2, one.height_m)
            if tile == tile_id and one.number not in self._reported and self._alone(one.position_m, places):
                self._reported.add(one.number)
                found.append(Found(one.kind, point, cov, bounded(one.existence), one.hits))
        return found

    def _alone(self, xy_m: F64, places: F64) -> bool:
        """Whether no other new feature of the layer stands too near."""
        return int((np.hypot(*(places - xy_m).T) < self.parameters.alone_m).sum()) <= 1

    def _placed(self, xy_m: F64, cov: F64, height_m: float, tile_id: TileId | None = None) -> tuple[TileId, F64, F64]:
        point, full = with_height(xy_m, cov, height_m, SIGMA_HEIGHT_M, self._z_m)
        return place_in_tile(self._frame, point, full, tile_id)


def taken(look: Look, rows: I64, kinds: Sequence[str]) -> Look:
    """Some detections of a look, with these kinds."""
    columns = (look.range_m, look.bearing_rad, look.sigma_range_m, look.sigma_bearing_rad)
    range_m, bearing_rad, sigma_range_m, sigma_bearing_rad = (column[rows] for column in columns)
    height_m = None if look.height_m is None else look.height_m[rows]
    return Look(look.t_ns, range_m, bearing_rad, sigma_range_m, sigma_bearing_rad, tuple(kinds), height_m)


def of_counts(hits: int, misses: float, confidence: float) -> Existence:
    """Masses of so many detections and misses, begun vacuous: this drive's own evidence. SLAMCU, Eq. (1), (2), (5).

    Combined in closed form: with u = (1 - λ)^n of either kind, m(∃) ∝ (1 - u_hit) u_miss, m(∄) ∝ (1 - u_miss) u_hit,
    m(Ω) ∝ u_hit u_miss, whatever their order.
    """
    fewer = min(hits, misses)  # u_hit and u_miss over their common factor: nothing underflows to 0 / 0
    u_hit, u_miss = (1.0 - confidence) ** (hits - fewer), (1.0 - confidence) ** (misses - fewer)
    of_hits, of_misses = 1.0 - (1.0 - confidence) ** hits, 1.0 - (1.0 - confidence) ** misses
    masses = np.array([of_hits * u_miss, of_misses * u_hit, (1.0 - confidence) ** max(hits, misses)])
    exist, absent, _ = np.minimum(masses / masses.sum(), LARGEST_MASS)
    return Existence(float(exist), float(absent), float(1.0 - exist - absent), min(of_hits * of_misses, LARGEST_MASS))


def bounded(existence: Existence) -> Existence:
    """Masses with their rounding taken out, so that they sum to 1."""
    exist, absent = max(existence.exist, 0.0), max(existence.absent, 0.0)
    return replace(existence, exist=exist, absent=absent, unknown=max(1.0 - exist - absent, 0.0))


def pose_of(T_map_vehicle: F64) -> F64:
    """(3,) x, y, heading of a pose (4, 4)."""
    return np.array([*T_map_vehicle[:2, 3], atan2(T_map_vehicle[1, 0], T_map_vehicle[0, 0])])
