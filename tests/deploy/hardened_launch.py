"""Runs a command with what a systemd unit leaves it: `python hardened_launch.py UNIT FOLDER COMMAND …`, as root.

systemd itself is not needed: a mount namespace in which only FOLDER can be written, another user without capabilities,
and the unit's filter of system calls by libseccomp, from the lists that `systemd-analyze syscall-filter` prints.
"""

import ctypes
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

USER = 10001
_ALLOW, _EPERM = 0x7FFF0000, 0x00050000 | 1
_NO_RIGHTS = (f"--reuid={USER}", f"--regid={USER}", "--clear-groups", "--no-new-privs")
_NO_CAPABILITIES = ("--inh-caps=-all", "--bounding-set=-all")


def read_only(folder: Path) -> str:
    """A script that leaves only `folder` to be written, and runs its arguments.

    A Python in a home folder that is closed to others is laid under an open folder of the same name.
    """
    lines = ["set -e", "mount --make-rprivate /", f"mount --bind {folder} {folder}", f"mkdir -p {folder}/.hold"]
    for path in (Path(sys.base_prefix), Path(sys.prefix), Path(__file__).resolve().parents[2]):
        closed = [parent for parent in reversed(path.parents) if not parent.stat().st_mode & 0o001]
        if closed:
            lines += [f"mount --bind {path} {folder}/.hold", f"mount -t tmpfs -o mode=0755 none {closed[0]}"]
            lines += [f"mkdir -p {path}", f"mount --move {folder}/.hold {path}"]
    return "\n".join([*lines, "mount -o remount,bind,ro /", 'exec "$@"'])


@cache
def calls_of(name: str) -> frozenset[str]:
    """The system calls of one of systemd's groups, or the call itself."""
    if not name.startswith("@"):
        return frozenset([name])
    done = subprocess.run(["systemd-analyze", "syscall-filter", name], capture_output=True, text=True, check=True)
    lines = [line.strip() for line in done.stdout.splitlines()[1:]]
    return frozenset().union(*(calls_of(line) for line in lines if line and not line.startswith("#")))


def allowed_calls(unit: Path) -> frozenset[str]:
    """What the `SystemCallFilter` lines of a unit leave, in their order."""
    allowed: frozenset[str] = frozenset()
    for line in unit.read_text().splitlines():
        key, _, value = line.partition("=")
        if key == "SystemCallFilter":
            names = frozenset().union(*(calls_of(word) for word in value.removeprefix("~").split()))
            allowed = allowed - names if value.startswith("~") else allowed | names
    return allowed


def filter_calls(names: frozenset[str]) -> None:
    """From now on every other call of this process fails with EPERM."""
    seccomp = ctypes.CDLL("libseccomp.so.2", use_errno=True)
    seccomp.seccomp_init.restype = ctypes.c_void_p
    context = ctypes.c_void_p(seccomp.seccomp_init(_EPERM))
    for name in names:
        number = seccomp.seccomp_syscall_resolve_name(name.encode())
        if number >= 0:
            seccomp.seccomp_rule_add(context, _ALLOW, number, 0)
    if seccomp.seccomp_load(context) != 0:
        raise OSError(ctypes.get_errno(), "the filter of system calls was not taken")


def main() -> None:
    """Three steps in three lives of this program: namespace, user, filter."""
    step, *rest = sys.argv[1:]
    if step == "filter":
        names, command = frozenset(rest[0].split(",")), rest[1:]
        filter_calls(names | {"execve"})
        os.execvp(command[0], command)
    unit, folder, command = Path(step), rest[0], rest[1:]
    names = ",".join(sorted(allowed_calls(unit)))
    last = [sys.executable, __file__, "filter", names, *command]
    rights = ["setpriv", *_NO_RIGHTS, *_NO_CAPABILITIES]
    words = ["unshare", "-m", "sh", "-c", read_only(Path(folder)), "sh", *rights, *last]
    os.execvp(words[0], words)


if __name__ == "__main__":
    main()
