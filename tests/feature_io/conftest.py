"""A store to import into."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from gnd.tile_store.sqlite_store import SqliteStore


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SqliteStore]:
    with SqliteStore(tmp_path / "map.sqlite") as opened:
        yield opened
