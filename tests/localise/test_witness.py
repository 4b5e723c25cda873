"""The witness: its kernel against plain loops, and what it tells of a right pose, a wrong one and a changed place."""

import numpy as np
import pytest
from yard import GROUND_M, local_map_of, match_map_of, pose, rectangle, seen_from

from gnd.gnd_map.se3 import transform
from gnd.vehicle_agent.localise import witness
from gnd.vehicle_agent.localise.initialise import STANDING_ABOVE_M
from gnd.vehicle_agent.localise.witness import CROSSED, GONE, HIT, KNOWN, NEW, witnessed

SENSOR_M = np.array([0.0, 0.0, 1.8])


def seen(yard_points, T, n=400, seed=0):
    return seen_from(np.random.default_rng(seed), yard_points, T, n)


def plain_counts(points, T, m):
    """The same in plain numpy and Python, from the definitions."""
    counts = np.zeros((witness._SECTORS, 5), np.int64)
    origin = transform(T, SENSOR_M[None])[0]
    for p in points:
        q = transform(T, p[None])[0]
        cell = np.floor(m.A @ q + m.b).astype(int)
        if (cell < 1).any() or (cell >= np.array(m.index.shape) - 1).any() or m.index[tuple(cell)] < -1:
            continue
        sector = int(np.floor((np.arctan2(p[1], p[0]) / (2 * np.pi) % 1.0) * witness._SECTORS)) % witness._SECTORS
        if p[2] > STANDING_ABOVE_M:
            nearest = min((distance2(m, row, q) for row in around(m, cell) if reaches(m, row, q)), default=np.inf)
            counts[sector, KNOWN] += 1
            counts[sector, HIT] += nearest < witness._HIT_SIGMAS**2
            counts[sector, NEW] += nearest > witness._FAR_SIGMAS**2
        walk(counts[sector], origin, q, m)
    return counts


def around(m, cell):
    block = m.index[cell[0] - 1 : cell[0] + 2, cell[1] - 1 : cell[1] + 2, cell[2] - 1 : cell[2] + 2]
    return block[block >= 0]


def reaches(m, row, q):
    return np.linalg.norm(q - m.mean_m[row]) <= 1.0


def matrix(m, row):
    xx, xy, xz, yy, yz, zz = m.information[row]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def distance2(m, row, q):
    d = q - m.mean_m[row]
    return float(d @ matrix(m, row) @ d)


def walk(count, origin, end, m):
    way = np.linalg.norm(end - origin)
    if way < 1.0:
        return
    u, last = (end - origin) / way, -1
    way = min(way, witness._MAX_WAY_M)
    for s in np.arange(int(way / 0.5) + 1) * 0.5:
        cell = np.floor(m.A @ (origin + s * u) + m.b).astype(int)
        if (cell < 0).any() or (cell >= m.index.shape).any():
            continue
        row = int(m.index[tuple(cell)])
        if row < 0 or row == last:
            continue
        last = row
        information = matrix(m, row)
        if u @ information @ u < witness._LEAST_ALONG_PER_M2:
            continue
        at = u @ information @ (m.mean_m[row] - origin) / (u @ information @ u)
        if distance2(m, row, origin + at * u) >= 1.0 or at < 0.0 or abs(at - s) > 1.0:
            continue
        count[CROSSED] += 1
        count[GONE] += at < way - witness._BEHIND_M


@pytest.mark.parametrize("shift_m", [0.0, 1.3])
def test_kernel_counts_as_plain_loops_do(yard_map, yard_points, shift_m, monkeypatch):
    monkeypatch.setattr(witness, "_N_RAYS", 400)
    m, T = match_map_of(yard_map), pose(2.0, 1.0, 30.0)
    points = seen(yard_points, T)
    T = pose(2.0 + shift_m, 1.0, 30.0)
    testimony = witnessed(points, SENSOR_M, 0.0, T, m)
    np.testing.assert_array_equal(testimony.counts, plain_counts(points, T, m))
    assert testimony.known > 50


def test_a_right_pose_hits_all_around_and_nothing_is_gone(yard_map, yard_points):
    T = pose(2.0, 1.0, 30.0)
    testimony = witnessed(seen(yard_points, T, 2000), SENSOR_M, 0.0, T, match_map_of(yard_map))
    assert testimony.hit_share > 0.9
    assert testimony.sector_hits.min() > 0.7
    assert testimony.new_share < 0.05


def test_a_wrong_pose_is_contradicted_all_around(yard_map, yard_points):
    T = pose(2.0, 1.0, 30.0)
    off = witnessed(seen(yard_points, T, 2000), SENSOR_M, 0.0, pose(4.5, 3.0, 30.0), match_map_of(yard_map))
    assert off.best_hits < 0.6
    assert off.new_share > 0.4


def test_what_is_new_is_seen_where_it_stands_and_the_rest_still_hits(yard_map, yard_points):
    rng, T = np.random.default_rng(0), pose(0.0, 0.0, 0.0)
    new_wall = rectangle(rng, (6.0, -3.0, GROUND_M), (0, 6, 0), (0, 0, 3), 200.0)
    changed = np.concatenate([yard_points, new_wall])
    testimony = witnessed(seen(changed, T, 3000), SENSOR_M, 0.0, T, match_map_of(yard_map))
    assert testimony.new_share > 0.1
    assert testimony.best_hits > 0.9
    ahead = testimony.counts[[0, -1]].sum(axis=0)
    assert ahead[NEW] > 0.8 * testimony.counts[:, NEW].sum()


def test_what_is_gone_is_crossed_by_rays():
    rng, T = np.random.default_rng(0), pose(0.0, 0.0, 0.0)
    ground = rectangle(rng, (-30, -20, GROUND_M), (60, 0, 0), (0, 40, 0), 60.0)
    behind = rectangle(rng, (15.3, -20, GROUND_M), (0, 40, 0), (0, 0, 6), 60.0)
    wall = rectangle(rng, (7.4, -20, GROUND_M), (0, 40, 0), (0, 0, 6), 60.0)
    m = match_map_of(local_map_of(np.concatenate([ground, behind, wall])))
    points = seen_from(rng, behind, T, 300)
    gone = witnessed(points, SENSOR_M, 0.0, T, m)
    stands = witnessed(seen_from(rng, wall, T, 300), SENSOR_M, 0.0, T, m)
    assert gone.gone_share > 0.35  # each ray goes through the missing wall and ends on the other
    assert stands.gone_share < 0.05


def test_no_points_say_nothing(yard_map):
    testimony = witnessed(np.empty((0, 3)), SENSOR_M, 0.0, np.eye(4), match_map_of(yard_map))
    assert testimony.known == 0
    assert testimony.hit_share == 0.0
    assert len(testimony.sector_hits) == 0
