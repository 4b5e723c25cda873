"""The command `gnd` as a process: Ctrl-C and SIGTERM are heeded before anything else is imported."""

import os

from gnd.ending import catch_signals, run_program


def one_thread_for_matrices() -> None:
    """Keep OpenBLAS to one thread, unless the environment says otherwise; before numpy is imported.

    Our matrices are small. A second thread waits in a loop for its share of them, and takes a core that is not there.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def program() -> None:
    """Run the command line, and exit with its status."""
    catch_signals()
    one_thread_for_matrices()
    from gnd.deploy.cli import main

    run_program(main)
