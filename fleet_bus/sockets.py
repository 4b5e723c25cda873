"""Sockets of this process that zenoh opened: found by their addresses among its descriptors (Linux)."""

import contextlib
import os
import socket
import stat
from collections.abc import Collection, Container, Iterator
from pathlib import Path
from typing import Final

_FD_FOLDER: Final = Path("/proc/self/fd")
Ends = tuple[tuple[str, int], tuple[str, int]]
"""Own and other address of a connection."""


def address_of(locator: str) -> tuple[str, int]:
    """("::1", 7447) of "tcp/[::1]:7447#options"."""
    host, _, port = locator.partition("/")[2].partition("#")[0].rpartition(":")
    return host.strip("[]"), int(port)


def duplicate_of(source: str, destination: str) -> socket.socket | None:
    """A second descriptor of this process's socket between two locators; None where there is none."""
    wanted = address_of(source), address_of(destination)
    for end in _tcp_sockets():
        if ends_of(end) == wanted:
            return end
        end.close()
    return None


def cut(links: Container[Ends]) -> int:
    """Ends those connections, whatever still waits on them; how many there were."""
    found = 0
    for end in _tcp_sockets():
        with end:
            if ends_of(end) in links:
                found += 1
                with contextlib.suppress(OSError):  # ended already
                    end.shutdown(socket.SHUT_RDWR)
    return found


def stop_listening(ports: Container[int]) -> int:
    """Takes the listening sockets of these ports out of service, so that others may listen there; how many."""
    found = 0
    for end in _listening(ports):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
            found += 1
    return found


def is_listening(ports: Collection[int]) -> bool:
    """Whether this process listens at all of these ports."""
    return {end.getsockname()[1] for end in _listening(ports)} == set(ports)


def _listening(ports: Container[int]) -> Iterator[socket.socket]:
    for end in _tcp_sockets():
        with end, contextlib.suppress(OSError):
            if end.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) and end.getsockname()[1] in ports:
                yield end


def ends_of(end: socket.socket) -> Ends | None:
    """Own and other address; None where it is not connected."""
    try:
        own, peer = end.getsockname(), end.getpeername()
    except OSError:
        return None
    return (own[0], own[1]), (peer[0], peer[1])


def _tcp_sockets() -> Iterator[socket.socket]:
    """A second descriptor of each TCP socket; who takes one closes it."""
    try:
        descriptors = [int(entry.name) for entry in _FD_FOLDER.iterdir()]
    except OSError:  # not Linux, or no descriptor left
        return
    for descriptor in descriptors:
        end = _tcp_socket(descriptor)
        if end is not None:
            yield end


def _tcp_socket(descriptor: int) -> socket.socket | None:
    try:
        if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return None
        end = socket.socket(fileno=os.dup(descriptor))
    except OSError:  # closed meanwhile by the thread that owns it
        return None
    if end.family in (socket.AF_INET, socket.AF_INET6) and end.type == socket.SOCK_STREAM:
        return end
    end.close()
    return None
