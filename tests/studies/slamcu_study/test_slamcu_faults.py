"""Faults put into a drive: each changes what it says and nothing else, the same every time."""

import numpy as np
import pytest

from gnd.fleet_sim.roads.drive import RoadDrive, RoadDriveOptions, drive_route
from gnd.fleet_sim.roads.motorway import motorway
from studies.frame.errors import OptionError
from studies.slamcu_study.faults import FAULTS, JUMP_M, with_faults
from studies.slamcu_study.study import SlamcuOptions


@pytest.fixture(scope="module")
def drive() -> RoadDrive:
    return drive_route(motorway(5, 5000.0), 1, RoadDriveOptions())


def bearings(drive: RoadDrive) -> np.ndarray:
    return np.concatenate([look.bearing_rad for look in drive.looks])


def test_a_turned_camera_turns_every_bearing(drive: RoadDrive) -> None:
    turned = with_faults(drive, ["camera"], 5)
    assert np.allclose(np.degrees(bearings(turned) - bearings(drive)), 0.5, atol=1e-4)
    assert turned.gnss is drive.gnss


def test_errors_of_signs_stay_with_them(drive: RoadDrive) -> None:
    wrong, of = with_faults(drive, ["signs"], 5), np.concatenate(drive.truth.of_detection)
    off = bearings(wrong) - bearings(drive)
    share = np.concatenate([a.range_m / b.range_m for a, b in zip(wrong.looks, drive.looks, strict=True)])
    by_sign = {sign: (off[of == sign], share[of == sign]) for sign in np.unique(of).tolist()}
    assert all(np.ptp(turn) < 1e-5 and np.ptp(scale) < 1e-4 for turn, scale in by_sign.values())
    assert np.abs(by_sign[0][0]).max() < 1e-6  # false alarms are no sign's
    assert 0.4 < np.degrees(np.std([turn[0] for sign, (turn, _) in by_sign.items() if sign])) < 1.6


def test_reflections_come_and_go(drive: RoadDrive) -> None:
    wrong = with_faults(drive, ["gnss"], 7)
    off_m = np.hypot(*(wrong.gnss.xy_m - drive.gnss.xy_m).T)
    assert 0.02 < (off_m > 0.0).mean() < 0.7
    assert JUMP_M[0] - 1e-6 <= off_m[off_m > 0.0].min() <= off_m.max() <= JUMP_M[1] + 1e-6
    assert np.array_equal(with_faults(drive, ["gnss"], 7).gnss.xy_m, wrong.gnss.xy_m)
    assert not np.array_equal(with_faults(drive, ["gnss"], 8).gnss.xy_m, wrong.gnss.xy_m)


def test_a_fault_that_there_is_not_is_refused() -> None:
    assert SlamcuOptions(faults=tuple(FAULTS)).faults == tuple(FAULTS)
    with pytest.raises(OptionError, match="known are camera, gnss, signs"):
        SlamcuOptions(faults=("rain",))
