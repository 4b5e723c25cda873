"""Every store has to pass the shared suite: a test that takes `store` or `maker` runs once for each kind."""

from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest
from store_helpers import Clock, Maker, PostgresMaker, SqliteMaker

from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE, MemberName
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


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    """Of two shards, an operator and a vehicle."""
    made = Authority.create(tmp_path_factory.mktemp("members") / "authority", "tests")
    for role, name in (("shard", "s1"), ("shard", "s2"), ("operator", "anna"), ("vehicle", "v1")):
        made.issue(MemberName(role, name), made.folder.parent / name)
    return made


@pytest.fixture
def folder(authority: Authority, monkeypatch: pytest.MonkeyPatch) -> Path:
    """With a folder of each member's identity; this process has none."""
    monkeypatch.setenv(IDENTITY_VARIABLE, "")
    return authority.folder.parent
