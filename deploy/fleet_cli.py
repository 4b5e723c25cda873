"""`gnd fleet`: run a whole fleet on this machine."""

import dataclasses
import json
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import click
from rich.console import Console

from gnd.deploy.fleet_config import FleetConfig, load_fleet_config
from gnd.deploy.fleet_identities import FLEET, make_identities, sign_map
from gnd.deploy.next_commands import after_fleet
from gnd.deploy.ports import claim_port
from gnd.deploy.report.software import software
from gnd.deploy.run_folder import RunFolder, create_run_folder, default_run_path
from gnd.deploy.site import SiteFrame
from gnd.deploy.source import Source
from gnd.ending import ending_at_once, orderly
from gnd.extras import need_all
from gnd.fleet_bus.links import load_link
from gnd.fleet_bus.settings_file import write_settings
from gnd.fleet_bus.settings_options import settings_options
from gnd.fleet_sim.families.names import FAMILY_NAMES
from gnd.gnd_map.settings import settings_text

PATH = click.Path(path_type=Path)


_PLAIN = "the bus of this run is plain, on this machine's loopback interface alone (--secure: TLS and rights)"
_SECURE = "every process of this run has a certificate of its own: TLS and rights by role, on the loopback interface"
_Command = TypeVar("_Command", bound=Callable[..., Any])


def listed(_context: click.Context, _option: click.Parameter, value: str | None) -> list[str] | None:
    """Return the items of a comma-separated list."""
    return None if value is None else [word.strip() for word in value.split(",") if word.strip()]


def given(_context: click.Context, _option: click.Parameter, values: tuple[str, ...]) -> list[str] | None:
    """Return the values of a repeatable option, or None where it was not given."""
    return list(values) or None


RUN_OPTIONS = (
    click.option("--shards", type=int, help="Merger shard processes.  [default: 2]"),
    click.option(
        "--layers", callback=listed, help="Layers kept up to date, such as ndt,signs,streetlights.  [default: ndt]"
    ),
    click.option(
        "--headway",
        "headway_s",
        type=float,
        help="Seconds between the starts of two vehicles, in time of the drives; 0: all at once.  [default: 4]",
    ),
    click.option("--world-seed", type=int, help="Seed of the simulated world.  [default: 7]"),
    click.option("--family", type=click.Choice(FAMILY_NAMES), help="Kind of place.  [default: street]"),
    click.option("--parking", type=float, help="Share of parking slots that are taken.  [default: the family's]"),
    click.option(
        "--wrong-mount",
        "wrong_mounts",
        multiple=True,
        callback=given,
        help="VEHICLE:DEGREES, such as 3:0.5: its drive contains a LiDAR mount turned by this angle; repeatable.",
    ),
    click.option("--drives", type=PATH, multiple=True, help="Drives (MCAP, folders) or recordings (KITTI, ...)."),
    click.option("--map", "base_map", type=PATH, help="Store with the base map for --drives (`gnd map build`)."),
    click.option("--worlds", type=PATH, help="Folder that keeps simulated worlds by seed for further runs."),
    click.option("--out", type=PATH, help="Folder of the run.  [default: runs/<UTC time>]"),
    click.option("--overwrite", is_flag=True, help="Replace an earlier run in that folder."),
    click.option(
        "--merge-mode",
        type=click.Choice(["default", "paper", "paper-observers"]),
        help="Rules of merging (merger.merge.mode).",
    ),
    click.option(
        "--detect-mode", type=click.Choice(["default", "paper"]), help="Rules of detection (agent.detect.mode)."
    ),
    settings_options,
    click.option("--keep-drives", is_flag=True, help="Keep the simulated drives (some hundred MB) after the run."),
    click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON."),
)
"""Options that `gnd fleet` and `gnd lab` share."""


def run_options(command: _Command) -> _Command:
    """Give a command the options of a run."""
    for option in reversed(RUN_OPTIONS):
        command = option(command)
    return command


