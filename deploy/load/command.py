"""`gnd load`: how many vehicles does a cloud on this machine keep up with?"""

import json
import math
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console
from rich.table import Table

from gnd.deploy.errors import LoadError
from gnd.deploy.interruption import ending_in_order
from gnd.deploy.lab.hosts.plan import HostsPlan, HostsSize, plan_hosts
from gnd.deploy.lab.tools import check_rights
from gnd.deploy.live import progress_bars
from gnd.deploy.load.making import kept_runs
from gnd.deploy.load.plan import LoadOptions
from gnd.deploy.load.run import Tell, run_load
from gnd.deploy.load.verdict import summary
from gnd.ending import exit_code
from gnd.extras import need_all
from gnd.tile_store.location import LOCATION, StoreLocation

PATH: Final = click.Path(path_type=Path)
MOST_SECURE: Final = 500
WITHIN_S: Final = 120.0
"""An interrupted run on several hosts has more to end."""


@click.command(short_help="Replay recorded reports as those of many vehicles and see whether the cloud keeps up.")
@click.option("--vehicles", type=int, default=100, show_default=True, help="How many.")
@click.option("--km", type=float, default=1.0, show_default=True, help="Distance that each drives.")
@click.option(
    "--pace",
    type=click.Choice(["real", "max"]),
    default="real",
    show_default=True,
    help="At the speed of real driving, or as fast as possible.",
)
@click.option("--kmh", type=float, default=30.0, show_default=True, help="Speed, for --pace real.")
@click.option("--seconds", type=float, default=math.inf, help="Send nothing later than this after the start.")
@click.option(
    "--drives", type=PATH, help="A finished run of `gnd fleet`.  [default: runs/load-drives, made where it is missing]"
)
@click.option("--settled", type=PATH, help="A run of the same street on its healed map, for --changed-share.")
@click.option("--seed", type=int, default=1, show_default=True, help="Seed of starting places and report ids.")
@click.option("--per-street", type=int, default=4, show_default=True, help="Vehicles on a street at the same time.")
@click.option(
    "--changed-share",
    type=float,
    default=1.0,
    show_default=True,
    help="Share of streets whose map is older than their changes.",
)
@click.option("--shards", type=int, default=2, show_default=True, help="Merger shards.")
@click.option("--clients", type=int, default=2, show_default=True, help="Processes, each of many vehicles.")
@click.option("--in-flight", type=int, default=50, show_default=True, help="Concurrent requests of each client.")
@click.option(
    "--drain", "drain_s", type=float, default=10.0, show_default=True, help="Seconds after which all must be merged."
)
@click.option(
    "--store",
    type=LOCATION,
    help="An empty PostgreSQL database, which keeps what is written.  [default: a file, removed afterwards]",
)
@click.option(
    "--secure", is_flag=True, help="Certificates for all, made on the fly; TLS and rights by role on the bus."
)
@click.option(
    "--hosts", "host_count", type=int, help="On so many hosts in network namespaces, as `gnd lab hosts`; needs root."
)
@click.option("--regions", type=int, help="With --hosts, each: router, tile server, shard.  [default: 2]")
@click.option("--keep", type=PATH, help="Empty folder in which store, logs and accounts are kept.")
@click.option(
    "--json", "json_file", type=click.Path(path_type=Path, allow_dash=True), help="Write the figures; `-`: print them."
)
def load(
    drives: Path | None,
    settled: Path | None,
    store: StoreLocation | None,
    keep: Path | None,
    json_file: Path | None,
    secure: bool,
    host_count: int | None,
    regions: int | None,
    **given: Any,
) -> None:
    """Replay the reports of a few drives as those of many vehicles on many streets, and measure the cloud.

    Router, tile server and merger shards run as processes of their own. Each street is a copy of the kept one at
    another place, with its map and the reports that were made on it.

    With --hosts they run on several hosts and in several regions, with PostgreSQL and a standby, as `gnd lab hosts` has
    them, and each client sends through the router of a region. With --secure each vehicle has a connection and a
    certificate of its own.
    """
    need_all()
    options = LoadOptions(**given)
    if secure and options.vehicles > MOST_SECURE:
        raise LoadError(f"--secure: {options.vehicles} vehicles, each with a connection; {MOST_SECURE} is the most")
    plan = _plan_of(host_count, regions, secure=secure)
    if json_file is not None and str(json_file) != "-" and not json_file.absolute().parent.is_dir():
        raise click.BadParameter(f"there is no folder {json_file.absolute().parent}", param_hint="--json")
    console = Console(stderr=True)
    runs = kept_runs(drives, settled, console)
    ending = ending_in_order() if plan is None else ending_in_order(is_awaited=False, within_s=WITHIN_S)
    with ending as stop, _folder(keep) as folder, _bar(console) as tell:
        if plan is None:
            outcome = run_load(options, runs, folder, tell, stop, store, secure=secure)
        else:
            from gnd.deploy.load.hosts import LoadOnHosts

            outcome = LoadOnHosts(plan, options, runs, folder).run(tell, stop)
        figures = summary(outcome)
    if json_file is not None:
        with click.open_file(str(json_file), "w", encoding="utf-8") as file:
            file.write(json.dumps(figures, indent=2) + "\n")
    if str(json_file) != "-":
        Console(width=110).print(table_of(figures))
    if figures["why_not"] == ["the run was interrupted"]:
        sys.exit(exit_code())


