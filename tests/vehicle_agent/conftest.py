"""A real router on a free port, and a session on it."""

from collections.abc import Iterator

import pytest

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router


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
