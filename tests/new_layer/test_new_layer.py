"""The new layer of a short drive with known truth."""

from dataclasses import replace

import numpy as np
import pytest
from plane_scene import PAPER, T0_NS, Noise, Scene, drive, fixes, lane_looks, look, looks, motion, sensors

from gnd.gnd_map.errors import ShapeError
from gnd.schemas.drive import MotionTrack
from gnd.vehicle_agent.errors import NewLayerError
from gnd.vehicle_agent.features.look import MapFeatures
from gnd.vehicle_agent.features.mapping.feature_drive import FeatureDrive, GnssFixes, Measurements
from gnd.vehicle_agent.features.mapping.new_layer import lane_map, localise_with_features, map_new_layer

EXACT = Noise()


@pytest.fixture(scope="module")
def truth():
    return Scene().truth()


def known_of(truth, rows=slice(None), cov=0.01):
    xy = truth.features[rows]
    n = len(xy)
    return MapFeatures(
        np.arange(101, 101 + n), ("streetlight",) * n, xy, np.full(n, np.nan), np.tile(cov**2 * np.eye(2), (n, 1, 1))
    )


def ordered(layer, truth):
    """Rows of the layer's features by those of the truth."""
    distance = np.hypot(*(layer.features.xy_m[:, None] - truth.features[None]).transpose(2, 0, 1))
    return np.argmin(distance, axis=0)


@pytest.mark.parametrize("with_lanes", [False, True])
def test_without_noise_the_truth_is_recovered_to_millimetres(truth, with_lanes):
    lanes = lane_map(truth.lanes) if with_lanes else None
    layer = map_new_layer(drive(truth, EXACT, 0), sensors(EXACT), lanes)
    assert len(layer.features) == len(truth.features)
    rows = ordered(layer, truth)
    np.testing.assert_allclose(layer.features.xy_m[rows], truth.features, atol=5e-3)
    pose = layer.path.at(truth.t_ns)
    np.testing.assert_allclose(pose[:, :2], truth.pose[:, :2], atol=1e-2)
    assert layer.features.kinds == ("streetlight",) * 4
    assert (layer.features.known_id == 0).all()
    assert layer.features.hits.min() > 20


def test_errors_of_wheels_and_gyro_are_found(truth):
    noise = replace(EXACT, scale=0.01, bias=0.005)
    d = drive(truth, EXACT, 0)
    off = MotionTrack(d.motion.t_ns, d.motion.speed_mps / 1.01, d.motion.yaw_rate_radps + 0.005)
    layer = map_new_layer(replace(d, motion=off), sensors(noise), lane_map(truth.lanes))
    assert layer.calibration[0] == pytest.approx(0.01, abs=1e-3)
    assert layer.calibration[1] == pytest.approx(0.005, abs=2e-4)
    np.testing.assert_allclose(layer.features.xy_m[ordered(layer, truth)], truth.features, atol=0.03)


def test_lanes_of_the_map_make_it_better(truth):
    off = {}
    for name, lanes in (("without", None), ("with", lane_map(truth.lanes))):
        found = [map_new_layer(drive(truth, PAPER, seed), sensors(PAPER), lanes) for seed in range(3)]
        off[name] = np.mean([np.hypot(*(f.features.xy_m[ordered(f, truth)] - truth.features).T) for f in found])
    assert off["with"] < 0.7 * off["without"]


def test_false_alarms_make_no_features_and_do_not_part_one(truth):
    rng = np.random.default_rng(4)
    times = np.repeat(np.arange(0.0, 16.0, 0.2), 1)
    alarms = np.column_stack([times, rng.uniform(5.0, 45.0, len(times)), rng.uniform(-3.1, 3.1, len(times))])
    kept = alarms[rng.random(len(times)) < 0.5]
    d = drive(truth, PAPER, 3)
    d = replace(d, looks=looks(truth, PAPER, rng, 5, 45.0, kept))
    layer = map_new_layer(d, sensors(PAPER), lane_map(truth.lanes))
    assert len(layer.features) == len(truth.features)
    assert len(set(ordered(layer, truth))) == len(truth.features)


def test_features_of_two_kinds_at_one_place_stay_two(truth):
    d = drive(truth, EXACT, 0)
    signs = [look(one.t_ns, np.column_stack([one.range_m, one.bearing_rad]), EXACT, "traffic_sign") for one in d.looks]
    both = [_together(a, b) for a, b in zip(d.looks, signs, strict=True)]
    layer = map_new_layer(replace(d, looks=tuple(both)), sensors(EXACT))
    assert sorted(layer.features.kinds) == ["streetlight"] * 4 + ["traffic_sign"] * 4


def _together(a, b):
    columns = ("range_m", "bearing_rad", "height_m", "sigma_range_m", "sigma_bearing_rad")
    joined = {name: np.concatenate([getattr(a, name), getattr(b, name)]) for name in columns}
    return replace(a, kinds=a.kinds + b.kinds, **joined)


def test_known_features_are_recognised_and_new_ones_added(truth):
    layer = map_new_layer(drive(truth, PAPER, 1), sensors(PAPER), None, known_of(truth, slice(0, 2)))
    rows = ordered(layer, truth)
    assert layer.features.known_id[rows].tolist() == [101, 102, 0, 0]


