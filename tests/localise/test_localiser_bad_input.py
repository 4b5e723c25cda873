"""Bad input has a name: what the localiser says of its pose, and errors stay bounded or it says that it is lost."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from yard import FRAME, GRID_FRAME, offset, pose, seen_from

from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.schemas.drive import GnssFix, MotionSample, Scan
from gnd.schemas.errors import BadValue
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise import Localiser, LocaliserParameters
from gnd.vehicle_agent.localise.refine_parameters import RefineParameters

S = 1_000_000_000
SWEEP_NS = S // 10
MOUNT = pose(1.2, 0.0, 0.0, z=1.9)
SPEED_MPS, RADIUS_M = 5.0, 9.0
PARAMETERS = LocaliserParameters(refine=RefineParameters(enabled=False))
GRID_FRAME_TILES = frozenset(covering_circle(FRAME.lat_rad, FRAME.lon_rad, 90.0))


def true_pose(t_ns):
    """A circle around the yard's middle."""
    angle = SPEED_MPS / RADIUS_M * t_ns / S
    return pose(RADIUS_M * np.sin(angle), -1.0 - RADIUS_M * np.cos(angle), np.degrees(angle))


@pytest.fixture(scope="module")
def snap(yard_points):
    """A scan taken in an instant, made once for each time."""
    few = yard_points[::6]

    @cache
    def make(t_ns):
        points = seen_from(np.random.default_rng(t_ns), few, true_pose(t_ns) @ MOUNT, 3000)
        return Scan(
            t_ns,
            points.astype(np.float32),
            np.zeros(len(points), np.uint32),
            np.arange(len(points), dtype=np.uint16) % 16,
        )

    return make


def fix_at(t_ns, away=(1.5, -1.0)):
    p = true_pose(t_ns)[:3, 3] + [*away, 2.0]
    lat, lon, height = FRAME.geodetic_from_enu(p)
    return GnssFix(t_ns, float(lat), float(lon), float(height), 2.5)


def motion_at(t_ns):
    return MotionSample(t_ns, SPEED_MPS / 1.004, SPEED_MPS / RADIUS_M + 1e-3)


class Driver:
    """Drives a localiser and keeps what it says: (t_ns, metres off, degrees off, estimate)."""

    def __init__(self, localiser, snap):
        self.localiser, self.snap, self.told = localiser, snap, []

    def go(self, first_s, last_s, scan=None, fix=fix_at, motion=motion_at):
        """Seconds of driving; `scan`, `fix`, `motion` give what the sensors say at a time, None for nothing."""
        scan = scan or self.snap
        for k in range(round(first_s * 50), round(last_s * 50)):
            t_ns = k * S // 50
            if k % 10 == 0 and (said := fix(t_ns)) is not None:
                self.localiser.push_gnss(said)
            if k % 5 == 0 and (said := scan(t_ns)) is not None:
                list(self.localiser.take_scan(said))
            if (said := motion(t_ns)) is not None:
                self.localiser.push_motion(said)
            self._note()
        return self.localiser.online

    def _note(self):
        online = self.localiser.online
        if online is None or (self.told and self.told[-1][3] is online):
            return
        self.told.append((online.t_ns, *offset(true_pose(online.t_ns), online.T_map_vehicle), online))

    def assert_never_confidently_wrong(self):
        wrong = [(t / S, m, d) for t, m, d, e in self.told if e.health == "good" and (m > 0.44 or d > 0.5)]
        assert not wrong

    def causes(self, first_s):
        return {e.cause for t, _, _, e in self.told if t > first_s * S}


@pytest.fixture
def driver(yard_map, snap):
    return Driver(Localiser(yard_map, MOUNT, PARAMETERS), snap)


def nothing(t_ns):
    return None


def test_no_tiles_here(snap):
    driver = Driver(Localiser(LocalMap(GRID_FRAME), MOUNT, PARAMETERS), snap)
    assert driver.go(0.0, 1.0) is None
    assert driver.localiser.state == ("lost", "no_map")


