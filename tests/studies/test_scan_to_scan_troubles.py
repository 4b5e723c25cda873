"""What is done to a drive in the benchmark of scan-to-scan odometry, and that both of its sides are what they say."""

import numpy as np
import pytest

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import covering_circle
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.vehicle_agent.local_map import LocalMap
from studies.scan_to_scan import HOLE_M, TROUBLES, Trouble, parameters_of, troubled, with_hole

S = 1_000_000_000


def items():
    for k in range(100):
        yield MotionSample(5 * S + k * S // 10, 8.0, 0.1)
        if k % 10 == 0:
            yield GnssFix(5 * S + k * S // 10, 0.6, 2.2, 30.0, 2.5)
            yield Scan(5 * S + k * S // 10, np.ones((3, 3), np.float32), np.zeros(3, np.uint32))


def test_wheels_slip_and_gnss_is_silent_when_it_is_said():
    got = list(troubled(items(), Trouble(slip_s=(2.0, 4.0), wheel_share=0.9, no_gnss_s=(3.0, 60.0))))
    speeds = np.array([x.speed_mps for x in got if isinstance(x, MotionSample)])
    assert np.allclose(speeds[20:40], 7.2)
    assert np.allclose(np.delete(speeds, range(20, 40)), 8.0)
    assert [x.t_ns // S - 5 for x in got if isinstance(x, GnssFix)] == [0, 1, 2]
    assert sum(isinstance(x, Scan) for x in got) == 10


def test_no_trouble_changes_nothing():
    assert [type(x) for x in troubled(items(), TROUBLES["no trouble"])] == [type(x) for x in items()]


def test_the_hole_is_across_the_way():
    frame = LocalFrame(np.radians(37.56), np.radians(127.03), 30.0)
    tiles = covering_circle(frame.lat_rad, frame.lon_rad, 150.0)
    local_map = LocalMap(GridFrame.around(frame, tiles))
    for tile_id in tiles:
        local_map.set_tile(Tile(tile_id, 1, Gaussians.empty()))
    T = np.tile(np.eye(4), (51, 1, 1))
    T[:, 0, 3] = np.linspace(-100.0, 100.0, 51)
    held = with_hole(local_map, Trajectory(np.arange(51, dtype=np.int64) * S, T))
    x_m = [float(frame.T_self_other(LocalFrame.of_tile(t))[0, 3]) for t in tiles]
    assert set(held.tiles) == {t for t, x in zip(tiles, x_m, strict=True) if abs(x) > HOLE_M / 2}
    assert 0 < len(held.tiles) < len(tiles)


@pytest.mark.parametrize("enabled", [False, True])
def test_both_sides_differ_in_one_setting(enabled):
    parameters = parameters_of(enabled)
    assert parameters.scan_odometry.enabled is enabled
    assert not parameters.refine.enabled
