"""What an import has found out so far, so that an interrupted one goes on where it was.

LiDAR odometry is the only stage whose work grows with the recording and is not cheap to do again (decision 135). Its
poses are kept beside the drive that is to be written, one record a scan, as they are found; the drive itself appears
under its name only when it is whole. A journal is of one set of input files (their lengths and times of change), one
set of choices and one version of the program; of anything else it is thrown away.
"""

import fcntl
import hashlib
import os
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.output import input_files

F64 = NDArray[np.float64]

_HEAD: Final = b"gnd import journal 1\n"
_RECORD: Final = struct.Struct("<qq16dI")
"""Number of the scan, time of the pose, T_first_vehicle by rows, CRC-32 of these."""
_PARTIAL: Final = re.compile(r"\.(\d+)\.partial$")


@dataclass(frozen=True, slots=True, eq=False)
class FoundPose:
    """T_first_vehicle (4, 4) of scan `number`, at the middle of its sweep."""

    number: int
    t_ns: int
    T: F64


class ImportJournal:
    """Poses that were found for the drive `out`; held by one process at a time.

    found: of an interrupted import of the same, in the order of the scans; empty: there was none.
    """

    def __init__(self, out: Path, key: bytes) -> None:
        """Take the journal of `out`, begin it anew where it is of another import.

        Raises:
            ImportDriveError: another process is importing to `out`, or the folder cannot be written.
        """
        self._path, self._out = journal_of(out), out
        try:
            self._file: IO[bytes] = os.fdopen(os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644), "r+b")
        except OSError as error:
            raise ImportDriveError(f"{self._path}: cannot be written: {error.strerror or error}") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.close()
            raise ImportDriveError(f"{out}: is being imported by another process") from error
        _sweep(out)
        data = self._file.read()
        head = _HEAD + key
        self.found = _poses(data[len(head) :]) if data.startswith(head) else []
        self._file.seek(0)
        self._file.write(head)
        self._file.seek(len(head) + _RECORD.size * len(self.found))
        self._file.truncate()
        self._file.flush()

    def add(self, pose: FoundPose) -> None:
        """Keep a pose; it is there for the next import even if this one is killed."""
        values = _RECORD.pack(pose.number, pose.t_ns, *pose.T.ravel().tolist(), 0)[:-4]
        self._file.write(values + struct.pack("<I", zlib.crc32(values)))
        self._file.flush()

    def close(self, *, keep: bool) -> None:
        """Let go of the journal; keep it for an import that goes on, where it holds anything."""
        keep = keep and self._file.seek(0, os.SEEK_END) > len(_HEAD) + hashlib.sha256().digest_size
        if not keep:
            self._path.unlink(missing_ok=True)
        self._file.close()


@contextmanager
def kept_on_interrupt(journal: ImportJournal) -> Iterator[ImportJournal]:
    """Hold a journal for an import: nothing is left of it where the import ended, with a drive or with a refusal."""
    try:
        yield journal
    except ImportDriveError:
        journal.close(keep=False)
        raise
    except BaseException:
        journal.close(keep=True)
        raise
    journal.close(keep=False)


def journal_of(out: Path) -> Path:
    """Where the journal of a drive lies."""
    return out.with_name(f".{out.name}.journal")


def key_of(kind: str, inputs: Sequence[Path], choices: Choices) -> bytes:
    """What poses depend on: the files that are read, the choices, the version of the program."""
    digest = hashlib.sha256(repr((version("gnd-fleet"), kind, choices)).encode())
    beside = [path for one in inputs if one.is_file() for path in one.parent.glob("*.json")]  # metadata of a capture
    for path in sorted(input_files((*inputs, *beside))):
        with suppress(OSError):  # a link to nowhere is no input
            held = path.stat()
            digest.update(repr((str(path.absolute()), held.st_size, held.st_mtime_ns)).encode())
    return digest.digest()


def kept_scans(out: Path) -> int:
    """How many poses an interrupted import of `out` has left."""
    with suppress(OSError):
        return max(0, journal_of(out).stat().st_size - len(_HEAD) - hashlib.sha256().digest_size) // _RECORD.size
    return 0


def _poses(data: bytes) -> list[FoundPose]:
    """Whole records, as far as they are whole: the last one may have been cut off."""
    found: list[FoundPose] = []
    for at in range(0, len(data) - _RECORD.size + 1, _RECORD.size):
        number, t_ns, *matrix, crc = _RECORD.unpack_from(data, at)
        if crc != zlib.crc32(data[at : at + _RECORD.size - 4]) or (found and number <= found[-1].number):
            break
        found.append(FoundPose(number, t_ns, np.array(matrix).reshape(4, 4)))
    return found


def _sweep(out: Path) -> None:
    """Remove what killed imports have left of the drive: files of processes that are no more."""
    for path in out.parent.glob(f".{out.name}.*.partial"):
        owner = _PARTIAL.search(path.name)
        if owner and not _runs(int(owner[1])):
            path.unlink(missing_ok=True)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
