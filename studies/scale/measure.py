"""Loads for the model: `gnd load` on one core of its own, with a file and PostgreSQL, below and beyond the limit.

    python -m studies.scale.measure --out studies/scale/loads.json --store postgresql://…/empty_database (as root)

Every process of a load runs on the last core of the machine, with 64 times the weight of others (control group `cpu`),
so that a machine that others use, too, measures what one core does. DATABASE is emptied before each run. Results are
added to the file: a setting that is measured again stands beside its first time.
"""

import json
import os
import tempfile
import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any, Final, Literal

import click
import numpy as np
import psutil
from rich.console import Console

from gnd.deploy.load.cpu import server_of
from gnd.deploy.load.drives import KeptRuns, KeptStreet
from gnd.deploy.load.making import kept_runs
from gnd.deploy.load.plan import LoadOptions
from gnd.deploy.load.run import run_load
from gnd.deploy.load.streets import Streets
from gnd.deploy.load.verdict import LoadOutcome, summary
from gnd.tile_store.location import StoreLocation, open_store
from studies.frame.errors import OptionError
from studies.ingest import costs
from studies.scale.loads import LoadSetting, MeasuredLoad
from studies.scale.replay import replayed
from studies.scale.room import Room, room
from studies.scale.yardstick import units_beside
from studies.short_corpus import corpus
from studies.speed.__main__ import machine

SETTINGS: Final = (
    # To fit the costs on: on one hardly anything is done, two leave the core idle, two offer more than it can do, in
    # one more workers share it ...
    LoadSetting("fit", vehicles=1, changed_share=1.0, kmh=15.0, km=0.2),
    LoadSetting("fit", vehicles=8, changed_share=0.0, km=0.8),
    LoadSetting("fit", vehicles=8, changed_share=1.0, km=0.8),
    LoadSetting("fit", vehicles=72, changed_share=0.0),
    LoadSetting("fit", vehicles=56, changed_share=1.0, shards=1),
    LoadSetting("fit", vehicles=36, changed_share=0.5, shards=4),
    # ... and those that the model has to foretell.
    LoadSetting("compared", vehicles=4, changed_share=0.5, km=0.8),
    LoadSetting("compared", vehicles=14, changed_share=0.0, shards=1),
    LoadSetting("compared", vehicles=28, changed_share=1.0, shards=4),
    LoadSetting("compared", vehicles=40, changed_share=0.5),
    LoadSetting("compared", vehicles=70, changed_share=1.0, shards=4),
    LoadSetting("compared", vehicles=90, changed_share=0.5),
    LoadSetting("compared", vehicles=20, changed_share=0.0),
    LoadSetting("compared", vehicles=34, changed_share=1.0),
    # Measured when the model was finished.
    LoadSetting("unseen", vehicles=12, changed_share=1.0, shards=1),
    LoadSetting("unseen", vehicles=26, changed_share=0.3, shards=3),
    LoadSetting("unseen", vehicles=64, changed_share=0.7),
)
DRAIN_S: Final = 120.0
REPLAYED_VEHICLES: Final = 30
ROUNDS: Final = 3


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), required=True)
@click.option("--store", default="", help="A PostgreSQL database of its own; none: files only.")
@click.option("--only", default="", help="Numbers of settings with commas between.  [default: all]")
@click.option(
    "--worker/--no-worker", default=False, help="Measure flags and second halves alone, as `python -m studies ingest`."
)
@click.option("--drives", type=click.Path(path_type=Path), help="As `gnd load` has it.")
@click.option("--settled", type=click.Path(path_type=Path), help="As `gnd load` has it.")
@click.option("--files/--no-files", default=True, help="Measure with files.")
def main(
    out: Path, store: str, only: str, drives: Path | None, settled: Path | None, *, worker: bool, files: bool
) -> None:
    """Measure all settings and add them to the file."""
    numbers = [int(one) for one in only.split(",")] if only else range(len(SETTINGS))
    console = Console(stderr=True)
    runs = kept_runs(drives, settled, console)
    told: dict[str, Any] = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {"loads": []}
    told |= {"machine": machine(), "streets": _streets(Streets.of(runs, LoadOptions(changed_share=0.5)))}
    with room() as made:
        if worker:
            told["worker"] = worker_costs(runs, made)
            out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
        for number in numbers:
            for location in [None] * files + [store] * bool(store):
                one = measured(SETTINGS[number], location, runs, made)
                told["loads"].append(asdict(one) | {"core": max(made.cores), "load_average": os.getloadavg()[0]})
                out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
                console.print(one)


