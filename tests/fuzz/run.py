"""Coverage-guided fuzzing of one target, or of several after another:

    python tests/fuzz/run.py TARGET... [--runs 1000000] [--seconds 600] [--seed 1]
    python tests/fuzz/run.py --list

With atheris (libFuzzer) where it can be imported, else with the seeded mutators alone. What was found is written to
build/fuzz/TARGET/found, new inputs by outcome to build/fuzz/TARGET/corpus; `--keep` copies those into the corpus of the
tests. The last line says how many cases were tried, refused and found, as JSON.
"""

import argparse
import hashlib
import json
import operator
import os
import re
import resource
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, Final

from fuzz_paths import CORPUS, ROOT, add_paths

add_paths()

OUT: Final = ROOT / "build" / "fuzz"
ADDRESS_SPACE_BYTES: Final = 2 << 30
"""More than what the process has: who allocates more gets a MemoryError, which is a finding."""
LIBFUZZER_TIMEOUT_S: Final = 60
MAX_KEPT_BYTES: Final = 4096
MAX_KEPT: Final = 40
_TOLD: Final = frozenset((int, bool, str, bytes))
_COMPARISONS: Final = (operator.lt, operator.le, operator.eq, operator.ne, operator.gt, operator.ge)
"""By the argument of COMPARE_OP."""


def main() -> None:
    """See the module's head."""
    arguments = _arguments()
    if arguments.list:
        from fuzz_all import TARGETS

        print("\n".join(TARGETS))
        return
    _load()
    failed = False
    for name in arguments.targets:
        if os.fork() == 0:  # libFuzzer's loop never comes back, and loading takes ten times as long as a fork
            _fuzz(name, arguments)
        failed |= os.wait()[1] != 0
    sys.exit(int(failed))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*")
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=int, default=3600)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--list", action="store_true")
    return parser.parse_args()


class Session:
    """One run: counts, findings by place, inputs by outcome."""

    def __init__(self, name: str, runs: int, seconds: int, engine: str, *, keep: bool) -> None:
        from fuzz_all import TARGETS
        from fuzz_target import Watch

        self.target, self.runs, self.seconds, self.engine, self.keep = TARGETS[name], runs, seconds, engine, keep
        self.folder = OUT / name
        self.found: dict[str, str] = {}
        self.outcomes: dict[str, bytes] = {}
        for part in ("found", "corpus", "libfuzzer"):
            (self.folder / part).mkdir(parents=True, exist_ok=True)
        inputs = sorted((CORPUS / name).glob("*"))
        self.inputs = [*self.target.seeds(), *(path.read_bytes() for path in inputs)]
        warm = Watch(self.target)
        for data in self.inputs:  # kernels compile, libraries load
            warm.call(data)
        _limit_memory()
        self.watch = Watch(self.target)
        self.began_s = time.monotonic()

    def one(self, data: bytes) -> None:
        """Try one input."""
        found = self.watch.call(data)
        if found is not None:
            self._note(found.kind, found.where, data)
        else:
            before = self.outcomes.get(self.watch.outcome)
            if before is None or len(data) < len(before):
                self.outcomes[self.watch.outcome] = data
        if self.watch.calls >= self.runs or time.monotonic() - self.began_s > self.seconds:
            self.finish()

    def _note(self, kind: str, where: str, data: bytes) -> None:
        place = kind if kind != "foreign" else where.split(": ")[0]
        if place in self.found:
            return
        self.found[place] = where
        path = self.folder / "found" / f"{kind}-{_name(data)}"
        path.write_bytes(data)
        print(f"FOUND in {self.target.name}: {kind}: {where}\n  {path}", file=sys.stderr, flush=True)

    def finish(self) -> None:
        """Write what was found and leave the process, whatever libFuzzer still wants."""
        kept = sorted((data for data in self.outcomes.values() if len(data) <= MAX_KEPT_BYTES), key=len)[:MAX_KEPT]
        folders = [self.folder / "corpus", *([CORPUS / self.target.name] if self.keep else [])]
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
            for data in kept:
                (folder / _name(data)).write_bytes(data)
        said = self._said()
        with (OUT / "results.jsonl").open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(said) + "\n")
        print(json.dumps(said), flush=True)
        os._exit(1 if self.found else 0)

    def _said(self) -> dict[str, Any]:
        took_s = time.monotonic() - self.began_s
        return {
            "target": self.target.name,
            "engine": self.engine,
            "cases": self.watch.calls,
            "refused": self.watch.refused,
            "outcomes": len(self.outcomes),
            "seconds": round(took_s, 1),
            "longest_s": round(self.watch.longest_s, 3),
            "findings": sorted(self.found.values()),
        }


