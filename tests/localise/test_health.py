"""The monitor's verdicts: which sign leads to which health and cause."""

import numpy as np
import pytest

from gnd.vehicle_agent.localise import witness
from gnd.vehicle_agent.localise.health import HealthMonitor, named_directions
from gnd.vehicle_agent.localise.parameters import HealthParameters
from gnd.vehicle_agent.localise.registration import RegistrationResult
from gnd.vehicle_agent.localise.witness import CROSSED, GONE, HIT, KNOWN, NEW

S = 1_000_000_000
FREE = np.empty((0, 6))


def match(fit=0.9, ratio=0.95, off_m=0.0):
    T = np.eye(4)
    T[0, 3] = off_m
    return RegistrationResult(T, np.eye(6) * 1e-4, ratio, fit, 1.0, 4, True, FREE)


def rays(hits, new, gone, sectors=12, n=20):
    counts = np.zeros((sectors, 5), np.int64)
    counts[:, KNOWN] = counts[:, CROSSED] = n
    counts[:, HIT] = (np.broadcast_to(hits, sectors) * n).astype(int)
    counts[:, NEW] = (np.broadcast_to(new, sectors) * n).astype(int)
    counts[:, GONE] = (np.broadcast_to(gone, sectors) * n).astype(int)
    return witness.Testimony(counts, sectors * n, 8)


@pytest.fixture
def monitor():
    """A pose that has been good for a second."""
    monitor = HealthMonitor(HealthParameters(), 0)
    for k in range(10):
        follow(monitor, k * S // 10)
    assert monitor.judge(S) == ("good", "none")
    return monitor


def follow(monitor, t_ns, result=None):
    result = result or match()
    believed = monitor.believe(result, np.eye(4), np.zeros(6), t_ns)
    if believed:
        monitor.see_match(result.fit, result.fit, result.degenerate)
    return believed


def test_a_pose_is_unconfirmed_until_a_match_has_fitted_well():
    monitor = HealthMonitor(HealthParameters(), 0)
    follow(monitor, 0, match(fit=0.5))
    assert monitor.judge(0) == ("degraded", "unconfirmed")
    follow(monitor, 1)
    assert monitor.judge(1) == ("good", "none")


def test_what_stands_must_fit_too():
    monitor = HealthMonitor(HealthParameters(), 0)
    monitor.believe(match(), np.eye(4), np.zeros(6), 0)
    monitor.see_match(0.4, 0.9, FREE)  # only the ground fits
    assert monitor.judge(0) == ("degraded", "unconfirmed")


def test_a_rival_makes_a_wrong_pose_unless_submaps_are_certain(monitor):
    monitor.contested = True
    assert monitor.judge(S) == ("degraded", "wrong_pose")
    monitor.beaten = True
    assert monitor.judge(S) == ("lost", "wrong_pose")
    monitor.certain = True
    assert monitor.judge(S) == ("good", "none")


def test_changes_in_some_places_are_a_stale_map_and_good(monitor):
    for _ in range(3):
        monitor.see_testimony(rays([1.0] * 8 + [0.0] * 4, [0.0] * 8 + [1.0] * 4, 0.2))
    assert monitor.judge(S) == ("good", "stale_map")


def test_contradiction_all_around_is_a_wrong_pose(monitor):
    for _ in range(2):
        monitor.see_testimony(rays(0.2, 0.5, 0.5))
    assert monitor.suspicious
    assert monitor.judge(S) == ("degraded", "wrong_pose")


def test_no_believed_match_is_the_maps_fault_where_the_rest_fits(monitor):
    monitor.see_testimony(rays([1.0] * 8 + [0.0] * 4, [0.0] * 8 + [1.0] * 4, 0.3))
    assert not follow(monitor, 2 * S, match(off_m=1.0))
    assert monitor.judge(2 * S) == ("degraded", "stale_map")
    assert monitor.judge(10 * S) == ("degraded", "stale_map")  # dead reckoning is still worth something
    assert monitor.judge(30 * S) == ("lost", "stale_map")


def test_no_believed_match_and_nothing_that_hits_is_lost_sooner(monitor):
    monitor.see_testimony(rays(0.1, 0.9, 0.9))
    assert monitor.judge(3 * S) == ("degraded", "wrong_pose")
    assert monitor.judge(7 * S) == ("lost", "wrong_pose")


def test_little_that_stands_is_a_poor_place(monitor):
    monitor.see_testimony(rays(1.0, 0.0, 0.0, n=1))
    assert monitor.judge(2 * S) == ("degraded", "poor_place")


def test_a_large_sigma_is_a_poor_place(monitor):
    monitor.see_sigma(0.5, 1e-4)
    assert monitor.judge(S) == ("degraded", "poor_place")
    monitor.see_sigma(0.01, 0.02)
    assert monitor.judge(S) == ("degraded", "poor_place")


def test_what_is_wrong_with_the_scan_comes_first(monitor):
    monitor.contested = True
    monitor.see_scan("bad_scan")
    assert monitor.judge(S) == ("degraded", "bad_scan")
    assert monitor.judge(8 * S) == ("lost", "bad_scan")


def test_gnss_that_drifts_away_from_the_start_contradicts(monitor):
    for k in range(6):
        monitor.see_fix(np.array([20.0, 0.0]), 2.5)
        assert monitor.judge(S)[0] == ("good" if k < 4 else "lost")


def test_gnss_that_jumps_while_scans_match_is_not_believed(monitor):
    monitor.see_fix(np.array([1.0, 0.0]), 2.5)
    for _ in range(20):
        monitor.see_fix(np.array([50.0, 0.0]), 2.5)
    assert monitor.judge(S) == ("good", "none")
    assert monitor.judge(3 * S)[0] == "lost"  # without matches there is nothing to hold against it


def test_a_pose_that_was_dead_reckoned_for_long_must_prove_itself_again(monitor):
    monitor.distrust()
    assert monitor.judge(S) == ("degraded", "unconfirmed")
    follow(monitor, S + 1)
    assert monitor.judge(S + 1) == ("good", "none")


def test_directions_have_names():
    free = np.array([[0, 0, 0, 0.99, 0.1, 0], [0, 0, -0.9, 0, 0.2, 0]])
    assert named_directions(free) == ("longitudinal", "heading")
    assert named_directions(FREE) == ()


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="must not exceed lost_after_s"):
        HealthParameters(degraded_after_s=5.0)
    with pytest.raises(ValueError, match=r"lost_after_s = -1\.0 lies outside > 0"):
        HealthParameters(lost_after_s=-1.0)