def worker_costs(runs: KeptRuns, made: Room) -> dict[str, Any]:
    """CPU from flags to the journal for a tile, and from Gaussians to the journal for a report, ms: medians; and of
    streets of each edition, how many merges of what was known there are for each of what has come (a replay).
    """
    reports = corpus()
    tiles = float(np.mean([len(one.whole.tiles) for one in reports.reports]))
    with units_beside(made) as units:
        rounds = [{one.name: one.value for one in costs(reports)} for _ in range(ROUNDS)]
    flags, half = (median(one[f"CPU from {what} to the journal"] for one in rounds) for what in ("flags", "Gaussians"))
    again = {name: _merged_again(runs, share) for name, share in (("settled", 0.0), ("changed", 1.0))}
    return {
        "flags_ms_a_tile": round(flags / tiles, 2),
        "half_ms": round(half, 2),
        "tiles_a_report": round(tiles, 1),
        "again": again,
        "unit_ms": round(units.mean_ms(), 3),
    }


def _merged_again(runs: KeptRuns, share: float) -> float:
    with tempfile.TemporaryDirectory() as folder:
        told, _ = replayed(
            runs, LoadOptions(vehicles=REPLAYED_VEHICLES, km=0.4, kmh=60.0, changed_share=share), Path(folder)
        )
    again = told.count["merges of what was known"]
    return round(again / (told.count["merges"] - again), 3)


def measured(
    setting: LoadSetting, store: StoreLocation | None, runs: KeptRuns, made: Room, shard_share: float | None = None
) -> MeasuredLoad:
    """Run a load in a room.

    Args:
        setting: what is sent.
        store: a database, which is emptied before; None: a file for the time being.
        runs: the kept drives.
        made: the room.
        shard_share: each shard with its worker uses at most so much of one core; None: what it can get.

    Raises:
        OptionError: not all was merged in time.
    """
    if store is not None:
        _emptied(str(store))
        server = psutil.Process(server_of(store))
        for process in (server, *server.children()):
            made.enter(process.pid)
    with tempfile.TemporaryDirectory() as folder:
        pids = Path(folder) / "pids.json"

        def tell(_what: str, _done: float, _total: float) -> None:
            if shard_share is not None and pids.exists():
                told: dict[str, int] = json.loads(pids.read_text(encoding="utf-8"))
                for name in [name for name in told if name.startswith("merger-")]:
                    made.bound(name, shard_share, told[name])

        with units_beside(made) as units:
            outcome = run_load(setting.options(DRAIN_S), runs, Path(folder), tell, threading.Event(), store)
        made.unbound()
        with open_store(Path(folder) / "store.sqlite" if store is None else store, create=False) as opened:
            parts = Counter(row.part for row in opened.reports())
    unit_ms = units.mean_ms(outcome.start_s, outcome.drained_s or float("inf"))
    return measured_load(setting, "file" if store is None else "postgresql", outcome, parts, unit_ms)


def measured_load(
    setting: LoadSetting,
    store: Literal["file", "postgresql"],
    outcome: LoadOutcome,
    parts: Mapping[int, int],
    unit_ms: float,
) -> MeasuredLoad:
    """The figures of a load that the model uses."""
    told, merged = summary(outcome), outcome.ledger.merged
    n = len(outcome.acknowledged)
    if outcome.drained_s is None or told["lost"] or n < len(outcome.sent):
        raise OptionError(f"{setting}: not all was merged: {told['why_not']}")
    return MeasuredLoad(
        setting=setting,
        store=store,
        at=f"{datetime.now(UTC):%Y-%m-%d}",
        reports=n,
        halves=told["second_halves"],
        tiles_told=parts[0],
        tiles_asked=parts[1],
        versions=told["versions"],
        parts_merged=len(merged),
        offered_s=told["offered_s"],
        drained_s=outcome.drained_s - outcome.start_s,
        ack_ms=told["ack_ms"],
        lag_s=told["merge_lag_s"],
        cpu_s=dict(outcome.cpu_s),
        client_cpu_s=outcome.client_cpu_s,
        unit_ms=round(unit_ms, 3),
    )


def _emptied(url: str) -> None:
    import psycopg

    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("DROP SCHEMA public CASCADE")
        connection.execute("CREATE SCHEMA public")


def _streets(streets: Streets) -> dict[str, Any]:
    return {"changed": _street(streets.changed), "settled": _street(streets.settled)}


def _street(street: KeptStreet) -> dict[str, Any]:
    """Where along it each drive reports, and of which of its tiles nothing has changed."""
    number = {
        tile: n
        for n, tile in enumerate(sorted({t.tile for d in street.drives for r in d.reports for t in r.whole.tiles}))
    }
    drives = [
        [
            {
                "at_m": round(report.at_m, 1),
                "tiles": [
                    [number[one.tile], int(not len(one.changed) and not len(one.unsure))] for one in report.whole.tiles
                ],
            }
            for report in drive.reports
        ]
        for drive in street.drives
    ]
    return {"length_m": round(street.length_m, 1), "tiles": len(street.tiles), "drives": drives}


if __name__ == "__main__":
    main()
