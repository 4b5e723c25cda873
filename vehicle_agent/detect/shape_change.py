"""Whether the surface in a voxel has changed its shape: the log-odds of a measured Gaussian against the map's.

The similarity of GND Eq. (13) judges two Gaussians alone: a thick one resembles almost anything, a thin one almost
nothing, and the counts of the rays are left out. Here figures of the two Gaussians and the counters are weighed
together by boosted regression trees, each monotone in what must only speak for or against a change. They were fitted on
simulated worlds of several families and on real recordings that no figure of merit is reported on
(`python -m studies.fit_shape_change`); the vehicle evaluates them alone, without the library that fitted them.

Trees answer whatever they are asked. So they need a second opinion: what Eq. (13) finds alike is not changed. And the
model holds the range of each figure that it was fitted on: outside of it, one plain threshold decides, which needs few
examples.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I32, check_array
from gnd.gnd_map.bounded import json_value
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.jit import kernel
from gnd.gnd_map.similarity import similarity
from gnd.vehicle_agent.errors import VehicleError

FEATURES: Final = (
    "map_offset_m",
    "new_offset_m",
    "similarity",
    "outside_share",
    "passed_share",
    "cells",
    "map_thickness",
    "new_thickness",
    "new_spread_m",
    "map_spread_m",
    "map_middle",
    "new_middle",
)
"""Distance of the two means along the map Gaussian's thin axis, and along the new one's; similarity (default mode);
BO over BI + BO; PI over BI + BO + PI; logarithm of the new Gaussian's sub-cells; logarithms of both smallest
eigenvalues; standard deviation of each Gaussian along the other's thin axis; logarithms of both middle eigenvalues:
beside the smallest they tell a plane from a bush. The map's sub-cells are none of them: a rounded map says "at least
20" of every voxel."""
SIMILARITY: Final = FEATURES.index("similarity")
"""Where the features hold the similarity of Eq. (13)."""
MONOTONE: Final = (1, 1, -1, 1, 1, 0, 0, 0, 1, 0, 0, 0)
"""How each feature may act on the log-odds: 1 upwards only, -1 downwards only, 0 freely."""
NOISE_M: Final = 0.05
"""Of the similarity that the trees were fitted with."""
_THIN_M2: Final = 2e-4
"""Added to eigenvalues before the logarithm: (1.4 cm)², below the noise of any sensor."""


class ShapeModelError(VehicleError):
    """The file of the fitted trees is damaged."""


@dataclass(frozen=True, slots=True, eq=False)
class Forest:
    """Regression trees whose leaves add up.

    Attributes:
        baseline: log-odds without any tree.
        root: int32 (T,), first node of each tree.
        feature: int32 (M,), what a node asks about; -1 for a leaf.
        threshold: float64 (M,): go left when the feature is at most this; the value of a leaf.
        left, right: int32 (M,), the next node.
    """

    baseline: float
    root: NDArray[np.int32]
    feature: NDArray[np.int32]
    threshold: F64
    left: NDArray[np.int32]
    right: NDArray[np.int32]

    def __post_init__(self) -> None:
        n = len(self.feature)
        check_array("threshold", self.threshold, np.float64, (n,))
        for name in ("root", "left", "right"):
            nodes = getattr(self, name)
            if len(nodes) != (len(self.root) if name == "root" else n) or not ((nodes >= 0) & (nodes < n)).all():
                raise ShapeModelError(f"trees with {n} nodes: {name} names other nodes")
        inner = np.flatnonzero(self.feature >= 0)
        if (np.minimum(self.left, self.right)[inner] <= inner).any() or (self.feature >= len(FEATURES)).any():
            raise ShapeModelError(
                f"trees with {n} nodes: a node leads back, or asks about feature {self.feature.max()}"
            )

    def log_odds(self, features: F64) -> F64:
        """Return the sum of the leaves, float64 (N,), for features (N, F) in the order of `FEATURES`."""
        check_array("features", features, np.float64, (None, len(FEATURES)))
        return self.baseline + _leaves(features, self.root, self.feature, self.threshold, self.left, self.right)


@dataclass(frozen=True, slots=True)
class PlainShapeRule:
    """One threshold on one feature: what decides without any trees.

    Attributes:
        feature: which of `FEATURES`.
        threshold: the shape has changed where the feature lies above it; below it where `below`.
        below: see there.
    """

    feature: int
    threshold: float
    below: bool

    def __post_init__(self) -> None:
        if not 0 <= self.feature < len(FEATURES) or not math.isfinite(self.threshold):
            raise ShapeModelError(f"a plain rule of feature {self.feature} at {self.threshold}")

    def reshaped(self, features: F64) -> NDArray[np.bool_]:
        """(N,) whether the shape has changed, for features (N, F)."""
        value = features[:, self.feature]
        return np.asarray(value < self.threshold if self.below else value > self.threshold)


