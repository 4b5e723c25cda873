"""Drives on which the particles are lost: the vehicle must notice, say so, and take back what it concluded."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import exp, radians, sqrt

import numpy as np
import pytest
from sign_road import FEW, PERIOD_S, Road
from sign_road import NO_SHIFT as HERE

from gnd.vehicle_agent.features.slamcu import noise
from gnd.vehicle_agent.features.slamcu.blind import BlindBelief, BlindFilter
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass
from gnd.vehicle_agent.features.slamcu.watch import Alarm, Watch
from gnd.vehicle_agent.features.slamcu.watched import WatchedSlamcu
from gnd.vehicle_agent.features.view import CAMERA

NORMAL = FeatureClass.NORMAL
SIGMA_M = 2.12
"""Of each axis of a fix: 2.5 m CEP."""
SIGNS = [(150.0 + 130.0 * i + 9.0 * (i % 3), (8.0, -9.0, -8.0)[i % 3]) for i in range(20)]
LONG = Road(standing=SIGNS, mapped=SIGNS, end_m=2700.0)
Off = Callable[[float], np.ndarray]


@dataclass(frozen=True)
class Trouble:
    """What goes wrong on a drive, by time [s]."""

    gnss_m: Off = lambda _: HERE
    wheel: float = 1.0
    gnss_from_s: float = 0.0
    kidnapped_s: float = -1.0
    kidnapped_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Told:
    """A drive's end, and how far off its path is then, (S, 2) along and across."""

    slamcu: WatchedSlamcu
    off_m: np.ndarray


def watched(road: Road, trouble: Trouble, seed: int = 0, parameters: SlamcuParameters = FEW) -> Told:
    """A drive along the road whose fixes come every second, with the errors that the parameters know of."""
    rng, slow_m = np.random.default_rng([seed, 78]), sqrt(0.7) * SIGMA_M
    error, fade = slow_m * rng.standard_normal(2), exp(-1.0 / noise.GNSS_CORRELATION_S)
    slamcu = WatchedSlamcu(parameters, road.known(), np.zeros(3), np.diag([0.25, 0.25, radians(0.3) ** 2]), seed)
    true = []
    for i, pose in road.poses():
        if i:
            slamcu.predict(PERIOD_S, road.speed_mps * trouble.wheel, 0.0)
        if i == round(trouble.kidnapped_s / PERIOD_S):
            slamcu._run.slamcu._particles.state[:2] += np.array(trouble.kidnapped_m)[:, None]
        slamcu.look(road.look(i, pose, rng), CAMERA)
        true.append(pose[:2])
        if i % 15 == 0:
            error = fade * error + sqrt(1.0 - fade**2) * slow_m * rng.standard_normal(2)
            white = sqrt(0.3) * SIGMA_M * rng.standard_normal(2)
            if i * PERIOD_S >= trouble.gnss_from_s:
                slamcu.gnss(*(pose[:2] + error + white + trouble.gnss_m(i * PERIOD_S)), SIGMA_M)
    slamcu.finish()
    return Told(slamcu, np.array([one.pose[:2] for one in slamcu.path]) - np.array(true))


def classes(slamcu: WatchedSlamcu) -> list[FeatureClass]:
    return [state.feature_class for state in slamcu.known_states()]


def test_a_drive_without_trouble_is_not_lost() -> None:
    told = watched(LONG, Trouble())
    assert told.slamcu.lost == []
    assert classes(told.slamcu) == [NORMAL] * len(SIGNS)
    assert told.slamcu.new_features() == ()
    assert np.abs(told.off_m).max() < 4.0


def test_another_reflection_is_refused_and_moves_nothing() -> None:
    told = watched(LONG, Trouble(gnss_m=lambda t_s: np.array([0.0, 40.0]) if 30.0 < t_s < 42.0 else HERE))
    assert told.slamcu.fixes_refused >= 10
    assert told.slamcu.lost == []
    assert np.abs(told.off_m).max() < 4.0


