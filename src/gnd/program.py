"""The command `gnd` as a process: Ctrl-C and SIGTERM are heeded before anything else is imported."""

from gnd.ending import catch_signals, run_program


def program() -> None:
    """Run the command line, and exit with its status."""
    catch_signals()
    from gnd.deploy.cli import main

    run_program(main)
