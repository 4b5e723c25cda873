"""A finished study as plain values: the JSON of `gnd reproduce new-feature-layer`."""

from typing import Any

from gnd.gnd_map.config import to_mapping
from studies.feature_study.averages import mean_over, rounded, std_over
from studies.feature_study.matching import RADIUS_M
from studies.feature_study.targets import judged
from studies.new_layer_study import reference
from studies.new_layer_study.layers import WIDE_RADIUS_M, LayerScore, pooled, score
from studies.new_layer_study.outcome import MotorwayOutcome, RouteOutcome, SeedOutcome, StudyOutcome
from studies.new_layer_study.reference import DIRECTIONS

MAP_CASES = ("without_map", "with_map")


def summary_of(outcome: StudyOutcome) -> dict[str, Any]:
    """Return everything as plain values: means over the seeds below `nfl`, their standard deviations below
    `std_over_seeds`, each seed below `seeds`.
    """
    seeds = {str(one.seed): seed_summary(one) for one in outcome.seeds}
    mean = mean_over(list(seeds.values()))
    found = {
        "nfl": mean,
        "std_over_seeds": std_over(list(seeds.values())),
        "targets": judged(mean, reference.TARGETS),
        "paper": {
            "single": reference.PAPER_SINGLE_M,
            "integrated": reference.PAPER_INTEGRATED_M,
            "table2": reference.PAPER_TABLE2,
            "table3": reference.PAPER_TABLE3,
        },
        "seeds": seeds,
        "matching_radius_m": {"track": RADIUS_M, "motorway": WIDE_RADIUS_M},
        "parameters": to_mapping(outcome.options),
        "runtime_s": dict(outcome.runtime_s),
    }
    return dict(rounded(found))


def seed_summary(outcome: SeedOutcome) -> dict[str, Any]:
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
