"""SLAMCU on short drives with known truth."""

from dataclasses import replace
from math import pi, radians

import numpy as np
import pytest
from sign_road import CERTAIN, FEW, PERIOD_S, Road, driven

from gnd.vehicle_agent.features.errors import BadLook, BadMapFeatures, BadPose
from gnd.vehicle_agent.features.look import Look, MapFeatures
from gnd.vehicle_agent.features.slamcu import track_management
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass
from gnd.vehicle_agent.features.view import CAMERA, Occlusion

NORMAL, DELETED, NEW = FeatureClass.NORMAL, FeatureClass.DELETED, FeatureClass.NEW
LEFT, RIGHT, GONE = (150.0, 8.0), (152.0, -8.0), (180.0, -9.0)


def empty_look(t_ns: int = 0) -> Look:
    return Look(t_ns, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0), ())


def test_normal_deleted_and_new() -> None:
    slamcu = driven(Road(standing=[LEFT, RIGHT], mapped=[LEFT, GONE]))
    assert [state.feature_class for state in slamcu.known_states()] == [NORMAL, DELETED]
    (new,) = slamcu.new_features()
    assert new.feature_class == NEW
    assert np.linalg.norm(new.position_m - RIGHT) < 1.5
    assert new.hits > 20


def test_a_perfect_sensor_finds_the_exact_place() -> None:
    road = Road(standing=[RIGHT], range_m=0.0, bearing_deg=0.0, miss=0.0)
    (new,) = driven(road, given=True, sigma_m=1e-4, sigma_deg=1e-3).new_features()
    assert np.allclose(new.position_m, RIGHT, atol=2e-3)


def test_masses_of_a_deleted_sign_follow_the_equations() -> None:
    slamcu = driven(Road(standing=[], mapped=[GONE]), given=True, sigma_m=1e-3, sigma_deg=1e-3)
    (state,) = slamcu.known_states()
    # λ_HD = 0.95 against one miss of λ = 0.9: K = 0.855; ∃ 0.95·0.1, ∄ 0.05·0.9, Ω 0.05·0.1
    first = state.history[0].existence
    assert first.exist == pytest.approx(0.095 / 0.145)
    assert first.absent == pytest.approx(0.045 / 0.145)
    assert first.conflict == pytest.approx(0.855)
    assert state.history[1].existence.state == "absent"
    assert state.hits == 0
    assert state.misses == len(state.history)


def test_an_occluded_sign_gets_no_evidence() -> None:
    everything_hidden = Occlusion.of_ranges(np.full(80, 10.0), -radians(20.0), radians(0.5))
    slamcu = driven(Road(standing=[LEFT], mapped=[LEFT]), hidden=[0], occlusion=everything_hidden)
    (state,) = slamcu.known_states()
    assert (state.hits, state.misses, state.feature_class) == (0, 0, NORMAL)
    assert slamcu.hidden > 20


def test_a_hidden_sign_without_the_scan_is_taken_for_deleted() -> None:
    slamcu = driven(Road(standing=[LEFT], mapped=[LEFT]), hidden=[0])
    assert slamcu.known_states()[0].feature_class == DELETED


def test_a_sign_beyond_the_view_gets_no_evidence() -> None:
    slamcu = driven(Road(standing=[], mapped=[(400.0, 5.0), (-50.0, 5.0), (100.0, 60.0)]))
    assert [(state.hits, state.misses) for state in slamcu.known_states()] == [(0, 0)] * 3


def test_kinds_are_not_mixed() -> None:
    slamcu = driven(Road(standing=[LEFT], mapped=[LEFT], kinds=["lamp"]))
    assert slamcu.known_states()[0].feature_class == DELETED
    assert [new.kind for new in slamcu.new_features()] == ["lamp"]


@pytest.mark.parametrize("seed", range(3))
def test_false_alarms_are_forgotten(seed: int) -> None:
    slamcu = driven(Road(standing=[], false=0.3, end_m=500.0), seed)
    assert slamcu.new_features() == ()
    assert len(slamcu.new_features(unclassified=True)) <= 3


@pytest.mark.parametrize("seed", range(5))
def test_panels_of_a_gantry_are_not_mistaken_for_each_other(seed: int) -> None:
    panels = [(150.0, -5.2), (150.0, -1.7), (150.0, 1.8)]
    slamcu = driven(Road(standing=panels, mapped=panels[1:2], start_m=60.0), seed, sigma_deg=0.2)
    (state,) = slamcu.known_states()
    assert state.feature_class == NORMAL
    new = sorted(slamcu.new_features(), key=lambda one: one.position_m[1])
    assert len(new) == 2
    assert abs(new[0].position_m[1] - panels[0][1]) < 1.75
    assert abs(new[1].position_m[1] - panels[2][1]) < 1.75


