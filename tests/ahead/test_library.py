"""A library of kernels that was compiled ahead of time computes what numba does, or is not used."""

import importlib
import json
import os
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from suite_kernels import LIBRARY

from gnd.ahead import build as building
from gnd.ahead.build import build_environment
from gnd.ahead.library import KernelLibrary, UnfitLibrary, _type_of, file_name, library_path, load, sealed
from gnd.gnd_map.jit import kernel_of

LIMITS = "FACTOR = 2.0\n"
KERNELS = """
from typing import NamedTuple
import numpy as np
import ahead_limits
from gnd.gnd_map.jit import bare_inlined, kernel, pasted

TABLE = np.array([1, 2, 3])
OFFSET = 0.1

class Grid(NamedTuple):
    step: float
    rows: int

class Span(NamedTuple):
    begin: float
    end: float

@kernel
def length(span):
    return span.end - span.begin

@pasted
def doubled(x):
    return ahead_limits.FACTOR * x

@bare_inlined
def shifted(x):
    return doubled(x) + OFFSET

@kernel
def total(values, grid, first):
    result = 0.0
    for value in values[first:]:
        result += np.sin(shifted(value) / grid.step) * TABLE[grid.rows] + values[0] * value
    if result > 1e6:
        raise ValueError("too much")
    return result, values * 3.0, Grid(result, first)

@kernel
def fill(out, by, pair):
    for k in range(len(out)):
        out[k] += by * pair[0]

@kernel
def spin(steps):
    x = 0.5
    for _ in range(steps):
        x = 3.9 * x * (1.0 - x)
    return x
"""
SCENE = """
import numpy as np
from ahead_kernels import Grid, Span, fill, length, spin, total

def warm_up():
    total(np.linspace(0.1, 1.7, 50), Grid(0.3, 2), 1)
    total(values=np.linspace(0.1, 1.7, 9)[::2], grid=Grid(0.3, 2), first=0)
    fill(np.zeros(4, np.float32), 2.5, (np.float32(3.0), True))
    fill(np.zeros((3, 4), order="F")[0], 2.5, (4, False))
    spin(10)
    length(Span(1.0, 3.0))
"""


def write_sources(folder: Path) -> None:
    for name, text in (("ahead_limits", LIMITS), ("ahead_kernels", KERNELS), ("ahead_scene", SCENE)):
        (folder / f"{name}.py").write_text(text)


def run(folder: Path, *command: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path]), **variables}
    return subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sources of kernels, and the library that was made of them."""
    made = tmp_path_factory.mktemp("ahead")
    write_sources(made)
    done = run(made, "-m", "gnd.ahead.build", str(made / "k.so"), "ahead_scene", **build_environment(made / "cache"))
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["kernels"], told["entries"], told["left_out"]) == (4, 6, {})
    return made


@pytest.fixture(scope="module")
def library(folder: Path) -> KernelLibrary:
    return load(folder / "k.so")


@pytest.fixture
def kernels(folder: Path, monkeypatch: pytest.MonkeyPatch):
    """The module of kernels, as a process that has just started finds it."""
    monkeypatch.syspath_prepend(folder)
    for name in ("ahead_kernels", "ahead_limits", "ahead_scene"):
        sys.modules.pop(name, None)
    return importlib.import_module("ahead_kernels")


PROGRAM = """
import json, logging, sys
logging.basicConfig(level="WARNING", format="%(message)s")
import ahead_scene, ahead_kernels as k
import numpy as np
ahead_scene.warm_up()
without, made_by = "numba" not in sys.modules, k.total.made_by if hasattr(k.total, "made_by") else "numba"
try:
    k.total(np.full(9, 1e9), k.Grid(1.0, 0), 0)
except ValueError as error:
    message = str(error)
