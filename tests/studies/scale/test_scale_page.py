"""`docs/scale.md` is what the committed measurements say, and its arithmetic is right."""

import json
from dataclasses import asdict, replace
from importlib import resources

import pytest

from gnd.gnd_map.errors import GndError
from studies.frame.errors import OptionError
from studies.scale.__main__ import PAGE
from studies.scale.fit import fitted_stores
from studies.scale.loads import Loads, MeasuredLoad
from studies.scale.page import page
from studies.scale.plan import (
    CostsOfUse,
    MeasuredFigure,
    ScaleParameters,
    ServedPlace,
    limits,
    measured_figures,
    planned,
)

USE = CostsOfUse(
    reports_a_km=2.0,
    worker_s=0.1,
    database_s=0.02,
    merges=4.0,
    publish_s=0.001,
    questions_a_km=10.0,
    question_s=0.001,
    up_bytes_a_km=5_000.0,
    down_bytes_a_km=3_000.0,
    map_bytes_a_km=200_000.0,
    journal_bytes=10_000.0,
    tile_row_bytes=400.0,
    tiles_a_km=80.0,
)


@pytest.mark.slow
def test_the_page_is_what_the_command_writes():
    assert PAGE.read_text(encoding="utf-8") == page()


def test_a_place_is_reckoned_by_hand():
    given = ScaleParameters.read()
    driving = replace(given.driving, km_a_year=8766.0, peak_to_mean=3.6, speed_kmh=36.0, new_road_share=0.1)
    keeping = replace(given.keeping, use_of_a_core=0.5, journal_days=10.0, versions_kept=2.0, copies=2.0)
    prices = replace(given.prices, core_hour=0.1, object_gb_month=1.0, disk_gb_month=1.0, egress_gb=1.0)
    one = planned(
        ServedPlace("here", 1000.0, 500.0), USE, replace(given, driving=driving, keeping=keeping, prices=prices)
    )
    assert one.km_s == pytest.approx(1.0)  # a thousand vehicles, a kilometre an hour each; 3.6 times that at the peak
    assert one.on_road == pytest.approx(100.0)
    assert (one.reports_s, one.merges_s) == (pytest.approx(2.0), pytest.approx(8.0))
    assert one.shard_cores == pytest.approx(0.4)
    assert one.tile_cores == pytest.approx(0.02)
    assert one.databases_by_publishing == pytest.approx(0.016)
    assert one.bodies_gb == pytest.approx(0.2)
    assert one.journal_gb == pytest.approx(1000 * 24 * 2 * 10 * 10_000 / 1e9)
    assert one.up_gbit_s == pytest.approx(40e-6)
    assert one.egress_gb == pytest.approx(1000 * 8766 * 23_000 / 1e9)
    assert one.money["shards"] == pytest.approx(0.4 * 8766 * 0.1)
    assert one.money["egress"] == pytest.approx(one.egress_gb)


def test_twice_the_vehicles_take_twice_as_much_and_limits_come_in_their_order():
    given = ScaleParameters.read()
    one, two = (planned(ServedPlace("here", vehicles, 500.0), USE, given) for vehicles in (1000.0, 2000.0))
    assert two.shard_cores == pytest.approx(2 * one.shard_cores)
    assert two.bodies_gb == one.bodies_gb  # that is the road's
    found = limits(USE, given)
    assert [one.vehicles for one in found] == sorted(one.vehicles for one in found)
    for limit in found:
        if limit.what.startswith("one worker process"):
            assert planned(ServedPlace("at it", limit.vehicles, 1.0), USE, given).shard_cores == pytest.approx(1.0)


def test_committed_figures_say_how_they_were_measured():
    for name, one in measured_figures().items():
        assert one.value > 0, name
        assert one.command.startswith(("gnd ", "python -m studies")), name
    with pytest.raises(OptionError):
        MeasuredFigure(0.0, "ms", "gnd load", "here", "2026-01-01")
    with pytest.raises(OptionError):
        MeasuredFigure(1.0, "ms", "", "here", "2026-01-01")


def test_an_unknown_parameter_is_an_error(tmp_path):
    text = resources.files("studies.scale").joinpath("prices.toml").read_text(encoding="utf-8")
    file = tmp_path / "prices.toml"
    file.write_text(text.replace("speed_kmh", "speed_mph"), encoding="utf-8")
    with pytest.raises(GndError, match="speed_mph"):
        ScaleParameters.read(file)


def test_a_fit_needs_loads_of_both_streets():
    loads = Loads.read()
    with pytest.raises(OptionError, match="to fit on"):
        fitted_stores(replace(loads, loads=loads.loads[:1]))
    settled = tuple(one for one in loads.loads if one.setting.changed_share == 0.0)
    with pytest.raises(OptionError, match="changed streets only"):
        fitted_stores(replace(loads, loads=settled))


def test_a_load_that_is_none_is_refused():
    told = asdict(Loads.read().loads[0])
    for wrong in ({"reports": 0}, {"drained_s": 1.0}, {"store": "elsewhere"}):
        with pytest.raises(OptionError, match="no load"):
            MeasuredLoad(**told | wrong)
    with pytest.raises(json.JSONDecodeError):
        Loads.read('{"loads": [')