@dataclass(frozen=True, slots=True, eq=False)
class ShapeModel:
    """Trees, where they decide, and what decides elsewhere.

    Attributes:
        forest: the trees.
        limit: the shape may have changed above these log-odds ...
        alike: ... and where the two Gaussians are less similar than this (Eq. 13).
        low, high: float64 (F,), least and largest value of each feature among the examples of the fit.
        plain: decides about voxels with a feature outside of these.
    """

    forest: Forest
    limit: float
    alike: float
    low: F64
    high: F64
    plain: PlainShapeRule

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            check_array(name, getattr(self, name), np.float64, (len(FEATURES),))
        if not math.isfinite(self.limit) or not self.alike > 0.0 or not (self.low <= self.high).all():
            raise ShapeModelError(f"limit {self.limit}, alike {self.alike}, features from {self.low} to {self.high}")

    def knows(self, features: F64) -> NDArray[np.bool_]:
        """(N,) whether every feature (N, F) lies within what the trees were fitted on."""
        return np.asarray(((features >= self.low) & (features <= self.high)).all(axis=1))

    def reshaped(self, features: F64) -> NDArray[np.bool_]:
        """(N,) whether the shape has changed, for features (N, F) in the order of `FEATURES`."""
        by_trees = (self.forest.log_odds(features) > self.limit) & (features[:, SIMILARITY] < self.alike)
        return np.where(self.knows(features), by_trees, self.plain.reshaped(features))

    def to_json(self) -> str:
        """Return the text of the model's file."""
        nodes = {name: getattr(self.forest, name).tolist() for name in _NODES}
        said = {"features": FEATURES, "baseline": self.forest.baseline, **nodes}
        span = {"limit": self.limit, "alike": self.alike, "low": self.low.tolist(), "high": self.high.tolist()}
        return json.dumps(said | span | {"plain": asdict(self.plain)}) + "\n"

    @classmethod
    def from_json(cls, text: str) -> "ShapeModel":
        """Read a model.

        Raises:
            ShapeModelError: the text is no model of these features.
        """
        try:
            data = json_value(text)
            if tuple(data["features"]) != FEATURES:
                raise ShapeModelError(f"the trees ask about {data['features']}, this program knows {FEATURES}")
            low, high = (np.array(data[name], np.float64) for name in ("low", "high"))
            plain = PlainShapeRule(**data["plain"])
            return cls(forest_from(data), float(data["limit"]), float(data["alike"]), low, high, plain)
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise ShapeModelError(f"the file of the fitted trees is damaged: {error}") from error


_NODES: Final = ("root", "feature", "threshold", "left", "right")


def forest_from(data: Mapping[str, Any]) -> Forest:
    """Make trees of their columns as plain lists."""
    ints = {name: np.array(data[name], np.int32) for name in _NODES if name != "threshold"}
    return Forest(float(data["baseline"]), threshold=np.array(data["threshold"], np.float64), **ints)


@kernel
def _leaves(
    x: F64,
    root: NDArray[np.int32],
    feature: NDArray[np.int32],
    threshold: F64,
    left: NDArray[np.int32],
    right: NDArray[np.int32],
) -> F64:
    total = np.zeros(len(x))
    for i in range(len(x)):
        for node in root:
            at = node
            while feature[at] >= 0:
                at = left[at] if x[i, feature[at]] <= threshold[at] else right[at]
            total[i] += threshold[at]
    return total


@lru_cache(maxsize=1)
def fitted() -> ShapeModel:
    """Return the model that was fitted (`shape_change.json` beside this file)."""
    return ShapeModel.from_json((files("gnd.vehicle_agent.detect") / "shape_change.json").read_text(encoding="utf-8"))


def shape_features(was: Gaussians, now: Gaussians, n_bi: I32, n_bo: I32, n_pi: I32, noise_m: float = NOISE_M) -> F64:
    """Return the `FEATURES` (N, 12) of N voxels.

    Args:
        was: the map's Gaussians of the voxels.
        now: the measured ones, in the same order.
        n_bi: (N,) points blocked inside the map's Gaussian.
        n_bo: (N,) points blocked outside it.
        n_pi: (N,) rays that passed it.
        noise_m: of the similarity; more where the poses are known poorly.
    """
    thin_was, middle_was, normal_was = _axes(was)
    thin_now, middle_now, normal_now = _axes(now)
    step = now.mean_m.astype(np.float64) - was.mean_m
    columns = [
        np.abs(np.einsum("ni,ni->n", normal_was, step)),
        np.abs(np.einsum("ni,ni->n", normal_now, step)),
        similarity(was.exists, was.mean_m, was.cov_m2, now.exists, now.mean_m, now.cov_m2, noise_m=noise_m),
        n_bo / np.maximum(n_bi + n_bo, 1),
        n_pi / np.maximum(n_bi + n_bo + n_pi, 1),
        np.log(np.maximum(now.cells, 1)),
        np.log(thin_was + _THIN_M2),
        np.log(thin_now + _THIN_M2),
        _spread_m(now, normal_was),
        _spread_m(was, normal_now),
        np.log(middle_was + _THIN_M2),
        np.log(middle_now + _THIN_M2),
    ]
    return np.column_stack(columns)


def _axes(gaussians: Gaussians) -> tuple[F64, F64, F64]:
    """Smallest and middle eigenvalue (N,), and the direction (N, 3) of the smallest."""
    values, vectors = np.linalg.eigh(gaussians.full_cov())
    return values[:, 0].clip(0.0), values[:, 1].clip(0.0), vectors[:, :, 0]


def _spread_m(gaussians: Gaussians, axis: F64) -> F64:
    """Standard deviation (N,) along unit vectors (N, 3)."""
    return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", axis, gaussians.full_cov(), axis).clip(0.0)))
