"""`gnd agent`: one vehicle on its own."""

import logging
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gnd.ending import orderly
from gnd.fleet_bus.config import DEFAULT_ENDPOINT
from gnd.fleet_bus.identity.names import identity_of_environment
from gnd.fleet_bus.identity.options import identity_option
from gnd.fleet_bus.settings_options import settings_options
from gnd.gnd_map.settings import settings_text

if TYPE_CHECKING:
    from gnd.vehicle_agent.config import AgentConfig


@click.command()
@click.option("--drive", type=click.Path(path_type=Path), help="Recording (MCAP) to drive.")
@click.option(
    "--live",
    type=click.Choice(["ros2", "zenoh"]),
    help="Drive now: on topics of ROS 2 over rmw_zenoh, or on plain keys; --set live.connect=[…] names their router.",
)
@click.option("--vehicle", help="Pseudonym of the vehicle.  [default: vehicle]")
@click.option("--connect", multiple=True, help=f"Router; repeatable.  [default: {DEFAULT_ENDPOINT}]")
@click.option("--tiles-from", help="URL of an archive (gnd map publish): tiles come from there, news over the bus.")
@click.option("--link", help="Mobile link to feel: 3g, 4g, 5g, none or a TOML file.  [default: none]")
@click.option("--work-dir", type=click.Path(path_type=Path), help="Cache, outbox and result.  [default: runs/VEHICLE]")
@click.option("--pace", type=float, help="1 = real time, 0 = as fast as possible.  [default: 0]")
@click.option("--mode", type=click.Choice(["default", "paper"]), help="Rules of change detection.")
@click.option(
    "--layers",
    help="Such as ndt,signs,streetlights,poles, or declared ones.  [default: ndt]",
)
@click.option(
    "--localise-by",
    type=click.Choice(["lidar", "slamcu", "graph"]),
    help="Scans on the voxel map; or, without LiDAR, a particle filter by features, or a graph of stretches.",
)
@settings_options
@click.option("--verbose", "-v", is_flag=True, help="Log every report and retry.")
@identity_option
def agent(
    drive: Path | None,
    live: str | None,
    work_dir: Path | None,
    connect: tuple[str, ...],
    mode: str | None,
    layers: str | None,
    config_file: Path | None,
    changes: tuple[str, ...],
    dump_config: bool,
    verbose: bool,
    **plain: Any,
) -> None:
    """Drive a recording, or now (--live): download tiles, localise, detect changes, upload them until acknowledged.

    All settings: docs/configuration.md. They come from --config FILE, the environment (GND_AGENT__PACE=1) and --set
    (report.longest_s=30), in this order; options go before all.
    """
    from gnd.extras import need_vehicle
    from gnd.vehicle_agent.agent import run_agent
    from gnd.vehicle_agent.settings import load_agent

    need_vehicle()
    logging.basicConfig(level=logging.INFO if verbose else logging.ERROR, format="%(asctime)s %(name)s %(message)s")
    options = plain | {
        "drive": None if drive is None else str(drive),
        "live": {"source": live},
        "work_dir": None if work_dir is None else str(work_dir),
        "connect": list(connect) or None,
        "detect": {"mode": mode},
        "features": {"layers": None if layers is None else feature_layers(layers)},
    }
    config = _under_pseudonym(load_agent(config_file, changes, options))
    if dump_config:
        click.echo(settings_text(config), nl=False)
        return
    stop = threading.Event()

    def end(number: int, _frame: object) -> None:
        stop.set()
        signal.signal(number, signal.SIG_DFL)  # a second one ends at once: reports wait in the outbox

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    with orderly():
        click.echo(summary_line(run_agent(config, stop)))


def _under_pseudonym(config: "AgentConfig") -> "AgentConfig":
    """The settings with the vehicle's present name, where its identity is a folder of pseudonyms."""
    if identity_of_environment() is None:
        return config
    from gnd.fleet_bus.identity.pseudonyms import take_pseudonym
    from gnd.vehicle_agent.config import DEFAULT_NAME, PRIVATE_M
    from gnd.vehicle_agent.errors import AgentConfigError

    taken = take_pseudonym()
    if taken is None:
        return config
    name, folder = taken
    if config.vehicle != DEFAULT_NAME:
        raise AgentConfigError(
            f"vehicle = {config.vehicle}: with a folder of pseudonyms the name is the present one, {name}"
        )
    report = replace(config.report, private_m=config.report.private_m or PRIVATE_M)
    is_default = config.work_dir == Path("runs", config.vehicle)
    work_dir = Path("runs", folder.resolve().name) if is_default else config.work_dir
    return replace(config, vehicle=name, pseudonyms=folder, report=report, work_dir=work_dir)


def feature_layers(layers: str) -> list[str]:
    """The layers of a comma-separated list, but for the voxels', which every vehicle with LiDAR keeps."""
    return [layer for name in layers.split(",") if (layer := name.strip()) and layer != "ndt"]


def summary_line(result: dict[str, object]) -> str:
    """One line for people."""
    if "stretches" in result:
        return (
            f"{result['vehicle']}: {result['distance_km']} km in {result['stretches']} stretches, "
            f"{result['reports_acknowledged']} of {result['reports_sent']} reports acknowledged"
        )
    if "scans" not in result:
        return (
            f"{result['vehicle']}: {result['distance_km']} km by features, {result['scans_refined']} poses, "
            f"{result['reports_acknowledged']} of {result['reports_sent']} reports acknowledged"
        )
    return (
        f"{result['vehicle']}: {result['distance_km']} km, {result['scans_used']} of {result['scans']} scans used, "
        f"{result['tiles_downloaded']} tiles downloaded, {result['changed_voxels']} changed voxels, "
        f"{result['reports_acknowledged']} of {result['reports_sent']} reports acknowledged"
    )