def _name(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def _limit_memory() -> None:
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (size + ADDRESS_SPACE_BYTES, hard))


def _kernel_modules() -> list[str]:
    """Modules that numba compiles: their functions stay as they are written."""
    found = []
    for folder in sorted((ROOT / "src" / "gnd").iterdir()):
        for path in folder.resolve().rglob("*.py") if folder.is_dir() else ():
            if re.search(r"gnd_map\.jit|numba", path.read_text(encoding="utf-8")):
                inner = path.relative_to(folder.resolve()).with_suffix("").parts
                found.append(".".join(("gnd", folder.name, *inner)).removesuffix(".__init__"))
    return found


def _load() -> None:
    """Every decoder, instrumented where atheris is there; once for all targets."""
    warnings.simplefilter("error")
    try:
        import atheris
    except ImportError:
        return
    with atheris.instrument_imports(include=["gnd", "studies", "mcap", "dpkt", "laspy"], exclude=_kernel_modules()):
        import fuzz_all  # noqa: F401  (brings every decoder)


def _comparing(native: Callable[..., Any]) -> Callable[..., Any]:
    """What instrumented code calls to compare. atheris 3.0.0 never gives back what a comparison results in: of arrays
    that is megabytes a case. Only numbers and texts tell libFuzzer anything; all else is compared as ever.
    """

    def compare(left: Any, right: Any, operation: int, counter: int, is_constant: bool) -> Any:
        if type(left) in _TOLD and type(right) in _TOLD:
            return native(left, right, operation, counter, is_constant)
        return _COMPARISONS[operation](left, right)

    return compare


def _fuzz(name: str, arguments: argparse.Namespace) -> None:
    try:
        import atheris
    except ImportError:
        _without_atheris(name, arguments)
        return
    session = Session(name, arguments.runs, arguments.seconds, "atheris", keep=arguments.keep)
    mutate = session.target.mutate

    def custom(data: bytes, max_size: int, seed: int) -> bytes:
        rng = Random(seed)
        if not data or rng.randrange(24) == 0:
            data = rng.choice(session.inputs)
        try:
            found = mutate(data, rng) if rng.randrange(3) else atheris.Mutate(data, max_size)
        except MemoryError:  # the mutator's own: a bomb that it unpacked
            found = rng.choice(session.inputs)
        return bytes(found[:max_size])

    def one(data: bytes) -> None:
        if session.watch.calls == 0:  # `Fuzz` sets what instrumented code calls when it begins
            atheris._trace_cmp = _comparing(atheris._trace_cmp)
        session.one(data)

    start = session.folder / "libfuzzer"
    for data in session.inputs:
        (start / _name(data)).write_bytes(data)
    longest = max(4096, 2 * max(map(len, session.inputs)))
    options = [f"-seed={arguments.seed}", f"-max_len={longest}", f"-timeout={LIBFUZZER_TIMEOUT_S}", "-verbosity=0",
               "-rss_limit_mb=0", f"-artifact_prefix={session.folder}/found/"]  # fmt: skip
    atheris.Setup([sys.argv[0], *options, str(start)], one, custom_mutator=custom)
    atheris.Fuzz()


def _without_atheris(name: str, arguments: argparse.Namespace) -> None:
    session = Session(name, arguments.runs, arguments.seconds, "seeded mutators", keep=arguments.keep)
    rng, pool = Random(arguments.seed), list(session.inputs)
    while True:
        data = session.target.mutate(rng.choice(pool), rng)
        known = len(session.outcomes)
        session.one(data)
        if len(session.outcomes) > known:
            pool.append(data)


if __name__ == "__main__":
    main()
