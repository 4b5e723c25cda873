"""The command `gnd`: one table of subcommands, each loaded when it is called."""

from gnd.ending import catch_signals, ending_at_once, exit_code, run_program, working  # isort: skip  # before others

if __name__ == "__main__":  # `python -m gnd.deploy.cli`: before the heavy imports
    from gnd.program import one_thread_for_matrices

    catch_signals()
    one_thread_for_matrices()

import importlib
import os
import sys
from collections.abc import Mapping
from typing import Any, Final

import click

from gnd.deploy.compiling import say_progress
from gnd.extras import explained
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.jit import tell_compiling
from gnd.importing import without_garbage

COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "fleet": ("gnd.deploy.fleet_cli:fleet", "Run a whole fleet on this machine and watch the map being updated."),
    "lab": ("gnd.deploy.lab.command:lab", "Run a fleet over real shaped links in network namespaces (root)."),
    "load": (
        "gnd.deploy.load.command:load",
        "Replay reports as those of many vehicles: does the cloud keep up?",
    ),
    "chaos": ("gnd.deploy.chaos_cli:chaos", "Inject faults into a whole cloud, and check its guarantees."),
    "watch": ("gnd.deploy.watch_cli:watch", "Print the tile updates of a region as they are published."),
    "serve": ("gnd.deploy.serve.command:serve", "Show a map in the browser: as it is, as it was, as it changes."),
    "traffic": (
        "gnd.deploy.traffic_cli:traffic",
        "Every byte of a run, compared with 3G, 4G and 5G; also as a page.",
    ),
    "report": (
        "gnd.deploy.report.command:report",
        "A finished run as one page to send: maps, changes, figures; also as PDF.",
    ),
    "map": ("gnd.deploy.map_cli:map_group", "Build, inspect, compare, export, back up and roll back maps."),
    "shards": ("gnd.cloud_merger.shards_cli:shards", "Who merges a map: shards, their districts, their queues."),
    "regions": (
        "gnd.tile_store.regions_cli:regions",
        "Stores that share a map: whose districts are, and moving them while vehicles drive.",
    ),
    "vehicles": ("gnd.deploy.vehicles_cli:vehicles", "Whose reports count, why not, and who decides it."),
    "release": ("gnd.deploy.release_cli:release", "See and steer new versions on trial with a share of the fleet."),
    "view": ("gnd.deploy.map_export.view:view", "Show a map, its changes and its fleet in Rerun."),
    "features": ("gnd.deploy.features_cli:features", "Import, export and list feature layers: Lanelet2, GeoJSON, ..."),
    "lanes": ("gnd.deploy.lanes_cli:lanes", "Lane borders of a Lanelet2 map kept by vehicles, and edits of the map."),
    "import": (
        "gnd.vehicle_agent.importer_cli:import_drives",
        "Turn a recording (KITTI, PCD, ROS 2, ...) into a drive.",
    ),
    "localise": ("gnd.vehicle_agent.localise_drive.command:localise", "Localise a recorded drive on a map."),
    "play": ("gnd.deploy.play:play_command", "Publish a recording as sensors would: ROS 2 topics, or plain keys."),
    "status": (
        "gnd.deploy.status.command:status",
        "How the cloud and its vehicles stand; live, or as a check for monitoring.",
    ),
    "doctor": ("gnd.deploy.doctor.command:doctor", "What keeps programs from working here, and what to do about it."),
    "bench": (
        "gnd.deploy.bench.command:bench",
        "What a vehicle costs on this machine: CPU, memory and start, by stage.",
    ),
    "kernels": (
        "gnd.deploy.kernels_cli:kernels",
        "Which machine code runs here, and compiling it ahead of time.",
    ),
    "completion": ("gnd.deploy.completion_cli:completion", "Tab completion for bash, zsh and fish."),
    "config": ("gnd.deploy.config_cli:config", "Show and check the settings of the programs."),
    "sim": ("gnd.fleet_sim.cli:sim", "Write and inspect simulated worlds and drives."),
    "reproduce": ("gnd.deploy.reproduce:reproduce", "Reproduce the papers' results and compare them with ours."),
    "benchmark": (
        "gnd.deploy.reproduce:benchmark",
        "Export worlds as files, and score any program that finds their changes.",
    ),
    "certs": ("gnd.deploy.certs_cli:certs", "Issue, renew and revoke the certificates of a fleet."),
    "router": ("gnd.fleet_bus.cli:router", "Run the Zenoh router alone."),
    "store": ("gnd.tile_store.cli:store", "Run the tile server alone."),
    "merger": ("gnd.cloud_merger.cli:merger", "Run one merger shard alone."),
    "agent": ("gnd.vehicle_agent.cli:agent", "Run one vehicle agent alone."),
}


class LazyGroup(click.Group):
    """A group whose commands are imported only when called, so that `gnd --help` answers at once.

    `table` gives by name where a command is ("module:attribute") and its line of help.
    """

    def __init__(self, *args: Any, table: Mapping[str, tuple[str, str]] = COMMANDS, **attributes: Any) -> None:
        super().__init__(*args, **attributes)
        self._table = table

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  (click's signature)
        """Return the names of the commands, in the order of the table."""
        return list(self._table)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002  (click's)
        """Import and return a command, or None when there is none of that name."""
        if cmd_name not in self._table:
            return None
        module, attribute = self._table[cmd_name][0].split(":")
        with explained(), ending_at_once(), without_garbage():
            command: click.Command = getattr(importlib.import_module(module), attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002  (click's)
        """Write the table of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in self._table.items()])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="gnd-fleet", prog_name="gnd")
def gnd() -> None:
    """Keep a LiDAR map up to date with a fleet of vehicles.

    Vehicles download tiles of a Geodetic Normal Distribution map, localise on it, detect what changed and
    upload only that; a sharded merger fuses the reports into new tile versions that every subscriber receives.
    """


def main() -> None:
    """Run the command line; every error of ours becomes one line on standard error and exit code 2."""
    tell_compiling(say_progress())
    try:
        with explained(), working():
            code = gnd.main(standalone_mode=False)
        if isinstance(code, int) and code:  # of `context.exit`; commands return nothing else
            sys.exit(code)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except GndError as error:
        click.echo(f"gnd: {error}", err=True)
        sys.exit(2)
    except (KeyboardInterrupt, click.Abort):
        click.echo("gnd: interrupted", err=True)
        sys.exit(exit_code())
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)


def program() -> None:
    """The command as installations from before `gnd.program` call it."""
    catch_signals()
    run_program(main)


if __name__ == "__main__":
    run_program(main)
