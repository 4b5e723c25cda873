"""A finished study as plain values, the JSON of `gnd reproduce new-feature-layer`, and as tables."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from gnd.gnd_map.config import to_mapping
from studies.feature_study.truth import RADIUS_M
from studies.frame.averages import mean_over, rounded, std_over
from studies.frame.tables import Sheet, fixed, seeds_named, several, sheet, sheet_of, shown
from studies.frame.targets import judged, targets_sheet
from studies.new_layer_study.layers import (
    DIRECTIONS,
    PAPER_INTEGRATED_M,
    PAPER_SINGLE_M,
    PAPER_TABLE2,
    PAPER_TABLE3,
    TARGETS,
    WIDE_RADIUS_M,
    LayerScore,
    MotorwayOutcome,
    NewLayerSeed,
    RouteOutcome,
    pooled,
    score,
)  # fmt: skip

MAP_CASES = ("without_map", "with_map")


def summary_of(options: Any, outcomes: Sequence[NewLayerSeed], spent_s: Mapping[str, float]) -> dict[str, Any]:
    """Return everything as plain values: means over the seeds below `nfl`, their standard deviations below
    `std_over_seeds`, each seed below `seeds`.
    """
    seeds = {str(one.seed): seed_summary(one) for one in outcomes}
    mean = mean_over(list(seeds.values()))
    found = {
        "nfl": mean,
        "std_over_seeds": std_over(list(seeds.values())),
        "targets": judged(mean, TARGETS),
        "paper": {
            "single": PAPER_SINGLE_M,
            "integrated": PAPER_INTEGRATED_M,
            "table2": PAPER_TABLE2,
            "table3": PAPER_TABLE3,
        },
        "seeds": seeds,
        "matching_radius_m": {"track": RADIUS_M, "motorway": WIDE_RADIUS_M},
        "parameters": to_mapping(options),
        "runtime_s": dict(spent_s),
    }
    return dict(rounded(found))


def seed_summary(outcome: NewLayerSeed) -> dict[str, Any]:
    """Return the numbers of one seed."""
    track = outcome.track
    single = {case: pooled(drive_scores(track, case)) for case in MAP_CASES}
    integrated = {str(n): score(layer, track.truth).plain() for n, layer in track.integrated.items()}
    found: dict[str, Any] = {f"single_{case}": single[case]["euclidean"]["mean"] for case in MAP_CASES}
    found |= {
        "integrated": {n: one["euclidean"]["mean"] for n, one in integrated.items()},
        "motorway": motorway_summary(outcome.motorway),
        "localisation": localisation_summary(outcome.motorway),
        "single": single,
        "first_drive": {case: drive_scores(track, case)[0].plain() for case in MAP_CASES},
        "integrated_more": integrated,
        "beacons": len(track.truth.xy_m),
        "noise": {
            sensor: {f"{level:g}": noise_summary(route) for level, route in routes.items()}
            for sensor, routes in outcome.noisy.items()
        },
    }
    if outcome.straight is not None:
        found["straight"] = {
            "motorway": motorway_summary(outcome.straight),
            "localisation": localisation_summary(outcome.straight),
        }
    return found


def drive_scores(route: RouteOutcome, case: str, radius_m: float = RADIUS_M) -> list[LayerScore]:
    """Return the score of each drive, in a case of `MAP_CASES`; drives that have not run it are left out."""
    layers = [getattr(drive, case) for drive in route.drives]
    return [score(layer, route.truth, radius_m) for layer in layers if layer is not None]


def integrated_score(route: RouteOutcome, radius_m: float = RADIUS_M) -> LayerScore:
    """Return the score of the layer of all drives."""
    return score(route.integrated[max(route.integrated)], route.truth, radius_m)


def noise_summary(route: RouteOutcome) -> dict[str, Any]:
    """Return the mean errors of the integrated layer (Figure 8) and of single drives at a noise level."""
    single = pooled(drive_scores(route, "with_map"))
    integrated = integrated_score(route).plain()
    return {
        "integrated": integrated["euclidean"]["mean"],
        "single_with_map": single["euclidean"]["mean"],
        "missed": integrated["missed"],
        "false": integrated["false"],
    }


def motorway_summary(outcome: MotorwayOutcome) -> dict[str, Any]:
    """Return Table 2: errors of single drives without and with map and of the integration, whose means stand first."""
    route = outcome.route
    table = {case: pooled(drive_scores(route, case, WIDE_RADIUS_M)) for case in MAP_CASES}
    table["integration"] = integrated_score(route, WIDE_RADIUS_M).plain()
    means = {direction: table["integration"][direction]["mean"] for direction in DIRECTIONS}
    return means | {"table2": table, "lights": len(route.truth.xy_m), "by_drives": _by_drives(route)}


def _by_drives(route: RouteOutcome) -> dict[str, Any]:
    scores = {n: score(layer, route.truth, WIDE_RADIUS_M) for n, layer in route.integrated.items()}
    return {str(n): one.plain()["euclidean"]["mean"] for n, one in scores.items()}


def localisation_summary(outcome: MotorwayOutcome) -> dict[str, Any]:
    """Return Table 3; `without` and `with` are the longitudinal root mean square errors, m."""
    (along, across), (along_with, across_with) = outcome.without.rmse(), outcome.with_layer.rmse()
    return {"without": along, "with": along_with, "lateral_without": across, "lateral_with": across_with}


# --- tables ----------------------------------------------------------------------------------------------------------

_LABELS: Final = {"without_map": "without HD map", "with_map": "with HD map", "integration": "integration"}
_COUNTS: Final = {
    "missed": "{missed:.3g}", "false": "{false:.3g}", "NEES (2)": "{nees.mean:.2f}",
    "within 95 %": "{nees.within_95:.0%}",
}  # fmt: skip
_PAIR: Final = "{euclidean.mean:.3f} ± {euclidean.std:.3f}"


def tables_of(found: Mapping[str, Any]) -> list[Sheet]:
    """Return all tables; the paper's numbers beside ours."""
    ours, seeds = found["nfl"], seeds_named(list(found["seeds"]))
    tables = [_single(found), _integrated(ours), *([_noise(found)] if ours["noise"] else [])]
    tables += [_motorway(ours["motorway"], "motorway"), _localisation(ours["localisation"], "motorway")]
    if "straight" in ours:
        straight = seeds_named([seed for seed, one in found["seeds"].items() if "straight" in one])
        tables += [_motorway(ours["straight"]["motorway"], f"straight motorway, {straight}")]
        tables += [_localisation(ours["straight"]["localisation"], "straight motorway")]
    return [*tables, targets_sheet(found["targets"], f"targets, mean of {seeds}")]


