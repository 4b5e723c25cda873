"""Feature reports for tests: one with known values, and strategies for any."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from schema_values import EAST, REPORT_ID, SHA, TILE, names, pairs, texts

from gnd.gnd_map.features import Existence, snapped_covariance
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.features import FeatureChange, FeatureReport, Found, Seen
from gnd.schemas.report_id import deterministic_report_id

SIGN_M = np.array([[4.25, -7.5, 31.062]])
LANE_M = np.array([[-15.0, -3.5, 30.0], [-4.0, -3.25, 30.125], [9.0, -2.0, 30.25]])
SURE_COV_M2 = np.array([0.04, 0.01, 0.0, 0.09, 0.0, 0.25])
FLAT_COV_M2 = np.array([0.04, 0.01, 0.0, 0.09, 0.0, 1e4])


def seen(**values: Any) -> Seen:
    plain: dict[str, Any] = {
        "feature_id": 2**62 + 5,
        "existence": Existence(0.9, 0.05, 0.05, 0.1),
        "hits": 17,
        "position_m": SIGN_M[0],
        "cov_m2": FLAT_COV_M2,
    }
    return Seen(**(plain | values))


def found(**values: Any) -> Found:
    plain: dict[str, Any] = {
        "kind": "traffic_sign",
        "points_m": SIGN_M,
        "cov_m2": SURE_COV_M2,
        "existence": Existence(0.8, 0.0, 0.2),
        "hits": 4,
        "attributes": (("code", "274-50"), ("face", "speed limit")),
    }
    return Found(**(plain | values))


def feature_change(tile: TileId = TILE, **values: Any) -> FeatureChange:
    plain: dict[str, Any] = {
        "base_version": 3,
        "base_sha": SHA,
        "viewed": 0x00FF_0000_F0F0_0001,
        "seen": (seen(feature_id=12, position_m=None, cov_m2=None, existence=Existence(0.0, 0.6, 0.4)), seen()),
        "found": (found(), found(kind="lane_boundary", points_m=LANE_M, attributes=())),
    }
    return FeatureChange(tile=tile, **(plain | values))


def feature_report(**values: Any) -> FeatureReport:
    plain: dict[str, Any] = {
        "report_id": REPORT_ID,
        "vehicle": "car-1",
        "sensor_model": "camera 40 x 80",
        "software": "gnd-fleet 0.1.0",
        "layer": "signs",
        "district": TILE.district,
        "first_ns": 1_700_000_000_000_000_000,
        "last_ns": 1_700_000_012_300_000_000,
        "tiles": (feature_change(), feature_change(EAST, base_version=0, base_sha=b"", seen=(), found=())),
    }
    return FeatureReport(**(plain | values))


FEATURE_GOLDEN: dict[str, FeatureReport] = {
    "FeatureReport-two_tiles": feature_report().snapped(),
    "FeatureReport-looked_and_found_nothing": feature_report(
        layer="streetlights", tiles=(feature_change(viewed=2**64 - 1, seen=(), found=()),)
    ),
}


# Strategies

shares = st.integers(0, 10_000)
levels = st.tuples(*[st.integers(0, 150)] * 3, *[st.integers(-20, 20)] * 3)


@st.composite
def any_existence(draw: Any) -> Existence:
    exist = draw(shares)
    absent = draw(st.integers(0, 10_000 - exist))
    return Existence(exist / 1e4, absent / 1e4, (10_000 - exist - absent) / 1e4, draw(shares) / 1e4)


@st.composite
def any_points(draw: Any, n: int) -> Any:
    """Points inside any tile of the latitude of `TILE`, in whole millimetres or not."""
    numbers = st.floats(-15.0, 15.0) if draw(st.booleans()) else st.integers(-15_000, 15_000).map(lambda mm: mm / 1000)
    return np.array(draw(st.lists(st.tuples(numbers, numbers, st.floats(-100, 100)), min_size=n, max_size=n)))


@st.composite
def any_cov(draw: Any) -> Any:
    spread = draw(st.lists(st.floats(-3, 3), min_size=9, max_size=9))
    A = np.array(spread).reshape(3, 3)
    full = A @ A.T + 1e-4 * np.eye(3)
    return full[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]


@st.composite
def any_seen(draw: Any, feature_id: int) -> Seen:
    measured = draw(st.booleans())
    return Seen(
        feature_id,
        draw(any_existence()),
        draw(st.integers(0, 2**31 - 1)),
        draw(any_points(1))[0] if measured else None,
        draw(any_cov()) if measured else None,
    )


@st.composite
def any_found(draw: Any) -> Found:
    keys = sorted(draw(st.sets(st.text(min_size=1, max_size=9), max_size=3)))
    return Found(
        draw(st.from_regex(r"[a-kp-z][a-z0-9_]{0,12}", fullmatch=True)),  # no lane: its vertices are anywhere
        draw(any_points(draw(st.integers(1, 5)))),
        draw(any_cov()),
        draw(any_existence()),
        draw(st.integers(0, 2**31 - 1)),
        tuple((key, draw(st.text(max_size=9))) for key in keys),
    )


@st.composite
def any_feature_change(draw: Any, tile: TileId) -> FeatureChange:
    version, sha = draw(pairs)
    ids = sorted(draw(st.sets(st.integers(1, 2**63 - 1), max_size=4))) if version else []
    return FeatureChange(
        tile,
        version,
        sha,
        draw(st.integers(0, 2**64 - 1)),
        tuple(draw(any_seen(one)) for one in ids),
        tuple(draw(st.lists(any_found(), max_size=3, unique_by=lambda one: (one.kind, str(one.snapped().points_m))))),
    )


@st.composite
def any_feature_report(draw: Any) -> FeatureReport:
    first, last = sorted(draw(st.tuples(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1))))
    offsets = draw(st.frozensets(st.integers(0, 1023), min_size=1, max_size=3))
    return FeatureReport(
        report_id=deterministic_report_id(draw(st.integers(0, 2**48 - 1)), draw(texts)),
        vehicle=draw(names),
        sensor_model=draw(texts),
        software=draw(texts),
        layer=draw(st.sampled_from(["signs", "lanes", "streetlights", "poles", "my_own"])),
        district=TILE.district,
        first_ns=first,
        last_ns=last,
        tiles=tuple(draw(any_feature_change(TileId(TILE.district.first_morton + k))) for k in sorted(offsets)),
    )


def changed_report(report: FeatureReport, **values: Any) -> FeatureReport:
    return dataclasses.replace(report, **values)


def is_on_levels(cov_m2: Any) -> bool:
    return bool(np.array_equal(snapped_covariance(cov_m2), cov_m2))


def write_missing_golden_files() -> None:
    """`python tests/schemas/feature_values.py` writes those that are missing; none is ever changed."""
    folder = Path(__file__).parent / "golden_features"
    for name, value in FEATURE_GOLDEN.items():
        path = folder / f"{name}.bin"
        if not path.exists():
            path.write_bytes(value.encode())


if __name__ == "__main__":
    write_missing_golden_files()
