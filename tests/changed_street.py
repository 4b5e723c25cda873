"""100 m of a street as it was, and a drive through it after it changed: what several folders of tests look at."""

from pathlib import Path

from prepared import Prepared

from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore

SCANS = 40


def changed_street(prepared: Prepared) -> tuple[Path, Path]:
    """(drive, map), made once for all processes."""
    folder = prepared("changed_street", make_changed_street)
    return folder / "drive.mcap", folder / "street.sqlite"


def make_changed_street(folder: Path) -> None:
    world = street(5, StreetOptions(length_m=100.0))
    mapping = DriveConfig("mapper", "VLP-16", "before", errors=PERFECT, car_share=0.0, cruise_mps=14.0, scans=45)
    with SqliteStore(folder / "street.sqlite") as store:
        build_map([simulate_drive(world, mapping, folder / "mapping.mcap")], store)
    simulate_drive(world, DriveConfig("car", "VLP-16", "after", seed=3, scans=SCANS), folder / "drive.mcap")
