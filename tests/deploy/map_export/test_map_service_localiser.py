"""A localiser that knows the map from the service alone finds the pose that it finds on the whole export.

On a real street: test_autoware_export.py, which has the map at hand.
"""

from pathlib import Path

import pytest
from service_localising import check_drive

from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore


@pytest.mark.slow
def test_a_localiser_drives_on_what_the_service_gives(tmp_path: Path, free_port: int) -> None:
    world = street(1005, StreetOptions(length_m=100.0))
    mapping = DriveConfig("mapper", "HDL-32E", "before", errors=PERFECT, car_share=0.0, cruise_mps=10.0, scans=30)
    with SqliteStore(tmp_path / "base.sqlite") as opened:
        build_map([simulate_drive(world, mapping, tmp_path / "mapping.mcap")], opened)
    config = DriveConfig("car", "HDL-32E", "before", seed=3, scans=60, car_share=0.0, cruise_mps=10.0)
    drive = simulate_drive(world, config, tmp_path / "drive.mcap")
    dropped, on_first_m = check_drive(tmp_path, drive, 6, 10.0, free_port)
    assert dropped > 0
    print(f"on the first answer alone: {1e3 * on_first_m:.1f} mm")
    assert on_first_m > 0.005  # the comparison sees cells that are missing