@click.command()
@click.option("--agents", type=int, help="Vehicle agent processes.  [default: 8, or one a drive with --drives]")
@click.option("--link", help="Link of every vehicle: 3g, 4g, 5g, none, or a TOML file.  [default: 4g]")
@click.option("--port", type=int, help="Port of the router; 0 takes a free one.  [default: 0]")
@click.option(
    "--made-up", type=click.IntRange(min=0), default=0, help="Made-up boxes to put into the scans of --drives."
)
@click.option(
    "--secure", is_flag=True, help="Certificates for all, made on the fly; TLS and rights by role on the bus."
)
@click.option("--no-page", is_flag=True, help="Show no live map in the browser.")
@run_options
def fleet(
    secure: bool,
    no_page: bool,
    drives: tuple[Path, ...],
    base_map: Path | None,
    made_up: int,
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
    """Run a fleet: vehicles download the map, drive, detect changes and upload them; the cloud updates the map.

    Without --drives a street that has changed since it was mapped is simulated, and the result is compared with the
    truth. The folder of the run holds the logs, the traffic ledger and its page,
    the store, three pictures and summary.json.
    """
    config = load_fleet_config(config_file, by_part(options), changes)
    if dump_config:
        click.echo(settings_text(config), nl=False)
        return
    need_all()
    source = Source(drives, base_map, worlds, options["agents"], made_up)
    load_link(config.link)  # what cannot work is refused before anything is written
    claim_port(config.port)
    folder = create_run_folder(out or default_run_path(), overwrite=overwrite)
    write_settings(config, folder.root)
    folder.write_mark(mark_of(config, source, secure=secure))
    source = _imported(source, folder, quiet=as_json)
    if not as_json:
        click.echo(_SECURE if secure else _PLAIN, err=True)
    summary = run(config, folder, source, keep_drives=keep_drives, secure=secure, page=not no_page)
    click.echo(json.dumps(summary, indent=2) if as_json else summary_text(summary, folder))
    if base_map is not None and not as_json:
        for line in after_fleet(summary, base_map, folder):
            click.echo(line)


def mark_of(config: FleetConfig, source: Source, **more: Any) -> dict[str, Any]:
    """What a run writes down of how it was made: settings, recordings, versions of the programs."""
    return {
        "config": dataclasses.asdict(config),
        "drives": [str(path) for path in source.drives],
        "map": None if source.base_map is None else str(source.base_map),
        "made_up": source.made_up,
        "software": software(),
        **more,
    }


def _imported(source: Source, folder: RunFolder, *, quiet: bool) -> Source:
    """Recordings among the drives become drives, which stay with the run."""
    if not source.drives:
        return source
    from gnd.deploy.recordings import drives_of

    return dataclasses.replace(source, drives=drives_of(source.drives, folder.imported, partial(click.echo, err=quiet)))


def by_part(options: dict[str, Any]) -> dict[str, Any]:
    """Options of the command as settings of a fleet: the two modes are settings of its agents and its shards."""
    own = dict(options)
    detect, merge = ({"mode": own.pop(name)} for name in ("detect_mode", "merge_mode"))
    return own | {"agent": {"detect": detect}, "merger": {"merge": merge}}


def run(
    config: FleetConfig,
    folder: RunFolder,
    source: Source,
    *,
    keep_drives: bool,
    secure: bool = False,
    page: bool = False,
    place: Callable[[], AbstractContextManager[SiteFrame | None]] = nullcontext,
) -> dict[str, Any]:
    """Prepare and run a fleet and write its summary.

    Args:
        config: what to run.
        folder: where the run writes.
        source: drives and map.
        keep_drives: keep simulated drives.
        secure: give every process a certificate, and the bus TLS and rights.
        page: show the run in the browser, too.
        place: gives the site while the processes run; by default all run on the loopback interface.

    Returns:
        The content of `summary.json`.
    """
    # The heavy imports wait until the options have been found good.
    with ending_at_once():
        from gnd.deploy import prepare, summary
        from gnd.deploy.compiling import watched_elsewhere
        from gnd.deploy.fleet import run_fleet
        from gnd.deploy.live import progress_bars
        from gnd.deploy.processes import start_fork_server
        from gnd.tile_store.signing import Signing
        from gnd.tile_store.sqlite_store import SqliteStore

    console = Console(stderr=True)
    started_s = time.monotonic()
    with progress_bars(console) as progress:
        compiling = progress.add_task("compiling kernels for this machine (once)", visible=False, total=None)

        def show(ready: int, known: int) -> None:
            progress.update(compiling, visible=True, completed=ready, total=known)

        def warm_up() -> None:
            with suppress(EOFError, OSError):  # the command ends meanwhile; else the first process tells what is wrong
                start_fork_server()

        # A daemon: who ends the command meanwhile does not wait until kernels are compiled.
        warm = threading.Thread(target=warm_up, name="fork-server", daemon=True)
        with watched_elsewhere(show):
            warm.start()  # the kernels are loaded while the world is made
            prepared = prepare.prepare(config, folder, source, progress)
            warm.join()
        progress.update(compiling, visible=False)
    if secure:
        identities = make_identities(folder.root, config.shards, len(prepared.agent_drives))
        prepared = dataclasses.replace(prepared, identities=identities)
        with SqliteStore(folder.store, signing=Signing(identities / FLEET)) as store:
            sign_map(store)
    prepare_s = time.monotonic() - started_s
    with orderly(), place() as site:
        outcome = run_fleet(config, folder, prepared, console, threading.Event(), site, page=page)
    result = summary.write_summary(config, folder, prepared, outcome, prepare_s)
    if not keep_drives:
        prepare.remove_drives(folder)
    return result


def summary_text(summary: dict[str, Any], folder: RunFolder) -> str:
    """Return the summary as a few lines for people."""
    from gnd.deploy.summary import summary_lines

    lines = [
        *summary_lines(summary),
        f"its map in the browser: gnd serve {folder.root}",
        f"everything else: {folder.root}",
    ]
    if folder.traffic_page.exists():
        lines.insert(-1, f"every byte of it: {folder.traffic_page}")
    return "\n".join(lines)
