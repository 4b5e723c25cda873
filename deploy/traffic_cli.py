"""`gnd traffic`: what a run sent and received, as tables, JSON, CSV and a page."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import click
from rich.console import Console

from gnd.deploy.traffic_page import write_page
from gnd.fleet_bus.errors import LinkError
from gnd.fleet_bus.ledger_file import read_run, run_folder
from gnd.fleet_bus.links import LinkProfile, load_link
from gnd.fleet_bus.traffic import DEFAULT_LINKS, agent_traffic, as_json
from gnd.fleet_bus.traffic_csv import as_csv
from gnd.fleet_bus.traffic_table import print_tables

_WIDTH: Final = 110


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--json", "as_json_", is_flag=True, help="Print JSON instead of tables.")
@click.option("--csv", "as_csv_", is_flag=True, help="Print CSV: a row for each agent, kind and direction.")
@click.option("--page", type=click.Path(path_type=Path), help="Write the account as a page (one HTML file).")
@click.option(
    "--link",
    "links",
    multiple=True,
    default=DEFAULT_LINKS,
    help="Profile to compare with, or a TOML file (FILE or FILE:NAME).",
)
def traffic(run: Path, as_json_: bool, as_csv_: bool, page: Path | None, links: tuple[str, ...]) -> None:
    """Show what RUN (a folder, or a name below runs/) sent and received, and compare it with mobile links.

    Every byte on the wire is accounted for: by kind of message, and what the connections themselves cost
    (acks: packets without data, those that answer tiles separately; resent; opening and closing of connections;
    keep-alives; session: declarations and the remainder).
    """
    if as_json_ and as_csv_:
        raise click.UsageError("--json and --csv exclude each other: one output, one form")
    profiles = load_links(links)
    agents = tuple(agent_traffic(ledger, profiles) for ledger in read_run(run))
    if page is not None:
        write_page(page, run_folder(run).resolve().name, agents, profiles)
    if as_json_:
        click.echo(json.dumps(as_json(str(run), agents, profiles), indent=1))
    elif as_csv_:
        click.echo(as_csv(agents, profiles), nl=False)
    elif page is not None:
        click.echo(f"page written: {page}")
    else:
        print_tables(agents, Console(width=_WIDTH))


def load_links(names: Sequence[str]) -> tuple[LinkProfile, ...]:
    """The profiles of these names or files.

    Raises:
        LinkError: one is unknown or malformed, or two have one name, so that their figures could not be told apart.
    """
    profiles = tuple(load_link(name) for name in names)
    twice = [name for name, count in Counter(profile.name for profile in profiles).items() if count > 1]
    if twice:
        raise LinkError(f"link profiles with one name: {', '.join(twice)}; rename the table in your file")
    return profiles