def elsewhere(monitor, t_ns, fit):
    result = match(fit=fit, off_m=0.7)
    believed = follow(monitor, t_ns, result)
    assert not believed
    monitor.see_verdict(result, believed)


def test_scans_that_fit_elsewhere_one_after_the_other_dispute_the_pose(monitor):
    elsewhere(monitor, S, 0.95)
    assert monitor.judge(S) == ("good", "none")  # one may be a scan's own error
    elsewhere(monitor, S + S // 10, 0.95)
    assert monitor.judge(S + S // 10) == ("degraded", "wrong_pose")


def test_what_submaps_are_certain_of_is_disputed_by_scans_that_fit_wholly_or_for_long(monitor):
    monitor.certain = True
    for k in range(3):
        elsewhere(monitor, S + k, 0.7)
    assert monitor.judge(S + 3)[0] == "good"
    elsewhere(monitor, S + 3, 0.7)
    assert monitor.judge(S + 3) == ("degraded", "wrong_pose")


def test_scans_that_fit_wholly_dispute_a_certain_pose_at_once(monitor):
    monitor.certain = True
    for k in range(2):
        elsewhere(monitor, S + k, 0.95)
    assert monitor.judge(S + 2) == ("degraded", "wrong_pose")


def test_matches_that_are_believed_settle_the_dispute(monitor):
    for k in range(2):
        elsewhere(monitor, S + k, 0.95)
    assert follow(monitor, S + 3)
    monitor.see_verdict(match(), True)
    assert monitor.judge(S + 3) == ("good", "none")


def test_a_first_pose_with_a_rival_nearby_must_agree_with_the_next_scans():
    monitor = HealthMonitor(HealthParameters(), 0)
    monitor.prove_first()
    said = []
    for k in range(4):
        follow(monitor, k)
        monitor.see_verdict(match(), True)
        said.append(monitor.judge(k)[0])
    assert said == ["degraded", "degraded", "good", "good"]


def test_a_scan_that_fits_nothing_disputes_nothing(monitor):
    for _k in range(6):
        monitor.see_verdict(match(fit=0.3, off_m=0.7), False)
        monitor.see_verdict(None, False)
    assert not monitor.disputed
