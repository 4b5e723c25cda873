"""Errors of `gnd load`."""

from gnd.deploy.errors import DeployError


class LoadError(DeployError):
    """A load cannot be made: no drives to replay, or more streets than the Earth has room for."""
