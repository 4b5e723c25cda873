"""A feature of an HD map: something with a place and a meaning, such as a sign, a lamp post or a boundary of a lane.

It lies in one tile, in whose ENU frame (`LocalFrame.of_tile`) its points are given; a polyline that crosses tiles is
cut into pieces that share their id. What is published lies on a lattice (`snapped`): whole millimetres, covariances
and masses on levels; so equal features have equal bytes.
"""

import hashlib
import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, check_array
from gnd.gnd_map.errors import FeatureError
from gnd.gnd_map.features.covariance import check_covariance, snapped_covariance
from gnd.gnd_map.features.existence import VACUOUS, Existence

MAX_ID: Final = 2**63 - 1
MAX_POINTS_OF_FEATURE: Final = 4096
MAX_ATTRIBUTES: Final = 256
MAX_KEY_CHARACTERS: Final = 64
MAX_VALUE_CHARACTERS: Final = 1024
MAX_COUNT: Final = 2**31 - 1
MAX_PART: Final = 2**20
MAX_REACH_M: Final = 25_000.0
"""No point of a tile's frame is farther from its centre: heights included."""
KIND_PATTERN: Final = re.compile(r"[a-z][a-z0-9_]{0,63}")

UNKNOWN_HEIGHT_M2: Final = 1e4
"""Variance of a height that nobody has measured."""
M_PER_STEP: Final = 1e-3
MASS_STEPS: Final = 10_000

CUT_START: Final = 1
CUT_END: Final = 2

LAYERS_KNOWN: Final = ("signs", "lanes", "streetlights", "poles")
"""Layers that importers and vehicles know by name; users may name others."""


def is_feature_layer(layer: str) -> bool:
    """Whether a layer holds features: every one whose name does not begin with "ndt" (those hold Gaussians)."""
    return not layer.startswith("ndt")


def feature_id_of(*parts: str | bytes | int) -> int:
    """An id made of what identifies a feature; the same parts give the same id, 1 … 2^63 - 1."""
    told = hashlib.blake2b(digest_size=8)
    for part in parts:
        said = part if isinstance(part, bytes) else str(part).encode()
        told.update(len(said).to_bytes(4, "little") + said)
    return int.from_bytes(told.digest(), "little") % MAX_ID + 1


@dataclass(frozen=True, slots=True, eq=False)
class Feature:
    """One feature, or the piece of a polyline that lies in one tile."""

    feature_id: int
    """1 … 2^63 - 1; pieces of one polyline share it."""
    kind: str
    """Such as "traffic_sign", "streetlight", "pole", "lane_boundary"."""
    points_m: F64
    """(N, 3) in the ENU frame of its tile: one is a point, more are a polyline."""
    cov_m2: F64
    """(6,) xx, xy, xz, yy, yz, zz of the position (of each vertex); `UNKNOWN_HEIGHT_M2` where no height is known."""
    existence: Existence = VACUOUS
    attributes: tuple[tuple[str, str], ...] = ()
    """Key and value, sorted by key, none twice."""
    part: int = 0
    """Which piece of its polyline, in order."""
    cuts: int = 0
    """`CUT_START`, `CUT_END`: the first, the last vertex is only where a tile's border cuts the polyline."""
    hits: int = 0
    """How often it was detected."""
    vehicles: int = 0
    """How many different vehicles have confirmed it."""

    def __post_init__(self) -> None:
        if not 1 <= self.feature_id <= MAX_ID:
            raise FeatureError(f"feature id {self.feature_id} is not in 1 … 2^63 - 1")
        if not KIND_PATTERN.fullmatch(self.kind):
            raise FeatureError(
                f"feature {self.feature_id}: kind {self.kind[:80]!r} does not match {KIND_PATTERN.pattern}"
            )
        self._check_points()
        check_covariance(f"feature {self.feature_id}", self.cov_m2)
        self._check_attributes()
        if not (0 <= self.part <= MAX_PART and 0 <= self.cuts <= 3):
            raise FeatureError(f"feature {self.feature_id}: part {self.part} with cuts {self.cuts}")
        if not (0 <= self.hits <= MAX_COUNT and 0 <= self.vehicles <= MAX_COUNT):
            raise FeatureError(f"feature {self.feature_id}: {self.hits} hits of {self.vehicles} vehicles")

    def _check_points(self) -> None:
        check_array(f"points of feature {self.feature_id}", self.points_m, np.float64, (None, 3))
        if not 1 <= len(self.points_m) <= MAX_POINTS_OF_FEATURE:
            raise FeatureError(
                f"feature {self.feature_id} has {len(self.points_m)} points, need 1 … {MAX_POINTS_OF_FEATURE}"
            )
        reach_m = float(np.abs(self.points_m).max())
        if reach_m > MAX_REACH_M:
            raise FeatureError(
                f"feature {self.feature_id}: a point {reach_m:.0f} m from its tile, limit {MAX_REACH_M:.0f}"
            )

    def _check_attributes(self) -> None:
        keys = [key for key, _ in self.attributes]
        if keys != sorted(set(keys)) or len(keys) > MAX_ATTRIBUTES:
            raise FeatureError(
                f"feature {self.feature_id}: its {len(keys)} attributes are not sorted, twice, or > {MAX_ATTRIBUTES}"
            )
        for key, value in self.attributes:
            if not 1 <= len(key) <= MAX_KEY_CHARACTERS or len(value) > MAX_VALUE_CHARACTERS:
                raise FeatureError(
                    f"feature {self.feature_id}: attribute {key[:80]!r} of {len(value)} characters; limits "
                    f"{MAX_KEY_CHARACTERS} and {MAX_VALUE_CHARACTERS}"
                )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Feature) and self._said == other._said

    def __hash__(self) -> int:
        return hash(self._said)

    @property
    def _said(self) -> tuple[object, ...]:
        geometry = (self.points_m + 0.0).tobytes(), (self.cov_m2 + 0.0).tobytes()
        counts = self.part, self.cuts, self.hits, self.vehicles
        return self.feature_id, self.kind, geometry, self.existence, self.attributes, counts

    @property
    def key(self) -> tuple[int, int]:
        """(feature id, part): what tells it from the others of its tile."""
        return self.feature_id, self.part

    @property
    def is_point(self) -> bool:
        """Whether it is a point, not a (piece of a) polyline."""
        return len(self.points_m) == 1

    @property
    def position_m(self) -> F64:
        """(3,) its point, or the first of its polyline."""
        position: F64 = self.points_m[0]
        return position


def snapped(feature: Feature) -> Feature:
    """The feature on the lattice of what is published; a second time changes nothing.

    Positions are whole millimetres, covariances lie on levels (`snapped_covariance`), masses are whole 1/10000.
    """
    return replace(
        feature,
        points_m=np.round(feature.points_m / M_PER_STEP) / round(1 / M_PER_STEP) + 0.0,
        cov_m2=snapped_covariance(feature.cov_m2),
        existence=_snapped_existence(feature.existence),
    )


def _snapped_existence(existence: Existence) -> Existence:
    exist, absent, conflict = (round(m * MASS_STEPS) for m in (existence.exist, existence.absent, existence.conflict))
    return existence_of_steps(exist, min(absent, MASS_STEPS - exist), conflict)


def existence_of_steps(exist: int, absent: int, conflict: int) -> Existence:
    """Masses of whole 1/10000; what is left is unknown."""
    unknown = MASS_STEPS - exist - absent
    return Existence(exist / MASS_STEPS, absent / MASS_STEPS, unknown / MASS_STEPS, conflict / MASS_STEPS)
