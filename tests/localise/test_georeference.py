"""Tracks on the Earth: synthetic ones with known truth, and the parts against plain twins."""

import numpy as np
import pytest
from pyproj import Geod

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, log_so3
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.georeference import Georeferenced, georeference
from gnd.vehicle_agent.localise.path_association import Untimed, _viterbi, georeference_untimed, matched_way_m
from gnd.vehicle_agent.localise.track_alignment import FixTable

PLACE = (np.radians(48.2644), np.radians(11.669))
FRAME = LocalFrame.of_tile(TileId.from_geodetic(*PLACE))
N, STEP_NS = 400, 200_000_000


def truth() -> Trajectory:
    """A round of 800 m with turns, on a slope."""
    yaw = np.concatenate([np.zeros(80), np.linspace(0, np.pi / 2, 20), np.full(80, np.pi / 2)] * 4)[:N]
    yaw = yaw + np.repeat(np.arange(3), 180)[:N] * np.pi / 2
    step = 2.0 * np.column_stack([np.cos(yaw), np.sin(yaw), np.full(N, 0.01)])
    start = FRAME.enu_from_geodetic(*PLACE, 480.0).reshape(3)
    p = start + np.cumsum(step, axis=0)
    R = exp_so3(np.column_stack([np.zeros((N, 2)), yaw]))
    return Trajectory(STEP_NS * np.arange(N, dtype=np.int64), T_from_R_t(R, p))


def local(track: Trajectory, *, scale: float = 1.0, turn_per_step: float = 0.0, tilt_rad: float = 0.0) -> Trajectory:
    """The track as an odometry far away would have it, drifting."""
    steps = T_inverse(track.T_dst_vehicle[:-1]) @ track.T_dst_vehicle[1:]
    steps[:, :3, 3] *= scale
    steps[:, :3, :3] = exp_so3([0.0, 0.0, turn_per_step]) @ steps[:, :3, :3]
    T = [T_from_R_t(exp_so3([tilt_rad, 0.0, 1.1]), np.array([5.0, -7.0, 3.0]))]
    for step in steps:
        T.append(T[-1] @ step)
    return Trajectory(track.t_ns, np.stack(T))


def fixes_of(track: Trajectory, sigma_m: float, seed: int = 1, height: bool = True) -> FixTable:
    rng = np.random.default_rng(seed)
    p = track.T_dst_vehicle[:, :3, 3] + rng.normal(0.0, sigma_m, (len(track), 3))
    lat, lon, up = FRAME.geodetic_from_enu(p)
    sigma = np.full(len(p), sigma_m)
    return FixTable(track.t_ns, lat, lon, up if height else np.full(len(p), np.nan), sigma, sigma)


def poses(found: Georeferenced) -> np.ndarray:
    """(N, 4, 4) in the frame of the truth."""
    return FRAME.T_self_other(found.frame) @ found.track.T_dst_vehicle


def off_m(found: Georeferenced, true: Trajectory) -> np.ndarray:
    return np.linalg.norm(poses(found)[:, :3, 3] - true.T_dst_vehicle[:, :3, 3], axis=1)


def test_without_noise_the_track_lies_where_it_was() -> None:
    true = truth()
    found = georeference(local(true), fixes_of(true, 1e-4), inflation=1.0)
    assert off_m(found, true).max() < 1e-3
    turn = log_so3(T_inverse(poses(found))[:, :3, :3] @ true.T_dst_vehicle[:, :3, :3])
    assert np.abs(turn).max() < 1e-4


def test_geodetic_poses_as_pyproj() -> None:
    true = truth()
    lat, lon, height, heading = georeference(local(true), fixes_of(true, 1e-4)).geodetic()
    azimuth_deg, _, length_m = Geod(ellps="WGS84").inv(*np.degrees([lon[10], lat[10], lon[60], lat[60]]))
    assert length_m == pytest.approx(100.0, abs=0.02)
    assert np.degrees(heading[30]) == pytest.approx(azimuth_deg % 360.0, abs=0.01)
    assert height[0] == pytest.approx(480.02, abs=0.01)


def test_a_third_of_the_fixes_may_be_wild() -> None:
    true, fixes = truth(), fixes_of(truth(), 0.5)
    rng = np.random.default_rng(2)
    wild = rng.random(N) < 0.33
    moved = FRAME.enu_from_geodetic(fixes.lat_rad, fixes.lon_rad, fixes.height_m)
    moved[wild] += rng.uniform(20.0, 90.0, (wild.sum(), 3))
    lat, lon, height = FRAME.geodetic_from_enu(moved)
    found = georeference(local(true), FixTable(fixes.t_ns, lat, lon, height, fixes.sigma_m, fixes.sigma_up_m))
    assert off_m(found, true).max() < 0.5
    assert found.weights[wild[found.used]].max() < 0.1 < 0.3 < np.median(found.weights[~wild[found.used]])


