"""Copies of a store: consistent while it is in use, read again after copying, and never over an existing file."""

import os
from pathlib import Path
from typing import Final

import apsw

from gnd.tile_store.check import Checked, Progress, require_whole, silent
from gnd.tile_store.errors import StoreError, StoreUnavailable
from gnd.tile_store.migrations import SCHEMA_VERSION, schema_of
from gnd.tile_store.sqlite_connection import SQL, as_store_error, open_reader

PAGES_A_STEP: Final = 2048
LOGS: Final = ("-wal", "-shm", "-journal")


def copy_store(source: Path, target: Path, progress: Progress = silent) -> Checked:
    """Copy a store as it is at one instant, and check every version and report of the copy against its hash.

    The copy is one file without a log. Leases and signs of life stay behind: they are of this machine and hour.

    Args:
        source: the store; it may be in use.
        target: appears whole or not at all; its folder must exist.
        progress: is told of the steps "copy", "pages", "tiles" and "reports".

    Raises:
        StoreError: the target exists, the copy is damaged (so the source is), or it cannot be written.
    """
    _refuse_existing(target)
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        _copy(source, partial, progress)
        checked = require_whole(partial, progress)
        _sync(partial)
        _name(partial, target)
    finally:
        for suffix in ("", *LOGS):
            partial.with_name(partial.name + suffix).unlink(missing_ok=True)
    return checked


def _refuse_existing(target: Path) -> None:
    """A log that a removed store has left would be taken for the copy's."""
    for one in (target, *(target.with_name(target.name + suffix) for suffix in LOGS)):
        if one.exists():
            raise StoreError(f"{one}: exists; nothing is overwritten, move it away or choose another path")
    if not target.parent.is_dir():
        raise StoreError(f"{target}: the folder {target.parent} does not exist")


def _copy(source: Path, partial: Path, progress: Progress) -> None:
    reader = open_reader(source)
    try:
        if not schema_of(reader, source):
            raise StoreUnavailable(f"{source}: empty, not a tile store")
        reader.execute("BEGIN")
        reader.execute("SELECT 1 FROM sqlite_schema").fetchall()  # from here on it reads the store of this instant
        copy = apsw.Connection(str(partial))
        try:
            with copy.backup("main", reader, "main") as steps:
                while not steps.done:
                    steps.step(PAGES_A_STEP)
                    progress("copy", steps.page_count - steps.remaining, steps.page_count)
            copy.pragma("journal_mode", "delete")  # one file that can be read where nothing can be written
            if schema_of(copy, partial) == SCHEMA_VERSION:
                copy.execute(f"BEGIN; {SQL['end_of_a_copy']}; COMMIT")
        finally:
            copy.close()
    except apsw.Error as error:
        raise as_store_error(error, partial if isinstance(error, apsw.FullError) else source) from None
    finally:
        reader.close()


def _sync(path: Path) -> None:
    for one, flags in ((path, os.O_RDONLY), (path.parent, os.O_RDONLY | os.O_DIRECTORY)):
        descriptor = os.open(one, flags)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _name(partial: Path, target: Path) -> None:
    try:
        os.link(partial, target)  # unlike a rename it fails when somebody was faster
    except FileExistsError:
        raise StoreError(f"{target}: exists; nothing is overwritten") from None
    except OSError:  # file systems without links
        _refuse_existing(target)
        partial.rename(target)
    _sync(target)
