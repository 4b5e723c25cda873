"""A short street: a map of it in a store, a drive along it after it changed, drives that something is wrong with."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from gnd.deploy.cli import gnd
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.errors import GndError
from gnd.schemas.drive import DriveItem, GnssFix
from gnd.schemas.drive_mcap import DriveWriter, read_drive, read_header
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore

SCANS = 40
MAPPED = 45


@dataclass(frozen=True)
class Ran:
    """A street and what the command wrote."""

    drive: Path
    store: Path
    out: Path
    stdout: str
    summary: dict[str, Any]


def make_street(folder: Path) -> tuple[Path, Path]:
    """(drive, store): the map is the street before, the drive goes through it after."""
    world = street(5, StreetOptions(length_m=100.0))
    mapping = DriveConfig("mapper", "VLP-16", "before", errors=PERFECT, car_share=0.0, cruise_mps=14.0, scans=MAPPED)
    with SqliteStore(folder / "base.sqlite") as store:
        build_map([simulate_drive(world, mapping, folder / "mapping.mcap")], store)
    config = DriveConfig("car", "VLP-16", "after", seed=3, scans=SCANS)
    return simulate_drive(world, config, folder / "drive.mcap"), folder / "base.sqlite"


def changed(source: Path, target: Path, change: Callable[[DriveItem], DriveItem | None]) -> Path:
    """A copy of a drive, each item changed, or left out where `change` gives None."""
    with DriveWriter(target, read_header(source)) as writer:
        for item in read_drive(source):
            kept = change(item)
            if kept is not None:
                writer.add(kept)
    return target


def moved_north(item: DriveItem) -> DriveItem:
    """GNSS fixes 0.01 rad, some 64 km, farther north."""
    return replace(item, lat_rad=item.lat_rad + 0.01) if isinstance(item, GnssFix) else item


def localise(drive: Path, store: Path, *more: str) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(gnd, ["localise", str(drive), "--map", str(store), *more])


def refusal(drive: Path, store: Path, *more: str) -> str:
    """The error that the command ends with, which the root prints as one line."""
    ran = localise(drive, store, *more)
    assert isinstance(ran.exception, GndError), ran.output
    assert "\n" not in str(ran.exception)
    return str(ran.exception)
