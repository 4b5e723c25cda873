"""Every store has to pass the shared suite: a test that takes `store` or `maker` runs once for each kind."""

from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest
from store_helpers import Clock, Maker, PostgresMaker, SqliteMaker

from gnd.tile_store.store import Store

_NUMBERS = count()


KINDS = ["sqlite", "postgres", "sqlite+objects", pytest.param("postgres+s3", marks=pytest.mark.slow)]


def maker_of(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], Maker]:
    """Gives makers of empty stores of the kind that a fixture's parameter names."""
    database, _, bodies = str(request.param).partition("+")

    def place() -> str | None:
        if bodies == "s3":
            return str(request.getfixturevalue("new_bucket")())
        return str(tmp_path / f"bodies{next(_NUMBERS)}") if bodies else None

    if database == "sqlite":
        return lambda: SqliteMaker(tmp_path / f"store{next(_NUMBERS)}.db", place())
    new_database = request.getfixturevalue("new_database")
    return lambda: PostgresMaker(new_database(), place())


@pytest.fixture(params=KINDS)
def new_maker(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], Maker]:
    return maker_of(request, tmp_path)


@pytest.fixture(params=KINDS)
def maker(request: pytest.FixtureRequest, tmp_path: Path) -> Maker:
    return maker_of(request, tmp_path)()


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(maker: Maker, clock: Clock) -> Iterator[Store]:
    opened = maker.open(clock=clock)
    yield opened
    opened.close()
