"""Existence over vehicles: one vote a vehicle, discounted, combined after Dempster (SLAMCU, Eq. (5)-(7))."""

from collections.abc import Iterable, Sequence
from math import prod
from typing import Final

import numpy as np

from gnd.cloud_merger.features.memory import Vote
from gnd.cloud_merger.features.statements import Statement
from gnd.cloud_merger.features.tracks import Bases, FeatureTrack, FeatureTracks
from gnd.gnd_map.features import VACUOUS, Existence, miss
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.feature_change import GRID

FEATURE_PRIOR: Final = 0.95
"""The evidence of the map for its own features never weighs more than this. λ_HD of SLAMCU, Eq. (3)."""
FEATURE_ABSENCE: Final = 0.8
"""Mass of "absent" of a vehicle that viewed a place without finding what others found there."""
FEATURE_VIEW_MARGIN_M: Final = 0.5
"""Such a vehicle must have viewed all cells within this of the feature, or within its sigma."""
FEATURE_CEILING: Final = 0.99
"""No published feature has a larger mass than this, or no evidence could change it any more."""


def pooled(bodies: Iterable[Existence]) -> Existence:
    """Dempster's rule over any number of bodies of evidence at once; the order does not matter.

    On the frame {∃, ∄} what is left to a set before normalisation is a product: of all m(∃) + m(Ω) for "∃ or nothing
    ruled out", and so on. What is missing from 1 is conflict. No body may be certain of anything, or all may vanish.
    """
    bodies = list(bodies)
    unknown = prod(one.unknown for one in bodies)  # Eq. (7)
    exist = prod(one.exist + one.unknown for one in bodies) - unknown
    absent = prod(one.absent + one.unknown for one in bodies) - unknown
    left = exist + absent + unknown
    agreed = prod(1.0 - one.conflict for one in bodies)
    return Existence(exist / left, absent / left, unknown / left, min(max(1.0 - left * agreed, 0.0), 1.0))  # Eq. (6)


def capped(existence: Existence, most: float) -> Existence:
    """The same masses, scaled so that no more than `most` is known for certain."""
    known = existence.exist + existence.absent
    return existence if known <= most else existence.discounted(most / known)


def prior_of(track: FeatureTrack) -> Existence:
    """The evidence of the map for a feature."""
    return VACUOUS if track.epoch is None else capped(track.epoch.existence, FEATURE_PRIOR)


def verdict(prior: Existence, votes: Iterable[Existence]) -> Existence:
    """What the map (`prior_of`) and votes, one a vehicle and discounted already, together."""
    return capped(pooled([prior, *votes]), FEATURE_CEILING)


def add_views(tile: TileId, tracks: FeatureTracks, statements: Sequence[Statement], bases: Bases) -> None:
    """Let those vote "absent" who looked where a feature is claimed, had it not in their map, and found nothing.

    Those who passed before anyone had seen it speak of another time. A report whose base is not known abstains.
    """
    absent, names_of = miss(FEATURE_ABSENCE), tracks.names_of()
    for track in tracks.all:
        cells, names = _cells(tile, track, FEATURE_VIEW_MARGIN_M), names_of[track.serial]
        for number in range(max(track.first, 0), len(statements)):
            one = statements[number]
            if one.viewed & cells != cells or number in track.votes or one.base_sha is None:
                continue
            known = bases.get(one.base_sha) if one.base_sha else {}
            if known is not None and known.keys().isdisjoint(names):
                track.votes[number] = Vote(one.vehicle, absent)


def _cells(tile: TileId, track: FeatureTrack, margin_m: float) -> int:
    """Mask of the cells that hold a feature, give or take its sigma; of one that lies outside, those nearest to it."""
    cov = track.state.cov_m2
    half_m = np.maximum(np.sqrt(np.diag(cov)[:2]), margin_m)
    (south, west), (north, east) = tile.south_west_rad, tile.north_east_rad
    mask = 0
    frame = LocalFrame.of_tile(tile)
    corners = track.state.points_m[:, None, :2] + half_m * np.array([[-1.0, -1.0], [1.0, 1.0]])
    points_m = np.concatenate([corners, np.repeat(track.state.points_m[:, None, 2:], 2, axis=1)], axis=2)
    lat, lon, _ = frame.geodetic_from_enu(points_m)
    rows = np.clip(np.floor((lat - south) / (north - south) * GRID).astype(int), 0, GRID - 1)
    columns = np.clip(np.floor((lon - west) / (east - west) * GRID).astype(int), 0, GRID - 1)
    for (low, high), (left, right) in zip(rows.tolist(), columns.tolist(), strict=True):
        for row in range(low, high + 1):
            mask |= ((1 << (right - left + 1)) - 1) << (row * GRID + left)
    return mask
