"""The vehicle among its own points: what travels along is found, what only keeps its distance is not."""

import numpy as np

from gnd.vehicle_agent.map_build.bodywork import MIN_SCANS, BodyworkSurvey

RNG = np.random.default_rng(3)


def box(low: tuple[float, ...], high: tuple[float, ...], n: int = 300) -> np.ndarray:
    return RNG.uniform(low, high, (n, 3))


def street(k: int) -> np.ndarray:
    """What a scan sees of a street: the road all around, a guard rail beside the lane, a car that is passed."""
    road = np.c_[RNG.uniform(-15, 10, (3000, 1)), RNG.uniform(-6, 6, (3000, 1)), 0.02 * RNG.standard_normal((3000, 1))]
    rail = box((-15, 1.75, 0.4), (10, 1.8, 0.8), 800)
    tree = box((8.0 - k, -1.5, 2.5), (8.6 - k, -1.2, 2.8), 40)
    return np.concatenate([road, rail, tree])


def survey(own: np.ndarray, scans: int = 40, road_z_m: float = 0.0) -> BodyworkSurvey:
    found = BodyworkSurvey()
    for k in range(scans):
        found.add(np.concatenate([street(k), own + 0.01 * RNG.standard_normal(own.shape)]) + np.array([0, 0, road_z_m]))
    return found


def test_a_trailer_and_a_roof_rack_are_found_and_nothing_else() -> None:
    own = np.concatenate([box((-8, -1.0, 0.8), (-7.9, 1.0, 2.0)), box((1.0, -0.5, 1.5), (1.6, 0.5, 1.7))])
    body = survey(own).bodywork(0.0)
    assert body.of(own).mean() > 0.97
    assert body.of(street(5)).mean() < 0.003


def test_where_the_road_lies_elsewhere_the_heights_go_with_it() -> None:
    own = box((-8, -1.0, 0.8), (-7.9, 1.0, 2.0))
    found = survey(own, road_z_m=-1.73)
    assert found.bodywork(-1.73).of(own - [0, 0, 1.73]).mean() > 0.97
    assert found.bodywork(-1.73).of(street(5) - [0, 0, 1.73]).mean() < 0.003


def test_a_street_without_anything_of_the_vehicle_has_no_bodywork() -> None:
    assert not survey(np.empty((0, 3))).bodywork(0.0).cells.any()


def test_of_few_scans_nothing_is_said() -> None:
    own = box((-8, -1.0, 0.8), (-7.9, 1.0, 2.0))
    assert not survey(own, scans=MIN_SCANS - 1).bodywork(0.0).of(own).any()
    assert survey(own, scans=MIN_SCANS).bodywork(0.0).of(own).any()


def test_what_is_there_half_of_the_way_is_not_the_vehicle() -> None:
    own, found = box((6, -0.8, 0.5), (6.1, 0.8, 1.5)), BodyworkSurvey()
    for k in range(40):
        found.add(np.concatenate([street(k), own if k % 2 else own[:0]]))
    assert not found.bodywork(0.0).of(own).any()
