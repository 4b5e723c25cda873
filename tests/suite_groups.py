"""Which tests run in one process, one after the other, where the suite runs in several, and which begin."""

import json
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

GROUPS_FILE = "groups_file"
_FOLDER = pytest.StashKey[Path]()

SLOW_S, QUICK_S = 10.0, 0.1
# A test that asks for more time than the others is one of the longest.
USUAL_PART_OF_TIMEOUT = 0.2


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Tell a worker where to write the groups: only workers collect tests, and only their parent deals them out."""
    if node.config.getoption("dist") == "loadscope":
        node.workerinput[GROUPS_FILE] = str(_file_of(node.config))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Deal out group by group. (`--dist loadgroup` of xdist 3.8 does not see its groups under pytest 9.)"""
    if config.getoption("dist") != "loadscope":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class ByGroup(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return _read(_file_of(config))[module_of(nodeid)]

    config.option.loadscopereorder = False  # they are in order already
    return ByGroup(config, log)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """In a worker: begin with the groups that take longest, and write down which module is in which."""
    told: dict[str, Any] = getattr(config, "workerinput", {})
    if GROUPS_FILE not in told:
        return
    groups = groups_of(items)
    items[:] = [item for group in groups for item in group.items]
    if told["workerid"] == "gw0":  # they all find the same
        named = {module_of(item.nodeid): group.name for group in groups for item in group.items}
        Path(told[GROUPS_FILE]).write_text(json.dumps(named), encoding="utf-8")


def _file_of(config: pytest.Config) -> Path:
    """The file of groups of this run, in a folder that goes with it."""
    if _FOLDER not in config.stash:
        folder = TemporaryDirectory(prefix="suite-groups-")
        config.add_cleanup(folder.cleanup)
        config.stash[_FOLDER] = Path(folder.name)
    return config.stash[_FOLDER] / "groups.json"


@cache
def _read(file: Path) -> dict[str, str]:
    named: dict[str, str] = json.loads(file.read_text(encoding="utf-8"))
    return named


def module_of(nodeid: str) -> str:
    """The module of a test by its name."""
    return nodeid.partition("::")[0]


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
        modules[module_of(item.nodeid)].append(item)
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
    """What a test shares with other modules: session fixtures of its folder, and what its marks name.

    What a session fixture gets from `prepared` is made once for all processes, and ties nobody.
    """
    assert isinstance(item, pytest.Function)
    of_folders = {
        f"{fixtures[-1].baseid}::{name}"
        for name, fixtures in item._fixtureinfo.name2fixturedefs.items()
        if fixtures[-1].scope == "session"
        and fixtures[-1].baseid not in ("", "tests")
        and "prepared" not in fixtures[-1].argnames
    }
    return of_folders | {str(mark.args[0]) for mark in item.iter_markers("xdist_group")}


def about_s(item: pytest.Item) -> float:
    """How long a test takes, roughly."""
    asks = item.get_closest_marker("timeout")
    if asks is not None and asks.args:
        return float(asks.args[0]) * USUAL_PART_OF_TIMEOUT
    return QUICK_S if item.get_closest_marker("slow") is None else SLOW_S
