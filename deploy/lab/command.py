"""`gnd lab`: a fleet over real shaped links; `check` measures them, `clean` removes what a killed lab left."""

import json
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from gnd.answers import json_option, tell
from gnd.deploy.errors import LabError
from gnd.deploy.fleet_cli import by_part, mark_of, run, run_options, summary_text
from gnd.deploy.fleet_config import load_fleet_config
from gnd.deploy.lab.check import DIRECTIONS, carried, congestion_control, measure
from gnd.deploy.lab.check import as_json as check_as_json
from gnd.deploy.lab.groups import DEFAULT_GROUPS, parse_groups
from gnd.deploy.lab.hosts.command import hosts
from gnd.deploy.lab.lab import clean as clean_up
from gnd.deploy.lab.lab import open_lab
from gnd.deploy.lab.run import LabRun
from gnd.deploy.lab.tables import check_table, run_table, run_verdict
from gnd.deploy.lab.tools import check_rights
from gnd.deploy.run_folder import create_run_folder, default_run_path
from gnd.deploy.source import Source
from gnd.ending import orderly
from gnd.extras import need_all
from gnd.fleet_bus.settings_file import write_settings
from gnd.gnd_map.settings import settings_text

WIDTH = 170


@click.group(invoke_without_command=True)
@click.option("--regions", type=int, help="With --hosts: as `gnd lab hosts`, which has further options.")
@click.option("--hosts", "host_count", type=int, help="With --regions: as `gnd lab hosts`.")
@click.option(
    "--groups", default=DEFAULT_GROUPS, show_default=True, help="Vehicles by link: profile (or TOML file):number, ..."
)
@click.option("--name", default="lab", show_default=True, help="Name of the lab; only one lab of a name can run.")
@click.option("--relay", "relay_all", is_flag=True, help="A relay process even where the kernel has netem.")
@run_options
@click.pass_context
def lab(
    context: click.Context,
    /,
    regions: int | None,
    host_count: int | None,
    groups: str,
    name: str,
    relay_all: bool,
    drives: tuple[Path, ...],
    base_map: Path | None,
    worlds: Path | None,
    out: Path | None,
    overwrite: bool,
    config_file: Path | None,
    changes: tuple[str, ...],
    dump_config: bool,
    keep_drives: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Run a fleet over real links: a network namespace for each group, each vehicle with a link of its own.

    As `gnd fleet`, but rate, delay, jitter and loss of the profiles (deploy/links.toml) are made by the network, not
    by the sessions. Needs root and iproute2. The folder of the run also holds lab.json: per group the rates reached,
    delays, losses, and the ledgers' wire bytes against the counters of the interfaces.
    """
    if context.invoked_subcommand is not None:
        return
    if regions is not None or host_count is not None:
        _as_hosts(context, regions, host_count, {"out": out, "as_json": as_json})
        return
    parsed = parse_groups(groups)
    counts = {"agents": sum(group.count for group in parsed), "link": groups}
    config = load_fleet_config(config_file, by_part(options) | counts, changes)
    if dump_config:
        click.echo(settings_text(config), nl=False)
        return
    need_all()
    source = Source(drives, base_map, worlds, config.agents)
    check_rights()
    with orderly(), open_lab(name, parsed, relay_all=relay_all) as opened:
        folder = create_run_folder(out or default_run_path(), overwrite=overwrite)
        write_settings(config, folder.root)
        folder.write_mark(mark_of(config, source, lab=name, groups=groups))
        lab_run = LabRun(opened, folder)
        summary = run(config, folder, source, keep_drives=keep_drives, place=lab_run.place)
    if as_json:
        click.echo(json.dumps(summary | {"lab": lab_run.report}, indent=2))
        return
    click.echo(summary_text(summary, folder))
    Console(width=WIDTH).print(run_table(lab_run.report))
    click.echo(run_verdict(lab_run.report))


def _as_hosts(context: click.Context, regions: int | None, count: int | None, also: dict[str, Any]) -> None:
    """Run `gnd lab hosts` instead; a fleet's options do not go with it.

    Raises:
        LabError: one was given.
    """
    allowed = {"regions", "host_count", "name", *also}
    command_line = click.core.ParameterSource.COMMANDLINE
    other = [key for key in context.params if context.get_parameter_source(key) is command_line and key not in allowed]
    if other:
        raise LabError(f"--{other[0].replace('_', '-')} does not go with --regions and --hosts: see `gnd lab hosts`")
    told = {"regions": regions, "count": count} | also
    if context.get_parameter_source("name") is command_line:
        told["name"] = context.params["name"]
    context.invoke(hosts, **{key: value for key, value in told.items() if value is not None})


lab.add_command(hosts)


@lab.command()
@click.option("--links", default="3g,4g,5g", show_default=True, help="Profiles or TOML files, with commas.")
@click.option("--name", default="check", show_default=True, help="Name of the lab.")
@click.option("--relay", "relay_all", is_flag=True, help="A relay process even where the kernel has netem.")
@click.option("--seconds", type=click.FloatRange(0.5, 60), default=3.0, show_default=True, help="Of each transfer.")
@click.option("--json", "as_json_", is_flag=True, help="Print the measurements as JSON.")
def check(links: str, name: str, relay_all: bool, seconds: float, as_json_: bool) -> None:
    """Measure rate, delay and loss of each profile by real transfers through a shaped link."""
    groups = parse_groups(",".join(f"{link}:1" for link in links.split(",") if link.strip()))
    check_rights()
    with orderly(), open_lab(name, groups, relay_all=relay_all) as opened, carried(opened):
        measured = [measure(link, direction, seconds) for link in opened.links for direction in DIRECTIONS]
    if as_json_:
        click.echo(json.dumps(check_as_json(measured), indent=2))
        return
    Console(width=WIDTH).print(check_table(measured))
    click.echo(f"one TCP: a single connection ({congestion_control()}); flood and delays: datagrams, IP bytes, one-way")


@lab.command()
@json_option
def clean(as_json: bool) -> None:
    """Remove namespaces and links that killed labs have left behind; labs that run are left alone."""
    check_rights()
    done = clean_up()
    lines = [f"{one}: {_removed_text(gone)}" if gone else f"{one} runs: left alone" for one, gone in done.items()]
    tell({"removed": done}, as_json, *(lines or ["nothing to remove"]))


def _removed_text(removed: tuple[str, ...]) -> str:
    folders = [one for one in removed if one.startswith("/")]
    count = len(removed) - len(folders)
    return " and ".join([f"{count} namespaces", *folders]) + " removed"