def test_a_drifting_track_is_bent_onto_the_fixes() -> None:
    true = truth()
    track = local(true, scale=1.01, turn_per_step=3e-4)
    fixes = fixes_of(true, 0.3)
    rigid, bent = (georeference(track, fixes, drift=drift) for drift in (False, True))
    assert np.quantile(off_m(rigid, true), 0.95) > 3.0
    assert np.quantile(off_m(bent, true), 0.95) < 1.0


def test_tilt_is_found_when_asked_for() -> None:
    true = truth()
    track, fixes = local(true, tilt_rad=0.2), fixes_of(true, 0.02)
    upright, tilted = (georeference(track, fixes, tilt=tilt, drift=False) for tilt in (False, True))
    assert off_m(upright, true).max() > 3.0
    assert off_m(tilted, true).max() < 0.05


def test_heights_that_are_not_known_leave_the_track_at_the_frames() -> None:
    true = truth()
    found = georeference(local(true), fixes_of(true, 0.1, height=False))
    across = (poses(found) - true.T_dst_vehicle)[:, :2, 3]
    assert np.linalg.norm(across, axis=1).max() < 0.15
    assert np.isnan(found.residuals_m(fixes_of(true, 0.1, height=False))[:, 2]).all()
    with pytest.raises(LocaliseError, match="400 of 400 fixes have no height"):
        georeference(local(true), fixes_of(true, 0.1, height=False), tilt=True, spacing_m=0.0)


def test_fixes_without_times_find_theirs_by_the_turns() -> None:
    true = truth()
    table = fixes_of(true, 0.1)
    chosen = np.sort(np.random.default_rng(3).choice(N, 300, replace=False))
    chosen[0], chosen[-1] = 0, N - 1
    untimed = Untimed(table.lat_rad[chosen], table.lon_rad[chosen], table.height_m[chosen], 0.1)
    found, timed = georeference_untimed(local(true, scale=0.99, turn_per_step=1e-4), untimed)
    along, across, up = np.quantile(np.abs((T_inverse(true.T_dst_vehicle) @ poses(found))[:, :3, 3]), 0.95, axis=0)
    assert along < 2.0
    assert max(across, up) < 0.5
    expected = table.t_ns[chosen[untimed.moving()]]
    assert np.quantile(np.abs(timed.t_ns - expected), 0.95) < STEP_NS


def test_turns_meet_whatever_the_frames() -> None:
    p = truth().T_dst_vehicle[:, :2, 3]
    turned = 0.99 * p @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    at = matched_way_m(turned, p)
    assert np.abs(at - np.linspace(0.0, 2.0 * 0.99 * (N - 1), N)).max() < 6.0
    assert np.median(np.abs(at - np.linspace(0.0, 2.0 * 0.99 * (N - 1), N))) < 2.0


def test_viterbi_as_its_plain_twin() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        cost, c = rng.random((12, 9)), 0.15
        best = cost[0].copy()
        for row in cost[1:]:
            best = np.array([min(best[j] + c * abs(i - j) for j in range(9)) + row[i] for i in range(9)])
        states = _viterbi(cost, c)
        total = cost[np.arange(12), states].sum() + c * np.abs(np.diff(states)).sum()
        assert total == pytest.approx(best.min())


@pytest.mark.parametrize("n", [0, 2])
def test_too_few_fixes_are_told(n: int) -> None:
    with pytest.raises(LocaliseError, match=f"{n} of {n} fixes"):
        georeference(local(truth()), fixes_of(truth(), 0.1).take(np.arange(n)))


def test_a_standing_vehicle_has_no_heading() -> None:
    true = truth()
    still = Trajectory(true.t_ns, np.tile(true.T_dst_vehicle[:1], (N, 1, 1)))
    with pytest.raises(LocaliseError, match="no heading"):
        georeference(still, fixes_of(true, 1.0), spacing_m=0.0)


def test_fixes_outside_the_track_are_left_out_or_told() -> None:
    true, fixes = truth(), fixes_of(truth(), 0.1)
    half = Trajectory(true.t_ns[:200], true.T_dst_vehicle[:200])
    found = georeference(half, fixes)
    assert found.used.max() < 200
    with pytest.raises(LocaliseError, match="200 of 400 fixes lie outside"):
        found.residuals_m(fixes)


def test_values_are_checked() -> None:
    table = FixTable.of([GnssFix(0, 0.8, 0.2, 100.0, 2.5), GnssFix(10**9, 0.8, 0.2, 100.0, 2.5)])
    assert table.sigma_up_m.tolist() == [5.0, 5.0]
    with pytest.raises(LocaliseError, match="sigma must be positive"):
        FixTable(table.t_ns, table.lat_rad, table.lon_rad, table.height_m, np.zeros(2), table.sigma_up_m)
