"""Documents that list others list all of them."""

from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
DECISIONS = sorted((DOCS / "decisions").glob("0*.md"))


@pytest.mark.parametrize("decision", DECISIONS, ids=lambda path: path.stem)
def test_the_index_names_every_decision_by_its_title(decision: Path) -> None:
    number, _, title = decision.read_text().splitlines()[0].removeprefix("# ").partition(". ")
    assert int(number) == int(decision.stem.split("-")[0])
    assert f"| {number} | [{title}]({decision.name}) |" in (DOCS / "decisions" / "index.md").read_text()


def test_the_index_names_nothing_that_is_not_there() -> None:
    lines = (DOCS / "decisions" / "index.md").read_text().splitlines()
    assert sum(line.startswith("| ") and line[2].isdigit() for line in lines) == len(DECISIONS) > 50
