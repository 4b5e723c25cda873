"""The watch of `gnd bench agent`: each stage is charged for itself alone, also where a generator does the work."""

import time
from collections.abc import Iterator

import pytest

from gnd.deploy.bench.stopwatch import REST, Stopwatch
from gnd.deploy.errors import DeployError


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch):
    """CPU time that passes only where a test says so."""
    now = [0.0]
    monkeypatch.setattr(time, "thread_time", lambda: now[0])

    def work(seconds: float) -> None:
        now[0] += seconds

    return work


def test_a_stage_is_not_charged_for_what_it_calls(clock) -> None:
    class Inner:
        def step(self) -> int:
            clock(2.0)
            return 7

    class Outer:
        def push(self, inner: Inner) -> int:
            clock(1.0)
            found = inner.step()
            clock(0.5)
            return found

    stopwatch = Stopwatch()
    stopwatch.watch(Inner, "step", "inner")
    stopwatch.watch(Outer, "push", "outer")
    clock(0.25)
    assert Outer().push(Inner()) == 7
    stopwatch.lap()
    assert stopwatch.scans == [{REST: 0.25, "outer": 1.5, "inner": 2.0}]


def test_a_generator_is_charged_while_it_is_asked_and_its_user_in_between(clock) -> None:
    class Source:
        def items(self) -> Iterator[int]:
            for number in range(3):
                clock(1.0)
                yield number

    stopwatch = Stopwatch()
    stopwatch.watch(Source, "items", "reading")
    found = []
    for item in Source().items():
        clock(10.0)
        found.append(item)
    stopwatch.lap()
    clock(1.0)
    stopwatch.lap()
    assert found == [0, 1, 2]
    assert stopwatch.scans == [{"reading": 3.0, REST: 30.0}, {REST: 1.0}]


def test_an_error_leaves_the_stage(clock) -> None:
    class Broken:
        def push(self) -> None:
            clock(1.0)
            raise ValueError("no")

    stopwatch = Stopwatch()
    stopwatch.watch(Broken, "push", "broken")
    with pytest.raises(ValueError, match="no"):
        Broken().push()
    clock(2.0)
    stopwatch.lap()
    assert stopwatch.scans == [{"broken": 1.0, REST: 2.0}]


def test_a_method_that_is_not_there_is_named() -> None:
    class Empty:
        pass

    with pytest.raises(DeployError, match="Empty has no method push"):
        Stopwatch().watch(Empty, "push", "any")


def test_every_watched_method_exists_and_is_the_classes_own() -> None:
    from gnd.deploy.bench.vehicle_process import parts

    watched = parts()
    assert all(callable(owner.__dict__[method]) for owner, method, _ in watched)
    assert len({(owner, method) for owner, method, _ in watched}) == len(watched)
