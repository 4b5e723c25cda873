"""Simultaneous localisation and map change update: SLAMCU (Jo, Kim and Sunwoo 2018), on one vehicle.

Each look: associate measurements with features, one to one (section 4.3.1); those in view that were not measured lose
existence, those measured gain it (4.3.2); what is new is registered; what exists localises the vehicle (4.3.4, 5).
"""

from collections.abc import Collection
from copy import deepcopy
from dataclasses import dataclass, replace
from math import isfinite, radians
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.errors import BadPose
from gnd.vehicle_agent.features.look import Look, MapFeatures
from gnd.vehicle_agent.features.slamcu.association import Association, associate, pair_costs
from gnd.vehicle_agent.features.slamcu.blind import STANDING_MPS, BlindBelief, BlindFilter
from gnd.vehicle_agent.features.slamcu.forecast import Forecast, forecast
from gnd.vehicle_agent.features.slamcu.identities import LN_NONE, LN_NONE_DOUBTED
from gnd.vehicle_agent.features.slamcu.map_comparison import MapComparison, MapInnovation
from gnd.vehicle_agent.features.slamcu.noise import GNSS_INTERVAL_S
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.particle_filter import ParticleFilter
from gnd.vehicle_agent.features.slamcu.sensor_model import CALIBRATION, SURE_HITS, WRONG, SensorModel
from gnd.vehicle_agent.features.slamcu.track_list import TrackList
from gnd.vehicle_agent.features.slamcu.track_management import leave, leave_all, leave_oldest, remove_false_and_double
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass, TrackedFeature, add_evidence, existence_of
from gnd.vehicle_agent.features.slamcu.verdicts import KnownState, NewFeature
from gnd.vehicle_agent.features.view import Occlusion, SensorView, wrapped

_GATE: Final = 13.8
"""Largest squared Mahalanobis distance of an association: χ² of 2 degrees of freedom, 99.9 %."""
_NEW_DENSITY: Final = 0.001
"""Density, 1/(m·rad), of measurements of features not yet known, or false: what an association must beat."""
_EDGE_SIGMAS: Final = 2.0
"""Nearer to the border of the view, or of what hides it, than this many sigmas: no evidence of absence."""
_EDGE_M: Final = 1.0
"""The same, in range, at least."""
_EDGE_RAD: Final = radians(1.0)
"""The same, in bearing, at least."""
_SETTLE_S: Final = 0.5
"""A feature has left the view when it was out of it for this time."""

NEAR_M: Final = 30.0
"""Features so much farther than the view's range cannot be what was measured."""
TOGETHER_S: Final = 0.1
"""Samples of wheels and gyro are put together for at most so long."""
KNOWN_MISS: Final = 0.5
"""A look in which a feature of the map is not seen counts so much, on a vehicle that learns how its camera errs: what
hides or confuses a sign does so in many looks. A sign that is gone is not seen in any."""
LEAST_PLAUSIBLE: Final = 1e-3
"""A feature that surely is not there competes for measurements with this share of its likelihood."""


@dataclass(frozen=True, slots=True, eq=False)
class Passed:
    """A feature that the vehicle has passed.

    Attributes:
        number: the map's id, or 1, 2, 3 … of new ones.
        known: whether it is the map's.
        kind: of it.
        xy_m: (2,) where the map has it, or where it was found.
        feature_class: what was concluded.
    """

    number: int
    known: bool
    kind: str
    xy_m: F64
    feature_class: FeatureClass


