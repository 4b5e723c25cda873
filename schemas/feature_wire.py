"""What one drive says of the features of one tile as protobuf columns of small integers, and back."""

from collections.abc import Sequence

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import Existence, decode_features, encode_features
from gnd.gnd_map.features.covariance import MAX_RATIO_STEPS, TOP_LEVEL, covariance_of, levels_of
from gnd.gnd_map.features.feature import M_PER_STEP, MASS_STEPS, existence_of_steps
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.feature_change import FeatureChange, Found, Seen
from gnd.schemas.generated import feature_change_pb2
from gnd.schemas.wire import check_length, refusing, tile_id

Place = tuple[F64 | None, F64 | None]
"""Position and covariance; None where nothing was measured."""


def change_message(change: FeatureChange) -> feature_change_pb2.FeatureChange:
    """The message of a change that is snapped."""
    measured = [(row, seen) for row, seen in enumerate(change.seen) if seen.position_m is not None]
    found = [one.as_feature(number) for number, one in enumerate(change.found, start=1)]
    return feature_change_pb2.FeatureChange(
        tile=change.tile.morton,
        base_version=change.base_version,
        base_sha=change.base_sha,
        viewed=change.viewed,
        seen_id=[seen.feature_id for seen in change.seen],
        seen_masses=[steps for seen in change.seen for steps in _steps_of(seen.existence)],
        seen_hits=[seen.hits for seen in change.seen],
        measured=[row for row, _ in measured],
        measured_mm=[mm for _, seen in measured for mm in _mm_of(seen.position_m)],
        measured_levels=[level for _, seen in measured for level in _levels_of(seen.cov_m2)],
        found=encode_features(found) if found else b"",
    )


def _steps_of(existence: Existence) -> tuple[int, int, int]:
    masses = (existence.exist, existence.absent, existence.conflict)
    exist, absent, conflict = (round(mass * MASS_STEPS) for mass in masses)
    return exist, absent, conflict


def _mm_of(position_m: F64 | None) -> list[int]:
    assert position_m is not None
    return [round(float(x) / M_PER_STEP) for x in position_m]


def _levels_of(cov_m2: F64 | None) -> tuple[int, ...]:
    assert cov_m2 is not None
    return levels_of(cov_m2)


def change_of(message: feature_change_pb2.FeatureChange) -> FeatureChange:
    """The checked value of a parsed message; `SchemaError` when it is none."""
    tile = tile_id(message.tile)
    name = f"features of tile {tile}"
    check_length(name, len(message.seen_id), limits.MAX_FEATURES_OF_TILE, "map features judged")
    with refusing(name):
        return FeatureChange(
            tile=tile,
            base_version=message.base_version,
            base_sha=message.base_sha,
            viewed=message.viewed,
            seen=_seen(message),
            found=_found(message.found),
        )


def _seen(message: feature_change_pb2.FeatureChange) -> tuple[Seen, ...]:
    n, m = len(message.seen_id), len(message.measured)
    counts = (len(message.seen_masses), len(message.seen_hits), len(message.measured_mm), len(message.measured_levels))
    if counts != (3 * n, n, 3 * m, 6 * m):
        raise BadValue(
            f"{n} map features judged, {m} of them measured, come with {counts[0]} masses, {counts[1]} hits, "
            f"{counts[2]} coordinates and {counts[3]} levels; expected {3 * n}, {n}, {3 * m} and {6 * m}"
        )
    places = _places(message)
    return tuple(
        Seen(feature_id, _existence(message.seen_masses[3 * row : 3 * row + 3]), message.seen_hits[row], *places[row])
        for row, feature_id in enumerate(message.seen_id)
    )


def _places(message: feature_change_pb2.FeatureChange) -> list[Place]:
    """Position (3,) and covariance (6,) of each judged feature, None where it was not measured."""
    rows, n = list(message.measured), len(message.seen_id)
    if rows != sorted(set(rows)) or (rows and rows[-1] >= n):
        raise BadValue(f"measured features {rows[:9]} are not ascending indices of the {n} judged")
    places: list[Place] = [(None, None)] * n
    positions_m = np.array(message.measured_mm, np.int64).reshape(-1, 3) / round(1 / M_PER_STEP)
    for number, row in enumerate(rows):
        places[row] = positions_m[number], _covariance(message.measured_levels[6 * number : 6 * number + 6])
    return places


def _covariance(levels: Sequence[int]) -> F64:
    k0, k1, k2, t10, t20, t21 = levels
    if not all(0 <= k <= TOP_LEVEL for k in (k0, k1, k2)) or max(map(abs, (t10, t20, t21))) > MAX_RATIO_STEPS:
        raise BadValue(
            f"levels {tuple(levels)} of a covariance: 0 .. {TOP_LEVEL} and -{MAX_RATIO_STEPS} .. {MAX_RATIO_STEPS}"
        )
    return covariance_of((k0, k1, k2, t10, t20, t21))


def _existence(steps: Sequence[int]) -> Existence:
    exist, absent, conflict = steps
    if exist + absent > MASS_STEPS or conflict > MASS_STEPS:
        raise BadValue(f"masses {exist}, {absent} and conflict {conflict} exceed {MASS_STEPS}/{MASS_STEPS}")
    return existence_of_steps(exist, absent, conflict)


def _found(body: bytes) -> tuple[Found, ...]:
    if not body:
        return ()
    features = decode_features(body)
    plain = [(number, 0, 0, 0) for number in range(1, len(features) + 1)]
    if [(one.feature_id, one.part, one.cuts, one.vehicles) for one in features] != plain or not features:
        raise BadValue(f"the {len(features)} features found are not numbered 1, 2, 3 .. without parts and vehicles")
    return tuple(map(Found.of, features))
