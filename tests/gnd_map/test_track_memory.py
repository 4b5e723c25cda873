"""What a vehicle remembers of its scans for the track: a position each."""

import weakref

import numpy as np

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.track_builder import TrackBuilder


def test_a_scan_is_not_kept_for_its_position() -> None:
    builder = TrackBuilder(LocalFrame(0.65, 2.2))
    points, origins = np.random.default_rng(1).normal(0.0, 10.0, (5000, 3)), np.zeros((5000, 3))
    held = weakref.ref(origins)
    builder.add_scan(1, points, origins, np.eye(4))
    del origins
    assert len(builder) == 1
    assert held() is None
