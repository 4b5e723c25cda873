"""`gnd lab hosts`, also `gnd lab --regions R --hosts H`: a cloud of several hosts, hurt and checked."""

import json
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from rich.console import Console

from gnd.deploy.errors import LabError
from gnd.deploy.interruption import ending_in_order
from gnd.deploy.lab.hosts.plan import BUCKET, HostsPlan, HostsSize, plan_hosts
from gnd.deploy.lab.hosts.tables import hosts_verdict, print_hosts
from gnd.deploy.lab.tools import check_rights
from gnd.extras import need_all
from gnd.fleet_bus.links import LinkProfile, load_link

if TYPE_CHECKING:
    from gnd.deploy.lab.hosts.run import HostsOptions
    from gnd.deploy.lab.hosts.verdict import HostsOutcome

ACCOUNT: Final = "lab_hosts.json"
WIDTH: Final = 150
WITHIN_S: Final = 120.0
"""An interrupted run settles, is looked at, and ends some twenty processes on all hosts: on a busy machine it takes
more than others get."""
SIZE: Final = HostsSize()


@click.command()
@click.option("--regions", type=int, default=SIZE.regions, show_default=True, help="Each: router, tile server, shard.")
@click.option("--hosts", "count", type=int, default=SIZE.hosts, show_default=True, help="Machines, 2 or more.")
@click.option("--vehicles", type=int, default=SIZE.vehicles, show_default=True, help="Of each region.")
@click.option("--bucket", is_flag=True, help="Bodies of tiles lie in a bucket of S3 on one of the hosts.")
@click.option(
    "--secure", is_flag=True, help="Certificates for all, made on the fly; TLS and rights by role on the bus."
)
@click.option("--link", default="5g", show_default=True, help="Link of each vehicle: a profile or a TOML file.")
@click.option("--faults", help="With commas, in order; all: each one.  [default: the loss of hosts, and a partition]")
@click.option("--times", type=click.IntRange(1, 100), default=1, show_default=True, help="How often the list is done.")
@click.option("--away", type=float, default=10.0, show_default=True, help="How long what is lost stays away, s.")
@click.option("--cut", type=float, default=60.0, show_default=True, help="How long a region is cut off, s.")
@click.option("--writes", type=int, default=5, show_default=True, help="A slow disk makes so many a second.")
@click.option("--clock", type=float, default=600.0, show_default=True, help="A wrong clock is wrong by so much, s.")
@click.option("--chaos", type=click.IntRange(1, 10_000), default=30, show_default=True, help="Faults of chaos in one.")
@click.option("--every", type=float, default=0.5, show_default=True, help="A vehicle's reports are so far apart, s.")
@click.option("--gap", type=float, default=5.0, show_default=True, help="Allowed time without service, s.")
@click.option("--seed", type=int, default=1, show_default=True, help="Draws the reports.")
@click.option("--name", default="hosts", show_default=True, help="Name of the lab; only one lab of a name can run.")
@click.option(
    "--out", type=click.Path(path_type=Path), help="For outboxes, logs, lab_hosts.json.  [default: a new one]"
)
@click.option("--json", "as_json", is_flag=True, help="Print lab_hosts.json instead of tables.")
def hosts(regions: int, count: int, vehicles: int, link: str, faults: str | None, times: int, **options: Any) -> None:
    """Run a cloud of several hosts and regions in network namespaces, inflict faults, and check what is left.

    The exit code is 1 if an acknowledged report was lost or is there twice, if the map differs from its journal, or if
    a region was not served for longer than --gap. Ctrl-C ends the faults; all up to then is checked and printed.
    Needs root, iproute2 and the programs of a PostgreSQL server.
    """
    size = HostsSize(regions, count, vehicles, options["bucket"], options["secure"])
    plan, profile = plan_hosts(options["name"], size), load_link(link)
    need_all()
    from gnd.deploy.lab.hosts.faults import chosen_faults
    from gnd.deploy.lab.hosts.run import HostsOptions

    chosen = chosen_faults(faults, plan) * times
    run_options = HostsOptions(
        chosen, options["seed"], options["every"], options["away"], options["cut"], options["gap"], options["writes"],
        options["clock"], options["chaos"],
    )  # fmt: skip
    check_rights()
    folder = _folder(options["out"])
    outcome = _run(plan, profile, run_options, folder)
    (folder / ACCOUNT).write_text(json.dumps(outcome.as_dict(), indent=2) + "\n", encoding="utf-8")
    if options["as_json"]:
        click.echo(json.dumps(outcome.as_dict(), indent=2))
    else:
        print_hosts(Console(width=WIDTH), outcome)
        click.echo(hosts_verdict(outcome))
        click.echo(f"outboxes, logs and {ACCOUNT}: {folder}")
    if outcome.failures:
        raise SystemExit(1)


def _folder(out: Path | None) -> Path:
    if out is None:
        return Path(tempfile.mkdtemp(prefix="gnd-lab-hosts-"))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise LabError(f"{out}: exists and is not empty; choose another folder for --out")
    out.mkdir(parents=True, exist_ok=True)
    return out.resolve()


def _run(plan: HostsPlan, profile: LinkProfile, options: "HostsOptions", folder: Path) -> "HostsOutcome":
    from gnd.deploy.lab.hosts.cloud import link_groups
    from gnd.deploy.lab.hosts.postgres import server_programs, server_user
    from gnd.deploy.lab.hosts.run import run_hosts
    from gnd.deploy.lab.hosts.running import opened_hosts
    from gnd.deploy.live import progress_bars
    from gnd.deploy.processes import start_fork_server

    server_programs()
    server_user()
    with (
        ending_in_order(is_awaited=False, within_s=WITHIN_S) as stop,
        _surroundings(plan, options, folder),
        progress_bars(Console(stderr=True)) as progress,
    ):
        start_fork_server()
        task = progress.add_task("starting", total=len(options.faults))
        with opened_hosts(plan, link_groups(plan, profile), folder) as (lab, folders):
            return run_hosts(
                plan, lab, folders, options, stop,
                lambda what, n: progress.update(task, description=what, completed=n),
            )  # fmt: skip


@contextmanager
def _surroundings(plan: HostsPlan, options: "HostsOptions", folder: Path) -> Iterator[None]:
    """What all processes of the laboratory find in their environment."""
    from gnd.deploy.lab.hosts.bucket import bucket_environment, server_program
    from gnd.deploy.lab.hosts.wrong_clock import clocks_may_be_wrong

    with ExitStack() as stack:
        if plan.size.has_bucket:
            server_program()
            stack.enter_context(bucket_environment(plan.host_of(BUCKET).address))
        if any(fault.is_of_clocks for fault in options.faults):
            stack.enter_context(clocks_may_be_wrong(folder))
        yield
