"""TCP ports for the router of a run."""

import socket

from gnd.deploy.errors import DeployError


def claim_port(port: int) -> int:
    """Return a loopback port that nobody listens on.

    Args:
        port: the wanted port, or 0 for any free one.

    Raises:
        DeployError: the port is taken.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise DeployError(f"port {port} is taken ({error.strerror}): choose another with --port, or 0") from error
        return int(probe.getsockname()[1])