def test_a_pair_of_signs_does_not_swap() -> None:
    slamcu = driven(Road(standing=[LEFT, RIGHT], mapped=[LEFT, RIGHT]), sigma_m=1.5)
    for state, place in zip(slamcu.known_states(), (LEFT, RIGHT), strict=True):
        assert state.feature_class == NORMAL
        assert state.position_m is not None
        assert np.linalg.norm(state.position_m - place) < 5.0


def test_a_sign_moved_by_a_few_metres_is_deleted_and_new() -> None:
    moved = (LEFT[0] - 5.0, LEFT[1])
    slamcu = driven(Road(standing=[moved, RIGHT], mapped=[LEFT, RIGHT]), sigma_m=0.2, sigma_deg=0.2)
    assert [state.feature_class for state in slamcu.known_states()] == [DELETED, NORMAL]
    (new,) = slamcu.new_features()
    assert np.linalg.norm(new.position_m - moved) < 1.5


@pytest.mark.parametrize("seed", range(3))
def test_a_vehicle_that_is_sure_of_a_wrong_place_finds_the_right_one(seed: int) -> None:
    """It starts 5 m beside the road and says 0.3 m: the first signs seem to have moved, all by the same step."""
    signs = [(100.0, 8.0), (140.0, -9.0), (210.0, 8.5), (260.0, -8.0)]
    road = Road(standing=signs, mapped=signs, end_m=290.0)
    slamcu = Slamcu(FEW, road.known(), np.array([0.0, 5.0, 0.0]), np.diag([0.09, 0.09, radians(0.3) ** 2]), seed)
    rng = np.random.default_rng(seed)
    for i, pose in road.poses():
        if i:
            slamcu.predict(PERIOD_S, road.speed_mps, 0.0)
        slamcu.look(road.look(i, pose, rng), CAMERA)
    end = list(road.poses())[-1][1]
    assert np.abs(slamcu.pose()[0] - end)[:2].max() < 1.5
    assert [state.feature_class for state in slamcu.known_states()] == [NORMAL] * 4
    assert slamcu.new_features() == ()


def test_normal_signs_tell_where_the_vehicle_is_and_deleted_ones_do_not() -> None:
    apart = [(140.0, 8.0), (200.0, -8.0), (260.0, 8.0)]
    sigmas = []
    for standing in (apart, []):
        slamcu = driven(Road(standing=standing, mapped=apart, end_m=265.0), sigma_m=3.0)
        sigmas.append(float(np.sqrt(np.trace(slamcu.pose()[1][:2, :2]))))
    assert sigmas[0] < 0.5 * sigmas[1]
    assert sigmas[1] > 3.0


def test_a_vehicle_that_comes_back_is_told_its_place_by_what_it_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """New features are used once they exist: also those that it has long settled."""
    road = Road(standing=[LEFT, RIGHT], end_m=260.0)
    monkeypatch.setattr(track_management, "HORIZON_M", 50.0)
    slamcu = driven(road, 3, sigma_m=0.05, sigma_deg=0.05)
    assert len(slamcu.new_features()) == 2
    slamcu._particles.place(np.array([0.0, 0.0, 0.0]), np.diag([4.0, 4.0, radians(0.3) ** 2]))
    rng = np.random.default_rng(5)
    for i, pose in road.poses():
        if i:
            slamcu.predict(PERIOD_S, road.speed_mps, 0.0)
        slamcu.look(road.look(i, pose, rng), CAMERA)
    assert len(slamcu.new_features()) == 2
    assert float(np.sqrt(slamcu.pose()[1][0, 0])) < 1.0


def test_given_poses_are_not_moved_by_features() -> None:
    slamcu = driven(Road(standing=[(150.0, 9.5)], mapped=[LEFT]), given=True, sigma_m=0.1, sigma_deg=0.05)
    last = list(Road(standing=[]).poses())[-1][1]
    pose, cov = slamcu.pose()
    assert np.allclose(pose, last, atol=1e-9)
    assert np.allclose(cov, np.diag([0.01, 0.01, radians(0.05) ** 2]), atol=1e-9)


def test_one_particle_does_where_poses_are_certain() -> None:
    one = replace(FEW, particles=1)
    slamcu = driven(Road(standing=[LEFT, RIGHT], mapped=[LEFT]), 0, one, given=True)
    assert slamcu.known_states()[0].feature_class == NORMAL
    (new,) = slamcu.new_features()
    assert np.linalg.norm(new.position_m - RIGHT) < 1.5


def test_measured_places_do_not_depend_on_the_map() -> None:
    """The map is 0.5 m wrong about one of the two; what the drive measured of it is not drawn there."""
    wrong = (LEFT[0] + 0.5, LEFT[1])
    true, other = (
        driven(Road(standing=[LEFT, RIGHT], mapped=[place, RIGHT]), 4, sigma_m=0.3).known_states()[0]
        for place in (LEFT, wrong)
    )
    assert true.position_m is not None
    assert other.position_m is not None
    assert np.linalg.norm(true.position_m - other.position_m) < 0.15


