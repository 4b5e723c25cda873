"""A wheel that holds machine code says so in its name; all else about the build is in pyproject.toml."""

from pathlib import Path

from setuptools import Distribution, setup


class WithKernels(Distribution):
    """Is of one version of Python and one kind of machine where `gnd kernels build` has been run before."""

    def has_ext_modules(self) -> bool:
        """Whether there is a library of kernels."""
        return any((Path(__file__).parent / "src" / "gnd" / "ahead").glob("_kernels.*.so"))


setup(distclass=WithKernels)
