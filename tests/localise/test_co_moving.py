"""What travels along is found, what stands is not, however much it looks the same metre after metre."""

import math
from functools import lru_cache

import numpy as np
import pytest

from gnd.fleet_sim.insert_company import VanAhead, put_behind_a_van
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.shapes import Block
from gnd.gnd_map.motion import deskew
from gnd.schemas.drive import MotionSample, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.importer import map_track, open_recording, write_drive
from gnd.vehicle_agent.localise import co_moving_kernels as kernels
from gnd.vehicle_agent.localise.co_moving import CoMoving
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.parameters import SamplingParameters
from gnd.vehicle_agent.localise.sampling import sample_scan
from gnd.vehicle_agent.localise.scan_odometry import (
    OFF_GROUND_M,
    OFF_GROUND_SLOPE,
    ScanOdometry,
)
from gnd.vehicle_agent.localise.scan_pool import standing_points

SWEEP_S, AZIMUTHS, LAYERS = 0.1, 720, 16
HEIGHT_M = 1.9
BRAKING = (7.4, 6.6, 5.8, 5.0, 4.2, 3.4, 2.6, 1.8, 1.0, 0.4)
T_VEHICLE_LIDAR = np.array([[1.0, 0, 0, 1.0], [0, 1, 0, 0], [0, 0, 1, HEIGHT_M], [0, 0, 0, 1]])
SIGMAS = np.array([0.001] * 3 + [0.01] * 3)

TUNNEL = [Block(20.0, side * 6.0, 120.0, 0.25, 0.0, 6.0) for side in (-1, 1)]
STREET = [Block(12.0 * k, s * 9.0, 4.0, 1.5, 0.0, 3.0 + k % 4) for k in range(-5, 10) for s in (-1, 1)]
POSTS = [Block(2.5 * k, s * 4.0, 0.06, 0.06, 0.0, 1.2) for k in range(-16, 30) for s in (-1, 1)]
VAN = Block(15.8, 0.0, 2.8, 1.0, 0.35, 2.5)
FOLLOWER = Block(-12.0, 0.2, 2.2, 0.9, 0.3, 1.6)
LORRY = Block(2.0, 3.4, 5.0, 1.25, 0.6, 3.8)
TRAILER = Block(-5.5, 0.0, 1.5, 0.8, 0.4, 1.6)


@lru_cache(maxsize=8)
def _scene(shapes):
    return Scene.build(shapes, margin_m=40.0)


def scene(shapes):
    return _scene(tuple(shapes))


def sweep(standing, along, x_m, speed_mps, rng):
    """One turn of the LiDAR at a vehicle that is at `x_m` in the middle of it: points (N, 3), offsets (N,) of a second,
    and which points lie on what travels along.
    """
    share = np.repeat(np.arange(AZIMUTHS) / AZIMUTHS, LAYERS)
    azimuth = 2.0 * np.pi * share
    tan = np.tan(np.radians(np.tile(np.linspace(-15.0, 15.0, LAYERS), AZIMUTHS)))
    d = np.column_stack([np.cos(azimuth), np.sin(azimuth), tan])
    d /= np.linalg.norm(d, axis=1)[:, None]
    at = np.tile(T_VEHICLE_LIDAR[:3, 3], (len(d), 1))
    rides = scene(along).cast(at, d, 100.0)[0] if along else np.full(len(d), np.inf)
    with np.errstate(divide="ignore"):
        road = np.where(d[:, 2] < 0.0, -HEIGHT_M / d[:, 2], np.inf)
    from_m = at + np.outer(x_m + speed_mps * SWEEP_S * (share - 0.5), [1, 0, 0])
    stands = np.minimum(scene(standing).cast(from_m, d, 100.0)[0], np.where(road < 100.0, road, np.inf))
    range_m = np.minimum(rides, stands)
    seen = np.isfinite(range_m)
    noisy_m = np.where(seen, range_m, 0.0) + 0.015 * rng.standard_normal(len(d))
    points = d * noisy_m[:, None]
    offset_ns = np.round(share * SWEEP_S * 1e9).astype(np.uint32)
    return points[seen].astype(np.float32), offset_ns[seen], (rides < stands)[seen]


