"""The mount watched while driving: what the header has wrong is found out from the ground, and nothing else is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.gnd_map.se3 import T_inverse, exp_so3, transform
from gnd.vehicle_agent.localise.mount import MountResidual, MountWatch, near_points

S = 1_000_000_000
HEIGHT_M = 1.9


def mount(height_m=HEIGHT_M, roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0):
    T = np.eye(4)
    roll, pitch, yaw = np.radians([roll_deg, pitch_deg, yaw_deg])
    T[:3, :3] = exp_so3([0.0, pitch, 0.0]) @ exp_so3([roll, 0.0, 0.0]) @ exp_so3([0.0, 0.0, yaw])
    T[:3, 3] = 1.2, 0.0, height_m
    return T


def street(rng, slope=0.0, crown=0.02):
    """(N, 3) a road of two lanes with kerbs and two walls in the frame of a vehicle that stands on the right lane: the
    left one falls by twice the crown's slope against it.
    """
    x, y = rng.uniform(-25, 25, 6000), rng.uniform(-7.0, 10.0, 6000)
    z = -2.0 * crown * np.maximum(y - 1.75, 0.0) + slope * np.maximum(x - 8.0, 0.0)
    z = np.where((y < -3.0) | (y > 6.5), z + 0.12, z) + rng.normal(0, 0.01, 6000)
    wall = np.column_stack([rng.uniform(-25, 25, 2000), rng.choice([-7.0, 10.0], 2000), rng.uniform(0, 6, 2000)])
    return np.concatenate([np.column_stack([x, y, z]), wall])


def watched(header, true=None, scans=20, sway_deg=0.2, scene=street, **how):
    """A watch that has seen scans of a vehicle that nods, taken with the true mount and told the header's."""
    rng, watch = np.random.default_rng(0), MountWatch(header)
    for k in range(scans):
        sway = np.eye(4)
        sway[:3, :3] = exp_so3(np.append(np.radians(rng.normal(0, sway_deg, 2)), 0.0))
        lidar = transform(T_inverse(mount() if true is None else true) @ sway, scene(rng, **how))
        near = near_points(lidar.astype(np.float32))
        if watch.due(k * S):
            watch.see(k * S, transform(header, lidar[near]))
    return watch.residual


def test_a_right_header_is_not_doubted():
    residual = watched(mount())
    assert residual.doubtful == ()
    assert residual.scans == 20
    assert abs(residual.height_m) < 0.03
    assert np.degrees(residual.pitch_sigma_rad) < 0.2


@settings(max_examples=20, deadline=None)
@given(st.floats(-0.8, 0.8), st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(-180.0, 180.0))
def test_residuals_have_their_sign_and_their_size(height_m, roll_deg, pitch_deg, yaw_deg):
    true = mount(HEIGHT_M + height_m, roll_deg, pitch_deg, yaw_deg)
    residual = watched(mount(yaw_deg=yaw_deg), true, scans=8, crown=0.0)
    assert residual.height_m == pytest.approx(height_m, abs=0.03)
    assert np.degrees([residual.roll_rad, residual.pitch_rad]) == pytest.approx([roll_deg, pitch_deg], abs=0.3)


def test_a_lidar_at_height_0_in_the_header_is_found_out_at_once():
    residual = watched(mount(0.0), scans=4)
    assert residual.doubtful == ("height",)
    assert residual.wrong
    assert residual.height_m == pytest.approx(HEIGHT_M, abs=0.05)


@pytest.mark.parametrize(("roll_deg", "pitch_deg", "said"), [(1.5, 0.0, ("roll",)), (0.0, -1.0, ("pitch",))])
def test_a_tilt_is_said_and_is_no_wrong_pose_yet(roll_deg, pitch_deg, said):
    residual = watched(mount(), mount(HEIGHT_M, roll_deg, pitch_deg))
    assert residual.doubtful == said
    assert not residual.wrong


def test_the_foot_of_a_ramp_is_no_tilt_of_the_mount():
    assert watched(mount(), slope=0.08).doubtful == ()


def test_without_ground_nothing_is_known():
    def walls(rng):
        return np.add(street(rng)[6000:], (0.0, 0.0, 3.0))

    residual = watched(mount(), scene=walls)
    assert residual == MountResidual()
    assert residual.doubtful == ()


def test_scans_are_looked_at_once_a_second():
    watch, rng = MountWatch(mount()), np.random.default_rng(0)
    looked = 0
    for k in range(100):
        if watch.due(k * S // 10):
            watch.see(k * S // 10, street(rng))
            looked += 1
    assert looked <= 15


@pytest.mark.parametrize("bad", [{"height_sigma_m": 0.0}, {"roll_sigma_rad": -1.0}, {"scans": -1}])
def test_residuals_check_themselves(bad):
    with pytest.raises(ValueError, match="positive sigmas"):
        MountResidual(**bad)
