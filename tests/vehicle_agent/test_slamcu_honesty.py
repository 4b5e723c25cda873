"""Whether covariances say how large errors are: normalised estimation error squared (NEES) over 100 drives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from sign_road import Road, driven

RUNS = 100
ROAD = Road(
    standing=[(90.0, -8.0), (130.0, 7.5), (175.0, -8.5)],
    mapped=[(90.0, -8.0), (175.0, -8.5)],
    end_m=205.0,
    start_m=20.0,
    false=0.02,
)
NEW = np.array(ROAD.standing[1])


def band(dimensions: int = 2) -> tuple[float, float]:
    low, high = chi2.ppf([0.025, 0.975], RUNS * dimensions) / RUNS
    return float(low), float(high)


def nees(error: np.ndarray, cov: np.ndarray) -> float:
    return float(error @ np.linalg.solve(cov, error))


@pytest.mark.slow
def test_covariances_of_new_features_measured_ones_and_the_vehicle_are_honest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Signs of the map before and after the new one; the map's own error is drawn anew in each drive."""
    feature, pose, seen = [], [], []
    monkeypatch.setattr("gnd.vehicle_agent.features.slamcu.track_list.MAP_SIGMA_M", 0.0)
    for seed in range(RUNS):
        survey = 0.1 * np.random.default_rng([seed, 5]).standard_normal((2, 2))
        road = replace(
            ROAD, mapped=[tuple(np.array(place) + off) for place, off in zip(ROAD.mapped, survey, strict=True)]
        )
        slamcu = driven(road, seed, sigma_m=0.7, sigma_deg=0.3)
        (new,) = slamcu.new_features()
        feature.append(nees(new.position_m - NEW, new.cov_m2))
        at, cov = slamcu.pose()
        end = list(road.poses())[-1][1]
        pose.append(nees((at - end)[:2], cov[:2, :2]))
        for state, place in zip(slamcu.known_states(), (ROAD.standing[0], ROAD.standing[2]), strict=True):
            assert state.position_m is not None
            assert state.cov_m2 is not None
            seen.append(nees(state.position_m - place, state.cov_m2))
    low, high = band()
    assert low < np.mean(feature) < high
    assert low < np.mean(seen) < high
    assert low < np.mean(pose) < high
