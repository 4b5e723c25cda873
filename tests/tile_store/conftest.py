"""Every store has to pass the shared suite: a test that takes `store` or `maker` runs once for each kind."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from store_helpers import Clock, SqliteMaker

from gnd.tile_store.store import Store


@pytest.fixture(params=["sqlite"])
def maker(request: pytest.FixtureRequest, tmp_path: Path) -> SqliteMaker:
    makers = {"sqlite": SqliteMaker(tmp_path / "store.db")}
    return makers[request.param]


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(maker: SqliteMaker, clock: Clock) -> Iterator[Store]:
    opened = maker.open(clock=clock)
    yield opened
    opened.close()
