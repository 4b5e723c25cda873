"""`gnd agent`: one vehicle on its own."""

import logging
import signal
import threading
from pathlib import Path

import click

from fleet_bus.config import DEFAULT_ENDPOINT


@click.command()
@click.option("--drive", required=True, type=click.Path(path_type=Path), help="Recording (MCAP) to drive.")
@click.option("--vehicle", default="vehicle", show_default=True, help="Pseudonym of the vehicle.")
@click.option("--connect", multiple=True, default=(DEFAULT_ENDPOINT,), show_default=True, help="Router; repeatable.")
@click.option("--link", default="none", show_default=True, help="Mobile link to feel: 3g, 4g, 5g, none or a TOML file.")
@click.option("--work-dir", type=click.Path(path_type=Path), help="Cache, outbox and result. [default: runs/VEHICLE]")
@click.option("--pace", default=0.0, show_default=True, help="1 = real time, 0 = as fast as possible.")
@click.option("--mode", type=click.Choice(["default", "paper"]), default="default", help="Rules of change detection.")
@click.option("--verbose", "-v", is_flag=True, help="Log every report and retry.")
def agent(
    drive: Path,
    vehicle: str,
    connect: tuple[str, ...],
    link: str,
    work_dir: Path | None,
    pace: float,
    mode: str,
    verbose: bool,
) -> None:
    """Drive a recording: download tiles, localise, detect changes, upload them until acknowledged."""
    from vehicle_agent.agent import AgentConfig, run_agent
    from vehicle_agent.detect.parameters import DetectParameters

    logging.basicConfig(level=logging.INFO if verbose else logging.ERROR, format="%(asctime)s %(name)s %(message)s")
    config = AgentConfig(
        vehicle=vehicle,
        drive=drive,
        work_dir=work_dir or Path("runs") / vehicle,
        connect=connect,
        link=link,
        pace=pace,
        detect=DetectParameters.paper() if mode == "paper" else DetectParameters(),
    )
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    click.echo(summary_line(run_agent(config, stop)))


def summary_line(result: dict[str, object]) -> str:
    """One line for people."""
    return (
        f"{result['vehicle']}: {result['distance_km']} km, {result['scans_used']} of {result['scans']} scans used, "
        f"{result['tiles_downloaded']} tiles downloaded, {result['changed_voxels']} changed voxels, "
        f"{result['reports_acknowledged']} of {result['reports_sent']} reports acknowledged"
    )