def test_tiles_of_the_wrong_place(yard_map, snap):
    """Every tile lies one to the east of where it should: the pose is not found, or not called good."""
    wrong = LocalMap(GRID_FRAME)
    for tile_id in yard_map.tiles:
        shifted = TileId.from_indices(tile_id.lon_index + 1, tile_id.lat_index)
        if shifted in GRID_FRAME_TILES:
            wrong.set_tile(Tile(shifted, 1, yard_map.tile(tile_id).gaussians))
    driver = Driver(Localiser(wrong, MOUNT, PARAMETERS), snap)
    driver.go(0.0, 3.0)
    assert driver.localiser.state[0] != "good"
    assert driver.localiser.state[1] in ("no_match", "no_map", "ambiguous", "searching", "unconfirmed")
    assert all(e.health != "good" for *_, e in driver.told)


def test_tiles_that_become_those_of_another_place(driver, yard_map):
    """While driving well, every tile is exchanged for its neighbour's content."""
    held = LocalMap(GRID_FRAME)
    for tile_id in yard_map.tiles:
        held.set_tile(yard_map.tile(tile_id))
    driver.localiser = Localiser(held, MOUNT, PARAMETERS)
    assert driver.go(0.0, 2.0).health == "good"
    contents = [held.tile(tile_id).gaussians for tile_id in held.tiles]
    for tile_id, gaussians in zip(held.tiles, contents[1:] + contents[:1], strict=True):
        held.set_tile(Tile(tile_id, 2, gaussians))
    online = driver.go(2.0, 5.0)
    assert online.health != "good"
    assert online.cause in ("wrong_pose", "stale_map", "no_match", "no_map", "ambiguous", "unconfirmed")
    driver.assert_never_confidently_wrong()


def test_time_going_backwards(driver):
    driver.go(0.0, 2.0)
    for k in range(4):  # a few late scans are dropped, and it says why it is worried
        list(driver.localiser.take_scan(driver.snap(k * SWEEP_NS)))
    assert driver.localiser.online.health == "degraded"
    assert driver.localiser.online.cause == "bad_time"
    assert driver.go(2.0, 3.0).health == "good"


def test_a_clock_that_was_set_back_starts_anew(driver):
    driver.go(4.0, 6.0)
    online = driver.go(1.0, 5.0)
    assert driver.localiser.initialisations == 2
    assert online.health == "good"
    assert "bad_time" in {e.cause for *_, e in driver.told}
    driver.assert_never_confidently_wrong()


def test_a_stamp_from_the_future_does_no_lasting_harm(driver):
    driver.go(0.0, 2.0)
    future = replace(driver.snap(2 * S), t_ns=3600 * S)
    list(driver.localiser.take_scan(future))
    online = driver.go(2.1, 6.0)
    assert online.health == "good"
    driver.assert_never_confidently_wrong()


@pytest.mark.parametrize("gap_s", [1, 10, 60])
def test_a_gap_in_everything(driver, gap_s):
    """The recording stops and goes on: nothing is good before it has been proven anew."""
    driver.go(0.0, 3.0)
    online = driver.go(3.0 + gap_s, 7.0 + gap_s)
    assert online.health == "good"
    driver.assert_never_confidently_wrong()
    assert driver.localiser.initialisations == (2 if gap_s == 60 else 1)


def test_scans_missing_for_a_second_are_a_gap(driver):
    driver.go(0.0, 3.0)
    online = driver.go(3.0, 4.0, scan=nothing)
    assert (online.health, online.cause) == ("degraded", "gap")
    assert driver.go(4.0, 6.0).health == "good"
    assert driver.localiser.initialisations == 1
    driver.assert_never_confidently_wrong()


def scan_of(t_ns, values):
    """A scan whose points are overwritten after it was made: the type itself refuses what is not finite."""
    scan = Scan(t_ns, np.ones((3000, 3), np.float32), np.zeros(3000, np.uint32))
    scan.points_m[:] = values
    return scan


def bad_scans(driver):
    frozen = driver.snap(2 * S)
    return {
        "NaN": lambda t: scan_of(t, np.nan),
        "infinite": lambda t: scan_of(t, np.inf),
        "one point": lambda t: scan_of(t, 7.5),
        "frozen": lambda t: replace(frozen, t_ns=t),
    }