def _single(found: Mapping[str, Any]) -> Sheet:
    ours, radius = found["nfl"], found["matching_radius_m"]["track"]
    noise = found["parameters"]["noise"]
    title = f"Figure 6: test track, {noise} noise, single drives, m; {ours['beacons']:.0f} beacons, within {radius:g} m"
    rows = {
        _LABELS[case]: ours["single"][case] | {"paper": f"{mean:g} ± {std:g}"}
        for case, (mean, std) in PAPER_SINGLE_M.items()
    }
    return sheet_of(title, {"mean ± std": _PAIR, "paper": "{paper}", **_COUNTS}, rows)


def _integrated(ours: Mapping[str, Any]) -> Sheet:
    rows = {n: row | {"paper": PAPER_INTEGRATED_M.get(int(n), "")} for n, row in ours["integrated_more"].items()}
    columns = {"mean ± std, m": _PAIR, "paper": "{paper}", **_COUNTS}
    return sheet_of("Figure 7: test track, drives integrated", columns, rows, "drives")


def _noise(found: Mapping[str, Any]) -> Sheet:
    noise, seeds = found["nfl"]["noise"], ", ".join(seed for seed, one in found["seeds"].items() if one["noise"])
    columns = {
        f"{sensor}: {what}": f"{{{sensor}.{key}:.3f}}"
        for sensor in noise
        for what, key in (("integrated, m", "integrated"), ("one drive, m", "single_with_map"))
    }
    rows = {level: {sensor: noise[sensor][level] for sensor in noise} for level in next(iter(noise.values()))}
    return sheet_of(f"Figure 8: noise levels, the other sensor at 1; seeds {seeds}", columns, rows, "level")


def _motorway(motorway: Mapping[str, Any], name: str) -> Sheet:
    title = f"Table 2: {name}, mean ± standard deviation, m; {motorway['lights']:.0f} lights"
    table, rows = sheet(title, "", *_LABELS.values()), [motorway["table2"][case] for case in _LABELS]
    for direction in DIRECTIONS:
        table.add(direction, *(shown(_PAIR.replace("euclidean", direction), row) for row in rows))
        paper = (PAPER_TABLE2[case][direction] for case in _LABELS)
        table.add("  paper", *(f"{mean:.4f} ± {std:.4f}" for mean, std in paper), style="dim")
    for label, cell in (("missed / false", "{missed:.3g} / {false:.3g}"),
                        ("NEES (2) / within 95 %", "{nees.mean:.2f} / {nees.within_95:.0%}")):  # fmt: skip
        table.add(label, *(shown(cell, row) for row in rows))
    return table


def _localisation(row: Mapping[str, Any], name: str) -> Sheet:
    table = sheet(f"Table 3: localisation on the {name}, RMSE, m", "", "without layer", "with layer", "paper")
    for direction, first in (("longitudinal", ""), ("lateral", "lateral_")):
        paper = several((PAPER_TABLE3[case][direction] for case in ("without", "with")), 4)
        table.add(direction, *(fixed(row[f"{first}{case}"], 3) for case in ("without", "with")), paper)
    return table