def drive(standing, along=(), *, speeds_mps=(8.0,) * 26, wheel_scale=1.0, swing_m=0.0):
    """Give for each scan, from the first 9 m on: which sampled points were left out, which are on what travels along,
    and the points in the vehicle frame.
    """
    rng, found, x_m, before_m = np.random.default_rng(4), [], 0.0, 0.0
    detector = CoMoving(T_VEHICLE_LIDAR)
    for n, speed in enumerate(speeds_mps):
        moved = [
            Block(
                b.x_m + swing_m * math.sin(2 * math.pi * 0.1 * n / 9.0),
                b.y_m,
                b.half_x_m,
                b.half_y_m,
                b.bottom_m,
                b.top_m,
            )
            for b in along
        ]
        raw, offset_ns, company = sweep(standing, moved, x_m, speed, rng)
        chosen = sample_scan(raw, SamplingParameters())
        T = np.eye(4)
        T[0, 3], before_m = wheel_scale * (x_m - before_m), x_m
        points = raw[chosen].astype(np.float64) + T_VEHICLE_LIDAR[:3, 3]
        points[:, 0] += wheel_scale * speed * (offset_ns[chosen] * 1e-9 - 0.5 * SWEEP_S)
        start_ns = n * 100_000_000
        out = detector.see(raw, offset_ns, start_ns, start_ns + 50_000_000, chosen, points, T)
        if x_m > 9.0:
            found.append((out, company[chosen], points))
        x_m += speed * SWEEP_S
    return found


def shares(found):
    """Recall on what travels along, of what is high enough to be judged; share of all else that was left out."""
    out, company, points = (np.concatenate(part) for part in zip(*found, strict=True))
    high = points[:, 2] > 0.45
    recall = out[company & high].mean() if (company & high).any() else np.nan
    return recall, out[~company & high].mean()


@pytest.mark.parametrize("name", ["van", "swinging van", "follower", "lorry beside", "trailer"])
def test_what_travels_along_is_found(name):
    along = {"van": VAN, "swinging van": VAN, "follower": FOLLOWER, "lorry beside": LORRY, "trailer": TRAILER}[name]
    recall, false = shares(drive(STREET, [along], swing_m=0.5 if name == "swinging van" else 0.0))
    assert recall > 0.75
    assert false < 0.002


@pytest.mark.parametrize("place", ["tunnel", "street", "posts"])
def test_what_stands_stays(place):
    """A smooth tunnel and posts that repeat look the same from metre to metre; a parked van is passed."""
    standing = {"tunnel": TUNNEL, "street": STREET, "posts": POSTS + TUNNEL}[place]
    parked = Block(40.0, 3.5, 2.8, 1.0, 0.3, 2.5)
    _, false = shares(drive([*standing, parked]))
    assert false < 0.001


def test_a_van_in_a_tunnel_goes_and_the_tunnel_stays():
    recall, false = shares(drive(TUNNEL, [VAN]))
    assert recall > 0.75
    assert false < 0.002


def test_wrong_odometry_makes_no_company():
    """Wheels that tell 5 % too much move everything that stands; hardly anything may be left out for it."""
    _, false = shares(drive([*STREET, *POSTS], wheel_scale=1.05))
    assert false < 0.01


def test_standing_vehicle_judges_nothing():
    """Everything keeps its place; what was known before is forgotten after four seconds."""
    found = drive(STREET, [VAN], speeds_mps=(8.0,) * 16 + BRAKING + (0.0,) * 48)
    assert sum(out.sum() for out, _, _ in found[:3]) > 0
    assert not any(out.any() for out, _, _ in found[-5:])
    assert shares(drive(STREET, speeds_mps=(8.0,) * 16 + BRAKING + (0.0,) * 8))[1] < 0.001


