"""The stopwatch of the benchmarks: who is timed, what counts for whom, and that nothing stays behind."""

from types import SimpleNamespace

import pytest

from studies.frame.measure import Stopwatch


def busy(n):
    return sum(i * i for i in range(n))


def test_time_inside_counts_for_the_inner_call_only():
    owner = SimpleNamespace(inner=lambda: busy(300_000))
    owner.outer = lambda: owner.inner()
    watch, before = Stopwatch(), (owner.inner, owner.outer)
    with watch.worn([("in", owner, "inner"), ("out", owner, "outer")]):
        assert owner.outer() == busy(300_000)
    assert watch.total_s["in"] > 5 * watch.total_s["out"]
    assert (owner.inner, owner.outer) == before


def test_what_raises_is_timed_and_put_back():
    owner = SimpleNamespace(fails=lambda: 1 / 0)
    watch, before = Stopwatch(), owner.fails
    with pytest.raises(ZeroDivisionError), watch.worn([("f", owner, "fails")]):
        owner.fails()
    assert owner.fails is before
    assert "f" in watch.total_s


def test_parts_of_one_name_add_up():
    owner = SimpleNamespace(a=lambda: busy(1000), b=lambda: busy(1000))
    watch = Stopwatch()
    with watch.worn([("x", owner, "a"), ("x", owner, "b")]):
        owner.a()
        once = watch.total_s["x"]
        owner.b()
    assert watch.total_s["x"] >= once
    assert list(watch.total_s) == ["x"]
