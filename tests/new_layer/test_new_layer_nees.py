"""Covariances are honest: over 100 runs the squared errors of features, in units of them, are what chi-square says."""

from functools import cache

import numpy as np
import pytest
from plane_scene import PAPER, Scene, drive, sensors
from scipy.stats import chi2

from gnd.vehicle_agent.features.mapping.new_layer import lane_map, map_new_layer

RUNS = 100
FIRST_SEED = {False: 1000, True: 5000}  # with lanes others than those on which their share of information was chosen
SCENE = Scene(seconds=8.0, features=np.array([[15.0, 7.0], [60.0, -8.0]]))


@cache
def errors(with_lanes):
    """(RUNS, 2, 2) errors in sigmas and (RUNS, 2) their squares of the first and the last feature."""
    truth = SCENE.truth()
    lanes = lane_map(truth.lanes) if with_lanes else None
    squares, off = np.empty((RUNS, 2)), np.empty((RUNS, 2, 2))
    for seed in range(RUNS):
        layer = map_new_layer(drive(truth, PAPER, FIRST_SEED[with_lanes] + seed), sensors(PAPER), lanes, rounds=1)
        distance = np.hypot(*(layer.features.xy_m[:, None] - truth.features[None]).transpose(2, 0, 1))
        row = np.argmin(distance, axis=0)
        off[seed] = layer.features.xy_m[row] - truth.features
        squares[seed] = np.einsum("ni,nij,nj->n", off[seed], np.linalg.inv(layer.features.cov_m2[row]), off[seed])
    return off, squares


@pytest.mark.slow
@pytest.mark.parametrize("with_lanes", [False, True])
def test_squared_errors_of_a_feature_lie_in_their_band(with_lanes):
    """The mean of 100 squares of two dimensions is chi-square with 200 degrees of freedom over 100."""
    low, high = chi2.ppf([0.025, 0.975], 2 * RUNS) / RUNS
    _, squares = errors(with_lanes)
    for mean in squares.mean(axis=0):
        assert low < mean < high


@pytest.mark.slow
@pytest.mark.parametrize("with_lanes", [False, True])
def test_errors_have_no_bias(with_lanes):
    off, _ = errors(with_lanes)
    assert (np.abs(off.mean(axis=0)) < 3.5 * off.std(axis=0) / np.sqrt(RUNS)).all()