class Slamcu:
    """One drive: the particles, the features in them, and the place by wheels, gyro and GNSS alone.

    Args:
        parameters: of existence and filter.
        known: the map's features; a 2D frame (ENU), metres.
        pose0: (3,) x, y, heading at the start.
        cov0: (3, 3) its covariance.
        seed: of the particles.
        gnss_sigma_m: of the GNSS fixes that the first pose was made of, whose slow error it shares; 0: made otherwise.
        sensor: what is learnt of the detector while driving; None: its stated noise is all there is.

    Attributes:
        now_s: time driven.
        odometer_m: way driven.
        z_m: height of the vehicle's origin in the map frame, as of `set_pose`; else 0: heights are those over it.
        hidden: features of the map in view that got no evidence because something hid them, over all looks.
        fixes_refused: fixes of the GNSS that lay too far from where wheels and gyro can have brought the vehicle.

    Raises:
        BadPose: the pose is not finite, or the covariance is none.
    """

    def __init__(
        self,
        parameters: SlamcuParameters,
        known: MapFeatures,
        pose0: F64,
        cov0: F64,
        seed: int = 0,
        gnss_sigma_m: float = 0.0,
        sensor: SensorModel | None = None,
    ) -> None:
        self._confidence = parameters.detection_confidence
        pose0, cov0 = checked_pose(pose0, cov0)
        self._particles = ParticleFilter(parameters.particles, pose0, cov0, np.random.default_rng(seed))
        belief = BlindBelief.first(pose0, cov0, gnss_sigma_m)
        self._blind = BlindFilter(belief)
        if gnss_sigma_m > 0.0:
            self._particles.seed(belief)
        self._tracks = TrackList(parameters, known, self._particles, sensor)
        if self.sensor.learns:
            self._particles.calibrate(CALIBRATION)
        self._comparison = MapComparison(self._tracks, self._blind)
        self.now_s = 0.0
        self.odometer_m = 0.0
        self.hidden = 0
        self.z_m = 0.0
        self.fixes_refused = 0
        self._gnss_s: float | None = None
        self._weighed_s: float | None = None
        self._looked_ns = 0
        self._moved = np.zeros(3)  # seconds, metres, radians that the particles have not moved yet

    def predict(self, dt_s: float, speed_mps: float, yaw_rate_radps: float) -> None:
        """The vehicle drove on for `dt_s` with the wheel speed and yaw rate that it measured.

        Raises:
            BadPose: a value is not finite, or the time runs backwards.
        """
        if not (isfinite(dt_s + speed_mps + yaw_rate_radps) and dt_s >= 0.0):
            raise BadPose(f"motion of {speed_mps} m/s, {yaw_rate_radps} rad/s over {dt_s} s")
        self._blind.predict(dt_s, speed_mps, yaw_rate_radps)
        if abs(speed_mps) >= STANDING_MPS:
            self._moved += np.array([dt_s, speed_mps * dt_s, yaw_rate_radps * dt_s])
            if self._moved[0] >= TOGETHER_S:
                self._move()
        self.now_s += dt_s
        self.odometer_m += abs(speed_mps) * dt_s

    def _move(self) -> None:
        """Move the particles by what was driven since they moved last: nobody asks them between looks and fixes."""
        dt_s, way_m, turn_rad = self._moved.tolist()
        if dt_s > 0.0:
            self._particles.predict(dt_s, way_m / dt_s, turn_rad / dt_s)
            self._moved = np.zeros(3)

    def gnss(self, x_m: float, y_m: float, sigma_m: float) -> bool:
        """A GNSS fix in the map frame; `sigma_m` of each axis.

        Returns:
            Whether it was used: not when it comes too soon after another, or is another reflection.

        Raises:
            BadPose: a value is not finite, or the sigma is not positive.
        """
        if not (isfinite(x_m + y_m + sigma_m) and sigma_m > 0.0):
            raise BadPose(f"GNSS fix ({x_m}, {y_m}) m with sigma {sigma_m} m")
        since_s = GNSS_INTERVAL_S if self._gnss_s is None else self.now_s - self._gnss_s
        if since_s + 1e-6 < GNSS_INTERVAL_S:
            return False
        self._gnss_s = self.now_s
        if not self._blind.fix(np.array([x_m, y_m]), sigma_m, since_s):
            self.fixes_refused += 1
            return False
        self._move()
        weighed_s = since_s if self._weighed_s is None else self.now_s - self._weighed_s
        self._particles.gnss(np.array([x_m, y_m]), sigma_m, weighed_s)
        self._weighed_s = self.now_s
        self._particles.resample_if_needed()
        return True

    def set_pose(self, pose: F64, cov: F64, z_m: float = 0.0) -> None:
        """The pose (3,) as a localiser has it, with its covariance (3, 3) and the height of the vehicle's origin in the
        map frame: from now on features do not move it.

        Raises:
            BadPose: as of the constructor.
        """
        pose, cov = checked_pose(pose, cov)
        self.z_m = z_m
        self._moved = np.zeros(3)
        self._particles.weighing = False
        self._particles.camera = np.zeros((2, self._particles.m))  # nothing would weigh the particles by it
        self._particles.place(pose, cov)

    def pose(self) -> tuple[F64, F64]:
        """Pose (3,) x, y [m], heading [rad], and covariance (3, 3)."""
        self._move()
        return self._particles.pose(self._particles.weights())

    @property
    def blind(self) -> BlindBelief:
        """Where the vehicle is by wheels, gyro and GNSS alone."""
        return self._blind.belief

    @property
    def sensor(self) -> SensorModel:
        """What is known of the detector."""
        return self._tracks.sensor

    @property
    def camera(self) -> tuple[F64, F64]:
        """Errors of the camera: mean (2,) and covariance (2, 2) of the share of ranges, and of the bearing [rad]."""
        return self._particles.calibration()

    @property
    def camera_is_wrong(self) -> bool:
        """Whether the camera is surely farther off than a camera may be mounted: `WRONG`."""
        mean, cov = self.camera
        return bool((np.abs(mean) - 2.0 * np.sqrt(np.diag(cov)) > WRONG).any())

    @property
    def has_fixes(self) -> bool:
        """Whether a fix has been used yet."""
        return self._blind.has_fixes

    def look_anew(self) -> None:
        """Lost: look for the place anew around where wheels, gyro and GNSS have it.

        What is under way with features ends here: those of the map are not settled, new ones stay where they are.
        """
        leave_all(self._tracks)
        self._comparison.forget_moves()
        self._moved = np.zeros(3)
        self._particles.seed(self._blind.belief)

    def widen(self, position_m: float, heading_rad: float) -> None:
        """The place is in doubt, and no better one is known: be as uncertain as that from now on."""
        self._move()
        self._particles.loosen((), position_m, heading_rad)

    def doubt_the_map(self, *, doubted: bool = True) -> None:
        """Whether to take it easier that a sign is gone and another stands in its place."""
        self._comparison.ln_none = LN_NONE_DOUBTED if doubted else LN_NONE

    def fork(self, seed: int) -> "Slamcu":
        """A copy that goes its own way, with chance of its own."""
        copied = deepcopy(self)
        copied._particles.rng = np.random.default_rng(seed)
        return copied

    def last_seen(self, from_s: float, until_s: float) -> list[Passed]:
        """What was last in view after `from_s` and not after `until_s`, and of which there is evidence."""
        return [
            Passed(feature.number, feature.known, feature.kind, feature.xy_m, feature.feature_class)
            for feature in (*self._tracks.known, *self._tracks.new)
            if from_s < feature.in_view_s <= until_s and feature.hits + feature.misses and self._decided(feature)
        ]

    def decide(self) -> None:
        """The drive has ended: decide what was left open for further signs."""
        self._comparison.decide_all(self._looked_ns)

    def _decided(self, feature: TrackedFeature) -> bool:
        return feature.slot is None or self._particles.provisional[feature.slot]

    def take_innovations(self) -> list[MapInnovation]:
        """How far from their places features of the map were measured that were compared since the last call."""
        found, self._comparison.innovations = self._comparison.innovations, []
        return found

    def changes(self) -> tuple[int, int]:
        """How many features of the map are called deleted, and how many new ones there are."""
        deleted = sum(feature.feature_class == FeatureClass.DELETED for feature in self._tracks.known)
        return deleted, sum(feature.feature_class == FeatureClass.NEW for feature in self._tracks.new)

    def in_view(self, within_s: float) -> bool:
        """Whether a feature was in view in the last so many seconds."""
        entries = (*self._tracks.known, *self._tracks.live)
        return any(feature.in_view_s > self.now_s - within_s for feature in entries)

    def look(self, look: Look, view: SensorView, occlusion: Occlusion | None = None) -> None:
        """Take what a detector found, or did not find.

        Args:
            look: one look; none found is evidence too.
            view: what the detector could have seen.
            occlusion: what was in the way; None = nothing.
        """
        self._move()
        self._looked_ns = look.t_ns
        weights = self._particles.weights()
        near = self._tracks.within(self._particles.state[:2] @ weights, view.range_m + NEAR_M)
        self._particles.held = self.sensor.held
        ahead, look = forecast(self._particles, weights, near), self._widened(look)
        found = self._associate(look, near, ahead)
        detected = [near[i] for i in found.feature]
        self._learn(look, found, near, ahead)
        missed, counts = self._missed(near, ahead, found.feature, view, occlusion)
        add_evidence(detected, missed, self._confidence, look.t_ns, counts)  # Eq. (5)
        for feature in detected:
            feature.together.update(other.key for other in detected if other is not feature)
        self._measure(look, found.measurement, detected, weights)
        self._register(look, found.alone, weights)
        self._tidy(near, look.t_ns)
        self._particles.resample_if_needed()  # Eq. (20)

    def hold(self, known: MapFeatures) -> None:
        """Further features of the map, such as those of a tile that came.

        Raises:
            BadMapFeatures: one of them is held already.
        """
        self._tracks.hold(known)

    def weigh_as_printed(self) -> None:
        """From now on features of the map weigh particles as Eq. (17) is printed; for studies of the paper."""
        self._particles.as_printed = True

    def forget(self, feature_ids: Collection[int]) -> None:
        """Features of the map that matter no longer, such as those of a tile that was left."""
        self._tracks.forget(feature_ids)

    def known_states(self) -> tuple[KnownState, ...]:
        """All features of the map, in its order."""
        return tuple(self._known_state(feature) for feature in self._tracks.known)

    def new_features(self, *, unclassified: bool = False) -> tuple[NewFeature, ...]:
        """Features that the map has not and that exist; `unclassified`: those with too little evidence as well."""
        weights = self._particles.weights()
        found = [self._new_feature(feature, weights) for feature in self._tracks.new]
        return tuple(one for one in found if unclassified or one.feature_class == FeatureClass.NEW)

    def _associate(self, look: Look, near: list[TrackedFeature], ahead: Forecast) -> Association:
        """Section 4.3.1, by the likelihood of range and bearing and by how plausible the feature's existence is."""
        z = np.stack([look.range_m, look.bearing_rad], axis=1)
        innovation = z[:, None] - ahead.z[None]
        innovation[..., 1] = wrapped(innovation[..., 1])
        noise = np.zeros((len(look), 1, 2, 2))
        noise[:, 0, [0, 1], [0, 1]] = look.variance
        kinds = np.array([[self.sensor.kind_cost(feature.kinds, kind) for feature in near] for kind in look.kinds])
        kinds = kinds.reshape(len(look), len(near))
        cost = kinds + pair_costs(innovation, ahead.cov[None] + noise, np.isfinite(kinds), _GATE)
        plausible = np.array([max(feature.masses[0] + feature.masses[2], LEAST_PLAUSIBLE) for feature in near])
        return associate(cost - np.log(plausible), -np.log(_NEW_DENSITY))

    def _widened(self, look: Look) -> Look:
        """The look with sigmas as innovations show them to be."""
        if not self.sensor.learns:
            return look
        factor = np.sqrt(self.sensor.white)
        return replace(
            look, sigma_range_m=look.sigma_range_m * factor[0], sigma_bearing_rad=look.sigma_bearing_rad * factor[1]
        )

    def _learn(self, look: Look, found: Association, near: list[TrackedFeature], ahead: Forecast) -> None:
        """What the features that are known well say about the white noise."""
        if not self.sensor.learns:
            return
        stated = look.variance / self.sensor.white
        for row, column in zip(found.measurement, found.feature, strict=True):
            if near[column].slot is not None and near[column].pass_hits >= SURE_HITS:
                off = np.array([look.range_m[row], look.bearing_rad[row]]) - ahead.z[column]
                off[1] = float(wrapped(off[1]))
                self.sensor.measured(off, np.diag(ahead.cov[column]), stated[row])

    def _missed(
        self, near: list[TrackedFeature], ahead: Forecast, measured: I64, view: SensorView, occlusion: Occlusion | None
    ) -> tuple[list[TrackedFeature], list[float]]:
        """Features well in view that nothing hides and that were not measured: they get Eq. (2), each this often."""
        if not near:
            return [], []
        sigma = _EDGE_SIGMAS * ahead.sigma
        edge_m, edge_rad = np.maximum(sigma[:, 0], _EDGE_M), np.maximum(sigma[:, 1], _EDGE_RAD)
        in_view = view.inside(ahead.z[:, 0], ahead.z[:, 1])
        for i in np.flatnonzero(in_view):
            near[i].in_view_s = self.now_s
        rows = np.flatnonzero(view.inside(ahead.z[:, 0], ahead.z[:, 1], edge_m, edge_rad))
        is_measured = np.isin(rows, measured)
        if occlusion is not None and len(rows):
            height_m = np.array([near[i].height_m for i in rows]) - self.z_m
            clear = occlusion.clear(ahead.z[rows, 0], ahead.z[rows, 1], edge_rad[rows], height_m)
            self.hidden += sum(near[i].known for i in rows[~clear & ~is_measured])
            rows, is_measured = rows[clear], is_measured[clear]
        for i, hit in zip(rows, is_measured, strict=True):
            near[i].tally.count(float(ahead.z[i, 0]), hit=bool(hit))
        rows = rows[~is_measured]
        return [near[i] for i in rows], [self._count_of_a_miss(near[i], float(ahead.z[i, 0])) for i in rows]

    def _count_of_a_miss(self, feature: TrackedFeature, range_m: float) -> float:
        """What a look counts in which a feature was not seen."""
        count = self.sensor.miss(range_m)
        return count * KNOWN_MISS if feature.known and self.sensor.learns else count

    def _measure(self, look: Look, rows: I64, detected: list[TrackedFeature], weights: F64) -> None:
        """Section 4.3.4: features that exist are measured; Eq. (16) to (19)."""
        for row, feature in zip(rows, detected, strict=True):
            z, variance = np.array([look.range_m[row], look.bearing_rad[row]]), look.variance[row]
            exists = feature.exists
            if feature.slot is None and exists:
                self._tracks.begin(feature, z, variance)
            elif feature.slot is not None:
                self._particles.measure(feature.slot, z, variance, weigh=exists)
            self._noted(feature, look, int(row), weights)

    def _register(self, look: Look, rows: I64, weights: F64) -> None:
        """What belongs to nothing known is new; Eq. (4)."""
        for row in rows:
            feature = self._tracks.register(look.kinds[row])
            self._tracks.begin(feature, np.array([look.range_m[row], look.bearing_rad[row]]), look.variance[row])
            feature.hits = 1
            feature.history.append((look.t_ns, feature.masses))
            self._noted(feature, look, int(row), weights)

    def _noted(self, feature: TrackedFeature, look: Look, row: int, weights: F64) -> None:
        feature.in_view_s, feature.odometer_m = self.now_s, self.odometer_m
        feature.pass_hits, feature.is_passed = feature.pass_hits + 1, False
        feature.named[look.kinds[row]] += 1
        if not feature.known:
            feature.kind = feature.named.most_common(1)[0][0]
        if look.height_m is not None and isfinite(look.height_m[row]):
            feature.heights.append(float(look.height_m[row]) + self.z_m)
        if feature.slot is not None and not feature.known:
            feature.xy_m = weights @ self._particles.mu[feature.slot] if feature.cov is None else feature.xy_m

    def _tidy(self, near: list[TrackedFeature], t_ns: int) -> None:
        """Remove false and double features, and settle what has left the view."""
        remove_false_and_double(self._tracks, near, t_ns)
        self._comparison.begin_round(self.now_s, self.odometer_m)
        for feature in list(self._tracks.live):
            out_of_view = self.now_s - feature.in_view_s > _SETTLE_S
            if self._tracks.awaits_map(feature):
                self._comparison.compare_if_due(feature, t_ns, out_of_view=out_of_view)
            elif feature.slot is not None and out_of_view:
                leave(self._tracks, feature, self.odometer_m)
        leave_oldest(self._tracks)

    def _known_state(self, feature: TrackedFeature) -> KnownState:
        seen = feature.measured
        if seen is None and self._tracks.awaits_map(feature):
            seen = self._tracks.moments(feature)
        xy_m, cov = (seen[0], seen[1] * self.sensor.places) if seen is not None else (None, None)
        return KnownState(
            feature.number, feature.feature_class, existence_of(feature.masses), feature.hits, feature.misses,
            xy_m, cov, feature.height_m, feature.masses_over_time(),
        )  # fmt: skip

    def _new_feature(self, feature: TrackedFeature, weights: F64) -> NewFeature:
        if feature.slot is not None:
            xy_m, cov = self._tracks.claimed(feature, weights)
        else:
            assert feature.cov is not None
            xy_m, cov = feature.xy_m, feature.cov[[0, 1, 1, 2]].reshape(2, 2)
        return NewFeature(
            feature.number, feature.kind, xy_m, cov * self.sensor.places, feature.height_m, feature.feature_class,
            existence_of(feature.masses), feature.hits, feature.misses, feature.masses_over_time(),
        )  # fmt: skip


def checked_pose(pose: F64, cov: F64) -> tuple[F64, F64]:
    """A pose (3,) and its covariance (3, 3) as float64.

    Raises:
        BadPose: of another shape, not finite, or a covariance with a negative eigenvalue.
    """
    pose, cov = np.asarray(pose, np.float64), np.asarray(cov, np.float64)
    if pose.shape != (3,) or cov.shape != (3, 3) or not (np.isfinite(pose).all() and np.isfinite(cov).all()):
        raise BadPose(f"pose {pose.tolist()} with covariance of shape {cov.shape}: expected finite (3,) and (3, 3)")
    if np.abs(cov - cov.T).max() > 1e-6 or np.linalg.eigvalsh(cov)[0] < -1e-9:
        raise BadPose(f"covariance {cov.tolist()} is not symmetric or has a negative eigenvalue")
    return pose, cov
