"""A detector that errs by the same of a feature in all looks: the graph finds it out, or claims too much."""

from dataclasses import replace

import numpy as np
import pytest
from plane_scene import PAPER, Scene, drive, sensors

from gnd.vehicle_agent.features.mapping.new_layer import map_new_layer
from gnd.vehicle_agent.features.slamcu.sensor_model import SensorModel

SCENE = Scene(seconds=16.0, features=np.array([[15.0 + 12.0 * k, 7.0 * (-1.0) ** k] for k in range(11)]))
HARD = replace(PAPER, gnss=0.5, white=0.3, held_share=0.08, held_rad=np.radians(1.5))
RUNS = 5


def nees_and_error() -> tuple[float, float]:
    """Mean NEES of the features of a few drives, and their mean error [m]."""
    truth, squares, off_m = SCENE.truth(), [], []
    for seed in range(RUNS):
        found = map_new_layer(drive(truth, HARD, 7000 + seed), sensors(HARD)).features
        off = truth.features[:, None] - found.xy_m[None]
        row = np.hypot(off[..., 0], off[..., 1]).argmin(axis=1)
        error = found.xy_m[row] - truth.features
        squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.cov_m2[row]), error))
        off_m.append(np.hypot(*error.T))
    return float(np.mean(squares)), float(np.mean(off_m))


def test_errors_that_stay_with_features_are_found_out_and_ignoring_them_claims_too_much(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    honest, off_m = nees_and_error()
    assert 1.2 < honest < 2.8
    monkeypatch.setattr(SensorModel, "held", property(lambda _: np.zeros(2)))
    monkeypatch.setattr(SensorModel, "claimed", property(lambda _: np.zeros(2)))
    too_sure, worse_m = nees_and_error()
    assert too_sure > 1.5 * honest
    assert worse_m > 1.1 * off_m


def test_a_detector_without_such_errors_is_believed() -> None:
    """White noise alone: what was learnt stays below what would matter, 1 % and 1°."""
    found = map_new_layer(drive(SCENE.truth(), replace(HARD, held_share=0.0, held_rad=0.0), 7100), sensors(HARD))
    assert np.abs(found.solution.state.errors).max(axis=0) == pytest.approx([0.0, 0.0], abs=0.02)
