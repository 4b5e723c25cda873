"""Costs from measured loads, and what the model makes of loads that it has not seen."""

import random
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import nnls

from gnd.deploy.fleet import SHARD_DEFAULTS
from gnd.deploy.load.plan import Timetable
from studies.frame.errors import OptionError
from studies.scale.loads import KINDS, Kind, Loads, MeasuredLoad, WorkerCosts
from studies.scale.model import STREET, CloudModel, CpuCosts, HostRules, Said, SimulatedReport, SimulatedRun

SEEDS: Final = (1, 2, 3)
"""Of which tiles are asked for; figures are medians over them."""
ROUNDS: Final = 4
"""How often costs are taken anew from the merges that the model makes with them; they hardly change after the first."""
NOTICE_SHARES: Final = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
QUANTILES: Final = {"p50": 0.5, "p95": 0.95}


@dataclass(frozen=True, slots=True)
class FittedStore:
    """What one kind of store costs.

    Attributes:
        costs: on a core on which a unit of the yardstick takes `unit_ms`.
        asked: of tiles with changes the share that is asked for, by edition of the street.
        again: for each merge of what has come, the merges of what was known, likewise.
        unit_ms: CPU.
        beside: what flags and second halves take, to what they take alone.
    """

    costs: CpuCosts
    asked: Mapping[str, float]
    again: Mapping[str, float]
    unit_ms: float
    beside: float = 1.0

    def costs_beside(self, unit_ms: float) -> CpuCosts:
        """On a core that is worth as much as it was in a load."""
        return self.costs.times(unit_ms / self.unit_ms)


@dataclass(frozen=True, slots=True)
class Foretold:
    """A load beside what the model says of it.

    Attributes:
        load: as it was measured.
        reports_per_s: from the first report until nothing waited any more.
        lag_s: quantiles, as the load has them.
        merges, versions: tiles merged; those that changed.
        busy_s: CPU.
    """

    load: MeasuredLoad
    reports_per_s: float
    lag_s: Mapping[str, float]
    merges: float
    versions: float
    busy_s: float

    def errors(self) -> dict[str, float]:
        """Of the model against what was measured: 0.1 is a tenth more."""
        lags = {f"lag {name}": self.lag_s[name] / self.load.lag_s[name] - 1.0 for name in QUANTILES}
        return {"throughput": self.reports_per_s / self.load.reports_per_s - 1.0} | lags


def reports_of(load: MeasuredLoad, loads: Loads, asked: Mapping[str, float], seed: int) -> list[SimulatedReport]:
    """The reports of a load as `gnd load` sends them: by its timetable, on its streets.

    Its vehicles do not download: who says "as on my map" of a tile that others have changed means an older version,
    which has to be merged. So only tiles that nobody disputes are quiet.
    """
    options, rng, streets = load.setting.options(), random.Random(seed), loads.streets
    longest_m = max(one.length_m for one in streets.values())
    table = Timetable(options, streets["changed"].at_m, streets["settled"].at_m, longest_m)
    found = []
    for due in table.due(range(options.vehicles)):
        edition = "changed" if options.is_changed(due.street) else "settled"
        tiles = streets[edition].drives[due.drive][due.report].tiles
        disputed = streets[edition].disputed
        says = tuple(
            (
                STREET * due.street + tile,
                said("quiet" if tile not in disputed else "plain" if quiet else None, asked[edition], rng),
            )
            for tile, quiet in tiles
        )
        found.append(SimulatedReport(due.at_s, due.street % options.shards, tuple(says)))
    return found


def said(known: Said | None, asked: float, rng: random.Random) -> Said:
    """What a report says of a tile: what is known, or drawn where something has changed."""
    return known or ("asked" if rng.random() < asked else "plain")


def simulated(load: MeasuredLoad, loads: Loads, fitted: FittedStore, seed: int) -> SimulatedRun:
    """A load in the model: one core, and the rules that the shards of `gnd load` have."""
    store = SHARD_DEFAULTS["store"]
    rules = HostRules(
        shards=load.setting.shards, merge_delay_s=store["merge_delay_s"], merge_after=int(store["merge_after_reports"])
    )
    options = load.setting.options()

    def again(street: int) -> float:
        return fitted.again["changed" if options.is_changed(street) else "settled"]

    return CloudModel(fitted.costs_beside(load.unit_ms), rules, seed, again).run(
        reports_of(load, loads, fitted.asked, seed), 3600.0
    )


def foretold(load: MeasuredLoad, loads: Loads, fitted: FittedStore) -> Foretold:
    """What the model says of a load: medians over the seeds."""
    runs = [simulated(load, loads, fitted, seed) for seed in SEEDS]
    lags = {name: float(np.median([np.quantile(run.lags_s, q) for run in runs])) for name, q in QUANTILES.items()}
    ended_s, *counts = (float(np.median([getattr(run, what) for run in runs])) for what in _MEDIANS)
    return Foretold(load, load.reports / ended_s, lags, *counts)


