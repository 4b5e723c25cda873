"""How good a feature layer is against the truth of a simulated street: classes as in Jo et al., Table 1, and places.

A map after a run is compared with the truth and the map before. A mapped feature that is still there was judged normal,
one that is gone deleted; one that the map before had not was judged new. New features are matched with the truth one to
one, nearest first, within a tolerance. A mapped feature whose place was corrected to where its moved thing stands now
counts as both, deleted and new.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import EvaluationError
from gnd.fleet_sim.feature_truth import FeatureClass, FeatureTruth, TrueFeature
from gnd.gnd_map.features import Feature, FeatureTile, geodetic_in_tile
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId

FloatArray = NDArray[np.float64]

TOLERANCE_M: Final = 1.0
"""A feature of the map this near to one of the truth is that feature."""


@dataclass(frozen=True, slots=True)
class FeatureClassScore:
    """How one class was judged: right ones, wrongly found ones, missed ones."""

    right: int
    wrong: int
    missed: int

    @property
    def precision(self) -> float:
        """Share of what was judged so that is so; 1 where nothing was."""
        return self.right / max(self.right + self.wrong, 1) if self.right + self.wrong else 1.0

    @property
    def recall(self) -> float:
        """Share of what is so that was judged so; 1 where nothing is."""
        return self.right / max(self.right + self.missed, 1) if self.right + self.missed else 1.0

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.right / max(2 * self.right + self.wrong + self.missed, 1) if self._any else 1.0

    @property
    def _any(self) -> int:
        return self.right + self.wrong + self.missed


@dataclass(frozen=True, slots=True)
class FeatureScore:
    """A layer against the truth.

    Attributes:
        layer: which.
        classes: "normal", "deleted" and "new".
        truth: how many there are of each.
        error_m: horizontal errors of the matched new features, sorted.
        normal_error_m: horizontal errors of the normal ones that are in the map, sorted.
    """

    layer: str
    classes: Mapping[FeatureClass, FeatureClassScore]
    truth: Mapping[FeatureClass, int]
    error_m: tuple[float, ...]
    normal_error_m: tuple[float, ...]

    @property
    def mean_error_m(self) -> float:
        """Mean horizontal error of new features, nan where there are none."""
        return float(np.mean(self.error_m)) if self.error_m else float("nan")

    @property
    def error_95_m(self) -> float:
        """95 % of the new features lie this near or nearer, nan where there are none."""
        return float(np.percentile(self.error_m, 95.0)) if self.error_m else float("nan")

    def as_dict(self) -> dict[str, object]:
        """Return it as plain values for JSON; no place known is None."""
        scores = {
            name: {"truth": self.truth[name], "right": s.right, "wrong": s.wrong, "missed": s.missed,
                   "precision": s.precision, "recall": s.recall, "f1": s.f1}
            for name, s in self.classes.items()
        }  # fmt: skip
        known = bool(self.error_m)
        error = {"mean": self.mean_error_m if known else None, "p95": self.error_95_m if known else None}
        return {"layer": self.layer, "classes": scores, "new_position_error_m": error}


@dataclass(frozen=True, slots=True)
class _Placed:
    """Point features of a map in the map frame of the truth; kinds differ from layer to layer and are not compared."""

    ids: tuple[int, ...]
    xy_m: FloatArray


def score_features(
    truth: FeatureTruth,
    layer: str,
    tiles: Iterable[FeatureTile],
    tolerance_m: float = TOLERANCE_M,
    only: Iterable[int] | None = None,
) -> FeatureScore:
    """Score the state of a layer after a run.

    Args:
        truth: of the world.
        layer: which layer.
        tiles: the layer's tiles now; those of the map before where nothing was published since.
        tolerance_m: see TOLERANCE_M.
        only: ids of the truth that count; None: those that can be seen from the stretch that is driven (`driven`). What
            lies at the others is neither right nor wrong.

    Raises:
        EvaluationError: the tolerance is not positive.
    """
    if not tolerance_m > 0:
        raise EvaluationError(f"the tolerance must be positive, got {tolerance_m} m")
    counted = {f.feature_id for f in driven(truth)} if only is None else set(only)
    there = _placed(truth.world.frame, tiles)
    known = {f.feature_id: f for f in truth.of(layer, "normal", "deleted")}
    now = dict(zip(there.ids, there.xy_m, strict=True))
    new = truth.of(layer, "new")
    relocated = _relocated(truth, layer, known, now, tolerance_m)
    found = [k for k, number in enumerate(there.ids) if number not in known or number in relocated]
    pairs = _matched(_xy(new), there.xy_m[found], tolerance_m)
    matched = {new[i].feature_id: distance for i, _, distance in pairs}
    spare = set(range(len(found))) - {j for _, j, _ in pairs}
    ignored = _xy([f for f in truth.of(layer) if f.feature_id not in counted])
    wrong_new = [j for j in spare if not (np.linalg.norm(ignored - there.xy_m[found[j]], axis=1) <= tolerance_m).any()]
    kept = {number for number in now if number in known and number not in relocated}
    normal = {f.feature_id for f in known.values() if f.state == "normal"} & counted
    deleted = {f.feature_id for f in known.values() if f.state == "deleted"} & counted
    wanted = {f.feature_id for f in new} & counted
    classes: dict[FeatureClass, FeatureClassScore] = {
        "normal": FeatureClassScore(len(normal & kept), len(deleted & kept), len(normal - kept)),
        "deleted": FeatureClassScore(len(deleted - kept), len(normal - kept), len(deleted & kept)),
        "new": FeatureClassScore(len(wanted & matched.keys()), len(wrong_new), len(wanted - matched.keys())),
    }
    numbers: dict[FeatureClass, int] = {"normal": len(normal), "deleted": len(deleted), "new": len(wanted)}
    errors = tuple(sorted(distance for number, distance in matched.items() if number in wanted))
    return FeatureScore(layer, classes, numbers, errors, _errors_of(known, now, normal & kept))


def driven(truth: FeatureTruth) -> tuple[TrueFeature, ...]:
    """Return the features beside the stretch that is driven, but for those that are buried or doubled.

    Beyond the ends of the stretch nobody looks long enough.
    """
    features = truth.features
    if not features:
        return ()
    street = truth.world.street_of_map(np.array([f.position_map_m for f in features]))
    inside = np.abs(street[:, 0]) <= truth.world.half_length_m
    seen = (held and not (f.buried or f.doubled) for f, held in zip(features, inside.tolist(), strict=True))
    return tuple(f for f, one in zip(features, seen, strict=True) if one)


def tiles_of_one_drive(
    base: Sequence[FeatureTile], absent: Iterable[int], found: Mapping[TileId, Sequence[Feature]]
) -> tuple[FeatureTile, ...]:
    """Return the layer as one drive alone would have it, to be scored.

    Args:
        base: tiles of the map before.
        absent: ids of mapped features that the drive says are gone.
        found: by tile id, features that the drive says are new.
    """
    gone, tiles = set(absent), {tile.tile_id: list(tile.features) for tile in base}
    for tile_id, features in found.items():
        tiles.setdefault(tile_id, []).extend(features)
    return tuple(
        FeatureTile.of(tile_id, 1, [f for f in tiles[tile_id] if f.feature_id not in gone]) for tile_id in sorted(tiles)
    )


def _placed(frame: LocalFrame, tiles: Iterable[FeatureTile]) -> _Placed:
    """The point features that exist, in a map frame."""
    ids, places = [], []
    for tile in tiles:
        points = [f for f in tile.features if f.is_point and f.existence.state != "absent"]
        if points:
            geodetic = geodetic_in_tile(tile.tile_id, np.array([f.position_m for f in points]))
            places.append(frame.enu_from_geodetic(*geodetic)[:, :2])
            ids += [f.feature_id for f in points]
    return _Placed(tuple(ids), np.concatenate(places) if places else np.empty((0, 2)))


def _xy(features: Sequence[TrueFeature]) -> FloatArray:
    return np.array([f.position_map_m[:2] for f in features], dtype=np.float64).reshape(-1, 2)


def _relocated(
    truth: FeatureTruth, layer: str, known: Mapping[int, TrueFeature], now: Mapping[int, FloatArray], tolerance_m: float
) -> set[int]:
    """Ids of mapped features that were moved, and whose place in the map now is the new one rather than the old."""
    after = {f.name: f for f in truth.of(layer, "new") if f.moved}
    found = set()
    for number, feature in known.items():
        if feature.moved and number in now and feature.name in after:
            old, new = _xy([feature, after[feature.name]])
            off = float(np.linalg.norm(now[number] - new))
            if off < tolerance_m and off < float(np.linalg.norm(now[number] - old)):
                found.add(number)
    return found


def _matched(truth_xy: FloatArray, map_xy: FloatArray, tolerance_m: float) -> list[tuple[int, int, float]]:
    """Pairs (truth, map, distance), one to one, nearest first."""
    if not len(truth_xy) or not len(map_xy):
        return []
    distance = np.linalg.norm(truth_xy[:, None] - map_xy[None], axis=2)
    pairs: list[tuple[int, int, float]] = []
    taken: tuple[set[int], set[int]] = (set(), set())
    for flat in np.argsort(distance, axis=None, kind="stable").tolist():
        i, j = divmod(flat, distance.shape[1])
        if distance[i, j] > tolerance_m:
            break
        if i not in taken[0] and j not in taken[1]:
            pairs.append((i, j, float(distance[i, j])))
            taken[0].add(i)
            taken[1].add(j)
    return pairs


def _errors_of(
    known: Mapping[int, TrueFeature], now: Mapping[int, FloatArray], chosen: Iterable[int]
) -> tuple[float, ...]:
    return tuple(sorted(float(np.linalg.norm(now[n] - known[n].position_map_m[:2])) for n in chosen))
