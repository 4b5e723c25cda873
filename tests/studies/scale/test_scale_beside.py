import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from studies.scale.beside import beside, figures_from, main
from studies.scale.fit import FittedStore
from studies.scale.loads import Kind, Loads
from studies.scale.model import CpuCosts


def figures_of(vehicles: int, **changed: Any) -> dict[str, Any]:
    """A load that is committed, as `gnd load --json` writes it."""
    load = next(one for one in Loads.read().of("file", "compared") if one.setting.vehicles == vehicles)
    one = load.setting
    asked = {"vehicles": one.vehicles, "km": one.km, "kmh": one.kmh, "shards": one.shards}
    by_part = {part: 1e3 * used_s / load.reports for part, used_s in load.cpu_s.items()}
    return {
        **asked,
        "changed_share": one.changed_share,
        "acknowledged": load.reports,
        "second_halves": load.halves,
        "versions": load.versions,
        "offered_s": load.offered_s,
        "drained_after_s": load.drained_s - load.offered_s,
        "ack_ms": load.ack_ms,
        "merge_lag_s": load.lag_s,
        "cpu_ms_by_part": by_part,
        "kept_up": True,
        "why_not": [],
        **changed,
    }


def run(path: Path, told: object, *words: str) -> tuple[int, str]:
    path.write_text(told if isinstance(told, str) else json.dumps(told), encoding="utf-8")
    result = CliRunner().invoke(main, [str(path), *words])
    return result.exit_code, result.output


def test_a_load_that_the_cloud_has_room_for_is_foretold() -> None:
    """By costs near those of docs/scale.md."""
    costs = CpuCosts(receive_s=0.0055, flags_s=0.0013, half_s=0.0087, merge_s=0.014, begin_s=0.18, news=0.78)
    stores: dict[Kind, FittedStore] = {
        "file": FittedStore(costs, {"settled": 0.9, "changed": 0.6}, {"settled": 0.25, "changed": 0.02}, 6.2)
    }
    told, loads = figures_of(14), Loads.read()
    found = figures_from(beside(told, loads, stores))
    assert found["lag p50"]["measured"] == round(told["merge_lag_s"]["p50"], 3)
    for figure in found.values():
        assert abs(figure["error"]) < 0.25
    slower = figures_from(beside(figures_of(14, merge_lag_s={"p50": 2.0, "p95": 3.0}), loads, stores))
    assert slower["lag p50"]["error"] < -0.5
    dear = {"file": replace(stores["file"], costs=costs.times(4.0))}
    assert figures_from(beside(told, loads, dear))["lag p95"]["error"] > 0.5


@pytest.mark.parametrize(
    ("told", "why"),
    [
        ("no JSON", "no figures of `gnd load`"),
        ([1], "no figures of `gnd load`, it has no vehicles"),
        ({"vehicles": 4}, "it has no changed_share"),
    ],
)
def test_what_is_no_load_is_refused(told: object, why: str, tmp_path: Path) -> None:
    code, output = run(tmp_path / "load.json", told)
    assert (code, why in output) == (1, True), output


def test_a_load_that_was_too_much_is_refused(tmp_path: Path) -> None:
    code, output = run(tmp_path / "load.json", figures_of(14, kept_up=False, why_not=["the queue grew"]))
    assert (code, "did not keep up: the queue grew" in output) == (1, True)
