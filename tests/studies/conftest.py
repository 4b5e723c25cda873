"""One finished run for all tests that only look at it."""

from pathlib import Path
from typing import Any

import pytest
from repro_world import result_of


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Folder and JSON of a finished run."""
    out = tmp_path_factory.mktemp("reproduce") / "run"
    return out, result_of(out)
