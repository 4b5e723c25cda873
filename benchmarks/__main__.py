"""`python -m benchmarks [NAME …] [--json]`: run the benchmarks and print their figures with their commands."""

import argparse
import importlib

from benchmarks.figures import machine, print_figures

NAMES = ("detection", "segmentation", "localisation", "scan-to-scan", "first-pose", "health", "ingest", "sizes")


def main() -> None:
    """Run the named benchmarks, or all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one or more of {', '.join(NAMES)} (default: all)")
    parser.add_argument("--json", action="store_true", help="one JSON object a benchmark")
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(NAMES))
    if unknown:
        parser.error(f"unknown benchmark {', '.join(unknown)}; there are {', '.join(NAMES)}")
    if not options.json:
        print(machine())
    for name in options.names or NAMES:
        module = importlib.import_module(f"benchmarks.{name.replace('-', '_')}")
        print_figures(name, module.COMMAND, module.run(), as_json=options.json)


if __name__ == "__main__":
    main()
