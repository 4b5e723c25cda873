"""Network namespaces: made and removed with `ip netns`, entered by a thread with setns(2).

A socket belongs to the namespace that its thread was in when it was made, and a thread inherits the namespace of the
thread that starts it.
"""

import ctypes
import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from gnd.deploy.errors import LabError

NETNS_FOLDER: Final = Path("/run/netns")
COMMAND_TIMEOUT_S: Final = 60.0
_CLONE_NEWNET: Final = 0x40000000  # linux/sched.h
_OWN: Final = Path("/proc/thread-self/ns/net")

_libc = ctypes.CDLL(None, use_errno=True)


def run_tool(*words: str, lines: str | None = None) -> str:
    """Run `ip`, `tc` or `ss` and return what it prints.

    Args:
        words: the command.
        lines: what it reads; None: nothing.

    Raises:
        LabError: the tool is missing, fails or hangs; with its own words.
    """
    try:
        done = subprocess.run(  # noqa: S603  (words of our own, no shell)
            words, input=lines, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S, check=False
        )
    except FileNotFoundError as error:
        raise LabError(f"{words[0]} is missing: install iproute2") from error
    except subprocess.TimeoutExpired as error:
        raise LabError(f"`{' '.join(words)}` did not end within {COMMAND_TIMEOUT_S:.0f} s") from error
    if done.returncode != 0:
        raise LabError(f"`{' '.join(words)}` failed with code {done.returncode}: {_one_line(done.stderr)}")
    return done.stdout


def _one_line(text: str) -> str:
    return "; ".join(line.strip() for line in text.splitlines() if line.strip())


def run_all(commands: Sequence[Sequence[str]]) -> None:
    """Run commands one after the other; raises `LabError` at the first that fails."""
    for words in commands:
        run_tool(*words)


def run_batch(namespace: str, commands: Sequence[Sequence[str]]) -> None:
    """Run commands of `ip` inside a namespace by one process; raises `LabError` at the first that fails."""
    run_tool("ip", "-n", namespace, "-batch", "-", lines="".join(" ".join(words) + "\n" for words in commands))


def namespaces() -> tuple[str, ...]:
    """Return the names of all named network namespaces, sorted."""
    return tuple(sorted(entry.name for entry in NETNS_FOLDER.iterdir())) if NETNS_FOLDER.is_dir() else ()


def add_namespace(name: str) -> None:
    """Make a network namespace with its loopback interface up and without IPv6, whose notices nobody asked for."""
    run_tool("ip", "netns", "add", name)
    with inside(name):
        for scope in ("all", "default"):
            _switch_off(Path(f"/proc/sys/net/ipv6/conf/{scope}/disable_ipv6"))
    run_tool("ip", "-n", name, "link", "set", "lo", "up")


def _switch_off(setting: Path) -> None:
    if setting.exists():  # a kernel without IPv6 has no such setting
        setting.write_text("1", encoding="ascii")


def remove_namespace(name: str) -> None:
    """Remove a namespace and so all its interfaces; it must exist."""
    run_tool("ip", "netns", "del", name)


def pids_in(name: str) -> tuple[int, ...]:
    """Return the processes whose main thread is in a namespace."""
    return tuple(int(word) for word in run_tool("ip", "netns", "pids", name).split())


def enter_namespace(name: str) -> None:
    """Move the calling thread, and the threads that it starts from now on, into a named namespace.

    Raises:
        LabError: there is none of that name, or this process lacks the right (root).
    """
    _enter(NETNS_FOLDER / name)


@contextmanager
def inside(name: str) -> Iterator[None]:
    """Move the calling thread into a namespace for the block."""
    home = os.open(_OWN, os.O_RDONLY | os.O_CLOEXEC)
    try:
        enter_namespace(name)
        try:
            yield
        finally:
            _set_namespace(home, "the namespace of before")
    finally:
        os.close(home)


def _enter(path: Path) -> None:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise LabError(f"cannot open the network namespace {path}: {error.strerror}") from error
    try:
        _set_namespace(descriptor, str(path))
    finally:
        os.close(descriptor)


def _set_namespace(descriptor: int, what: str) -> None:
    if _libc.setns(descriptor, _CLONE_NEWNET) != 0:  # os.setns exists from Python 3.12 on
        raise LabError(f"cannot enter {what}: {os.strerror(ctypes.get_errno())}")
