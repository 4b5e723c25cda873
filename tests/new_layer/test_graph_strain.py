"""A graph whose edges contradict each other says so; one whose edges agree does not."""

from dataclasses import replace

import numpy as np
import pytest
from plane_scene import PAPER, Scene, drive, sensors

from gnd.schemas.drive import MotionTrack
from gnd.vehicle_agent.features.mapping.feature_drive import GnssFixes
from gnd.vehicle_agent.features.mapping.new_layer import NewLayer, lane_map, map_new_layer

SCENE = Scene(seconds=40.0, features=np.array([[20.0 * n, (8.0, -7.0)[n % 2]] for n in range(1, 19)]))
TRUTH = SCENE.truth()


def mapped(changed, with_lanes: bool = False, shift_m: float = 0.0) -> NewLayer:
    lanes = lane_map([lane + np.array([0.0, shift_m]) for lane in TRUTH.lanes]) if with_lanes else None
    return map_new_layer(changed, sensors(PAPER), lanes, rounds=2)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("with_lanes", [False, True])
def test_noise_as_it_is_known_is_no_contradiction(seed: int, with_lanes: bool) -> None:
    assert mapped(drive(TRUTH, PAPER, seed), with_lanes).strains == ()


def test_a_gnss_that_jumps_contradicts_the_motion() -> None:
    """30 m beside itself for the second half: no vehicle moves so."""
    honest = drive(TRUTH, PAPER, 1)
    off = np.where(honest.fixes.t_ns > honest.fixes.t_ns[len(honest.fixes.t_ns) // 2], 30.0, 0.0)
    jumped = replace(honest, fixes=GnssFixes(honest.fixes.t_ns, honest.fixes.xy_m + np.column_stack([off, -off])))
    assert "jumps of fixes" in {one.what for one in mapped(jumped).strains}


def test_wheels_far_off_their_calibration_are_named() -> None:
    honest = drive(TRUTH, PAPER, 2)
    motion = MotionTrack(honest.motion.t_ns, 1.06 * honest.motion.speed_mps, honest.motion.yaw_rate_radps)
    assert "calibration" in {one.what for one in mapped(replace(honest, motion=motion)).strains}


def test_lanes_of_another_place_contradict_the_fixes() -> None:
    """The whole HD map stands 14 m farther on: lanes and fixes cannot both be right."""
    found = mapped(drive(TRUTH, replace(PAPER, gnss=1.0), 3), with_lanes=True, shift_m=14.0)
    assert found.strains
    assert "at most" in str(found.strains[0])
