"""Settings of the refined poses: what cannot work is refused with the values."""

from dataclasses import fields, replace

import pytest

from gnd.gnd_map.config import from_mapping
from gnd.gnd_map.errors import ConfigError
from gnd.vehicle_agent.localise import LocaliserParameters
from gnd.vehicle_agent.localise.refine_parameters import RefineParameters

POSITIVE = (
    "every_m", "every_s", "knot_m", "knot_s", "correlated_m", "length_m", "length_s", "longest_s", "near_m", "fit_m",
    "most_misfit", "certain_m",
)  # fmt: skip


@pytest.mark.parametrize("name", POSITIVE)
@pytest.mark.parametrize("value", [0.0, -1.0])
def test_lengths_times_and_sigmas_must_be_positive(name, value):
    with pytest.raises(ValueError, match=rf"must be positive, got .*{name}={value}"):
        RefineParameters(**{name: value})


@pytest.mark.parametrize("name", ["scales", "first_scales"])
def test_scales_must_be_positive(name):
    with pytest.raises(ValueError, match="must be positive"):
        RefineParameters(**{name: (2.0, 0.0)})


@pytest.mark.parametrize(("name", "value"), [("n_points", 99)])
def test_counts_have_a_least_value(name, value):
    with pytest.raises(ValueError, match=rf"required, got .*{name}={value}"):
        RefineParameters(**{name: value})
    assert getattr(RefineParameters(**{name: value + 1}), name) == value + 1


def test_a_negative_lag_is_refused_and_none_is_not():
    with pytest.raises(ValueError, match=r"lag_m=-0\.1"):
        RefineParameters(lag_m=-0.1)
    assert RefineParameters(lag_m=0.0).lag_m == 0.0


def test_a_mapping_sets_them_and_an_unknown_key_is_refused():
    made = from_mapping(LocaliserParameters, {"refine": {"enabled": False, "length_m": 7.0}})
    assert made.refine == replace(RefineParameters(), enabled=False, length_m=7.0)
    with pytest.raises(ConfigError, match="refine: unknown key lenght_m"):
        from_mapping(LocaliserParameters, {"refine": {"lenght_m": 7.0}})


def test_every_setting_is_explained():
    document = RefineParameters.__doc__ or ""
    assert [field.name for field in fields(RefineParameters) if field.name not in document] == []
