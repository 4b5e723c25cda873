"""Scenes that several tests look at."""

import numpy as np
import pytest
from yard import local_map_of, yard

from gnd.vehicle_agent.local_map import LocalMap


@pytest.fixture(scope="session")
def yard_points() -> np.ndarray:
    return yard(np.random.default_rng(1))


@pytest.fixture(scope="session")
def yard_map(yard_points: np.ndarray) -> LocalMap:
    rng = np.random.default_rng(2)
    return local_map_of(yard_points + rng.normal(0.0, 0.02, yard_points.shape))
