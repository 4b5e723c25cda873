"""Rules that tell "modified" from "normal", and how they are fitted: a plain threshold, and boosted trees.

Every source (a family of worlds, a recording) counts the same, however many rows it has, and marginal voxels count as
much as others. Thresholds are chosen where the mean F1 over sources and levels is best; that of the trees by what
trees say of a source when they were fitted on the others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier

from gnd.fleet_sim.truth import LEVELS, Level
from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.detect.shape_change import FEATURES, MONOTONE, SIMILARITY, Forest, PlainShapeRule, ShapeModel
from studies.modified_study.rows import Mask, ShapeRows, taken

TREES: Final = 120
LEAVES: Final = 16
_RATE: Final = 0.1
_SMALLEST_LEAF: Final = 40
_MOST_ROWS: Final = 13_000
"""Of a source, drawn by chance: more of the same voxels teach little and take long."""
_LIMITS: Final = tuple(round(0.1 * step, 1) for step in range(-15, 16))
_ALIKE: Final = (1.1, 0.9, 0.8, 0.7, 0.65, 0.6, 0.55, 0.5)
"""The first, above every similarity, leaves the trees alone."""
_MAY_COST: Final = 0.5
_TRIED: Final = 60
Sources = Mapping[str, ShapeRows]


@dataclass(frozen=True, slots=True)
class ShapeScore:
    """How many modified voxels a rule finds, calls so wrongly, and misses."""

    hits: int
    false: int
    missed: int

    @classmethod
    def of(cls, rows: ShapeRows, said: Mask, level: Level) -> "ShapeScore":
        """Compare what a rule says (N,) with the truth at a level."""
        counts, true = rows.mask(level), rows.modified
        hits, false = int((said & true & counts).sum()), int((said & ~true & counts).sum())
        return cls(hits, false, int((~said & true & counts).sum()) + rows.missed_at(level))

    def as_dict(self) -> dict[str, float]:
        """Precision, recall and F1 in percent, 0 where there is nothing to divide by."""
        precision, recall = (100.0 * self.hits / max(self.hits + n, 1) for n in (self.false, self.missed))
        f1 = 2.0 * precision * recall / max(precision + recall, 1e-12)
        return {"precision": round(precision, 2), "recall": round(recall, 2), "f1": round(f1, 2)}

    @property
    def f1(self) -> float:
        """F1 in percent."""
        return self.as_dict()["f1"]


def strongest_threshold(sources: Sources) -> PlainShapeRule:
    """Return the one threshold on one feature that is best on the mean over the sources."""
    features = {name: rows.features for name, rows in sources.items()}
    best, rule = -1.0, PlainShapeRule(0, 0.0, below=False)
    for feature in range(len(FEATURES)):
        values = np.concatenate([held[:, feature] for held in features.values()])
        for threshold in np.unique(np.quantile(values, np.linspace(0.02, 0.98, _TRIED))).tolist():
            for below in (False, True):
                one = PlainShapeRule(feature, threshold, below)
                f1 = _mean_f1(sources, {name: one.reshaped(held) for name, held in features.items()})
                best, rule = (f1, one) if f1 > best else (best, rule)
    return rule


def fitted_model(sources: Sources) -> ShapeModel:
    """Fit trees, the limits between which they decide, their range, and the plain rule outside of it."""
    some = {name: thinned(rows) for name, rows in sources.items()}
    odds = {}
    for name, rows in some.items():
        others = {other: held for other, held in some.items() if other != name}
        odds[name] = forest_of(fit(others)).log_odds(rows.features)
    limit, alike = best_limits(some, odds)
    features = np.concatenate([rows.features for rows in sources.values()])
    low, high = features.min(axis=0), features.max(axis=0)
    return ShapeModel(forest_of(fit(some)), limit, alike, low, high, strongest_threshold(some))


def best_limits(sources: Sources, odds: Mapping[str, F64]) -> tuple[float, float]:
    """Return the log-odds above which, and the similarity below which, trees are followed.

    The best mean F1 over sources and levels decides, among those pairs that cost no source more than `_MAY_COST` of F1
    (observable) against the trees alone at their best.

    Args:
        sources: rows by source.
        odds: (N,) of each source, by trees that have not seen it.
    """
    similar = {name: rows.features[:, SIMILARITY] for name, rows in sources.items()}

    def said(limit: float, alike: float) -> dict[str, Mask]:
        return {name: (odds[name] > limit) & (similar[name] < alike) for name in sources}

    without = [_observable_f1(sources, said(limit, _ALIKE[0])) for limit in _LIMITS]
    best_without = max(without, key=lambda f1: sum(f1.values()))
    floor = {name: f1 - _MAY_COST for name, f1 in best_without.items()}
    best, found = -1.0, (0.0, _ALIKE[0])
    for limit, alike in product(_LIMITS, _ALIKE):
        one = said(limit, alike)
        f1 = _mean_f1(sources, one)
        if f1 > best and all(got >= floor[name] for name, got in _observable_f1(sources, one).items()):
            best, found = f1, (limit, alike)
    return found


def _observable_f1(sources: Sources, said: Mapping[str, Mask]) -> dict[str, float]:
    return {name: ShapeScore.of(rows, said[name], "observable").f1 for name, rows in sources.items()}


def thinned(rows: ShapeRows) -> ShapeRows:
    """At most `_MOST_ROWS` of the rows that a surface holds before and after, by a seeded draw."""
    held = np.flatnonzero(rows.held)
    drawn = np.random.default_rng(len(rows)).permutation(held)[:_MOST_ROWS]
    return taken(rows, np.sort(drawn))


def _mean_f1(sources: Sources, said: Mapping[str, Mask]) -> float:
    scores = [ShapeScore.of(rows, said[name], level).f1 for name, rows in sources.items() for level in LEVELS]
    return float(np.mean(scores))


def fit(sources: Sources) -> HistGradientBoostingClassifier:
    """Fit the trees; the same rows give the same trees."""
    features = np.concatenate([rows.features for rows in sources.values()])
    modified = np.concatenate([rows.modified for rows in sources.values()])
    weight = np.concatenate([np.full(len(rows), len(modified) / len(sources) / len(rows)) for rows in sources.values()])
    return boosted(features, modified, weight)


def boosted(features: F64, modified: Mask, weight: F64) -> HistGradientBoostingClassifier:
    """Fit boosted trees to features (N, F), labels (N,) and weights (N,)."""
    model = HistGradientBoostingClassifier(
        max_iter=TREES,
        learning_rate=_RATE,
        max_leaf_nodes=LEAVES,
        min_samples_leaf=_SMALLEST_LEAF,
        l2_regularization=1.0,
        monotonic_cst=list(MONOTONE),
        early_stopping=False,
        random_state=0,
    )
    return model.fit(features, modified, weight)


def forest_of(model: HistGradientBoostingClassifier) -> Forest:
    """Return a fitted model's trees as the vehicle evaluates them."""
    trees = [predictors[0].nodes for predictors in model._predictors]
    sizes = np.cumsum([0, *map(len, trees)])
    columns: dict[str, list[NDArray[Any]]] = {"feature": [], "threshold": [], "left": [], "right": []}
    for nodes, start in zip(trees, sizes[:-1].tolist(), strict=True):
        leaf = nodes["is_leaf"].astype(bool)
        columns["feature"].append(np.where(leaf, -1, nodes["feature_idx"].astype(np.int32)))
        columns["threshold"].append(np.where(leaf, nodes["value"], nodes["num_threshold"]))
        columns["left"].append(np.where(leaf, 0, start + nodes["left"].astype(np.int64)))
        columns["right"].append(np.where(leaf, 0, start + nodes["right"].astype(np.int64)))
    joint = {name: np.concatenate(parts) for name, parts in columns.items()}
    ints = {name: joint[name].astype(np.int32) for name in ("feature", "left", "right")}
    baseline = float(np.ravel(model._baseline_prediction)[0])
    return Forest(baseline, sizes[:-1].astype(np.int32), threshold=joint["threshold"].astype(np.float64), **ints)


def figures_of(
    sources: Sources,
    said: Mapping[str, Mask],
    levels: Sequence[Level],
    parts: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Scores of a rule by level and source; beside them the mean and the worst F1 over all, and over parts of them.

    Args:
        sources: rows by source.
        said: (N,) of each source, whether the rule calls a row modified.
        levels: of voxels.
        parts: names of sources, by what they are called together; those that are not there count for nothing.
    """
    found: dict[str, Any] = {}
    for level in levels:
        by = {name: ShapeScore.of(rows, said[name], level).as_dict() for name, rows in sources.items()}
        f1 = {name: row["f1"] for name, row in by.items()}
        groups = {"all": tuple(f1)} | {what: [n for n in names if n in f1] for what, names in (parts or {}).items()}
        over = {
            what: {"mean_f1": round(float(np.mean([f1[n] for n in names])), 2), "worst_f1": min(f1[n] for n in names)}
            for what, names in groups.items()
            if names
        }
        found[level] = {"by": by, "over": over}
    return found
