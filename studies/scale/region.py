"""One database with its shards at the peak of a country, as the model has it."""

import random
from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil
from typing import Final

import numpy as np

from studies.scale.model import STREET, CloudModel, CpuCosts, HostRules, Said, SimulatedReport, SimulatedRun
from studies.scale.plan import CostsOfUse, MeasuredFigure

SIMULATED_S: Final = 40.0
PATIENCE_S: Final = 400.0
LIGHT_PER_S: Final = 2.0
STREETS: Final = 10_000
"""Vehicles of a country seldom meet on a street within half an hour."""


@dataclass(frozen=True, slots=True)
class ReportShape:
    """Reports of a vehicle that knows its street.

    Attributes:
        told: tiles a report.
        asked: of these asked for Gaussians.
        again: merges of what was known, for each merge of what has come.
    """

    told: float
    asked: float
    again: float = 0.0

    @classmethod
    def of(cls, figures: Mapping[str, MeasuredFigure], again: float) -> "ReportShape":
        """As measured."""
        return cls(figures["tiles_told_a_report"].value, figures["tiles_asked_a_report"].value, again)


@dataclass(frozen=True, slots=True)
class RegionAtRate:
    """What a region does at a rate of reports: share of what publications can take, and what comes of it."""

    share: float
    offered_per_s: float
    done_per_s: float
    ack_ms_p50: float
    lag_s: tuple[float, float]


def light(costs: CpuCosts, shape: ReportShape) -> SimulatedRun:
    """A region that has little to do: for the costs of a report."""
    return _run(costs, shape, LIGHT_PER_S, HostRules(cores=64, shards=4))


def costs_of_use(fitted: CpuCosts, figures: Mapping[str, MeasuredFigure], run: SimulatedRun) -> CostsOfUse:
    """Costs of single things, from the figures and a simulated region."""
    value = {name: one.value for name, one in figures.items()}
    reports = len(run.acks_s)
    report_s = run.busy_s / reports
    return CostsOfUse(
        reports_a_km=value["reports_a_km"],
        worker_s=(1.0 - fitted.database_share) * report_s,
        database_s=fitted.database_share * report_s,
        merges=run.merges / reports,
        publish_s=fitted.publish_s,
        questions_a_km=value["questions_a_km"],
        question_s=value["postgresql: question about 8 tiles that are held, CPU"] / 1e3,
        up_bytes_a_km=1e3 * value["up_kB_a_km"],
        down_bytes_a_km=1e3 * value["down_kB_a_km"],
        map_bytes_a_km=1e3 * value["map_kB_a_km"],
        journal_bytes=value["journal_B_a_report"],
        tile_row_bytes=value["postgresql: row_B"],
        tiles_a_km=value["tiles_a_km"],
    )


def regions(fitted: CpuCosts, shape: ReportShape, use: CostsOfUse, shares: tuple[float, ...]) -> list[RegionAtRate]:
    """A database with as many shards as it can feed, at shares of what its publications can take."""
    most_per_s = 1.0 / (use.merges * use.publish_s)
    shards = ceil(most_per_s * use.worker_s / 0.6)
    rules = HostRules(cores=shards, shards=shards, database_cores=ceil(most_per_s * use.database_s / 0.6))
    found = []
    for share in shares:
        run = _run(fitted, shape, share * most_per_s, rules)
        lags = tuple(float(np.quantile(run.lags_s, q)) for q in (0.5, 0.95))
        acks_ms = 1e3 * float(np.median(run.acks_s))
        found.append(
            RegionAtRate(share, share * most_per_s, len(run.acks_s) / run.ended_s, acks_ms, (lags[0], lags[1]))
        )
    return found


def shards_of_region(use: CostsOfUse) -> int:
    """As many as a database can feed, at 60 % of a core each."""
    return ceil(use.worker_s / (use.merges * use.publish_s) / 0.6)


def _run(costs: CpuCosts, shape: ReportShape, per_s: float, rules: HostRules, seed: int = 1) -> SimulatedRun:
    rng, at_s, reports = random.Random(seed), 0.0, list[SimulatedReport]()
    while (at_s := at_s + rng.expovariate(per_s)) < SIMULATED_S:
        first = STREET * rng.randrange(STREETS)
        told = _drawn(shape.told, rng)
        asked = min(told, _drawn(shape.asked, rng))
        says: list[tuple[int, Said]] = [(first + n, "asked" if n < asked else "quiet") for n in range(told)]
        reports.append(SimulatedReport(at_s, first // STREET % rules.shards, tuple(says)))
    return CloudModel(costs, rules, seed, lambda _: shape.again).run(reports, PATIENCE_S)


def _drawn(mean: float, rng: random.Random) -> int:
    """A whole number with this mean."""
    return int(mean) + (rng.random() < mean % 1)