_MEDIANS: Final = ("ended_s", "merges", "versions", "busy_s")


def fitted_stores(loads: Loads) -> dict[Kind, FittedStore]:
    """Costs of each kind of store, from the loads to fit on and what other commands measure.

    Workers and receivers do the same whatever the store is, and use nearly the same CPU, so their loads are taken
    together. Three things are found from what workers have used, by least squares: how much more flags and second
    halves take beside all else than alone, what a merge takes, and what a worker takes once. How many merges there are
    is the model's own count. How much of a merge comes after its publication is what brings the median lag of these
    loads nearest. A database adds its own CPU, to each cost the same share.

    Raises:
        OptionError: there are too few loads.
    """
    known = [one for kind in KINDS for one in loads.of(kind, "fit")]
    if len(known) < 2:
        raise OptionError(f"{len(known)} loads to fit on; it takes 2")
    asked = {name: _asked(name, known, loads) for name in ("settled", "changed")}
    unit_ms = float(np.median([one.unit_ms for one in loads.loads]))
    alone = _alone(loads.worker, unit_ms)
    found = FittedStore(alone, asked, loads.worker.again, unit_ms)
    for _ in range(ROUNDS):
        costs, beside = _refined(found, alone, known, loads)
        found = replace(found, costs=costs, beside=beside)
    tried = [replace(found, costs=replace(found.costs, notice_share=share)) for share in NOTICE_SHARES]
    of_file = [one for one in known if one.store == "file"]
    best = min(tried, key=lambda one: sum(foretold(it, loads, one).errors()["lag p50"] ** 2 for it in of_file))
    return {kind: replace(best, costs=_with_database(best.costs, loads.of(kind, "fit"))) for kind in KINDS}


def _with_database(costs: CpuCosts, known: list[MeasuredLoad]) -> CpuCosts:
    """The costs with what the database server adds to the programs that ask it."""
    database_s = _spent(known, "database")
    more = 1.0 + database_s / (_spent(known, "shards") + _spent(known, "workers"))
    return replace(
        costs,
        receive_s=more * costs.receive_s,
        flags_s=more * costs.flags_s,
        half_s=more * costs.half_s,
        merge_s=more * costs.merge_s,
        database_share=1.0 - 1.0 / more,
    )


def _spent(known: list[MeasuredLoad], part: str) -> float:
    return sum(one.cpu_s.get(part, 0.0) for one in known)


def _asked(edition: str, known: list[MeasuredLoad], loads: Loads) -> float:
    """Of the tiles with changes on streets of an edition, how many are asked for."""
    some = [one for one in known if one.setting.changed_share == (edition == "changed")]
    tiles = loads.streets[edition].changed_tiles * sum(one.reports for one in some)
    if not tiles:
        raise OptionError(f"no load to fit on has {edition} streets only")
    return min(1.0, sum(one.tiles_asked for one in some) / tiles)


def _alone(worker: WorkerCosts, unit_ms: float) -> CpuCosts:
    """What is measured without a bus, on a core of which a unit of the yardstick takes so much; the rest is a guess."""
    scale_s = 1e-3 * unit_ms / worker.unit_ms
    return CpuCosts(0.005, scale_s * worker.flags_ms_a_tile, scale_s * worker.half_ms, 0.01)


def _refined(before: FittedStore, alone: CpuCosts, known: list[MeasuredLoad], loads: Loads) -> tuple[CpuCosts, float]:
    """Costs of uploads, from what the other parts have used; of what workers do, from what they have used, what they do
    alone, and the merges that the model counts. And how much more flags and second halves take than alone.
    """
    rows, used_s, others_s, versions = [], [], 0.0, [0.0, 0.0]
    for load in known:
        runs = [simulated(load, loads, before, seed) for seed in SEEDS]
        alone_s = load.tiles_told * alone.flags_s + load.halves * alone.half_s
        rows.append((alone_s, float(np.median([run.merges for run in runs])), load.setting.shards))
        worth = before.unit_ms / load.unit_ms
        used_s.append(worth * load.cpu_s["workers"])
        others_s += worth * (load.client_cpu_s + sum(_spent([load], part) for part in ("router", "store", "shards")))
        versions[0] += load.versions
        versions[1] += float(np.median([run.versions for run in runs]))
    weight = np.array(used_s) ** -0.5  # a load with little to do says less than one with much
    (beside, merge_s, begin_s), _ = nnls(np.array(rows) * weight[:, None], np.array(used_s) * weight)
    costs = replace(
        before.costs,
        receive_s=others_s / sum(one.reports + one.halves for one in known),
        flags_s=float(beside) * alone.flags_s,
        half_s=float(beside) * alone.half_s,
        merge_s=float(merge_s),
        begin_s=float(begin_s),
        news=before.costs.news * (versions[0] / versions[1]) ** 2,
    )
    return costs, float(beside)
