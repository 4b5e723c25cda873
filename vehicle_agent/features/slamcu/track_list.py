"""The features of one drive: the map's and the new ones, and which of them are estimated in the particles.

A feature that is in sight is estimated in a slot of the particle filter. Here is kept which slot is whose, whatever is
begun, ended, merged or taken for another; nothing is decided here.
"""

from collections import Counter
from collections.abc import Collection
from math import nan
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.errors import BadMapFeatures
from gnd.vehicle_agent.features.look import MapFeatures
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.particle_filter import ParticleFilter
from gnd.vehicle_agent.features.slamcu.sensor_model import SensorModel, Tally
from gnd.vehicle_agent.features.slamcu.tracked_feature import KNOWN_MASSES, NEW_MASSES, TrackedFeature, recount

MAP_SIGMA_M: Final = 0.05
"""Error of each axis of a map feature's position beside the covariance that the map gives it."""


class TrackList:
    """Features, and their slots in the particles.

    Args:
        parameters: of existence.
        known: the map's features.
        particles: where features are estimated.
        sensor: what is known of the detector; None: its stated noise is all there is.

    Attributes:
        particles, sensor: as given.
        known: the map's features, in its order.
        new: the others.
        live: those that are estimated; the place in this list is the slot.
    """

    def __init__(
        self,
        parameters: SlamcuParameters,
        known: MapFeatures,
        particles: ParticleFilter,
        sensor: SensorModel | None = None,
    ) -> None:
        self._parameters, self.particles = parameters, particles
        self.sensor = sensor or SensorModel(parameters.detection_confidence, learns=False)
        self.known: list[TrackedFeature] = []
        self.new: list[TrackedFeature] = []
        self.live: list[TrackedFeature] = []
        self._known_xy_m = np.zeros((0, 2))
        self._numbers = 0
        self.hold(known)

    # Which features there are

    def hold(self, known: MapFeatures) -> None:
        """Further features of the map.

        Raises:
            BadMapFeatures: one of them is held already.
        """
        held = {feature.number for feature in self.known} & set(known.feature_id.tolist())
        if held:
            raise BadMapFeatures(f"{len(held)} features are held already, the first {min(held)}; forget them first")
        extra = np.eye(2) * MAP_SIGMA_M**2
        for i, number in enumerate(known.feature_id.tolist()):
            cov = known.cov[i] + extra
            packed = np.array([cov[0, 0], cov[0, 1], cov[1, 1]])
            self.known.append(
                TrackedFeature(
                    number, True, known.kind[i], known.xy_m[i].copy(), packed, float(known.z_m[i]), KNOWN_MASSES
                )
            )
        self._index()

    def forget(self, feature_ids: Collection[int]) -> None:
        """Features of the map that matter no longer."""
        gone = set(feature_ids)
        for feature in [feature for feature in self.live if feature.known and feature.number in gone]:
            self.end(feature)
        self.known = [feature for feature in self.known if feature.number not in gone]
        self._index()

    def _index(self) -> None:
        self._known_xy_m = np.array([feature.xy_m for feature in self.known]).reshape(-1, 2)

    def within(self, xy_m: F64, radius_m: float) -> list[TrackedFeature]:
        """Features whose position lies within a radius of a place (2,)."""
        off = self._known_xy_m - xy_m
        known = np.flatnonzero(np.einsum("ni,ni->n", off, off) <= radius_m**2)
        new = [feature for feature in self.new if float(np.hypot(*(feature.xy_m - xy_m))) <= radius_m]
        return [self.known[i] for i in known] + new

    def register(self, kind: str) -> TrackedFeature:
        """A feature that nobody knew, without evidence so far; Eq. (4)."""
        self._numbers += 1
        feature = TrackedFeature(self._numbers, False, kind, np.zeros(2), None, nan, NEW_MASSES)
        self.new.append(feature)
        return feature

    def drop(self, feature: TrackedFeature) -> None:
        """A new feature that was none."""
        self.end(feature)
        self.new.remove(feature)

    def recount(self, feature: TrackedFeature, hits: int, misses: float, t_ns: int) -> None:
        """The feature's evidence anew, from counts."""
        recount(feature, hits, misses, self._parameters.detection_confidence, t_ns)

    # Which of them are estimated

    def begin(self, feature: TrackedFeature, z: F64, variance: F64) -> None:
        """Estimate a feature from this first measurement on; z, variance: (2,) of range and bearing."""
        self.particles.held = feature.held = self.sensor.held
        self.particles.add(z, variance, feature.prior)
        feature.slot, feature.pass_hits, feature.pass_misses = len(self.live), 0, 0
        self.live.append(feature)

    def end(self, feature: TrackedFeature) -> None:
        """Estimate it no longer."""
        if feature.slot is not None:
            self.particles.remove(feature.slot)
            self._free(feature)

    def freeze(self, feature: TrackedFeature) -> None:
        """Keep the position of a new feature as it is, and estimate it no longer."""
        feature.xy_m, cov = self.claimed(feature, self.particles.weights())
        feature.cov = np.array([cov[0, 0], cov[0, 1], cov[1, 1]])
        self.end(feature)

    def awaits_map(self, feature: TrackedFeature) -> bool:
        """Whether it is estimated, and has not been compared with its position known otherwise."""
        return feature.slot is not None and self.particles.priors[feature.slot] is not None

    def moments(self, feature: TrackedFeature, *others: TrackedFeature) -> tuple[F64, F64]:
        """Estimated position (2,) and covariance (2, 2) of a feature by what does not rest on its own map position, nor
        on those of others.
        """
        without = [one.slot or 0 for one in (feature, *others)]
        return self.claimed(feature, self.particles.weights(without))

    def claimed(self, feature: TrackedFeature, weights: F64) -> tuple[F64, F64]:
        """Position (2,) and covariance (2, 2) of an estimated feature, with what is known now of errors that stay with
        features: those that the camera saw first were estimated before it was known.
        """
        held = (feature.held, self.sensor.claimed) if self.sensor.learns else None
        return self.particles.moments(feature.estimated_in, weights, held)

    def settle(self, feature: TrackedFeature) -> None:
        """Take a feature's position known otherwise for good; what its errors may be by what is known now, or the first
        signs of a drive would make the pose surer than they can.
        """
        if self.sensor.learns:
            claimed = self.sensor.claimed
            self.particles.expect(feature.estimated_in, feature.held, claimed)
            feature.held = claimed
        self.particles.settle(feature.estimated_in)

    # What is estimated is another feature

    def unite(self, kept: TrackedFeature, other: TrackedFeature) -> None:
        """The estimates of two features become one, that of `kept`."""
        kept.named.update(other.named)
        if other.slot is None:
            return
        if kept.slot is None:
            kept.held = other.held
            self.live[other.slot] = kept
            kept.slot, other.slot = other.slot, None
            kept.pass_hits, kept.pass_misses = other.pass_hits, other.pass_misses
            self.particles.priors[kept.slot] = kept.prior
        else:
            self.particles.merge(kept.slot, other.slot)
            self._free(other)

    def hand_over(self, giver: TrackedFeature, taker: TrackedFeature) -> None:
        """What was estimated for a feature of the map is a new one."""
        slot, giver.slot = giver.estimated_in, None
        self.live[slot] = taker
        taker.slot, taker.pass_hits, taker.cov = slot, giver.pass_hits, None
        taker.named, giver.named, taker.tally, giver.tally = giver.named, Counter(), giver.tally, Tally()
        taker.held = giver.held
        self.particles.priors[slot] = None

    def hand_back(self, giver: TrackedFeature, taker: TrackedFeature) -> None:
        """The new feature was the map's after all; it is given up."""
        if giver.slot is not None:
            slot, giver.slot = giver.slot, None
            self.live[slot] = taker
            taker.slot, taker.pass_hits, taker.pass_misses = slot, giver.pass_hits, giver.pass_misses
            taker.named, taker.tally, taker.held = giver.named, giver.tally, giver.held
            self.particles.priors[slot] = taker.prior
        self.drop(giver)

    def exchange(self, one: TrackedFeature, other: TrackedFeature) -> None:
        """The estimates of two features are each other's."""
        for feature, slot in ((one, other.estimated_in), (other, one.estimated_in)):
            feature.slot = slot
            self.live[slot], self.particles.priors[slot] = feature, feature.prior
        for name in ("pass_hits", "pass_misses", "in_view_s", "odometer_m", "heights", "named", "tally", "held"):
            before = getattr(one, name)
            setattr(one, name, getattr(other, name))
            setattr(other, name, before)

    def _free(self, feature: TrackedFeature) -> None:
        del self.live[feature.estimated_in]
        feature.slot = None
        for slot, one in enumerate(self.live):
            one.slot = slot
