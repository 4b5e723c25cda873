"""Benchmarks: speed beside accuracy, each with the command that repeats it. Imported by nobody."""
