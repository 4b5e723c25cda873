"""Bytes of a store's file, found and overwritten by a process that has nothing else to do with the store.

Whoever opens and closes a file that SQLite has open in the same process loses SQLite's locks on it.

    python -m gnd.deploy.chaos.page find PATH < BODY     offset of 64 of these bytes, -1: there is no place
    python -m gnd.deploy.chaos.page write PATH AT HEX    what was there, as hex
"""

import mmap
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

PAGE_BYTES: Final = 4_096
_NEXT_BYTES: Final = 4
SAMPLE_BYTES: Final = 64


def find(path: Path, body: bytes) -> int | None:
    """Offset of `SAMPLE_BYTES` of a long body that lie in a page of their own; None: there is none, or only in the log.

    Such a page is written once: nothing else ever comes to lie there while the version is kept.
    """
    found = int(_run("find", path, stdin=body))
    return None if found < 0 else found


def write(path: Path, at: int, new: bytes) -> bytes:
    """Other bytes into the file; gives those that were there."""
    return bytes.fromhex(_run("write", path, str(at), new.hex()))


def _run(what: str, path: Path, *arguments: str, stdin: bytes = b"") -> str:
    command = [sys.executable, "-m", __name__, what, str(path), *arguments]
    return subprocess.run(  # noqa: S603 - of its own session: Ctrl-C must not leave a page as it is
        command, input=stdin, capture_output=True, check=True, start_new_session=True
    ).stdout.decode()


def _find(path: Path, body: bytes) -> int:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
        for part in range(PAGE_BYTES // 2, len(body) - SAMPLE_BYTES, PAGE_BYTES // 2):
            at = raw.find(body[part : part + SAMPLE_BYTES]) // PAGE_BYTES * PAGE_BYTES
            # A page of a chain is the number of the next page and then nothing but the body.
            begin = at + _NEXT_BYTES
            if at > 0 and raw[begin : begin + SAMPLE_BYTES] in body:
                return begin
    return -1


def _write(path: Path, at: int, new: bytes) -> bytes:
    descriptor = os.open(path, os.O_RDWR)
    try:
        was = os.pread(descriptor, len(new), at)
        os.pwrite(descriptor, new, at)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    return was


def main() -> None:
    """One of the two."""
    what, path, *rest = sys.argv[1:]
    if what == "find":
        print(_find(Path(path), sys.stdin.buffer.read()))
    else:
        at, new = rest
        print(_write(Path(path), int(at), bytes.fromhex(new)).hex())


if __name__ == "__main__":
    main()
