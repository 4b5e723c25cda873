"""Fixtures of databases with empty stores; they skip where there is no server."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Final

import pytest
from postgres_server import FAST, NoServerError, PostgresServer

_NUMBERS = count()
_MEMORY: Final = Path("/dev/shm")
_LEAST_FREE_BYTES: Final = 4 << 30
"""A server of hundreds of databases, one after the other, holds some 100 MB, and at most 1 GB of a journal."""


@contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """A server until the end of the block; the test is skipped where there can be none."""
    pytest.importorskip("psycopg", reason="pip install 'gnd-fleet[postgres]'")
    try:
        server = PostgresServer(FAST, _memory())
    except NoServerError as error:
        pytest.skip(str(error))
    try:
        yield server
    finally:
        server.end()


def _memory() -> Path | None:
    """A folder in memory, where there is room: each database is 300 files that are copied and removed."""
    has_room = _MEMORY.is_dir() and shutil.disk_usage(_MEMORY).free > _LEAST_FREE_BYTES
    return _MEMORY if has_room else None


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    """One server for all tests, with a database `store` that holds an empty store, to be copied."""
    with postgres_server() as server:
        from gnd.tile_store.postgres_store import PostgresStore

        server.sql("CREATE DATABASE store")
        PostgresStore(server.url("store")).close()
        yield server


@pytest.fixture(scope="session")
def run_as_owner(postgres: PostgresServer) -> Iterator[Callable[[str], object]]:
    """Runs commands as the server's owner, over one connection: to start psql for each takes longer than most tests."""
    import psycopg

    with psycopg.connect(postgres.url("postgres"), autocommit=True) as connection:
        yield lambda command: connection.execute(command.encode())


@pytest.fixture
def new_database(postgres: PostgresServer, run_as_owner: Callable[[str], object]) -> Iterator[Callable[[], str]]:
    """Gives URLs of databases with empty stores."""
    made: list[str] = []

    def make() -> str:
        made.append(f"test_{next(_NUMBERS)}")
        run_as_owner(f"CREATE DATABASE {made[-1]} TEMPLATE store STRATEGY file_copy")
        return postgres.url(made[-1])

    yield make
    for name in made:
        run_as_owner(f"DROP DATABASE {name} WITH (FORCE)")
