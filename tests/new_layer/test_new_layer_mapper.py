"""Gathering items while driving, and mapping at stops."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
from plane_scene import EXACT_PARAMETERS, Noise, Scene, drive

from gnd_map.geodesy import LocalFrame
from schemas.drive import GnssFix, MotionSample
from vehicle_agent.features.feature_drive import FeatureDrive
from vehicle_agent.features.new_layer_mapper import NewLayerMapper
from vehicle_agent.features.new_layer_parameters import (
    GnssNoise,
    LandmarkParameters,
    LaneParameters,
    MotionNoise,
    NewLayerParameters,
)

FRAME = LocalFrame(radians(37.45), radians(127.12), 60.0)


def items_of(d, stop_s=0.0):
    """The drive as a recording; afterwards the vehicle stands."""
    items = [MotionSample(*row) for row in zip(*(c.tolist() for c in d.motion), strict=True)]
    last = d.motion.t_ns[-1]
    items += [MotionSample(int(last + n * 20_000_000), 0.0, 0.0) for n in range(1, round(stop_s * 50) + 1)]
    lat, lon, height = FRAME.geodetic_from_enu(np.column_stack([d.fixes.xy_m, np.zeros(len(d.fixes.xy_m))]))
    rows = zip(d.fixes.t_ns.tolist(), lat.tolist(), lon.tolist(), height.tolist(), strict=True)
    items += [GnssFix(*row, 2.5) for row in rows]
    return sorted([*items, *d.looks, *d.lanes], key=lambda item: item.t_ns)


@pytest.fixture(scope="module")
def truth():
    return Scene().truth()


def pushed(mapper, items):
    return [layer for layer in map(mapper.push, items) if layer is not None]


def test_a_stop_maps_what_was_gathered_and_begins_anew(truth):
    mapper = NewLayerMapper(FRAME, "streetlights", EXACT_PARAMETERS)
    layers = pushed(mapper, items_of(drive(truth, Noise(), 0), stop_s=6.0))
    assert len(layers) == 1
    found = layers[0].features.xy_m
    distance = np.hypot(*(found[:, None] - truth.features[None]).transpose(2, 0, 1))
    assert len(found) == len(truth.features)
    assert distance.min(axis=0).max() < 0.02
    assert mapper.way_m == pytest.approx(0.0)
    assert mapper.finish() is None


def test_without_a_stop_the_end_of_the_drive_maps(truth):
    mapper = NewLayerMapper(FRAME, "streetlights", EXACT_PARAMETERS)
    assert pushed(mapper, items_of(drive(truth, Noise(), 0))) == []
    assert mapper.way_m == pytest.approx(160.0, rel=0.01)
    layer = mapper.finish()
    assert layer is not None
    assert len(layer.features) == 4


def test_a_drive_that_takes_too_long_is_mapped_on_the_way(truth):
    mapper = NewLayerMapper(FRAME, "streetlights", replace(EXACT_PARAMETERS, longest_s=8.0))
    assert len(pushed(mapper, items_of(drive(truth, Noise(), 0)))) == 1


def test_looks_of_another_layer_or_sensor_are_not_taken(truth):
    items = items_of(drive(truth, Noise(), 0))
    assert FeatureDrive.of_items(items, FRAME, "signs").looks == ()
    assert FeatureDrive.of_items(items, FRAME, "streetlights", "camera").looks == ()
    both = FeatureDrive.of_items(items, FRAME, "streetlights", "lidar")
    assert len(both.looks) == 81
    assert len(both.lanes) == 81
    np.testing.assert_allclose(both.fixes.xy_m, truth.pose[::50, :2], atol=1e-3)


def test_a_short_way_and_a_way_without_fixes_are_dropped(truth):
    mapper = NewLayerMapper(FRAME, "streetlights", replace(EXACT_PARAMETERS, least_m=500.0))
    assert pushed(mapper, items_of(drive(truth, Noise(), 0), stop_s=4.0)) == []
    assert mapper.finish() is None
    mapper = NewLayerMapper(FRAME, "streetlights", EXACT_PARAMETERS)
    no_fixes = [item for item in items_of(drive(truth, Noise(), 0)) if not isinstance(item, GnssFix)]
    assert pushed(mapper, no_fixes) == []
    assert mapper.finish() is None


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (MotionNoise, "wheel_scale", 0.0),
        (MotionNoise, "slip_rad", -1.0),
        (GnssNoise, "correlation_s", 0.0),
        (LandmarkParameters, "min_hits", 0),
        (LandmarkParameters, "gate_chi2", -1.0),
        (LaneParameters, "sigma_m", 0.0),
        (LaneParameters, "information", 1.5),
        (LaneParameters, "min_polylines", 0),
        (NewLayerParameters, "rounds", 0),
        (NewLayerParameters, "keyframe_m", 0.0),
    ],
)
def test_parameters_that_cannot_be_are_refused(kind, field, value):
    with pytest.raises(ValueError, match=field):
        kind(**{field: value})
