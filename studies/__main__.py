"""`python -m studies [NAME …] [--json]`: run the benchmarks and print their figures with their commands.

A benchmark with options of its own takes them when it is named alone: `python -m studies codec --help`.
"""

import argparse
import importlib
import sys
from collections.abc import Sequence
from types import ModuleType

from studies.figures import machine, print_figures

NAMES = (
    "detection",
    "segmentation",
    "localisation",
    "scan-to-scan",
    "clock",
    "first-pose",
    "health",
    "ingest",
    "short-reports",
    "sizes",
    "codec",
    "return-download",
    "gnss-noise",
    "poles",
    "features-merge",
    "merging",
    "slamcu-step",
    "map-build",
    "stalled",
    "outage",
)
WITH_OPTIONS = ("codec", "return-download", "gnss-noise", "poles", "slamcu-step", "short-reports")


def main() -> None:
    """Run the named benchmarks, or all."""
    name, *own = sys.argv[1:] or [""]
    if name in WITH_OPTIONS and not set(own) & set(NAMES):
        _run_alone(name, own)
    else:
        _run_many()


def _run_alone(name: str, arguments: Sequence[str]) -> None:
    """One benchmark with its own options."""
    module, as_json = _module(name), "--json" in arguments
    chosen = module.options([argument for argument in arguments if argument != "--json"])
    if not as_json:
        print(machine())
    command = " ".join(["python -m studies", name, *arguments])
    print_figures(name, command, module.run(chosen), as_json=as_json)


def _run_many() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one or more of {', '.join(NAMES)} (default: all)")
    parser.add_argument("--json", action="store_true", help="one JSON object a benchmark")
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(NAMES))
    if unknown:
        parser.error(f"unknown benchmark {', '.join(unknown)}; there are {', '.join(NAMES)}")
    if not options.json:
        print(machine())
    for name in options.names or NAMES:
        module = _module(name)
        print_figures(name, module.COMMAND, module.run(), as_json=options.json)


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"studies.{name.replace('-', '_')}")


if __name__ == "__main__":
    main()