def test_forgotten_sweeps_say_nothing():
    rng, detector, answers = np.random.default_rng(1), CoMoving(T_VEHICLE_LIDAR), []
    for n in range(24):
        raw, offset_ns, _ = sweep(STREET, [VAN], 0.8 * n, 8.0, rng)
        chosen = sample_scan(raw, SamplingParameters())
        points = raw[chosen].astype(np.float64) + T_VEHICLE_LIDAR[:3, 3]
        if n == 22:
            detector.forget()
        T = np.eye(4)
        T[0, 3] = 0.8 if n else 0.0
        answers.append(detector.see(raw, offset_ns, n * 10**8, n * 10**8 + 5 * 10**7, chosen, points, T).any())
    assert answers[20]
    assert answers[21]
    assert not any(answers[22:])
    assert detector.left_out > 0


def test_image_is_that_of_a_plain_twin():
    rng = np.random.default_rng(2)
    raw, offset_ns, _ = sweep(STREET, [VAN], 3.0, 8.0, rng)
    image, times_s = kernels.draw_sweep(raw, offset_ns, 50_000_000, T_VEHICLE_LIDAR)
    x, y, z = raw.astype(np.float64).T
    flat, u = np.hypot(x, y), y / (np.abs(x) + np.abs(y))
    along = np.where(x < 0.0, 2.0 - u, np.where(y < 0.0, u + 4.0, u))
    column = np.minimum((along * kernels.COLUMNS / 4.0).astype(int), kernels.COLUMNS - 1)
    row = np.floor((z / flat - kernels.TAN_LOW) / kernels.TAN_STEP).astype(int)
    low = z + HEIGHT_M < kernels.GROUND_M + kernels.GROUND_SLOPE * flat
    kept = (flat > 0.5) & (row >= 0) & (row < kernels.ROWS)
    twin = np.zeros_like(image)
    cm = np.maximum(1, np.minimum((np.sqrt(flat**2 + z**2) * 100.0).astype(int), kernels.FAR_CM))
    for n in sorted(np.flatnonzero(kept), key=lambda n: (-cm[n], -n)):
        twin[column[n], row[n]] = cm[n] | (kernels.GROUND_BIT if low[n] else 0)
    np.testing.assert_array_equal(image, twin)
    for c in np.unique(column[kept]):
        t = offset_ns[kept & (column == c)].astype(np.float64) * 1e-9 - 0.05
        known = np.ptp(t) <= kernels.SPREAD_S
        assert np.isnan(times_s[c]) != known
        if known:
            assert times_s[c] == pytest.approx(0.5 * (t.min() + t.max()), abs=1e-6)


def looked(image, column, row, range_m):
    """`look` as it reads: the nearest filled pixels above and below in three columns, all verdicts together."""
    verdicts = {"above": [], "below": []}
    for c in (column - 1, column, column + 1):
        line = image[c % kernels.COLUMNS].astype(int)
        rows = np.flatnonzero(line)
        above = rows[(rows >= row) & (rows <= row + kernels.LAYERS_ROWS)][:1]
        below = rows[(rows <= row) & (rows >= row - kernels.LAYERS_ROWS)][-1:]
        for side, chosen in (("above", above), ("below", below)):
            for r in chosen:
                behind = (line[r] & kernels.FAR_CM) / 100.0 - range_m
                margin = kernels.MARGIN_M + kernels.MARGIN_SHARE * range_m
                ground = side == "below" and r < row and line[r] & kernels.GROUND_BIT
                hidden = behind < -margin
                passed = behind > margin or ground
                verdicts[side].append("hidden" if hidden else "passed" if passed else "met")
    told = verdicts["above"] + verdicts["below"]
    if "met" in told:
        return kernels.MET
    clear = "hidden" not in told and "passed" in verdicts["above"] and "passed" in verdicts["below"]
    return kernels.PASSED if clear else kernels.UNKNOWN


