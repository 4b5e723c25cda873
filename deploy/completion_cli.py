"""`gnd completion`: Tab completes commands, options and files in bash, zsh and fish."""

import os
from pathlib import Path
from typing import Final

import click
from click.shell_completion import get_completion_class

from gnd.deploy.errors import DeployError

PROGRAM: Final = "gnd"
VARIABLE: Final = "_GND_COMPLETE"
SHELLS: Final = ("bash", "zsh", "fish")


@click.command(short_help="Tab completion for bash, zsh and fish.")
@click.argument("shell", type=click.Choice(SHELLS))
@click.option("--install", is_flag=True, help="Write it where the shell looks for it, for this user.")
def completion(shell: str, *, install: bool) -> None:
    """Print the completion of SHELL, or install it for this user. It takes effect in the next shell.

    For one shell: eval "$(gnd completion bash)". One file is written; one of that name that is not ours stays.
    """
    source = completion_source(shell)
    if not install:
        click.echo(source)
        return
    path = installed_path(shell)
    try:
        if path.exists() and VARIABLE not in path.read_text(encoding="utf-8", errors="replace"):
            raise DeployError(
                f"{path} is there and not ours: move it away, or append what `gnd completion {shell}` prints"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source, encoding="utf-8")
    except OSError as error:
        raise DeployError(f"{path}: cannot write: {error.strerror}") from None
    click.echo(f"written: {path}; it takes effect in the next shell")
    if shell == "zsh":
        click.echo(f"next: if it does not, put fpath=({path.parent} $fpath) before compinit in ~/.zshrc")


def completion_source(shell: str) -> str:
    """The script that a shell reads."""
    from gnd.deploy.cli import gnd

    made = get_completion_class(shell)
    if made is None:
        raise DeployError(f"click has no completion for {shell}")
    return made(gnd, {}, PROGRAM, VARIABLE).source()


def installed_path(shell: str) -> Path:
    """Where a shell looks for the completions of a user: fish always, bash with bash-completion, zsh by its fpath."""
    home = Path.home()
    data = Path(os.environ.get("XDG_DATA_HOME") or home / ".local" / "share")
    config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    return {
        "bash": data / "bash-completion" / "completions" / PROGRAM,
        "zsh": data / "zsh" / "site-functions" / f"_{PROGRAM}",
        "fish": config / "fish" / "completions" / f"{PROGRAM}.fish",
    }[shell]