@pytest.mark.parametrize(("moved_m", "seed"), [((25.0, 0.0), 0), ((0.0, 14.0), 1), ((-18.0, -10.0), 2)])
def test_a_kidnapped_vehicle_notices_and_takes_back(moved_m: tuple[float, float], seed: int) -> None:
    """The particles are put elsewhere, as sure as before: nothing of the map is where it should be."""
    told = watched(LONG, Trouble(kidnapped_s=40.0, kidnapped_m=moved_m), seed)
    assert told.slamcu.lost
    first = told.slamcu.lost[0]
    assert first.from_s < 40.0 + 2.0
    assert first.until_s > 40.0
    assert first.off_m > 0.5 * np.hypot(*moved_m)
    assert np.abs(told.off_m[-15:]).max() < 4.0
    assert classes(told.slamcu).count(NORMAL) == len(SIGNS)
    assert told.slamcu.new_features() == ()


@pytest.mark.slow
def test_a_map_whose_signs_all_stand_elsewhere_is_not_followed_silently() -> None:
    """Everything is 12 m farther on in the map from 1 km on: map and GNSS contradict, and neither can be asked."""
    shifted = [(x + (12.0 if x > 1000.0 else 0.0), y) for x, y in SIGNS]
    told = watched(replace(LONG, mapped=shifted), Trouble(), 3)
    far = np.hypot(*told.off_m.T) > 8.0
    t_s = np.array([one.t_s for one in told.slamcu.path])
    given_up = np.zeros(len(t_s), bool)
    for one in told.slamcu.lost:
        given_up |= (t_s >= one.from_s) & (t_s <= one.until_s) & (not one.replayed)
    assert not (far & ~given_up).any()
    assert told.slamcu.doubts or told.slamcu.lost


def given_up(told: Told) -> np.ndarray:
    """(S,) looks of stretches of which the vehicle says nothing."""
    t_s, lost = np.array([one.t_s for one in told.slamcu.path]), np.zeros(len(told.slamcu.path), bool)
    for one in told.slamcu.lost:
        lost |= (t_s >= one.from_s) & (t_s <= one.until_s) & (not one.replayed)
    return lost


@pytest.mark.slow
def test_fixes_that_go_wrong_for_good_end_in_giving_up_and_nothing_concluded_then_is_told() -> None:
    """From 40 s on all fixes lie 14 m to the left, a few signs have gone and a few are new: map and GNSS contradict,
    the vehicle cannot know which is right, and says of the rest of its way nothing at all.
    """
    changed = [(x + 40.0, y) if 1200.0 < x < 1900.0 and i % 2 else (x, y) for i, (x, y) in enumerate(SIGNS)]
    road = replace(LONG, standing=changed)
    honest = watched(road, Trouble(), 0).slamcu
    assert sum(one != NORMAL for one in classes(honest)) + len(honest.new_features()) >= 4
    told = watched(road, Trouble(gnss_m=lambda t_s: np.array([0.0, 14.0]) if t_s > 40.0 else HERE), 0)
    assert told.slamcu.is_lost
    assert np.sqrt(told.slamcu.pose()[1][1, 1]) > 8.0
    assert any(not one.replayed for one in told.slamcu.lost)
    assert classes(told.slamcu) == [NORMAL] * len(SIGNS)
    assert told.slamcu.new_features() == ()
    wrong = (np.hypot(*told.off_m.T) > 5.0) & ~given_up(told)
    assert wrong.sum() < 75  # five seconds


def test_wheels_that_tell_three_per_cent_too_much() -> None:
    """Six times the sigma that is known of them: the place must stay within what is claimed, or be said to be lost."""
    told = watched(LONG, Trouble(wheel=1.03), 4)
    claimed = np.array([sqrt(one.cov[0, 0]) for one in told.slamcu.path])
    beyond = (np.abs(told.off_m[:, 0]) > np.maximum(5.0, 3.7 * claimed)).mean()
    assert beyond < 0.02 or told.slamcu.lost


def test_verdicts_of_a_lost_stretch_are_undone() -> None:
    """Without its doubts the same drive calls signs deleted and finds new ones."""
    trouble = Trouble(gnss_from_s=50.0, kidnapped_s=10.0, kidnapped_m=(25.0, 0.0))
    blind = watched_without_doubt(trouble, 0)
    assert sum(one != NORMAL for one in classes(blind)) + len(blind.new_features()) >= 10
    told = watched(LONG, trouble, 0).slamcu
    assert sum(one.taken_back for one in told.lost) >= 3
    assert classes(told) == [NORMAL] * len(SIGNS)
    assert told.new_features() == ()


def watched_without_doubt(trouble: Trouble, seed: int) -> WatchedSlamcu:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WatchedSlamcu, "_look_into", lambda *_: None)
        return watched(LONG, trouble, seed).slamcu


