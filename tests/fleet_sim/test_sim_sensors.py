"""The sensor models against the tables of their data sheets."""

from dataclasses import replace

import numpy as np
import pytest

from gnd.fleet_sim.errors import SceneError
from gnd.fleet_sim.sensors import HDL32E, HDL64E, MODELS, RS16, RS32, SCALA, SHORT_NAMES, VLP16, LidarModel

SPINNING = (VLP16, HDL32E, HDL64E, RS16, RS32)

# model, beams, lowest and highest beam [deg], azimuth step [deg], range [m], sigma [m]
SHEETS = [
    (VLP16, 16, -15.0, 15.0, 0.2, 100.0, 0.03),
    (HDL32E, 32, -30.67, 10.67, 0.16, 100.0, 0.02),
    (HDL64E, 64, -24.33, 2.0, 0.1728, 120.0, 0.02),
    (RS16, 16, -15.0, 15.0, 0.18, 150.0, 0.02),
    (RS32, 32, -25.0, 15.0, 0.18, 200.0, 0.03),
    (SCALA, 4, -1.2, 1.2, 0.25, 150.0, 0.05),
]


def degrees(model: LidarModel) -> np.ndarray:
    return np.degrees(np.sort(model.elevations_rad))


@pytest.mark.parametrize(("model", "beams", "low", "high", "step", "range_m", "sigma_m"), SHEETS)
def test_figures_of_the_data_sheets(
    model: LidarModel, beams: int, low: float, high: float, step: float, range_m: float, sigma_m: float
) -> None:
    angles = degrees(model)
    assert len(angles) == model.beams == beams
    assert (angles[0], angles[-1]) == (pytest.approx(low, abs=0.01), pytest.approx(high, abs=0.01))
    assert np.all(np.diff(angles) > 0.1), "every beam has its own elevation"
    assert 360.0 * model.cycle_ns / model.period_ns == pytest.approx(step, rel=0.05)
    assert (model.range_max_m, model.range_sigma_m) == (range_m, sigma_m)


def test_steps_between_beams() -> None:
    np.testing.assert_allclose(np.diff(degrees(VLP16)), 2.0)
    np.testing.assert_allclose(np.diff(degrees(HDL32E)), 1.333, atol=0.001)
    np.testing.assert_allclose(np.diff(degrees(HDL64E)[:32]), 0.5)
    np.testing.assert_allclose(np.diff(degrees(HDL64E)[32:]), 1 / 3)
    assert degrees(HDL64E)[31:33] == pytest.approx([-8.833, -8.333], abs=0.001)
    np.testing.assert_allclose(np.diff(degrees(RS16)), 2.0)
    assert np.diff(degrees(RS32)).min() == pytest.approx(0.333, abs=0.002)
    assert np.diff(degrees(RS32)).max() == pytest.approx(10.36, abs=0.01)
    assert (np.abs(degrees(RS32)) < 5.0).sum() == 23, "most beams look straight ahead"
    np.testing.assert_allclose(np.diff(degrees(SCALA)), 0.8)


def test_order_of_firing() -> None:
    np.testing.assert_allclose(np.degrees(VLP16.elevations_rad[:4]), [-15.0, 1.0, -13.0, 3.0])
    np.testing.assert_allclose(np.degrees(HDL32E.elevations_rad[:4]), [-30.67, -9.33, -29.33, -8.0], atol=0.01)
    np.testing.assert_allclose(np.degrees(RS16.elevations_rad[6:10]), [-3.0, -1.0, 15.0, 13.0])
    np.testing.assert_allclose(np.degrees(RS32.elevations_rad[:4]), [-10.281, -25.0, 0.333, -2.333])
    assert HDL64E.firing_ns[:10] == (0, 0, 1260, 1260, 2460, 2460, 3660, 3660, 6000, 6000)
    assert HDL64E.firing_ns[-1] == 45_660
    assert set(SCALA.firing_ns) == {0}, "one flash for all layers"


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
def test_rings_rank_the_beams_and_shots_fit_into_the_period(model: LidarModel) -> None:
    np.testing.assert_array_equal(
        np.array(model.elevations_rad)[np.argsort(model.rings)], np.sort(model.elevations_rad)
    )
    times = model.shot_times_ns()
    assert times.shape == (model.columns, model.beams)
    assert np.all(np.diff(times.ravel()) >= 0), "in the order of firing"
    assert times[-1, -1] < model.period_ns
    np.testing.assert_allclose(model.shares, times[0] / model.cycle_ns)


@pytest.mark.parametrize("model", SPINNING, ids=lambda m: m.name)
def test_spinning_sensors_turn_clockwise_and_start_behind(model: LidarModel) -> None:
    directions = model.directions()
    np.testing.assert_allclose(directions[0, 0, :2] / np.linalg.norm(directions[0, 0, :2]), [-1.0, 0.0], atol=1e-9)
    azimuth = np.unwrap(np.arctan2(directions[:, 0, 1], directions[:, 0, 0]))
    assert np.all(np.diff(azimuth) < 0)
    assert azimuth[0] - azimuth[-1] == pytest.approx(2 * np.pi, abs=0.01)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    assert model.period_ns == 100_000_000


def test_the_scala_looks_ahead_25_times_a_second() -> None:
    azimuth = np.degrees(np.arctan2(SCALA.directions()[..., 1], SCALA.directions()[..., 0]))
    assert SCALA.period_ns == 40_000_000
    assert (azimuth.max(), azimuth.min()) == (pytest.approx(72.5), pytest.approx(-72.25, abs=0.01))
    np.testing.assert_allclose(np.diff(azimuth, axis=0), -0.25, atol=1e-4)
    assert SCALA.columns == 580
    assert SCALA.shot_times_ns().max() == pytest.approx(40e6 * 145 / 360, rel=0.002), "blind for the rest of the turn"


def test_names() -> None:
    assert list(SHORT_NAMES) == ["vlp16", "hdl32e", "hdl64e", "rs16", "rs32", "scala"]
    assert list(SHORT_NAMES.values()) == list(MODELS)
    assert list(MODELS) == ["VLP-16", "HDL-32E", "HDL-64E", "RS-LiDAR-16", "RS-LiDAR-32", "Scala"]


def test_mounts() -> None:
    assert (VLP16.mount_m[2], HDL32E.mount_m[2]) == (1.9, 1.9)
    assert SCALA.mount_m == (3.6, 0.0, 0.6), "behind the front bumper"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cycle_ns": 30_000}, "do not fit"),
        ({"firing_ns": (0, 1)}, "16 beams have 2"),
        ({"firing_ns": tuple(range(16, 0, -1))}, "do not fit"),
        ({"span_rad": 7.0}, "span"),
        ({"span_rad": 0.0}, "span"),
        ({"range_min_m": 200.0}, "impossible ranges"),
        ({"range_sigma_m": -0.1}, "impossible ranges"),
    ],
)
def test_impossible_models_are_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        replace(VLP16, **change)
