"""Fixtures that every test may use."""

import signal
import socket
from pathlib import Path

import pytest

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_configure() -> None:
    """Heed Ctrl-C, also where the suite is started with SIGINT ignored, as build servers and `nohup … &` do.

    A process hands an ignored signal on to all that it starts, and Python then makes no KeyboardInterrupt of it: what
    tests of Ctrl-C start would not hear them, and outlive them. That the commands themselves keep to what they were
    started with is the custom of the system, and stays.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; a test that needs it skips where it is missing."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"real recordings not found at ../{SHARED_DATA.parent.name}/{SHARED_DATA.name}")
    return SHARED_DATA


@pytest.fixture
def free_port() -> int:
    """A TCP port on the loopback interface that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
