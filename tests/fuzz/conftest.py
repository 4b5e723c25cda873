"""The samples of other tests, and what the targets have written."""

from collections.abc import Iterator

import pytest
from fuzz_paths import add_paths

add_paths()


@pytest.fixture(scope="session", autouse=True)
def folders_in_memory() -> Iterator[None]:
    """Removed when all targets have run."""
    yield
    from fuzz_folder import clean

    clean()
