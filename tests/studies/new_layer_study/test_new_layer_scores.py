"""Errors of layers along and across the route, on cases made by hand."""

import numpy as np
import pytest

from studies.new_layer_study.layers import (
    DriveLayers,
    Layer,
    LayerLocalised,
    LayerTruth,
    MotorwayOutcome,
    RouteOutcome,
    pooled,
    score,
)
from studies.new_layer_study.summary import localisation_summary, motorway_summary, noise_summary

TRUTH = LayerTruth(np.array([[0.0, 0.0], [0.0, 40.0]]), np.array([[0.0, 1.0], [0.0, 1.0]]))  # northwards


def layer(*points: tuple[float, float]) -> Layer:
    return Layer(np.array(points, np.float64).reshape(-1, 2), np.broadcast_to(np.eye(2), (len(points), 2, 2)))


def test_errors_are_told_along_the_route_and_to_its_left() -> None:
    found = score(layer((-0.3, 2.0), (0.4, 40.0)), TRUTH)
    assert found.error_m.tolist() == [[2.0, pytest.approx(0.3)], [0.0, pytest.approx(-0.4)]]
    assert found.of("lateral") == pytest.approx([0.3, 0.4])
    assert found.of("longitudinal") == pytest.approx([2.0, 0.0])
    assert found.of("euclidean") == pytest.approx([np.hypot(2.0, 0.3), 0.4])
    assert found.honesty is not None
    assert found.honesty.mean == pytest.approx((4.0 + 0.09 + 0.16) / 2)


def test_missed_and_false_features_stand_beside_the_mean() -> None:
    found = score(layer((0.0, 0.1), (0.2, 0.3), (30.0, 0.0)), TRUTH).plain()
    assert (found["missed"], found["false"]) == (1, 2)
    assert found["euclidean"]["found"] == 1
    assert score(layer(), TRUTH).plain()["euclidean"]["mean"] is None


def test_drives_are_pooled_by_feature() -> None:
    scores = [score(layer((0.0, 1.0), (0.0, 41.0)), TRUTH), score(layer((0.0, 4.0)), TRUTH)]
    assert pooled(scores)["euclidean"]["mean"] == pytest.approx(2.0)
    assert pooled(scores)["missed"] == pytest.approx(0.5)


def route() -> RouteOutcome:
    drives = (
        DriveLayers(layer((3.0, 8.0), (3.0, 48.0)), layer((0.1, 3.0), (0.1, 43.0))),
        DriveLayers(layer((3.0, -8.0)), layer((0.1, -3.0), (0.1, 37.0))),
    )
    return RouteOutcome(TRUTH, drives, {1: drives[0].with_map, 2: layer((0.1, 0.0), (0.1, 40.5))})


def test_table_2_pools_single_drives_and_puts_the_integration_first() -> None:
    series = LayerLocalised(np.arange(2.0), np.array([[5.0, 0.2], [-5.0, 0.2]]))
    with_layer = LayerLocalised(np.arange(2.0), np.array([[0.3, 0.1], [-0.5, 0.1]]))
    road = MotorwayOutcome(route(), series, with_layer)
    found = motorway_summary(road)
    assert found["lateral"] == pytest.approx(0.1)
    assert found["longitudinal"] == pytest.approx(0.25)
    assert found["table2"]["without_map"]["longitudinal"]["mean"] == pytest.approx(8.0)
    assert found["table2"]["without_map"]["missed"] == pytest.approx(0.5)
    assert found["table2"]["with_map"]["euclidean"]["mean"] == pytest.approx(np.hypot(3.0, 0.1))
    assert found["by_drives"] == pytest.approx({"1": np.hypot(3.0, 0.1), "2": (0.1 + np.hypot(0.1, 0.5)) / 2})
    table3 = localisation_summary(road)
    assert table3 == pytest.approx({"without": 5.0, "with": np.sqrt(0.17), "lateral_without": 0.2, "lateral_with": 0.1})


def test_the_sweep_tells_the_integrated_layer_and_single_drives() -> None:
    found = noise_summary(route())
    assert found["single_with_map"] == pytest.approx(np.hypot(3.0, 0.1))
    assert found["integrated"] == pytest.approx((0.1 + np.hypot(0.1, 0.5)) / 2)
