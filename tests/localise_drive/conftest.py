"""The street, and the command run on it once."""

import json

import pytest
from localised_street import Ran, localise, make_street


@pytest.fixture(scope="session")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Ran:
    folder = tmp_path_factory.mktemp("street")
    drive, store = make_street(folder)
    out = folder / "out"
    result = localise(drive, store, "--out", str(out), "--json", str(folder / "all.json"))
    assert result.exit_code == 0, result.output
    return Ran(drive, store, out, result.stdout, json.loads((folder / "all.json").read_text()))
