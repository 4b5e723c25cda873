"""`python -m studies [NAME …] [--json]`: run the benchmarks and print their figures with their commands.

A benchmark with options of its own takes them when it is named alone: `python -m studies poles --help`.
"""

import importlib
import sys
from typing import Any, Final

import click

from studies.frame.measure import machine, print_figures
from studies.frame.options import click_options, options_of

NAMES: Final = (
    "ingest",
    "poles",
    "stalled",
    "outage",
    "router-loss",
    "district-move",
    "shares",
    "flooder",
    "herd",
    "dearest",
    "signatures",
    "identity-bytes",
    "many-tiles",
    "endings",
    "page",
)


def main() -> None:
    """Run the named benchmarks, or all."""
    names = [word for word in sys.argv[1:] if word in NAMES]
    if len(names) == 1 and sys.argv[1] == names[0]:
        alone(names[0]).main(sys.argv[2:], prog_name=f"python -m studies {names[0]}")
    one_of_many().main(prog_name="python -m studies")


def one_of_many() -> click.Command:
    """The command that runs several benchmarks with their usual options."""

    @click.command(help=__doc__, epilog=f"Benchmarks: {', '.join(NAMES)}.")
    @click.argument("names", nargs=-1, type=click.Choice(NAMES), metavar="[NAME]…")
    @click.option("--json", "as_json", is_flag=True, help="One JSON object a benchmark.")
    def run(names: tuple[str, ...], *, as_json: bool) -> None:
        for name in names or NAMES:
            _run(name, as_json, {})

    return run


def alone(name: str) -> click.Command:
    """The command that runs one benchmark with options of its own: those of its `OPTIONS`, where it has any."""
    module = importlib.import_module(f"studies.{name.replace('-', '_')}")
    flag = click.Option(["--json", "as_json"], is_flag=True, help="One JSON object.")
    own = click_options(module.OPTIONS) if hasattr(module, "OPTIONS") else []

    def run(*, as_json: bool, **given: Any) -> None:
        _run(name, as_json, given)

    return click.Command(name, callback=run, params=[*own, flag], help=module.__doc__)


def _run(name: str, as_json: bool, given: dict[str, Any]) -> None:
    module = importlib.import_module(f"studies.{name.replace('-', '_')}")
    figures = module.run(options_of(module.OPTIONS, given)) if given else module.run()
    if not as_json:
        print(machine())
    command = " ".join(["python -m studies", *sys.argv[1:]]) if given else f"python -m studies {name}"
    print_figures(name, command, figures, as_json=as_json)


if __name__ == "__main__":
    main()
