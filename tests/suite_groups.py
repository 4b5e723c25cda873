"""Which tests run in one process, one after the other, where the suite runs in several, and which begin."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import pytest

SLOW_S, QUICK_S = 10.0, 0.1
# A test that asks for more time than the others is one of the longest.
USUAL_PART_OF_TIMEOUT = 0.2


@dataclass(frozen=True)
class Group:
    """Tests that stay together.

    Attributes:
        name: the first module's.
        items: the tests, in the order in which they were collected.
        about_s: how long they take, guessed from their marks.
    """

    name: str
    items: tuple[pytest.Item, ...]
    about_s: float


def groups_of(items: Iterable[pytest.Item]) -> list[Group]:
    """The tests in groups, the longest first.

    A module stays together: its fixtures are made once. So do modules that share a session fixture of their folder (a
    world, a finished run), and those that carry the same mark `xdist_group`: they use one thing of the machine.
    """
    modules: defaultdict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        modules[item.nodeid.partition("::")[0]].append(item)
    together = Together(modules)
    first_with: dict[str, str] = {}
    for module, tests in modules.items():
        for shared in {name for item in tests for name in shared_by(item)}:
            together.join(first_with.setdefault(shared, module), module)
    members: defaultdict[str, list[pytest.Item]] = defaultdict(list)
    for module, tests in modules.items():
        members[together.name(module)] += tests
    groups = [Group(name, tuple(tests), sum(map(about_s, tests))) for name, tests in members.items()]
    return sorted(groups, key=lambda group: (-group.about_s, group.name))


class Together:
    """Names that are joined, each standing for the first of its group."""

    def __init__(self, names: Iterable[str]) -> None:
        self._first = {name: name for name in names}

    def name(self, one: str) -> str:
        """The name of the group of `one`."""
        while self._first[one] != one:
            one = self._first[one]
        return one

    def join(self, one: str, other: str) -> None:
        """Make one group of two."""
        first, second = sorted((self.name(one), self.name(other)))
        self._first[second] = first


def shared_by(item: pytest.Item) -> set[str]:
    """What a test shares with other modules: session fixtures of its folder, and what its marks name."""
    assert isinstance(item, pytest.Function)
    of_folders = {
        f"{fixtures[-1].baseid}::{name}"
        for name, fixtures in item._fixtureinfo.name2fixturedefs.items()
        if fixtures[-1].scope == "session" and fixtures[-1].baseid not in ("", "tests")
    }
    return of_folders | {str(mark.args[0]) for mark in item.iter_markers("xdist_group")}


def about_s(item: pytest.Item) -> float:
    """How long a test takes, roughly."""
    asks = item.get_closest_marker("timeout")
    if asks is not None and asks.args:
        return float(asks.args[0]) * USUAL_PART_OF_TIMEOUT
    return QUICK_S if item.get_closest_marker("slow") is None else SLOW_S
