"""Kernels that were compiled ahead of time: a library of machine code that needs no numba, no LLVM and no compiler."""
