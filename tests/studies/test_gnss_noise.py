"""The fit of GNSS errors finds what made them, and gives the figures that drives along roads use."""

from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim.roads.drive import GNSS_CEP_M, GNSS_CORRELATION_S, GNSS_WHITE_SHARE, ROAD_ERRORS
from gnd.fleet_sim.trajectory import gauss_markov
from studies.gnss_noise import GnssNoiseOptions, fitted, horizontal_errors, run


def test_a_known_process_is_found_again() -> None:
    rng = np.random.default_rng(4)
    t_s = np.arange(3000.0)
    slow = np.stack([gauss_markov(rng, len(t_s), 1.0, 1.5, 20.0) for _ in range(2)], axis=1)
    noise = fitted(t_s, slow + 1.0 * rng.standard_normal(slow.shape) + [3.0, -4.0])
    assert noise.correlation_s == pytest.approx(20.0, rel=0.25)
    assert noise.slow_share == pytest.approx(1.5**2 / (1.5**2 + 1.0), abs=0.06)
    assert noise.sigma_m == pytest.approx(np.hypot(1.5, 1.0), rel=0.1)
    assert noise.constant_m == pytest.approx(5.0, abs=0.5)
    assert noise.left_out < 0.01


def test_drives_use_what_the_recording_gives(shared_data: Path) -> None:
    noise = fitted(*horizontal_errors(shared_data / "gnss_nagoya"))
    assert noise.correlation_s == pytest.approx(GNSS_CORRELATION_S, abs=0.05)
    assert 1.0 - noise.slow_share == pytest.approx(GNSS_WHITE_SHARE, abs=0.005)
    assert ROAD_ERRORS.gnss_correlation_s == GNSS_CORRELATION_S


def test_the_median_error_of_a_drive_is_the_data_sheets() -> None:
    rng = np.random.default_rng(5)
    slow = ROAD_ERRORS.gnss_m / np.sqrt(2) * rng.standard_normal((200_000, 2))
    error = slow + ROAD_ERRORS.gnss_white_m * rng.standard_normal((200_000, 2))
    assert np.median(np.linalg.norm(error, axis=1)) == pytest.approx(GNSS_CEP_M, rel=0.01)


def test_without_the_recording_nothing_is_measured(tmp_path: Path) -> None:
    assert [figure.name for figure in run(GnssNoiseOptions(tmp_path / "none"))] == ["not measured"]
