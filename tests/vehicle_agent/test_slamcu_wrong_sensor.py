"""A camera whose errors change in the middle of a drive, or that names kinds wrongly again and again: what is concluded
from it is taken back or called uncertain.
"""

from dataclasses import replace
from math import exp, radians, sqrt

import numpy as np
import pytest
from sign_road import PERIOD_S, Road

from gnd.vehicle_agent.features.look import Look
from gnd.vehicle_agent.features.slamcu import noise
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.sensor_model import CONFUSED, SensorModel
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass
from gnd.vehicle_agent.features.slamcu.watched import WatchedSlamcu
from gnd.vehicle_agent.features.view import CAMERA

SIGNS = [(x, y) for x in range(60, 1260, 60) for y in (-7.0, 7.0)]
ROAD = Road(SIGNS, SIGNS, end_m=1260.0)
SIGMA_M = 2.12
JUMP_S = 16.0


def watched(jump_rad: float, seed: int = 3) -> tuple[WatchedSlamcu, np.ndarray]:
    """A drive whose camera is turned by so much from `JUMP_S` on, and squared distances (S,) of the path from the true
    one in units of its covariances.
    """
    rng, slow_m = np.random.default_rng([seed, 78]), sqrt(0.7) * SIGMA_M
    error, fade = slow_m * rng.standard_normal(2), exp(-1.0 / noise.GNSS_CORRELATION_S)
    start, parameters = np.diag([0.25, 0.25, radians(0.3) ** 2]), SlamcuParameters(particles=500)
    slamcu = WatchedSlamcu(parameters, ROAD.known(), np.zeros(3), start, seed, sensor=SensorModel(0.9))
    true = []
    for i, pose in ROAD.poses():
        if i:
            slamcu.predict(PERIOD_S, ROAD.speed_mps, 0.0)
        look = ROAD.look(i, pose, rng)
        slamcu.look(replace(look, bearing_rad=look.bearing_rad + jump_rad * (i * PERIOD_S > JUMP_S)), CAMERA)
        true.append(pose[:2])
        if i % 15 == 0:
            error = fade * error + sqrt(1.0 - fade**2) * slow_m * rng.standard_normal(2)
            slamcu.gnss(*(pose[:2] + error + sqrt(0.3) * SIGMA_M * rng.standard_normal(2)), SIGMA_M)
    slamcu.finish()
    off = np.array([one.pose[:2] for one in slamcu.path]) - np.array(true)
    cov = np.array([one.cov[:2, :2] for one in slamcu.path])
    return slamcu, np.einsum("si,sij,sj->s", off, np.linalg.inv(cov), off)


@pytest.mark.slow
def test_a_camera_that_is_turned_on_the_way_is_noticed_and_the_path_is_not_claimed_for_certain() -> None:
    slamcu, squared = watched(radians(6.0))
    assert any(one.until_s > JUMP_S for one in slamcu.lost), "the vehicle says that it had been elsewhere"
    after = np.array([one.t_s > JUMP_S for one in slamcu.path])
    assert (squared[after] > 13.8).mean() < 0.05, "what it claims in the end holds what it is off by"


@pytest.mark.slow
def test_a_camera_that_stays_where_it_is_raises_no_alarm() -> None:
    slamcu, squared = watched(0.0)
    assert not slamcu.lost
    assert (squared > 13.8).mean() < 0.01


def named_wrongly(look: Look, share: float, rng: np.random.Generator) -> Look:
    return replace(look, kinds=tuple("other" if rng.random() < share else kind for kind in look.kinds))


def by_kinds(share: float) -> Slamcu:
    """A drive from given poses whose camera names that share of all detections wrongly."""
    rng, sensor = np.random.default_rng(5), SensorModel(0.9)
    slamcu = Slamcu(SlamcuParameters(particles=1), ROAD.known(), np.zeros(3), np.eye(3) * 1e-4, sensor=sensor)
    for i, pose in ROAD.poses():
        if i:
            slamcu.predict(PERIOD_S, ROAD.speed_mps, 0.0)
        slamcu.set_pose(pose, np.eye(3) * 1e-4)
        slamcu.look(named_wrongly(ROAD.look(i, pose, rng), share, rng), CAMERA)
    slamcu.decide()
    return slamcu


def test_kinds_that_are_often_confused_make_no_new_signs_and_the_vehicle_knows_of_it() -> None:
    slamcu = by_kinds(0.4)
    assert slamcu.sensor.confused == pytest.approx(CONFUSED[1]), "more than any detector may: the bound"
    assert not slamcu.new_features()
    assert all(state.feature_class != FeatureClass.DELETED for state in slamcu.known_states())


def test_kinds_that_are_nearly_always_others_are_other_signs() -> None:
    """Then it is the map that is wrong, and it is reported, not averaged away."""
    slamcu = by_kinds(0.95)
    classes = [state.feature_class for state in slamcu.known_states() if state.hits + state.misses]
    assert np.mean([one == FeatureClass.DELETED for one in classes]) > 0.9
    assert len(slamcu.new_features()) > 0.9 * len(classes)
