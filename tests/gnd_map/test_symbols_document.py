"""docs/symbols.md names what exists."""

import importlib
import re
from pathlib import Path

import pytest

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "symbols.md"
ROWS = re.findall(r"\| `([\w.]+)` \| `([\w.]+)` \|$", DOCUMENT.read_text(encoding="utf-8"), flags=re.MULTILINE)


def test_the_table_is_read() -> None:
    assert len(ROWS) >= 30


@pytest.mark.parametrize(("name", "module"), ROWS)
def test_every_name_of_the_table_exists(name: str, module: str) -> None:
    value = importlib.import_module(module)
    for part in name.split("."):
        value = getattr(value, part)
