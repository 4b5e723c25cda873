"""Wheels and scans contradict each other: the map says who is wrong, and says when it cannot."""

import numpy as np
import pytest
from yard import pose

from gnd.vehicle_agent.localise.arbiter import ArbitratedMotion, believing_neither, who_is_wrong
from gnd.vehicle_agent.localise.registration import RegistrationResult
from gnd.vehicle_agent.localise.scan_odometry import ScanStep

BEFORE = pose(3.0, -2.0, 30.0)
KNOWN = np.diag([1e-6, 1e-6, 1e-6, 0.03**2, 0.03**2, 0.01**2])
SMALL = np.diag([1e-7, 1e-7, 1e-7, 0.01**2, 0.01**2, 0.01**2])
TRUE_M, FALSE_M = 0.9, 0.65


def forward(metres):
    T = np.eye(4)
    T[0, 3] = metres
    return T


def match_at(metres, sigma_m=0.04, fit=0.95, converged=True):
    covariance = np.diag([1e-6, 1e-6, 1e-6, sigma_m**2, 0.03**2, 0.01**2])
    return RegistrationResult(BEFORE @ forward(metres), covariance, 0.99, fit, 1.0, 5, converged, np.empty((0, 6)))


def verdict(driven_m, seen_m, *matches):
    return who_is_wrong(
        BEFORE, KNOWN, ArbitratedMotion(forward(driven_m), SMALL), ArbitratedMotion(forward(seen_m), SMALL), matches
    )


@pytest.mark.parametrize(("driven_m", "seen_m", "wrong"), [(TRUE_M, FALSE_M, "scans"), (FALSE_M, TRUE_M, "wheels")])
def test_the_one_whom_the_map_contradicts_is_wrong(driven_m, seen_m, wrong):
    assert verdict(driven_m, seen_m, match_at(TRUE_M), match_at(TRUE_M + 0.01)) == wrong


def test_a_map_that_says_nothing_along_the_way_decides_nothing():
    assert verdict(TRUE_M, FALSE_M, match_at(TRUE_M, sigma_m=10.0)) == "open"


def test_a_match_half_way_decides_nothing():
    assert verdict(TRUE_M, FALSE_M, match_at(0.5 * (TRUE_M + FALSE_M))) == "open"


def test_two_minima_that_fit_alike_decide_nothing_and_one_that_fits_worse_does_not_matter():
    assert verdict(TRUE_M, FALSE_M, match_at(TRUE_M), match_at(FALSE_M, fit=0.94)) == "open"
    assert verdict(TRUE_M, FALSE_M, match_at(TRUE_M), match_at(FALSE_M, fit=0.6)) == "scans"


def test_without_a_match_that_converged_nobody_is_accused():
    assert verdict(TRUE_M, FALSE_M) == "open"
    assert verdict(TRUE_M, FALSE_M, match_at(TRUE_M, converged=False)) == "open"


def test_when_nobody_knows_the_claimed_sigma_holds_both():
    sigmas = np.sqrt(np.diag(SMALL))
    joint, unsure = believing_neither(forward(TRUE_M), sigmas, ScanStep(forward(FALSE_M), SMALL))
    apart = TRUE_M - FALSE_M
    assert np.sqrt(unsure.covariance[3, 3]) > apart
    assert joint.driven_sigmas[3] > apart
    assert joint.slipped
    assert FALSE_M <= joint.T_before_now[0, 3] <= TRUE_M
    assert joint.driven_sigmas[4] == pytest.approx(sigmas[4])  # across they agree
