"""A real router, a real store behind it, and programs in processes of their own."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from api_testing import EAST, FAR, HERE, Cloud, Program, gaussian_tile, sign_tile
from changed_street import changed_street
from prepared import Prepared

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore


@pytest.fixture
def cloud(tmp_path: Path, free_port: int) -> Iterator[Cloud]:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        open_router((endpoint,)),
        SqliteStore(tmp_path / "map.sqlite") as store,
        open_bus(BusConfig(connect=(endpoint,)), name="cloud") as bus,
    ):
        day_ns = 1_767_225_600_000_000_000  # 2026-01-01
        store.put_tiles([gaussian_tile(HERE, 5, 9, 70), gaussian_tile(EAST, 3)], surveyed_ns=day_ns)
        store.put_tiles([gaussian_tile(FAR, 1)])
        store.put_tiles([sign_tile(HERE, 1, 2, 3), sign_tile(FAR, 4)], layer="signs")
        with TileServer(store, bus):
            yield Cloud(endpoint, store, bus)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    """Starts programs in a folder of the test; those that still run at its end are killed."""
    programs: list[Program] = []

    def begin(*arguments: str) -> Program:
        programs.append(Program(arguments, tmp_path))
        return programs[-1]

    yield begin
    for program in programs:
        if program.process.poll() is None:
            program.process.kill()
        program.end()
        assert program.process.stdout is not None
        program.process.stdout.close()


@pytest.fixture(scope="session")
def street_files(prepared: Prepared) -> tuple[Path, Path]:
    """A drive and the map of its street."""
    return changed_street(prepared)
