"""Settings of the refined poses: what cannot work is refused with the values."""

from dataclasses import replace

import pytest

from gnd.gnd_map.config import from_mapping
from gnd.gnd_map.errors import ConfigError
from gnd.vehicle_agent.localise import LocaliserParameters
from gnd.vehicle_agent.localise.parameters import RefineParameters


@pytest.mark.parametrize("name", ["every_m", "length_m", "longest_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("inf")])
def test_lengths_and_times_must_be_positive(name, value):
    with pytest.raises(ValueError, match=rf"{name} = {value} lies outside > 0"):
        RefineParameters(**{name: value})


def test_a_negative_lag_is_refused_and_none_is_not():
    with pytest.raises(ValueError, match=r"lag_m = -0\.1 lies outside ≥ 0"):
        RefineParameters(lag_m=-0.1)
    assert RefineParameters(lag_m=0.0).lag_m == 0.0


def test_a_mapping_sets_them_and_an_unknown_key_is_refused():
    made = from_mapping(LocaliserParameters, {"refine": {"enabled": False, "length_m": 7.0}})
    assert made.refine == replace(RefineParameters(), enabled=False, length_m=7.0)
    with pytest.raises(ConfigError, match="refine: unknown key lenght_m"):
        from_mapping(LocaliserParameters, {"refine": {"lenght_m": 7.0}})
