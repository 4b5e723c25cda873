"""What the model of scale says of a load, beside what `gnd load` has measured: on one machine, or on several hosts.

    gnd load --vehicles 24 --km 0.75 --hosts 4 --regions 2 --json load.json
    python -m studies.scale.beside load.json

Costs are those of docs/scale.md, on a core that is worth what it was there; the model knows no network and no standby.
Of a load with which the cloud did not keep up it says nothing.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console
from rich.table import Table

from gnd.gnd_map.errors import GndError
from studies.frame.errors import OptionError
from studies.scale.fit import FittedStore, Foretold, fitted_stores, foretold
from studies.scale.loads import Kind, Loads, LoadSetting, MeasuredLoad

MUST: Final = 0.25
_NEEDED: Final = ("vehicles", "changed_share", "shards", "kmh", "km", "acknowledged", "kept_up", "merge_lag_s")


def read_load(path: Path) -> dict[str, Any]:
    """The figures that `gnd load --json` has written.

    Raises:
        OptionError: it is no such file, or one of a load with which the cloud did not keep up.
    """
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        missing = [name for name in _NEEDED if name not in told]
    except (OSError, ValueError, TypeError) as error:
        raise OptionError(f"{path}: no figures of `gnd load`: {error}") from error
    if missing:
        raise OptionError(f"{path}: no figures of `gnd load`, it has no {', '.join(missing)}")
    if not told["kept_up"]:
        raise OptionError(f"{path}: the cloud did not keep up: {'; '.join(told['why_not'])}")
    return dict(told)


def beside(told: dict[str, Any], loads: Loads, stores: Mapping[Kind, FittedStore]) -> Foretold:
    """The figures of a load, and what the model says of it with the costs of its kind of store."""
    store: Kind = "postgresql" if "database" in told["cpu_ms_by_part"] else "file"
    fitted = stores[store]
    names = ("vehicles", "changed_share", "shards", "kmh", "km")
    reports = told["acknowledged"]
    load = MeasuredLoad(
        setting=LoadSetting("unseen", **{name: told[name] for name in names}),
        store=store,
        at="",
        reports=reports,
        halves=told["second_halves"],
        tiles_told=0,
        tiles_asked=0,
        versions=told["versions"],
        parts_merged=0,
        offered_s=told["offered_s"],
        drained_s=told["offered_s"] + told["drained_after_s"],
        ack_ms=told["ack_ms"],
        lag_s=told["merge_lag_s"],
        cpu_s={part: 1e-3 * ms * reports for part, ms in told["cpu_ms_by_part"].items()},
        client_cpu_s=0.0,
        unit_ms=fitted.unit_ms,
    )
    return foretold(load, loads, fitted)


def figures_from(found: Foretold) -> dict[str, dict[str, float]]:
    """Measured, model and error of each figure."""
    load, errors = found.load, found.errors()
    pairs = {"throughput": (load.reports_per_s, found.reports_per_s)}
    pairs |= {f"lag {name}": (load.lag_s[name], found.lag_s[name]) for name in found.lag_s}
    return {
        name: {"measured": round(here, 3), "model": round(there, 3), "error": round(errors[name], 3)}
        for name, (here, there) in pairs.items()
    }


def _table(figures: dict[str, dict[str, float]], title: str) -> Table:
    table = Table("", "measured", "model", "error", f"within {MUST:.0%}", title=title)
    for name, one in figures.items():
        unit = "reports a second" if name == "throughput" else f"{name}, s"
        is_within = "yes" if abs(one["error"]) <= MUST else "no"
        table.add_row(unit, f"{one['measured']:.2f}", f"{one['model']:.2f}", f"{one['error']:+.0%}", is_within)
    return table


@click.command(help=__doc__)
@click.argument("load_json", type=click.Path(path_type=Path))
@click.option("--json", "is_json", is_flag=True, help="Print the figures as JSON.")
def main(load_json: Path, is_json: bool) -> None:
    """Compare, and tell."""
    try:
        told, loads = read_load(load_json), Loads.read()
        with Console(stderr=True).status("costs are taken from the committed loads, a minute"):
            stores = fitted_stores(loads)
        figures = figures_from(beside(told, loads, stores))
    except GndError as error:
        raise click.ClickException(str(error)) from error
    if is_json:
        click.echo(json.dumps(figures))
        return
    where = f"{len(told['hosts'])} hosts" if told.get("hosts") else "one machine"
    Console(width=100).print(_table(figures, f"{told['vehicles']} vehicles, {told['shards']} shards on {where}"))


if __name__ == "__main__":
    main(prog_name="python -m studies.scale.beside")
