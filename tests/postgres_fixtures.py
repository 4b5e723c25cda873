"""Fixtures of databases with empty stores; they skip where there is no server."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count

import pytest
from postgres_server import FAST, NoServerError, PostgresServer

_NUMBERS = count()


@contextmanager
def postgres_server() -> Iterator[PostgresServer]:
    """A server until the end of the block; the test is skipped where there can be none."""
    pytest.importorskip("psycopg", reason="pip install 'gnd-fleet[postgres]'")
    try:
        server = PostgresServer(FAST)
    except NoServerError as error:
        pytest.skip(str(error))
    try:
        yield server
    finally:
        server.end()


@pytest.fixture(scope="session")
def postgres() -> Iterator[PostgresServer]:
    """One server for all tests, with a database `store` that holds an empty store, to be copied."""
    with postgres_server() as server:
        from gnd.tile_store.postgres_store import PostgresStore

        server.sql("CREATE DATABASE store")
        PostgresStore(server.url("store")).close()
        yield server


@pytest.fixture
def new_database(postgres: PostgresServer) -> Iterator[Callable[[], str]]:
    """Gives URLs of databases with empty stores."""
    made: list[str] = []

    def make() -> str:
        made.append(f"test_{next(_NUMBERS)}")
        postgres.sql(f"CREATE DATABASE {made[-1]} TEMPLATE store STRATEGY file_copy")
        return postgres.url(made[-1])

    yield make
    for name in made:
        postgres.sql(f"DROP DATABASE {name} WITH (FORCE)")
