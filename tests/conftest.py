"""Fixtures that every test may use, and how the suite is dealt out to processes (`pytest -n 3 --dist loadscope`)."""

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest
from postgres_fixtures import new_database, postgres, run_as_owner
from prepared import Prepared, prepared
from suite_groups import (
    pytest_collection_modifyitems,
    pytest_configure_node,
    pytest_xdist_make_scheduler,
)
from suite_kernels import choose_kernels
from suite_ports import new_port
from unpacked import unpacked_once
from web_fixtures import new_bucket, s3_server, served

# Hooks and fixtures that pytest finds here.
__all__ = [
    "new_bucket",
    "new_database",
    "postgres",
    "prepared",
    "pytest_collection_modifyitems",
    "pytest_configure_node",
    "pytest_xdist_make_scheduler",
    "run_as_owner",
    "s3_server",
    "served",
]

# Whether a commit is good must not depend on what is drawn, nor on how busy the machine is.
hypothesis.settings.register_profile("same", derandomize=True, deadline=None, max_examples=60)
hypothesis.settings.register_profile("random", derandomize=False)  # pytest --hypothesis-profile=random
hypothesis.settings.load_profile("same")

ROOT = Path(__file__).resolve().parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"
WARM_UP = Path(__file__).with_name("suite_kernels.py")


def pytest_configure() -> None:
    """Heed Ctrl-C, also where the suite is started with SIGINT ignored, as build servers and `nohup … &` do.

    A process hands an ignored signal on to all that it starts, and Python then makes no KeyboardInterrupt of it: what
    tests of Ctrl-C start would not hear them, and outlive them. That the commands themselves keep to what they were
    started with is the custom of the system, and stays.

    While tests are collected nothing becomes garbage: to look for it takes a third of that time.

    Tests are of the source, compiled by numba; programs that they start run a library of it (`suite_kernels`). Those of
    tests/ahead are of libraries. GND_KERNELS=numba or FILE tests all on one.
    """
    keep_bytecode()
    choose_kernels()
    gc.disable()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def keep_bytecode() -> None:
    """Python keeps what it compiles, in this process and in those that it starts, also where PYTHONDONTWRITEBYTECODE
    is set, as in most container images.

    Else each tester compiles all tests anew, and each of the hundreds of programs that they start all of our modules.
    """
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


def pytest_collection_finish() -> None:
    """Collect garbage from now on, but look no more at the thousands of tests and modules that stay."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes() -> None:
    """Have the kernels of vehicle, cloud and simulator ready before the processes start: see `suite_kernels`."""
    subprocess.run([sys.executable, str(WARM_UP)], check=True, env={**os.environ, "PYTHONPATH": str(ROOT / "src")})


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """Commands that a test calls in its own process leave their handlers of Ctrl-C: not for the next test."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def identity_as_before() -> Iterator[None]:
    """`--identity` of a command that a test calls in its own process is for the processes that it starts: not for the
    next test.
    """
    before = os.environ.get("GND_IDENTITY")
    yield
    os.environ.pop("GND_IDENTITY", None)
    if before is not None:
        os.environ["GND_IDENTITY"] = before


@pytest.fixture(scope="session")
def shared_data(prepared: Prepared) -> Iterator[Path]:
    """The folder of real recordings; a test that needs it skips where it is missing."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"real recordings not found at ../{SHARED_DATA.parent.name}/{SHARED_DATA.name}")
    with unpacked_once(SHARED_DATA, prepared):
        yield SHARED_DATA


@pytest.fixture
def free_port() -> int:
    """A TCP port on the loopback interface that was free a moment ago."""
    return new_port()