def test_where_a_known_feature_was_measured_need_not_depend_on_the_map(truth):
    wrong = replace(known_of(truth), xy_m=truth.features + np.array([0.6, -0.5]))
    free = map_new_layer(drive(truth, EXACT, 1), sensors(EXACT), known=wrong, trust_known=False)
    rows = ordered(free, truth)
    assert free.features.known_id[rows].tolist() == [101, 102, 103, 104]
    np.testing.assert_allclose(free.features.xy_m[rows], truth.features, atol=0.02)
    held = map_new_layer(drive(truth, PAPER, 1), sensors(PAPER), known=wrong)
    np.testing.assert_allclose(held.features.xy_m[ordered(held, truth)], wrong.xy_m, atol=0.05)


def test_known_features_make_localisation_better_and_add_none(truth):
    off = {True: [], False: []}
    for seed in range(2):
        for with_layer, errors in off.items():
            known = known_of(truth) if with_layer else None
            found = localise_with_features(drive(truth, PAPER, seed), sensors(PAPER), lane_map(truth.lanes), known)
            errors.append(np.hypot(*(found.path.at(truth.t_ns) - truth.pose).T[:2]).mean())
            assert set(found.features.known_id) <= {101, 102, 103, 104}
            assert with_layer == (len(found.features) > 0)
    assert np.mean(off[True]) < 0.6 * np.mean(off[False])


def test_a_drive_that_saw_nothing_has_an_empty_layer(truth):
    d = drive(truth, PAPER, 1)
    layer = map_new_layer(replace(d, looks=()), sensors(PAPER), lane_map(truth.lanes))
    assert len(layer.features) == 0
    assert layer.features.cov_m2.shape == (0, 2, 2)
    assert np.hypot(*(layer.path.at(truth.t_ns) - truth.pose).T[:2]).mean() < 3.0


def test_covariance_is_that_of_the_map_frame(truth):
    """With lanes, features beside a straight road are known across it and little along."""
    road = Scene(bend=0.0).truth()
    layer = map_new_layer(drive(road, PAPER, 5), sensors(PAPER), lane_map(road.lanes))
    yaw = road.pose[0, 2]
    R = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    along, across = np.sqrt(np.diagonal(R @ layer.features.cov_m2 @ R.T, axis1=1, axis2=2)).T
    assert along.min() > 1.0
    assert across.max() < 0.5


def test_bad_drives_are_refused(truth):
    good = drive(truth, PAPER, 0)
    with pytest.raises(NewLayerError, match="1 motion samples"):
        replace(good, motion=MotionTrack(*(column[:1] for column in good.motion)))
    with pytest.raises(NewLayerError, match="without GNSS fixes"):
        FeatureDrive(good.motion, GnssFixes(np.empty(0, np.int64), np.empty((0, 2))))
    with pytest.raises(NewLayerError, match="looks are not in order of time: row 1"):
        replace(good, looks=good.looks[::-1])
    with pytest.raises(ShapeError, match="xy_m of fixes"):
        GnssFixes(good.fixes.t_ns, good.fixes.xy_m[:-1])
    with pytest.raises(ShapeError, match="not finite"):
        replace(good, motion=good.motion._replace(speed_mps=np.full(len(truth.t_ns), np.nan)))
    with pytest.raises(ShapeError, match="range_m"):
        Measurements.of([replace_range(good.looks[10])])


def test_a_vehicle_that_never_moved_is_refused(truth):
    t_ns = truth.t_ns
    still = MotionTrack(t_ns, np.zeros(len(t_ns)), np.zeros(len(t_ns)))
    with pytest.raises(NewLayerError, match="never moved"):
        map_new_layer(FeatureDrive(still, GnssFixes(t_ns[::50], np.zeros((17, 2)))), sensors(PAPER)).solution.pose_cov(
            np.array([0])
        )


def test_what_was_measured_outside_of_the_motion_is_not_taken(truth):
    d = drive(truth, EXACT, 0)
    late = 10_000_000_000
    fixes_ = GnssFixes(
        np.append(d.fixes.t_ns, d.fixes.t_ns[-1] + late), np.concatenate([d.fixes.xy_m, [[999.0, 999.0]]])
    )
    more = replace(d, fixes=fixes_, looks=(*d.looks, replace(d.looks[-1], t_ns=d.looks[-1].t_ns + late)))
    kept = more.within_motion()
    assert len(kept.fixes.t_ns) == len(d.fixes.t_ns)
    assert len(kept.looks) == len(d.looks)
    outside = replace(d, fixes=GnssFixes(d.fixes.t_ns + 100 * late, d.fixes.xy_m))
    with pytest.raises(NewLayerError, match="without GNSS fixes"):
        map_new_layer(outside, sensors(EXACT))


class replace_range:
    """A look of another source that is not finite."""

    def __init__(self, one):
        self.t_ns, self.kinds = one.t_ns, ("streetlight",)
        self.range_m = np.array([np.inf])
        self.bearing_rad = self.sigma_range_m = self.sigma_bearing_rad = np.array([0.1])


def test_helpers_of_the_scene_agree(truth):
    rng = np.random.default_rng(0)
    assert len(motion(truth, EXACT, rng).t_ns) == len(truth.t_ns)
    np.testing.assert_allclose(fixes(truth, EXACT, rng).xy_m, truth.pose[::50, :2])
    assert len(lane_looks(truth, EXACT, rng, 5)[0].polylines) == 3
    assert truth.t_ns[0] == T0_NS