def _plan_of(count: int | None, regions: int | None, *, secure: bool) -> HostsPlan | None:
    """The laboratory that was asked for, None: none was.

    Raises:
        LoadError: options do not go together.
        LabError: there can be no such laboratory, or not here.
    """
    if count is None:
        if regions is not None:
            raise LoadError("--regions goes with --hosts")
        return None
    context = click.get_current_context()
    for name, why in (("store", "the laboratory has a database"), ("shards", "there is one a region")):
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise LoadError(f"--{name} does not go with --hosts: {why}")
    plan = plan_hosts(f"load-{os.getpid()}", HostsSize(regions or HostsSize().regions, count, 1, is_secure=secure))
    check_rights()
    return plan


def table_of(figures: dict[str, Any]) -> Table:
    """The figures for people."""
    yes = "yes" if figures["kept_up"] else "no: " + "; ".join(figures["why_not"])
    drained = figures["drained_after_s"]
    rows = {
        "vehicles": f"{figures['vehicles']} on {figures['streets']} streets, pace {figures['pace']}",
        "reports": f"{figures['reports']} sent in {figures['offered_s']} s, {figures['acknowledged']} acknowledged, "
        f"{figures['lost']} lost",
        "of them": f"{figures['second_halves']} second halves, {figures['sent_whole']} sent whole, "
        f"{figures['questions']} asked after",
        "acks": f"{figures['acks_per_s']} a second; {_spread(figures['ack_ms'], 'ms')}",
        "vehicles hear what is wanted after": _spread(figures["word_s"], "s"),
        "receipt to published tile": f"{_spread(figures['merge_lag_s'], 's')}; {figures['versions']} versions",
        "deciding report to notice": _spread(figures["notice_lag_s"], "s"),
        "CPU a report": _cpu(figures),
        "share of all cores": ", ".join(f"{name} {100 * share:.0f} %" for name, share in figures["cpu_share"].items()),
        "queue": f"at most {figures['backlog_max']} uploads and tiles; empty "
        + (f"{drained} s after the last report" if drained is not None else "not in time"),
        "kept up": yes,
        "limit": figures["limit"],
    }
    if hosts := figures.get("hosts"):
        rows["hosts"] = "; ".join(f"{name}: {', '.join(parts)}" for name, parts in hosts.items())
    secure = ", with certificates" if figures.get("secure") else ""
    table = Table(show_header=False, title=f"{figures['vehicles']} vehicles{secure}")
    for name, value in rows.items():
        table.add_row(name, value)
    return table


def _cpu(figures: dict[str, Any]) -> str:
    if figures["cpu_ms_per_report"] is None:
        return "not known: not all was merged"
    parts = ", ".join(f"{name} {ms}" for name, ms in figures["cpu_ms_by_part"].items())
    return f"{figures['cpu_ms_per_report']} ms: {parts}"


def _spread(values: dict[str, float | None], unit: str) -> str:
    said = [f"{name} {value:g} {unit}" for name, value in values.items() if value is not None]
    return ", ".join(said) or "none"


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        if any(keep.iterdir()):
            raise click.BadParameter(f"{keep} is not empty", param_hint="--keep")
        yield keep
        return
    with tempfile.TemporaryDirectory(prefix="gnd-load-", ignore_cleanup_errors=True) as name:
        yield Path(name)


@contextmanager
def _bar(console: Console) -> Iterator[Tell]:
    with progress_bars(console) as progress:
        task = progress.add_task("drives", total=1)

        def tell(what: str, done: float, total: float) -> None:
            progress.update(task, description=what, completed=done, total=total)

        yield tell
