"""docs/symbols.md names what exists."""

import importlib
import re
from pathlib import Path

import pytest

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "symbols.md"
ROWS = re.findall(r"\| `([\w.]+)` \| `([\w.]+)` \|$", DOCUMENT.read_text(encoding="utf-8"), flags=re.MULTILINE)


def test_the_table_is_read() -> None:
    assert len(ROWS) >= 30


def test_every_equation_that_is_implemented_is_in_the_table() -> None:
    """GND 1-7 and 9-18 (8 and 10 say "unknown"), SLAMCU 1-7 and 11-20 (8-10 derive), NFL 1-12."""
    expected = {
        "GND": {*range(1, 8), 9, *range(11, 19)},
        "SLAMCU": {*range(1, 8), *range(11, 21)},
        "NFL": {*range(1, 13)},
    }
    named: dict[str, set[int]] = {paper: set() for paper in expected}
    for paper, numbers in re.findall(
        r"^\| (GND|SLAMCU|NFL) Eq\. ([\d, -]+) \|", DOCUMENT.read_text("utf-8"), re.MULTILINE
    ):
        for part in numbers.split(","):
            first, _, last = part.strip().partition("-")
            named[paper] |= set(range(int(first), int(last or first) + 1))
    assert named == expected


@pytest.mark.parametrize(("name", "module"), ROWS)
def test_every_name_of_the_table_exists(name: str, module: str) -> None:
    value = importlib.import_module(module)
    for part in name.split("."):
        value = getattr(value, part)