def test_tiles_come_and_go() -> None:
    road = Road(standing=[LEFT], mapped=[LEFT])
    slamcu = Slamcu(FEW, MapFeatures.none(), np.zeros(3), CERTAIN)
    slamcu.hold(road.known())
    with pytest.raises(BadMapFeatures, match="held already"):
        slamcu.hold(road.known())
    rng = np.random.default_rng(1)
    for i, pose in list(road.poses())[:50]:
        slamcu.set_pose(pose, CERTAIN)
        slamcu.look(road.look(i, pose, rng), CAMERA)
    assert slamcu.known_states()[0].hits > 0
    slamcu.forget([1])
    assert slamcu.known_states() == ()
    slamcu.look(empty_look(), CAMERA)


def test_same_seed_same_result() -> None:
    road = Road(standing=[LEFT, RIGHT], mapped=[LEFT, GONE], false=0.05)
    one, other = (driven(road, 8) for _ in range(2))
    assert np.array_equal(one.pose()[0], other.pose()[0])
    assert np.array_equal(one.new_features()[0].cov_m2, other.new_features()[0].cov_m2)


def test_standing_still_a_removed_sign_still_shows() -> None:
    """However long it was looked at before."""
    slamcu = Slamcu(FEW, Road(standing=[], mapped=[(40.0, 3.0)]).known(), np.zeros(3), CERTAIN)
    there, rng = Road(standing=[(40.0, 3.0)], miss=0.0), np.random.default_rng(2)
    for i in range(300):
        slamcu.look(there.look(i, np.zeros(3), rng), CAMERA)
    assert slamcu.known_states()[0].feature_class == NORMAL
    for _ in range(30):
        slamcu.look(empty_look(), CAMERA)
    assert slamcu.known_states()[0].feature_class == DELETED


def test_bad_looks_are_refused() -> None:
    ones = np.ones(1)
    with pytest.raises(BadLook, match="range_m of shape"):
        Look(0, np.ones(2), ones, ones, ones, ("sign",))
    with pytest.raises(BadLook, match="finite"):
        Look(0, np.array([np.nan]), ones, ones, ones, ("sign",))
    with pytest.raises(BadLook, match="ranges"):
        Look(0, np.array([5000.0]), ones, ones, ones, ("sign",))
    with pytest.raises(BadLook, match="not positive"):
        Look(0, ones, ones, np.zeros(1), ones, ("sign",))
    with pytest.raises(BadLook, match="1000000 detections, at most 1024"):
        Look(0, ones, ones, ones, ones, ("sign",) * 1_000_000)


def test_bad_maps_are_refused() -> None:
    cov = np.tile(np.eye(2), (2, 1, 1))
    two = ("sign", "sign")
    with pytest.raises(BadMapFeatures, match="2 ids, 1 of them different"):
        MapFeatures(np.array([3, 3]), two, np.zeros((2, 2)), np.zeros(2), cov)
    with pytest.raises(BadMapFeatures, match="1 features without position"):
        MapFeatures(np.array([3, 4]), two, np.array([[0.0, 0.0], [np.nan, 1.0]]), np.zeros(2), cov)
    with pytest.raises(BadMapFeatures, match="negative eigenvalue"):
        MapFeatures(np.array([3, 4]), two, np.zeros((2, 2)), np.zeros(2), -cov)


def test_bad_poses_and_motion_are_refused() -> None:
    with pytest.raises(BadPose, match="negative eigenvalue"):
        Slamcu(FEW, MapFeatures.none(), np.zeros(3), -np.eye(3))
    slamcu = Slamcu(FEW, MapFeatures.none(), np.zeros(3), np.eye(3))
    with pytest.raises(BadPose, match="expected finite"):
        slamcu.set_pose(np.array([0.0, np.inf, 0.0]), np.eye(3))
    with pytest.raises(BadPose, match="motion of nan"):
        slamcu.predict(0.1, np.nan, 0.0)
    with pytest.raises(BadPose, match=r"-0\.1 s"):
        slamcu.predict(-0.1, 1.0, 0.0)
    with pytest.raises(BadPose, match=r"sigma 0\.0 m"):
        slamcu.gnss(0.0, 0.0, 0.0)


def test_heading_across_south_is_no_jump() -> None:
    """A vehicle that drives west: its heading is π or -π."""
    slamcu = Slamcu(FEW, MapFeatures.none(), np.array([0.0, 0.0, pi]), np.diag([0.01, 0.01, 1e-4]))
    for _ in range(30):
        slamcu.predict(PERIOD_S, 20.0, 0.0)
        slamcu.gnss(float(slamcu.pose()[0][0]), 0.0, 2.0)
    pose, cov = slamcu.pose()
    assert abs(abs(pose[2]) - pi) < 0.1
    assert np.sqrt(cov[2, 2]) < 0.1
    assert pose[0] == pytest.approx(-40.0, abs=1.0)
