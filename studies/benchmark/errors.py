"""Errors of the benchmark; each is one line for the command line."""

from studies.frame.errors import ReproduceError


class BenchmarkError(ReproduceError):
    """A folder that holds another export, or none, or cannot be written."""
