"""A real router on a free port, and a session on it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from prepared import Prepared

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore


@pytest.fixture
def endpoint(free_port: int) -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port}"
    with open_router((address,)):
        yield address


@pytest.fixture
def cloud(endpoint: str) -> Iterator[Bus]:
    """The session of whoever answers the vehicle."""
    with open_bus(BusConfig(connect=(endpoint,)), name="cloud") as bus:
        yield bus


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    """The vehicle's session."""
    with open_bus(BusConfig(connect=(endpoint,)), name="vehicle") as bus:
        yield bus


@pytest.fixture(scope="session")
def recordings(prepared: Prepared) -> Path:
    """A map of the first part of a street, and a later drive through it."""
    return prepared("recordings", make_recordings)


def make_recordings(folder: Path) -> None:
    world = street(101)
    mapper = DriveConfig("mapper", "HDL-32E", state="before", errors=PERFECT, car_share=0.0, scans=60)
    simulate_drive(world, mapper, folder / "mapper.mcap")
    simulate_drive(world, DriveConfig("probe", "VLP-16", seed=4, scans=55), folder / "probe.mcap")
    with SqliteStore(folder / "map.sqlite") as store:
        build_map([folder / "mapper.mcap"], store)
