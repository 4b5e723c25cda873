"""docs/attacks.md is what the tests say."""

from pathlib import Path

import pytest
from attacks_page import PAGE, attacks, page


def test_the_page_of_attacks_is_current() -> None:
    assert PAGE.read_text() == page(), "run `python tests/attacks_page.py`"


def test_every_attack_says_what_it_tries() -> None:
    assert [attack.name for attack in attacks() if len(attack.what) < 30] == []


def test_there_are_at_least_sixty() -> None:
    assert len(list(attacks())) >= 60


@pytest.mark.parametrize("name", ["docs/security.md", "SECURITY.md"])
def test_the_pages_that_lead_there_exist(name: str) -> None:
    assert "attacks" in (Path(PAGE).parents[1] / name).read_text()
