import itertools
from collections.abc import Callable, Iterator

import pytest
from bus_testing import RouterProcess, new_endpoint

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.router import open_router

_NUMBERS = itertools.count()


@pytest.fixture
def endpoint() -> str:
    """Endpoint at which nobody listens yet."""
    return new_endpoint()


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    """Endpoint of a router that lives as long as the test module."""
    at = new_endpoint()
    with open_router([at]):
        yield at


@pytest.fixture
def router_process(endpoint: str) -> Iterator[RouterProcess]:
    """A started router in a process of its own."""
    process = RouterProcess(endpoint)
    process.start()
    yield process
    process.close()


@pytest.fixture
def key() -> str:
    """A key root of this test alone."""
    return f"test/{next(_NUMBERS)}"


Opener = Callable[..., Bus]


@pytest.fixture
def client() -> Iterator[Opener]:
    """Opens clients of an endpoint and closes them at the end."""
    opened: list[Bus] = []

    def open_client(at: str, *more: str, ledger: Ledger | None = None, link: str | LinkProfile = "none", **config: int):
        settings = BusConfig(connect=(at, *more), link=link, **config)
        opened.append(open_bus(settings, ledger, name=f"client {len(opened)}"))
        return opened[-1]

    yield open_client
    for bus in reversed(opened):
        bus.close()
