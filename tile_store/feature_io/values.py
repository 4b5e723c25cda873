"""What files of features are turned into, and made from: features on the Earth, each with the layer it belongs to."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import pi
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import FeatureError
from gnd.gnd_map.features import (
    UNKNOWN_HEIGHT_M2,
    Existence,
    Feature,
    check_simple_polyline,
    is_feature_layer,
    prior,
)
from gnd.gnd_map.features.feature import KIND_PATTERN, MAX_ATTRIBUTES, MAX_KEY_CHARACTERS, MAX_VALUE_CHARACTERS
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.limits import MAX_FLOOR, MIN_FLOOR
from gnd.tile_store.feature_io.errors import BadGeometry, DuplicateId, FeatureFileError, FileTooLarge
from gnd.tile_store.feature_io.lane_network import MapLane, check_lanes
from gnd.tile_store.feature_io.placement import Placement
from gnd.tile_store.values import check_layer

LAYER_OF_KIND: Final[Mapping[str, str]] = {
    "traffic_sign": "signs",
    "traffic_light": "signs",
    "pole": "poles",
    "streetlight": "streetlights",
    "lane_boundary": "lanes",
    "stop_line": "lanes",
    "crosswalk": "crosswalks",
    "drivable_area": "drivable_areas",
}
"""Where features go unless told otherwise; other kinds are left out unless a layer is named for them."""

LEFT_OUT: Final = "-"
"""Instead of a layer: features of this kind are not imported."""
SURE: Final = 0.95
"""How sure a map is that what it holds exists (λ_HD; SLAMCU, section 6.2), unless told otherwise."""
SIGMA_M: Final = 0.1
"""One sigma of an axis of what a file holds, which no format but our GeoJSON states; HD maps are within 10 to 20 cm
(SLAMCU, section 1)."""
MAX_VERTICES_OF_LINE: Final = 20_000
MAX_NOTES: Final = 20
"""So many findings are written out; the rest is counted."""
_LATITUDE_LIMIT: Final = pi / 2
_SLACK: Final = 1e-12


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """How a file is understood.

    layers: by kind, the layer for it (`LEFT_OUT`: none); they come before `LAYER_OF_KIND`.
    other: the layer for every other kind; None: left out.
    placement: where local coordinates lie; None: the file says it itself.
    trust_latlon: latitudes and longitudes hold although local coordinates stand beside them.
    height_offset_m: added to the file's heights, which makes them ellipsoidal: the geoid's height there, when they are
        above the sea.
    sigma_m, sigma_up_m: of the positions; exist: mass of their existence.
    strict: lines and borders that cross refuse the file; otherwise they are reported and kept.
    """

    layers: Mapping[str, str] = field(default_factory=dict)
    other: str | None = None
    placement: Placement | None = None
    trust_latlon: bool = False
    height_offset_m: float = 0.0
    sigma_m: float = SIGMA_M
    sigma_up_m: float = SIGMA_M
    exist: float = SURE
    strict: bool = False

    def __post_init__(self) -> None:
        for layer in (*self.layers.values(), *([] if self.other is None else [self.other])):
            if layer != LEFT_OUT and not is_feature_layer(check_layer(layer)):
                raise FeatureFileError(f"layer {layer!r} holds Gaussians: feature layers do not begin with ndt")
        if not (0 < self.sigma_m <= 100 and 0 < self.sigma_up_m <= 100):
            raise FeatureFileError(f"sigmas are in 0 … 100 m, got {self.sigma_m} and {self.sigma_up_m}")
        if not abs(self.height_offset_m) <= MAX_FLOOR:
            raise FeatureFileError(f"height offset {self.height_offset_m} m is beyond {MAX_FLOOR} m")
        prior(self.exist)

    def layer_of(self, kind: str) -> str:
        """The layer of a kind, or `LEFT_OUT`."""
        return self.layers.get(kind) or LAYER_OF_KIND.get(kind) or self.other or LEFT_OUT

    def cov_m2(self, *, height_known: bool) -> F64:
        """(6,) of a position."""
        up = self.sigma_up_m**2 if height_known else UNKNOWN_HEIGHT_M2
        return np.array([self.sigma_m**2, 0.0, 0.0, self.sigma_m**2, 0.0, up])

    def existence(self) -> Existence:
        """What a map says of what it holds. SLAMCU, Eq. (3)."""
        return prior(self.exist)


@dataclass(frozen=True, slots=True, eq=False)
class MapFeature:
    """One feature on the Earth, whole: not cut into tiles.

    name: what its file calls it, for messages. lat_rad, lon_rad, height_m (ellipsoidal): (N,) each, one vertex is a
    point. The rest is as in `gnd.gnd_map.features.Feature`.
    """

    feature_id: int
    kind: str
    layer: str
    lat_rad: F64
    lon_rad: F64
    height_m: F64
    cov_m2: F64
    existence: Existence
    attributes: tuple[tuple[str, str], ...] = ()
    name: str = ""
    hits: int = 0
    vehicles: int = 0

    def __post_init__(self) -> None:
        told = self.name or f"feature {self.feature_id}"
        if not KIND_PATTERN.fullmatch(self.kind):
            raise FeatureFileError(f"{told}: kind {self.kind[:80]!r} does not match {KIND_PATTERN.pattern}")
        check_positions(told, self.lat_rad, self.lon_rad, self.height_m)

    def __len__(self) -> int:
        return len(self.lat_rad)

    def feature(self) -> Feature:
        """The same without its place: `pieces_of` gives it one."""
        return Feature(
            self.feature_id, self.kind, np.zeros((1, 3)), self.cov_m2, self.existence, self.attributes,
            hits=self.hits, vehicles=self.vehicles,
        )  # fmt: skip

    def enu_m(self, frame: LocalFrame | None = None) -> F64:
        """(N, 3) in a frame, by default that of the first vertex."""
        frame = frame or LocalFrame(float(self.lat_rad[0]), float(self.lon_rad[0]), float(self.height_m[0]))
        return frame.enu_from_geodetic(self.lat_rad, self.lon_rad, self.height_m)


def check_positions(name: str, lat_rad: F64, lon_rad: F64, height_m: F64) -> None:
    """BadGeometry unless there is a position, and all lie on the Earth between -1,000 m and 10,000 m."""
    if not len(lat_rad):
        raise BadGeometry(f"{name}: has no position")
    for what, values, limit in (("latitude", lat_rad, _LATITUDE_LIMIT), ("longitude", lon_rad, pi)):
        bad = ~(np.abs(values) <= limit + _SLACK)
        if bad.any():
            value = float(np.degrees(values[np.argmax(bad)]))
            raise BadGeometry(f"{name}: {what} {value:.6f} degrees is beyond {np.degrees(limit):.0f}")
    bad = ~((height_m >= MIN_FLOOR) & (height_m <= MAX_FLOOR))
    if bad.any():
        raise BadGeometry(f"{name}: height {height_m[np.argmax(bad)]:.1f} m is not in {MIN_FLOOR} … {MAX_FLOOR} m")


@dataclass(slots=True)
class MapFindings:
    """What is odd about a file's geometry but loses nothing: it is reported, or with `strict` refused.

    Attributes:
        strict: whether the first finding refuses the file.
        notes: the findings so far.
    """

    strict: bool
    notes: list[str] = field(default_factory=list)

    def add(self, finding: str) -> None:
        """Keep a finding; BadGeometry when it refuses the file."""
        if self.strict:
            raise BadGeometry(finding)
        self.notes.append(finding)

    def check_simple(self, feature: MapFeature) -> None:
        """A finding when a polyline crosses itself; FileTooLarge when it has too many vertices to tell."""
        check_vertices(feature.name, len(feature))
        if len(feature) < 3:
            return
        try:
            check_simple_polyline(feature.name, feature.enu_m())
        except FeatureError as error:
            self.add(str(error))

    def told(self) -> tuple[str, ...]:
        """The findings, the first of them in full."""
        more = len(self.notes) - MAX_NOTES
        rest = (f"and {more} more findings (--strict refuses the file)",) if more > 0 else ()
        return (*self.notes[:MAX_NOTES], *rest)


def check_vertices(name: str, n: int) -> None:
    """FileTooLarge when a line has too many vertices: whether it crosses itself takes the square of their number."""
    if n > MAX_VERTICES_OF_LINE:
        raise FileTooLarge(f"{name}: {n} vertices, a line has at most {MAX_VERTICES_OF_LINE}; cut it")


def attributes_of(values: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """Those key-value pairs that a feature may carry, sorted; the others are too long."""
    fit = sorted(
        (k, v) for k, v in values.items() if 1 <= len(k) <= MAX_KEY_CHARACTERS and len(v) <= MAX_VALUE_CHARACTERS
    )
    return tuple(fit[:MAX_ATTRIBUTES])


@dataclass(frozen=True, slots=True, eq=False)
class FeatureFile:
    """What one file holds.

    format: its name. features: those with a layer. left_out: how many of each kind have none. document: the file's
    bytes, when what was not understood can be given back on export (Lanelet2, OpenDRIVE); notes: what a reader should
    know. lanes: between which of the features lanes run. kept: what the document keeps that is no feature, by type.
    """

    format: str
    features: tuple[MapFeature, ...]
    left_out: Mapping[str, int]
    document: bytes | None = field(default=None, repr=False)
    notes: tuple[str, ...] = ()
    lanes: tuple[MapLane, ...] = field(default=(), repr=False)
    kept: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_unique(self.features)
        check_lanes(self.lanes, (feature.feature_id for feature in self.features))

    @property
    def layers(self) -> dict[str, int]:
        """How many features each layer gets."""
        return dict(sorted(Counter(feature.layer for feature in self.features).items()))

    def as_dict(self) -> dict[str, Any]:
        """In numbers."""
        return {"format": self.format, "layers": self.layers, "left_out": dict(self.left_out), "notes": self.notes}


def check_unique(features: Iterable[MapFeature]) -> None:
    """DuplicateId when two features have one id."""
    seen: dict[int, str] = {}
    for feature in features:
        if feature.feature_id in seen:
            raise DuplicateId(f"{feature.name} and {seen[feature.feature_id]} have the same id {feature.feature_id}")
        seen[feature.feature_id] = feature.name


def default_source(path: Path) -> str:
    """What features of a file are known by in a store: the file's name."""
    return path.name