def test_a_stretch_that_is_given_up_is_forgotten() -> None:
    """No account would do: the book is that of the last good state, and the place that of wheels, gyro and GNSS."""
    slamcu = watched_without_doubt(Trouble(kidnapped_s=40.0, kidnapped_m=(25.0, 0.0)), 0)
    wrong = sum(one != NORMAL for one in classes(slamcu)) + len(slamcu.new_features())
    assert wrong >= 5
    slamcu._give_up(Alarm("blind", 99.0, 21.1))
    (lost,) = slamcu.lost
    assert not lost.replayed
    assert lost.from_s < 41.0 < lost.until_s
    assert lost.taken_back >= 5
    assert classes(slamcu) == [NORMAL] * len(SIGNS)
    assert slamcu.new_features() == ()
    end = list(LONG.poses())[-1][1]
    assert np.hypot(*(slamcu.pose()[0] - end)[:2]) < 8.0


def test_a_fork_goes_its_own_way() -> None:
    slamcu = watched(replace(LONG, end_m=400.0), Trouble()).slamcu._run.slamcu
    before = slamcu.pose()[0], classes_of(slamcu)
    other = slamcu.fork(9)
    other.look_anew()
    other.predict(1.0, 20.0, 0.0)
    assert np.array_equal(slamcu.pose()[0], before[0])
    assert classes_of(slamcu) == before[1]
    assert not np.array_equal(other.pose()[0], before[0])


def classes_of(slamcu: object) -> list[object]:
    return [(state.feature_class, state.hits) for state in slamcu.known_states()]  # type: ignore[attr-defined]


# The filter that has never seen a feature


def blind_run(seed: int, bias_m: float = 0.0) -> tuple[np.ndarray, np.ndarray, float]:
    """Error (3,) and covariance of a blind filter after 80 s on a curve, and the largest offset its watch has seen."""
    rng = np.random.default_rng([seed, 3])
    slow_m, white_m = sqrt(1.0 - noise.GNSS_WHITE_SHARE) * SIGMA_M, sqrt(noise.GNSS_WHITE_SHARE) * SIGMA_M
    cov0 = np.diag([0.25, 0.25, radians(1.0) ** 2])
    true, dt_s = np.zeros(3), 0.1
    start = true + np.sqrt(np.diag(cov0)) * rng.standard_normal(3)
    blind, watch = BlindFilter(BlindBelief.first(start, cov0)), Watch()
    scale, bias = noise.SCALE * rng.standard_normal(), noise.BIAS_RADPS * rng.standard_normal()
    error, fade, most = slow_m * rng.standard_normal(2), exp(-1.0 / noise.GNSS_CORRELATION_S), 0.0
    for i in range(801):
        if i % 10 == 0:
            fix = true[:2] + error + white_m * rng.standard_normal(2)
            assert blind.fix(fix, SIGMA_M, 1.0)
            exact = true[:3].copy(), np.diag([0.01, 0.01, 1e-6])
            watch.fix(fix - true[:2] + bias_m, SIGMA_M, 1.0, exact, blind.belief)
            most = max(most, watch._offset)
            error = fade * error + sqrt(1.0 - fade**2) * slow_m * rng.standard_normal(2)
        way = 25.0 * dt_s + noise.SPEED_M * sqrt(dt_s) * rng.standard_normal()
        turn = 0.01 * dt_s + noise.YAW_RAD * sqrt(dt_s) * rng.standard_normal()
        middle = true[2] + 0.5 * turn
        true += np.array([way * np.cos(middle), way * np.sin(middle), turn])
        blind.predict(dt_s, 25.0 / (1.0 + scale), 0.01 + bias)
    belief = blind.belief
    return belief.mean[:3] - true, belief.cov[:3, :3], most


def test_the_blind_filter_is_as_sure_as_it_may_be_and_offsets_raise_no_alarm_without_cause() -> None:
    runs = [blind_run(seed) for seed in range(100)]
    nees = np.mean([error @ np.linalg.solve(cov, error) for error, cov, _ in runs])
    assert 2.55 < nees < 3.5  # χ² of 300 degrees of freedom over 100, 95 %, within a tenth
    assert sum(most > 18.4 for *_, most in runs) <= 1


def test_an_offset_of_six_metres_raises_the_alarm() -> None:
    assert all(blind_run(seed, bias_m=6.0 / sqrt(2.0))[2] > 18.4 for seed in range(5))
