"""Which features of a drive are kept: false and double ones go, those out of sight are estimated no longer."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu.map_comparison import ENOUGH_HITS
from gnd.vehicle_agent.features.slamcu.sensor_model import LN_SIGN, Tally
from gnd.vehicle_agent.features.slamcu.track_list import TrackList
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass, TrackedFeature

HORIZON_M: Final = 2000.0
"""A new feature left behind by this way no longer learns from what comes."""
MOST_LIVE: Final = 32
"""At most this many features are estimated at a time; those longest out of view go first."""
GIVEN_UP: Final = 0.9
"""A new feature with this mass of absence is forgotten."""
SAME_GATE: Final = 9.0
"""Two features within this squared Mahalanobis distance may be one."""
SAME_M: Final = 4.0
"""And at most so far apart."""
TOGETHER_SHARE: Final = 0.15
"""Two features that are measured at once in this share of the looks that could are two."""


def remove_false_and_double(tracks: TrackList, near: Sequence[TrackedFeature], t_ns: int) -> None:
    """Of the features near the vehicle: forget new ones that are none, merge those that are another one."""
    for feature in [one for one in near if not one.known and one in tracks.new]:
        if feature.masses[1] > GIVEN_UP:
            tracks.drop(feature)
            continue
        for other in near:
            alike = other.kind == feature.kind or tracks.sensor.learns  # else its kind may have been confused
            if other is not feature and alike and _same(tracks, other, feature):
                _merge(tracks, other, feature, t_ns)
                break


def leave(tracks: TrackList, feature: TrackedFeature, odometer_m: float) -> None:
    """A feature out of view is estimated no longer: the map's at once, a new one when it can learn little more."""
    learn_of(tracks, feature)
    if feature.known:
        tracks.end(feature)
    elif feature.feature_class != FeatureClass.NEW:
        tracks.drop(feature)
    elif odometer_m - feature.odometer_m > HORIZON_M:
        tracks.freeze(feature)


def learn_of(tracks: TrackList, feature: TrackedFeature) -> None:
    """What a feature that has been passed says of the sensor, and whether a new one is a sign at all."""
    sensor, tally = tracks.sensor, feature.tally
    if not sensor.learns or feature.is_passed:
        return
    feature.is_passed = True
    if not feature.known and not feature.is_clutter:
        feature.is_clutter = sensor.ln_sign(tally, feature.named) < LN_SIGN
    if feature.feature_class in (FeatureClass.NORMAL, FeatureClass.NEW) and feature.hits >= ENOUGH_HITS:
        sensor.passed(tally, feature.named, feature.kind)
    feature.tally = Tally()


def leave_oldest(tracks: TrackList) -> None:
    """Estimate at most `MOST_LIVE` features."""
    while len(tracks.live) > MOST_LIVE:
        oldest = min(tracks.live, key=lambda feature: feature.in_view_s)
        if oldest.known:
            tracks.end(oldest)
        else:
            tracks.freeze(oldest)


def leave_all(tracks: TrackList) -> None:
    """Estimate nothing any longer: what is new and exists stays where it is, what is not is forgotten."""
    for feature in list(tracks.live):
        if feature.known:
            tracks.end(feature)
        elif feature.feature_class == FeatureClass.NEW:
            tracks.freeze(feature)
        else:
            tracks.drop(feature)


def _same(tracks: TrackList, other: TrackedFeature, feature: TrackedFeature) -> bool:
    """Whether a new feature is another one: at one place, and never measured at once."""
    if feature.slot is None or (not other.known and (other.slot is None or other.number > feature.number)):
        return False
    hits = min(feature.hits, max(other.pass_hits, 1))
    apart = TOGETHER_SHARE * hits if not tracks.sensor.learns else max(TOGETHER_SHARE * hits, 1)
    if feature.hits + other.pass_hits < ENOUGH_HITS or feature.together[other.key] > apart:
        return False
    off, cov = _apart(tracks, other, feature)
    return float(np.hypot(*off)) < SAME_M and float(off @ np.linalg.solve(cov, off)) < SAME_GATE


def _apart(tracks: TrackList, other: TrackedFeature, feature: TrackedFeature) -> tuple[F64, F64]:
    """Mean (2,) and covariance (2, 2) of how far apart two features are. A new one beside a feature of the map is as
    uncertain as what is claimed of it: what the camera saw first was estimated before its errors were known.
    """
    if other.known and other.slot is None:
        xy_m, cov = tracks.claimed(feature, tracks.particles.weights())
        assert other.cov is not None
        return xy_m - other.xy_m, cov + other.cov[[0, 1, 1, 2]].reshape(2, 2)
    particles, weights, slot = tracks.particles, tracks.particles.weights(), feature.estimated_in
    mu, sigma = particles.mu[slot], particles.sigma[slot]
    if other.slot is not None:
        off, within = mu - particles.mu[other.slot], weights @ (sigma + particles.sigma[other.slot])
    else:
        off, within = mu - other.xy_m, weights @ sigma + (0.0 if other.cov is None else other.cov)
    mean = weights @ off
    off = off - mean
    return mean, (off * weights[:, None]).T @ off + within[[0, 1, 1, 2]].reshape(2, 2)


def _merge(tracks: TrackList, kept: TrackedFeature, other: TrackedFeature, t_ns: int) -> None:
    """Each look that measured one of them measured the feature, though the other was missed."""
    hits = kept.hits + other.hits
    tracks.unite(kept, other)
    kept.in_view_s = max(kept.in_view_s, other.in_view_s)
    kept.odometer_m = max(kept.odometer_m, other.odometer_m)
    kept.heights += other.heights
    if kept.named and not kept.known:
        kept.kind = kept.named.most_common(1)[0][0]
    tracks.recount(kept, hits, max(kept.misses - other.hits, 0), t_ns)
    tracks.drop(other)