found = k.total(np.arange(7.0), k.Grid(0.7, 1), 2)
print(json.dumps([found[0].hex(), found[1].tolist(), type(found[2]).__name__, message, without, made_by]))
"""


@pytest.mark.slow
def test_programs_need_no_numba_and_compute_the_same(folder: Path) -> None:
    ahead = run(folder, "-c", PROGRAM, GND_KERNELS=str(folder / "k.so"))
    numba = run(folder, "-c", PROGRAM, GND_KERNELS="numba", NUMBA_CACHE_DIR=str(folder / "own"))
    assert ahead.returncode == numba.returncode == 0, ahead.stderr + numba.stderr
    ours, theirs = json.loads(ahead.stdout), json.loads(numba.stdout)
    assert ours[:4] == theirs[:4] == [ours[0], [3.0 * k for k in range(7)], "Grid", "too much"]
    assert (ours[4:], theirs[4:]) == ([True, "ahead"], [False, "numba"])
    assert ahead.stderr == ""

    other = (folder / "k.so").read_bytes()
    (folder / "damaged.so").write_bytes(other[:-1000])
    refused = run(folder, "-c", PROGRAM, GND_KERNELS=str(folder / "damaged.so"), NUMBA_CACHE_DIR=str(folder / "own"))
    assert json.loads(refused.stdout) == theirs
    assert refused.stderr.count("kernels are compiled by numba") == 1
    assert f"damaged: its {len(other) - 1000} bytes do not end with their digest" in refused.stderr


def test_other_types_are_left_to_numba_and_numbas_rules_hold(library: KernelLibrary, kernels) -> None:
    ahead = library.compiled(kernels.fill)
    kernels.fill._ahead = ahead
    pair = (np.float32(3.0), True)

    def called(*arguments: object, **named: object) -> int:
        before = sum(ahead.calls_ahead.values())
        ahead(*arguments, **named)
        return sum(ahead.calls_ahead.values()) - before

    out = np.zeros(4, np.float32)
    assert called(out, 2.5, pair) == called(pair=(np.float32(3.0), np.True_), by=2.5, out=out) == 1
    assert out.tolist() == [15.0] * 4
    assert called(np.zeros((4, 2))[:, 0], np.float64(2.5), (np.int64(4), False)) == 1
    for others in (
        (np.zeros(4, np.float32), 2, pair),
        (np.zeros(8, np.float32)[::2], 2.5, pair),
        (np.zeros(4), 2.5, pair),
        (np.zeros(4, np.float32), 2.5, (3.0, True)),
        (np.zeros((3, 4), order="F")[0], 2.5, (np.int32(4), False)),
    ):
        assert called(*others) == 0
        assert set(others[0].tolist()) == {others[1] * others[2][0]}
    with pytest.raises(TypeError):
        ahead(out)
    constant = np.zeros(4, np.float32)
    constant.flags.writeable = False
    with pytest.raises(Exception, match=r"readonly array|Cannot modify"):
        ahead(constant, 2.5, pair)
    assert not constant.any()


def test_python_goes_on_while_a_kernel_runs(library: KernelLibrary, kernels) -> None:
    spin, counted, ended = library.compiled(kernels.spin), [0], threading.Event()

    def count() -> None:
        while not ended.wait(0.001):
            counted[0] += 1

    other = threading.Thread(target=count)
    other.start()
    steps, took_s = 1_000_000, 0.0
    while took_s < 0.3:
        before, begun_s = counted[0], time.monotonic()
        spin(steps)
        took_s, during = time.monotonic() - begun_s, counted[0] - before
        steps *= 3
    ended.set()
    other.join()
    assert during > 5


def test_what_is_damaged_or_made_for_others_is_refused(folder: Path, tmp_path: Path) -> None:
    good = (folder / "k.so").read_bytes()
    code = good[: good.rindex(b"gnd-kernels-1 ")]
    soabi = file_name().split(".")[1].encode()
    bad = {
        "empty": b"",
        "text": b"not a library\n" * 100,
        "truncated": good[: len(good) // 2],
        "flipped": good[:5000] + bytes([good[5000] ^ 1]) + good[5001:],
        "longer": good + b"\n",
        "no machine code": sealed(b"not an object file" * 50),
        "made for python": sealed(code.replace(b'"python":"' + soabi, b'"python":"x' + soabi[1:])),
        "made for system": sealed(code.replace(b'"system":"Linux"', b'"system":"Minix"')),
    }
    for name, content in bad.items():
        path = tmp_path / f"{name}.so"
        path.write_bytes(content)
        with pytest.raises(UnfitLibrary, match=r"damaged|not a library of kernels|made for") as refused:
            load(path)
        assert str(path) in str(refused.value)
    with pytest.raises(UnfitLibrary, match="cannot be read"):
        load(tmp_path / "absent.so")


def test_a_processor_that_has_less_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gnd.ahead import library as loading

    told = {"environment": loading.environment(), "cpu": "x86-64-v3"}
    loading._check_fits(folder, told, runs_here=True)
    with pytest.raises(UnfitLibrary, match="made for processors of x86-64-v3, which this one is not"):
        loading._check_fits(folder, told, runs_here=False)
    monkeypatch.setenv("GND_KERNELS", "numba")
    assert library_path() is None


CHANGES = {
    "the kernel": ("ahead_kernels", "+ values[0] * value", "- values[0] * value", {"total"}),
    "a kernel in it": ("ahead_kernels", "doubled(x) + OFFSET", "doubled(x) - OFFSET", {"total"}),
    "a part that is pasted": ("ahead_kernels", "FACTOR * x", "FACTOR * x * x", {"total"}),
    "how it is compiled": ("ahead_kernels", "@kernel\ndef fill", "@bare_inlined\ndef fill", {"fill"}),
    "a constant": ("ahead_kernels", "OFFSET = 0.1", "OFFSET = 0.2", {"total"}),
    "a table": ("ahead_kernels", "[1, 2, 3]", "[1, 2, 4]", {"total"}),
    "a constant elsewhere": ("ahead_limits", "2.0", "2.5", {"total"}),
    "fields of an argument": ("ahead_kernels", "rows: int", "lines: int", {"total"}),
    "the order of fields": (
        "ahead_kernels",
        "begin: float\n    end: float",
        "end: float\n    begin: float",
        {"length"},
    ),
    "the name of a type": ("ahead_kernels", "class Span", "class Length", {"length"}),
    "a comment": ("ahead_kernels", "@pasted", "# said\n\n@pasted", set()),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_kernel_whose_source_has_changed_is_left_to_numba(
    library: KernelLibrary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    name, old, new, changed = CHANGES[what]
    write_sources(tmp_path)
    source = (tmp_path / f"{name}.py").read_text()
    assert source.count(old) == 1
    (tmp_path / f"{name}.py").write_text(source.replace(old, new))
    monkeypatch.syspath_prepend(tmp_path)
    for one in ("ahead_kernels", "ahead_limits"):
        sys.modules.pop(one, None)
    _type_of.cache_clear()  # a program does not see its sources change
    edited = importlib.import_module("ahead_kernels")
    names = ("total", "fill", "spin", "length")
    assert {one for one in names if not library.is_valid_for(getattr(edited, one))} == changed
    assert {one for one in names if library.compiled(getattr(edited, one)) is None} == changed


def test_without_a_compiler_nothing_is_written_and_one_line_says_so(folder: Path, tmp_path: Path) -> None:
    for variables in ({"CC": "/nowhere/cc"}, {"CXX": "/nowhere/c++ -O2"}):
        out = tmp_path / "k.so"
        done = run(folder, "-m", "gnd.deploy.cli", "kernels", "build", "--out", str(out), **variables)
        ((variable, word),) = variables.items()
        line = f"gnd: no library of kernels was built: no compiler: {word} does not run ({variable}); numba is used\n"
        assert (done.returncode, done.stdout, done.stderr) == (2, "", line)
        assert not out.exists()


def test_a_compiler_without_headers_is_told_before_anything_is_compiled(folder: Path, tmp_path: Path) -> None:
    for variable, words in (("CC", "cc -nostdinc"), ("CXX", "c++ -nostdinc")):
        out = tmp_path / "k.so"
        done = run(folder, "-m", "gnd.deploy.cli", "kernels", "build", "--out", str(out), **{variable: words})
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith(f"gnd: no library of kernels was built: {words} builds no extension of Python: ")
        assert done.stderr.count("\n") == 1
        assert not out.exists()


@pytest.mark.slow
def test_every_kernel_in_a_library_here_agrees_with_numba_to_the_bit() -> None:
    """The one that the suite's programs run, or else that of this installation."""
    path = next(filter(Path.is_file, (LIBRARY, Path(building.__file__).parent / file_name())), None)
    if path is None:
        pytest.skip("no library here: make kernels")
    done = run(path.parent, "-m", "gnd.deploy.cli", "kernels", "check", "--json", GND_KERNELS=str(path))
    told = json.loads(done.stdout)
    assert (done.returncode, told["unequal"]) == (0, [])
    assert len(told["kernels"]) > 50


