"""The street, and the command run on it once."""

import json
from pathlib import Path

import pytest
from changed_street import changed_street
from localised_street import Ran, localise
from prepared import Prepared


@pytest.fixture(scope="session")
def street_files(prepared: Prepared) -> tuple[Path, Path]:
    """A drive and the map of its street."""
    return changed_street(prepared)


@pytest.fixture(scope="session")
def ran(tmp_path_factory: pytest.TempPathFactory, street_files: tuple[Path, Path]) -> Ran:
    folder = tmp_path_factory.mktemp("street")
    drive, store = street_files
    out = folder / "out"
    result = localise(drive, store, "--out", str(out), "--json", str(folder / "all.json"))
    assert result.exit_code == 0, result.output
    return Ran(drive, store, out, result.stdout, json.loads((folder / "all.json").read_text()))
