"""Reports a second over their whole way, with a store in a file and in PostgreSQL in turns, or with 1, 2 and 4 shards.

    python -m studies.scale.rates --store postgresql://…/empty_database --rounds 3 (as root)
    python -m studies.scale.rates --shards 1,2,4 --share 0.15 --vehicles 8 --each (as root)

A load (`gnd load`) offers more than the cloud can do; counted are its reports from the first one sent until nothing
waits any more: acknowledged, journaled, merged, published and told. All processes, the database server too, share the
last cores of the machine, on which they go before everybody else (control groups). With `--share` each shard with its
worker gets so much of a core and no more, so that the shards are the limit, whatever else the machine does. What a
report costs falls with what waits, as several reports about a tile are merged together; with `--each` a shard has as
many vehicles whatever their number, so that as much waits for each. What a report costs depends on its street, too,
and on how many vehicles are there: loads of which a shard is not offered the same are refused. Beside the shards stands
a yardstick: work without any cloud, in as many processes with the same bounds. DATABASE is emptied before each run.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from typing import Any, Final

import click
from rich.console import Console

from gnd.deploy.load.drives import KeptRuns
from gnd.deploy.load.making import kept_runs
from studies.frame.errors import OptionError
from studies.scale.loads import LoadSetting, MeasuredLoad
from studies.scale.measure import measured
from studies.scale.mix import OfferedMix
from studies.scale.room import Room, room
from studies.scale.yardstick import unit_ms

MOST_APART: Final = 0.05
"""Between loads that are compared: share of reports about changed streets; vehicles a street."""


@click.command(help=__doc__)
@click.option("--store", default="", help="A PostgreSQL database of its own; none: a file.")
@click.option("--shards", default="", help="Numbers of shards with commas between, all with the same store.")
@click.option("--share", default=0.2, show_default=True, type=click.FloatRange(0.01, 1.0), help="Of a core, a shard.")
@click.option("--rounds", default=3, show_default=True, type=click.IntRange(1))
@click.option("--cores", default=1, show_default=True, type=click.IntRange(1), help="That all share.")
@click.option("--vehicles", default=60, show_default=True, type=click.IntRange(1))
@click.option("--each", is_flag=True, help="So many vehicles for each shard, not for all.")
@click.option("--km", default=0.4, show_default=True, type=click.FloatRange(0.1), help="Way of each vehicle.")
@click.option("--drives", type=click.Path(path_type=Path), help="As `gnd load` has it.")
@click.option("--settled", type=click.Path(path_type=Path), help="As `gnd load` has it.")
def main(
    store: str,
    shards: str,
    share: float,
    rounds: int,
    cores: int,
    vehicles: int,
    km: float,
    drives: Path | None,
    settled: Path | None,
    *,
    each: bool,
) -> None:
    """Measure in turns, and print a line a run and one for all."""
    runs = kept_runs(drives, settled, Console(stderr=True))
    with room(cores) as made:
        if shards:
            counts = [int(one) for one in shards.split(",")]
            loads = [replace(_load(vehicles * (one if each else 1), km), shards=one) for one in counts]
            _of_shards(loads, share, rounds, store, runs, made)
        else:
            _of_stores(_load(vehicles, km), rounds, store, runs, made)


def _load(vehicles: int, km: float) -> LoadSetting:
    return LoadSetting("compared", vehicles=vehicles, changed_share=0.5, km=km)


def _of_stores(setting: LoadSetting, rounds: int, store: str, runs: KeptRuns, made: Room) -> None:
    if not store:
        raise click.UsageError("say a database (--store), or numbers of shards (--shards)")
    pairs = list[tuple[MeasuredLoad, MeasuredLoad]]()
    for number in range(rounds):
        found = {
            place: _told(measured(setting, place or None, runs, made))
            for place in ("", store)[:: 1 if number % 2 else -1]
        }
        pairs.append((found[""], found[store]))
    _say(
        "PostgreSQL over a file, worst, median, best",
        reports_per_s=_ends([there.reports_per_s / file.reports_per_s for file, there in pairs]),
        by_cpu=_ends([_cpu_ms(file) / _cpu_ms(there) for file, there in pairs]),
    )


def _of_shards(loads: Sequence[LoadSetting], share: float, rounds: int, store: str, runs: KeptRuns, made: Room) -> None:
    require_alike({one: OfferedMix.of(one, runs) for one in loads})
    found: dict[LoadSetting, list[tuple[float, float, float]]] = {one: [] for one in loads}
    for number in range(rounds):
        for one in loads[:: -1 if number % 2 else 1]:
            yardstick_ms = unit_ms(one.shards, share, made)
            load = _told(measured(one, store or None, runs, made, share), yardstick_ms=round(yardstick_ms, 2))
            found[one].append((load.reports_per_s, _cpu_ms(load), yardstick_ms))
    first = loads[0]
    for other in loads[1:]:
        pairs = list(zip(found[first], found[other], strict=True))
        _say(
            f"{other.shards} shards over {first.shards}, worst, median, best",
            reports_per_s=_ends([many[0] / one[0] for one, many in pairs]),
            by_cpu=_ends([other.shards / first.shards * one[1] / many[1] for one, many in pairs]),
            cpu_of_a_report=_ends([many[1] / one[1] for one, many in pairs]),
            yardstick=_ends([many[2] / one[2] for one, many in pairs]),
        )


def require_alike(offered: Mapping[LoadSetting, OfferedMix]) -> None:
    """Say what a shard of each load is offered.

    Raises:
        OptionError: it is not the same.
    """
    for one, mix in offered.items():
        each = round(mix.reports / one.shards, 1)
        _say(f"{one.shards} shards are offered", reports_each=each, **{k: round(v, 2) for k, v in asdict(mix).items()})
    for name in ("changed", "a_street"):
        values = [getattr(mix, name) for mix in offered.values()]
        if max(values) - min(values) > MOST_APART:
            raise OptionError(f"shards are not offered the same, {name}: {', '.join(f'{one:.2f}' for one in values)}")


def _told(one: MeasuredLoad, **more: float) -> MeasuredLoad:
    _say(
        f"{one.store}, {one.setting.shards} shards",
        reports=one.reports,
        reports_per_s=round(one.reports_per_s, 2),
        offered_per_s=round(one.reports / one.offered_s, 2),
        versions=one.versions,
        cpu_ms=round(_cpu_ms(one), 1),
        by_part={name: round(1e3 * used_s / one.reports, 1) for name, used_s in one.cpu_s.items()},
        lag_p50_s=one.lag_s["p50"],
        load=round(os.getloadavg()[0], 1),
        **more,
    )
    return one


def _cpu_ms(one: MeasuredLoad) -> float:
    """Of the cloud and its database a report."""
    return 1e3 * one.cloud_cpu_s / one.reports


def _ends(ratios: Sequence[float]) -> list[float]:
    return [round(one, 2) for one in (min(ratios), median(ratios), max(ratios))]


def _say(what: str, **told: Any) -> None:
    click.echo(json.dumps({"what": what} | told))


if __name__ == "__main__":
    main(prog_name="python -m studies.scale.rates")
