"""A kernel that numba sees at its first call stands for its dispatcher in every way that kernels are used."""

import sys
import threading
import types

import numpy as np
import pytest

from gnd.gnd_map.jit import LazyKernel

SOURCE = """
import numpy as np
from gnd.gnd_map.jit import inlined, kernel, pasted

@pasted
def twice(x):
    return 2 * x

@inlined
def shifted(x, by):
    return x + by

@kernel
def total(values, by):
    \"\"\"Sum of all.\"\"\"
    result = 0.0
    for value in values:
        result += shifted(twice(value), by)
    return result

imported = total  # as another module holds it
"""


@pytest.fixture
def module(tmp_path, monkeypatch) -> types.ModuleType:
    (tmp_path / "kernels_of_the_test.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("kernels_of_the_test", None)
    import kernels_of_the_test  # type: ignore[import-not-found]

    yield kernels_of_the_test
    sys.modules.pop("kernels_of_the_test", None)


def test_it_computes_what_the_plain_function_does(module) -> None:
    values = np.arange(5.0)
    lazy = module.imported
    assert isinstance(lazy, LazyKernel)
    assert (lazy.__name__, lazy.__doc__) == ("total", "Sum of all.")
    assert lazy(values, 1.0) == lazy(values=values, by=1.0) == 25.0 == sum(2 * v + 1 for v in values)
    assert len(lazy.signatures) == 1
    assert lazy.py_func is lazy.dispatcher.py_func


def test_in_its_own_module_the_dispatcher_takes_its_place(module) -> None:
    assert isinstance(module.total, LazyKernel)
    module.total(np.ones(3), 0.0)
    assert module.total is module.imported.dispatcher


def test_threads_that_call_it_first_at_once_share_one(module) -> None:
    found, barrier = [], threading.Barrier(8)

    def call() -> None:
        barrier.wait()
        found.append((module.imported(np.ones(4), 0.5), id(module.imported.dispatcher)))

    threads = [threading.Thread(target=call) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert {value for value, _ in found} == {10.0}
    assert len({number for _, number in found}) == 1


def test_what_numba_does_not_have_is_no_attribute(module) -> None:
    with pytest.raises(AttributeError):
        _ = module.imported.nothing_of_the_kind
    assert not hasattr(module.imported, "__array_interface__")
