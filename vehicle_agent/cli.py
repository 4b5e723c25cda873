"""`gnd agent`: one vehicle on its own."""

import logging
import signal
import threading
from pathlib import Path
from typing import Literal

import click

from gnd.fleet_bus.config import DEFAULT_ENDPOINT


@click.command()
@click.option("--drive", required=True, type=click.Path(path_type=Path), help="Recording (MCAP) to drive.")
@click.option("--vehicle", default="vehicle", show_default=True, help="Pseudonym of the vehicle.")
@click.option("--connect", multiple=True, default=(DEFAULT_ENDPOINT,), show_default=True, help="Router; repeatable.")
@click.option("--link", default="none", show_default=True, help="Mobile link to feel: 3g, 4g, 5g, none or a TOML file.")
@click.option("--work-dir", type=click.Path(path_type=Path), help="Cache, outbox and result. [default: runs/VEHICLE]")
@click.option("--pace", default=0.0, show_default=True, help="1 = real time, 0 = as fast as possible.")
@click.option("--mode", type=click.Choice(["default", "paper"]), default="default", help="Rules of change detection.")
@click.option(
    "--layers", default="ndt", show_default=True, help="Layers to keep up to date: ndt,signs,streetlights,poles."
)
@click.option(
    "--localise-by",
    type=click.Choice(["lidar", "slamcu", "graph"]),
    default="lidar",
    help="Scans on the voxel map; or, without LiDAR, a particle filter by features, or a graph of stretches.",
)
@click.option("--verbose", "-v", is_flag=True, help="Log every report and retry.")
def agent(
    drive: Path,
    vehicle: str,
    connect: tuple[str, ...],
    link: str,
    work_dir: Path | None,
    pace: float,
    mode: str,
    layers: str,
    localise_by: Literal["lidar", "slamcu", "graph"],
    verbose: bool,
) -> None:
    """Drive a recording: download tiles, localise, detect changes, upload them until acknowledged."""
    from gnd.vehicle_agent.agent import AgentConfig, run_agent
    from gnd.vehicle_agent.detect.parameters import DetectParameters
    from gnd.vehicle_agent.features.layer_parameters import FeatureParameters

    logging.basicConfig(level=logging.INFO if verbose else logging.ERROR, format="%(asctime)s %(name)s %(message)s")
    config = AgentConfig(
        vehicle=vehicle,
        drive=drive,
        work_dir=work_dir or Path("runs") / vehicle,
        connect=connect,
        link=link,
        pace=pace,
        detect=DetectParameters.paper() if mode == "paper" else DetectParameters(),
        features=FeatureParameters.of(*feature_layers(layers)),
        localise_by=localise_by,
    )
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    click.echo(summary_line(run_agent(config, stop)))


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