def test_look_is_that_of_a_plain_twin():
    rng = np.random.default_rng(3)
    image = np.zeros((kernels.COLUMNS, kernels.ROWS), np.uint16)
    filled = rng.uniform(size=image.shape) < 0.3
    image[filled] = rng.choice([900, 1000, 1080, 1400, 3000], int(filled.sum())).astype(np.uint16)
    image[rng.uniform(size=image.shape) < 0.1] |= kernels.GROUND_BIT
    image[(image & kernels.FAR_CM) == 0] = 0
    answers = []
    for _ in range(3000):
        column, row = int(rng.integers(kernels.COLUMNS)), int(rng.integers(kernels.ROWS))
        range_m = float(rng.choice([5.0, 8.0, 10.0, 13.0]))
        answers.append(kernels.look(image, column, row, range_m))
        assert answers[-1] == looked(image, column, row, range_m)
    assert set(answers) == {kernels.UNKNOWN, kernels.MET, kernels.PASSED}


def test_rings_on_open_ground_are_no_odometry():
    """On bare ground a scan fits where the one before stood: better nothing is said than that the vehicle stands."""

    def steps(standing):
        rng, odometry, told = np.random.default_rng(5), ScanOdometry(), []
        for n in range(6):
            raw, offset_ns, _ = sweep(standing, [], 0.9 * n, 9.0, rng)
            chosen = sample_scan(raw, SamplingParameters())
            points = raw[chosen].astype(np.float64) + T_VEHICLE_LIDAR[:3, 3]
            points[:, 0] += 9.0 * (offset_ns[chosen] * 1e-9 - 0.05)
            T = np.eye(4)
            T[0, 3] = 0.93
            told.append(odometry.step(n * 10**8, points, T, SIGMAS))
        return told[1:], len(standing_points(points, OFF_GROUND_M, OFF_GROUND_SLOPE)) / len(points)

    silent, few = steps([Block(70.0 * s, 20.0 * s, 0.2, 0.2, 0.0, 3.0) for s in (-1, 1)])
    assert few < 0.05
    assert silent == [None] * 5
    spoken, many = steps(STREET)
    assert many > 0.3
    assert all(step is not None for step in spoken)
    assert abs(spoken[-1].T_before_now[0, 3] - 0.9) < 0.02


@pytest.mark.slow
def test_a_van_put_before_real_scans(shared_data, tmp_path):
    """Sixteen sweeps of an HDL-64E: of the van most points go, of the street next to none."""
    recording = open_recording("kitti", shared_data / "kitti00_start16")
    write_drive(recording, map_track(recording), tmp_path / "alone.mcap", stand_ins=True)
    hits = put_behind_a_van(tmp_path / "alone.mcap", tmp_path / "van.mcap", VanAhead(13.0, swing_m=0.5))
    items, mount = list(read_drive(tmp_path / "van.mcap")), read_header(tmp_path / "van.mcap").T_vehicle_lidar
    motion, detector, before_ns, way_m = MotionBuffer(), CoMoving(mount), None, 0.0
    for item in items:
        if isinstance(item, MotionSample):
            motion.push(item.t_ns, item.speed_mps, item.yaw_rate_radps)
    found = []
    for scan, on_van in zip((i for i in items if isinstance(i, Scan)), hits, strict=True):
        end_ns = scan.t_ns + int(scan.t_offset_ns.max())
        t_ns, chosen = (scan.t_ns + end_ns) // 2, sample_scan(scan.points_m, SamplingParameters(n_points=8000))
        points = deskew(
            scan.points_m[chosen],
            scan.t_offset_ns[chosen],
            scan.t_ns,
            motion.trajectory(scan.t_ns, end_ns),
            mount,
            t_ns,
        )
        T = motion.delta(t_ns if before_ns is None else before_ns, t_ns)
        out, before_ns, way_m = (
            detector.see(scan.points_m, scan.t_offset_ns, scan.t_ns, t_ns, chosen, points, T),
            t_ns,
            way_m + float(T[0, 3]),
        )
        if way_m > 5.0:
            found.append((out, on_van[chosen], points))
    recall, false = shares(found)
    assert recall > 0.6
    assert false < 0.002