@pytest.mark.slow
def test_a_comparison_finds_one_bit(folder: Path) -> None:
    program = textwrap.dedent(
        """
        import sys, json
        from dataclasses import asdict
        from pathlib import Path
        from gnd.ahead import check, library
        import ahead_kernels, numpy as np
        made = library.load(Path(sys.argv[1]))
        if sys.argv[2] == "b":
            true = library.KernelLibrary.compiled
            def other(self, kernel):
                right = true(self, kernel)
                class Wrong:
                    calls_ahead = {0: 1}
                    def __call__(self, *arguments):
                        found = right(*arguments)
                        return np.nextafter(found, 1.0) if isinstance(found, float) else found
                return Wrong()
            library.KernelLibrary.compiled = other
        print(json.dumps(asdict(check.check(made, ["ahead_scene"]))))
        """
    )
    right, wrong = (run(folder, "-c", program, str(folder / "k.so"), kind, GND_KERNELS="numba") for kind in "ab")
    compared = {"ahead_kernels:total": 2, "ahead_kernels:fill": 2, "ahead_kernels:spin": 1, "ahead_kernels:length": 1}
    told = json.loads(right.stdout)
    assert (told["kernels"], told["unequal"], told["by_numba"]) == (compared, [], []), right.stderr
    assert set(told["times_us"]) == set(compared)
    assert json.loads(wrong.stdout)["unequal"] == ["ahead_kernels:spin", "ahead_kernels:length"], wrong.stderr


def test_a_kernel_stands_for_itself_in_every_way(library: KernelLibrary, kernels) -> None:
    lazy = kernels.total
    ahead = library.compiled(lazy)
    assert (ahead.__name__, ahead.py_func, ahead.plain) == ("total", lazy.plain, lazy.plain)
    assert kernel_of(ahead.plain) is lazy
    assert not hasattr(ahead, "__array_interface__")
