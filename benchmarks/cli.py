"""`gnd reproduce`: the results of the papers, made again. Commands are imported when they are called."""

import importlib
from typing import Final

import click

_COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "simulation": (
        "benchmarks.simulation.command:simulation",
        "The GND paper's simulation: worlds, single drives, fleets.",
    ),
    "errors": ("benchmarks.simulation.errors_command:errors", "Which voxels of a simulation cost F1, and why."),
    "real": ("benchmarks.real.command:real", "Detection on recordings of real sensors, with objects inserted."),
}


class _LazyGroup(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002  (click's signature)
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002  (click's)
        if cmd_name not in _COMMANDS:
            return None
        module, attribute = _COMMANDS[cmd_name][0].split(":")
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002  (click's)
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in _COMMANDS.items()])


@click.group(cls=_LazyGroup)
def reproduce() -> None:
    """Reproduce the papers' results and set ours beside them."""
