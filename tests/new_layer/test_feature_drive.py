"""A recording as the mapping sees it, and sensors that cannot be."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
from plane_scene import Noise, Scene, drive

from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import GnssFix, MotionSample
from gnd.vehicle_agent.features.mapping.feature_drive import FeatureDrive
from gnd.vehicle_agent.features.mapping.sensors import SERIES_CAR

FRAME = LocalFrame(radians(37.45), radians(127.12), 60.0)


def items_of(d):
    """The drive as a recording."""
    items = [MotionSample(*row) for row in zip(*(c.tolist() for c in d.motion), strict=True)]
    lat, lon, height = FRAME.geodetic_from_enu(np.column_stack([d.fixes.xy_m, np.zeros(len(d.fixes.xy_m))]))
    rows = zip(d.fixes.t_ns.tolist(), lat.tolist(), lon.tolist(), height.tolist(), strict=True)
    items += [GnssFix(*row, 2.5) for row in rows]
    return sorted([*items, *d.looks, *d.lanes], key=lambda item: item.t_ns)


@pytest.fixture(scope="module")
def truth():
    return Scene().truth()


def test_looks_of_another_layer_or_sensor_are_not_taken(truth):
    items = items_of(drive(truth, Noise(), 0))
    assert FeatureDrive.of_items(items, FRAME, "signs").looks == ()
    both = FeatureDrive.of_items(items, FRAME, "streetlights")
    assert len(both.looks) == 81
    assert len(both.lanes) == 81
    np.testing.assert_allclose(both.fixes.xy_m, truth.pose[::50, :2], atol=1e-3)


@pytest.mark.parametrize(("part", "field", "value"), [
    ("motion", "wheel_scale", 0.0), ("motion", "slip_rad", -1.0), ("gnss", "correlation_s", 0.0)
])  # fmt: skip
def test_sensors_that_cannot_be_are_refused(part, field, value):
    with pytest.raises(ValueError, match=field):
        replace(getattr(SERIES_CAR, part), **{field: value})
