"""What is packed in the real recordings, unpacked once for all processes of a run of the suite."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from prepared import Prepared


@contextmanager
def unpacked_once(recordings: Path, prepared: Prepared) -> Iterator[None]:
    """Within, an xz file below `recordings` is unpacked when it is first read, and read from there after that.

    An import reads each scan some five times, and many tests import: xz is two thirds of their work. All else of an
    import is done each time, and files elsewhere, such as damaged copies, are unpacked as ever.
    """
    from gnd.vehicle_agent.importers import files  # not before the suite has chosen its kernels

    home, unpack = recordings.resolve(), files._unpacked

    def kept(path: Path, data: bytes) -> bytes:
        real = path.resolve()
        if not real.is_relative_to(home):
            return unpack(path, data)
        name = hashlib.sha256(str(real.relative_to(home)).encode()).hexdigest()
        return (prepared(f"unpacked-{name}", lambda folder: write(folder, unpack(path, data))) / "scan").read_bytes()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "_unpacked", kept)
        yield


def write(folder: Path, data: bytes) -> None:
    (folder / "scan").write_bytes(data)
