from math import degrees

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.fleet_sim.drives import EPOCH_NS
from gnd.fleet_sim.street import StreetOptions
from gnd.gnd_map.config import to_mapping
from studies.frame.errors import OptionError
from studies.simulation.options import MethodParameters, PoseSource, RunOptions, fleet_configs, fleet_sensors
from studies.simulation.worlds import world_name


@pytest.mark.parametrize(
    ("text", "sigma_m", "sigma_deg"),
    [
        ("noisy:4cm:0.08deg", 0.04, 0.08),
        ("noisy:0.04m:0.08deg", 0.04, 0.08),
        ("noisy:40mm:1mrad", 0.04, degrees(1e-3)),
        ("noisy:10cm:.15deg", 0.10, 0.15),
        ("noisy:0cm:0deg", 0.0, 0.0),
        ("true", 0.0, 0.0),
        ("estimated", 0.0, 0.0),
    ],
)
def test_pose_sources_are_read(text: str, sigma_m: float, sigma_deg: float) -> None:
    source = PoseSource.parse(text)
    assert source.sigma_m == pytest.approx(sigma_m)
    assert degrees(source.sigma_rad) == pytest.approx(sigma_deg)


@pytest.mark.parametrize(
    "text", ["", "noisy", "noisy:4cm", "noisy:4:0.08", "noisy:4cm:0.08", "noisy:-4cm:1deg", "noisy:nancm:1deg", "True"]
)
def test_other_pose_sources_are_refused(text: str) -> None:
    with pytest.raises(OptionError, match="such as noisy:4cm"):
        PoseSource.parse(text)


def test_absurd_noise_is_refused() -> None:
    with pytest.raises(OptionError, match="at most 1 m"):
        PoseSource.parse("noisy:3m:1deg")


@given(st.floats(0, 0.99), st.floats(0, 4.9))
def test_a_pose_source_is_read_back_as_written(sigma_m: float, sigma_deg: float) -> None:
    written = str(PoseSource.parse(f"noisy:{sigma_m:.6f}m:{sigma_deg:.6f}deg"))
    assert str(PoseSource.parse(written)) == written


def test_set_replaces_parameters_and_nothing_else() -> None:
    base = to_mapping(MethodParameters.of_mode("default"))
    changed = to_mapping(
        MethodParameters.of_mode("default").with_changes(
            ["detect.new_cells=30", "detect.masses.lambda_c_pass=0.04", "merge.xi=0.7", "segment.enabled=false"]
        )
    )
    assert changed["detect"]["new_cells"] == 30
    assert changed["detect"]["masses"]["lambda_c_pass"] == 0.04
    assert changed["merge"]["xi"] == 0.7
    assert changed["segment"]["enabled"] is False
    base["detect"]["new_cells"], base["detect"]["masses"]["lambda_c_pass"] = 30, 0.04
    base["merge"]["xi"], base["segment"]["enabled"] = 0.7, False
    assert changed == base


@pytest.mark.parametrize(
    "change",
    ["new_cells=30", "detect.new_cells", "detect.nothing=1", "nothing.new_cells=1", "detect.new_cells=2.5",
     "detect.masses=1", "detect.eta_block=1.5", "merge.xi=1", "detect.masses.lambda_s_block=0.99"],
)  # fmt: skip
def test_set_refuses_what_it_does_not_know(change: str) -> None:
    with pytest.raises(OptionError):
        MethodParameters.of_mode("default").with_changes([change])


def test_paper_mode_takes_the_papers_rules_and_still_segments() -> None:
    method = MethodParameters.of_mode("paper")
    assert (method.detect.mode, method.merge.mode, method.segment.enabled) == ("paper", "paper", True)


def test_a_fleet_cycles_sensors_both_ways() -> None:
    options = RunOptions(vehicles=(20,))
    sensors, drives = fleet_sensors(options, 3), fleet_configs(options, 3)
    assert len(drives) == 20
    assert sensors[:6] == sensors[6:12]
    assert set(sensors[:6]) == set(options.sensors)
    assert len({drive.seed for drive in drives}) == 20
    for sensor in options.sensors:
        ways = [d.direction for d, s in zip(drives, sensors, strict=True) if s == sensor]
        assert set(ways) == {1, -1}
    assert abs(sum(drive.direction for drive in drives[:9])) <= 1


def test_the_first_vehicles_stay_when_a_fleet_grows() -> None:
    small, large = RunOptions(vehicles=(7,)), RunOptions(vehicles=(1, 20))
    assert fleet_configs(large, 3)[:7] == fleet_configs(small, 3)


def test_every_sensor_drives_at_least_once() -> None:
    assert RunOptions(vehicles=(1,)).fleet_size == 6
    assert set(fleet_sensors(RunOptions(vehicles=(1,)), 1)) == set(RunOptions().sensors)


def test_a_family_has_a_folder_of_its_own_and_drives_take_what_is_asked_for() -> None:
    options = RunOptions(
        street=StreetOptions(200.0, "wangsimni", family="avenue"), vehicles=(3,), sensors=("vlp16",),
        weather="rain", beams="real", stay_h=2.0, apart_min=20.0,
    )  # fmt: skip
    assert world_name(5, options.street) == "seed-5-avenue-200m-wangsimni"
    assert world_name(5, StreetOptions(200.0, "wangsimni")) == "seed-5-200m-wangsimni"
    drives = fleet_configs(options, 5)
    assert [(d.weather, d.beams, d.stay_h, d.car_share) for d in drives] == [("rain", "real", 2.0, None)] * 3
    assert [(d.start_ns - drives[0].start_ns) / 60e9 for d in drives] == [0.0, 20.0, 40.0]
    assert [d.start_ns - EPOCH_NS for d in fleet_configs(RunOptions(), 5)][:2] == [0, 3_600 * 10**9]
