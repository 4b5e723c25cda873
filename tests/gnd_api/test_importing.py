"""Modules are imported without a collector of garbage."""

import gc
import sys
from collections.abc import Iterator

import pytest

from gnd.importing import without_garbage

RARE = "this"  # of the standard library, imported by nobody
pytestmark = pytest.mark.usefixtures("collector_as_before")


@pytest.fixture
def collector_as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    was_on = gc.isenabled()
    monkeypatch.delitem(sys.modules, RARE, raising=False)
    yield
    (gc.enable if was_on else gc.disable)()


def test_modules_are_imported_without_a_collector_and_are_no_garbage_later(capsys: pytest.CaptureFixture[str]) -> None:
    gc.enable()
    frozen = gc.get_freeze_count()
    with without_garbage():
        assert not gc.isenabled()
        __import__(RARE)
    assert capsys.readouterr().out.startswith("The Zen of Python")
    assert gc.isenabled()
    assert gc.get_freeze_count() > frozen


def test_where_nothing_is_imported_what_is_there_may_be_garbage() -> None:
    frozen = gc.get_freeze_count()
    kept = [[] for _ in range(10_000)]
    with without_garbage():
        pass
    assert len(kept) > gc.get_freeze_count() - frozen


@pytest.mark.parametrize("is_on", [False, True])
def test_the_collector_is_as_before_also_where_an_import_fails(is_on: bool) -> None:
    (gc.enable if is_on else gc.disable)()
    with pytest.raises(ModuleNotFoundError), without_garbage():
        __import__("gnd.there_is_none")
    assert gc.isenabled() == is_on
