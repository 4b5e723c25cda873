"""Every input that was ever found, and seeded changes of good ones: refused by name or read, quickly, in little memory.

The long runs, guided by coverage, are `python tests/fuzz/run.py` (docs/fuzzing.md).
"""

import resource
import time
from pathlib import Path
from random import Random

import pytest
from fuzz_all import TARGETS
from fuzz_mutators import bytes_mutated
from fuzz_paths import CORPUS
from fuzz_target import FuzzTarget, Watch, peak_rss_bytes

MAX_CORPUS_BYTES = 2_000_000


def foreign(_data: bytes) -> object:
    return {}["no such key"]


def slow(_data: bytes) -> object:
    end_s = time.process_time() + 1.1
    while time.process_time() < end_s:
        pass
    return None


def greedy(_data: bytes) -> object:
    """More than the process ever had: what stays below an earlier peak is not seen."""
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    return bytearray(b"x") * (peak_rss_bytes() - resident + (300 << 20))


@pytest.mark.parametrize("name", TARGETS)
def test_hostile_input_is_refused_by_name(name: str) -> None:
    target = TARGETS[name]
    watch, rng = Watch(target), Random(name)
    good = list(target.seeds())
    kept = [path.read_bytes() for path in sorted((CORPUS / name).glob("*"))]
    for data in good:  # kernels and libraries load
        watch.call(data)
    assert watch.refused < watch.calls, "nothing good is read: changes of it would try nothing"
    found = [watch.call(data) for data in (*good, *kept)]
    found += [watch.call(target.mutate(rng.choice(good + kept), rng)) for _ in range(target.rounds)]
    assert [one for one in found if one is not None] == []


@pytest.mark.parametrize(("call", "kind"), [(foreign, "foreign"), (slow, "hang"), (greedy, "memory")])
def test_the_watch_sees_what_must_not_be(call, kind: str) -> None:
    found = Watch(FuzzTarget("bad", (), "", call, lambda: [b""], bytes_mutated)).call(b"")
    assert found is not None
    assert found.kind == kind


def test_the_corpus_is_small_and_each_folder_is_of_a_target() -> None:
    assert {path.name for path in CORPUS.iterdir()} <= set(TARGETS)
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < MAX_CORPUS_BYTES