@pytest.mark.parametrize("kind", ["NaN", "one point", "frozen", "infinite"])
def test_scans_that_say_nothing(driver, kind):
    """Two seconds of them: dead reckoning, named; then all is well again."""
    driver.go(0.0, 2.0)
    online = driver.go(2.1, 4.0, scan=bad_scans(driver)[kind])
    assert online.health != "good"
    assert online.cause == "bad_scan"
    off_m, off_deg = offset(true_pose(online.t_ns), online.T_map_vehicle)
    assert off_m < 0.3
    assert off_deg < 1.0
    assert driver.go(4.0, 7.0).health == "good"
    driver.assert_never_confidently_wrong()


def test_empty_scans_are_a_gap(driver):
    driver.go(0.0, 2.0)
    empty = np.empty((0, 3), np.float32)
    online = driver.go(2.0, 3.5, scan=lambda t: Scan(t, empty, np.empty(0, np.uint32)))
    assert (online.health, online.cause) == ("degraded", "gap")
    assert driver.go(3.5, 5.0).health == "good"


def test_bad_scans_from_the_start_give_no_pose(driver):
    driver.go(0.0, 1.0, scan=bad_scans(driver)["NaN"])
    assert driver.localiser.state == ("lost", "bad_scan")


def test_scans_of_one_ring(driver):
    """A single level ring: whatever it makes of them, it is not wrong and good."""

    def ring(t_ns):
        scan = driver.snap(t_ns)
        level = np.abs(scan.points_m[:, 2] - 0.3) < 0.15
        return Scan(t_ns, scan.points_m[level], scan.t_offset_ns[level])

    driver.go(0.0, 2.0)
    driver.go(2.0, 5.0, scan=ring)
    driver.assert_never_confidently_wrong()
    assert driver.go(5.0, 7.0).health == "good"


def test_gnss_that_jumps_by_50_m_is_not_believed(driver):
    driver.go(0.0, 3.0)
    online = driver.go(3.0, 6.0, fix=lambda t: fix_at(t, (50.0, 10.0)))
    assert online.health == "good"
    assert driver.localiser.initialisations == 1
    driver.assert_never_confidently_wrong()
    assert driver.go(6.0, 7.0).health == "good"


def test_gnss_outage_changes_nothing(driver):
    driver.go(0.0, 2.0)
    assert driver.go(2.0, 8.0, fix=nothing).health == "good"
    driver.assert_never_confidently_wrong()


def test_gnss_that_is_wrong_from_the_start_finds_nothing_good(driver):
    """50 m off: there the map is empty, or does not fit."""
    driver.go(0.0, 3.0, fix=lambda t: fix_at(t, (50.0, 10.0)))
    assert driver.localiser.state[0] != "good"
    assert driver.localiser.state[1] in ("no_map", "no_match", "ambiguous", "searching", "unconfirmed")
    driver.assert_never_confidently_wrong()


def test_numbers_that_are_none_are_refused_by_their_types():
    with pytest.raises(BadValue):
        replace(fix_at(0), lat_rad=np.nan)
    with pytest.raises(BadValue):
        MotionSample(0, np.nan, 0.1)
    with pytest.raises(BadValue):
        Scan(0, np.full((5, 3), np.nan, np.float32), np.zeros(5, np.uint32))


def test_motion_that_stops_coming(driver):
    """The scans go on: the pose is followed, but not called good."""
    driver.go(0.0, 3.0)
    online = driver.go(3.0, 5.0, motion=nothing)
    assert (online.health, online.cause) == ("degraded", "no_motion")
    driver.assert_never_confidently_wrong()
    assert driver.go(5.0, 8.0).health == "good"


def test_a_vehicle_that_was_towed_is_found_again(yard_map, snap):
    """Teleported 14 m and turned by 90 degrees between two scans."""

    def elsewhere(t_ns):
        return replace(snap(t_ns + 3 * S), t_ns=t_ns)

    driver = Driver(Localiser(yard_map, MOUNT, PARAMETERS), snap)
    driver.go(0.0, 2.0)
    before = len(driver.told)
    driver.go(2.0, 8.0, scan=elsewhere, fix=lambda t: replace(fix_at(t + 3 * S), t_ns=t))
    later = [(e.t_ns, e) for *_, e in driver.told[before:]]
    off = [(offset(true_pose(t + 3 * S), e.T_map_vehicle), e.health) for t, e in later]
    assert not [o for o, health in off[4:] if health == "good" and (o[0] > 0.44 or o[1] > 0.5)]
    assert off[-1][1] == "good"
    assert driver.localiser.initialisations == 2
