"""An acknowledged report survives a power cut: a file system that forgets all that was not synced shows it."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import apsw
import pytest
from store_helpers import EAGER, TILE, merge_once, report, report_id, tile_of_voxels

from gnd.tile_store.sqlite_store import SqliteStore


class SyncWatcher(apsw.VFS):
    """Passes all to the real file system, and copies each file of `watched` to `durable` whenever it is synced."""

    def __init__(self, watched: Path, durable: Path) -> None:
        self.watched, self.durable = watched, durable
        super().__init__("sync-watcher", base="unix", makedefault=True)

    def xOpen(self, name, flags):
        return _WatchedFile(self, name, flags)

    def xDelete(self, filename, syncdir):
        super().xDelete(filename, syncdir)
        if Path(filename).parent == self.watched:
            (self.durable / Path(filename).name).unlink(missing_ok=True)


class _WatchedFile(apsw.VFSFile):
    def __init__(self, vfs: SyncWatcher, name, flags) -> None:
        super().__init__("unix", name, flags)
        path = name.filename() if isinstance(name, apsw.URIFilename) else name
        self.path, self.vfs = Path(path or ""), vfs

    def xSync(self, flags):
        super().xSync(flags)
        if self.path.parent == self.vfs.watched:
            shutil.copyfile(self.path, self.vfs.durable / self.path.name)


@pytest.fixture
def durable(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "durable"
    folder.mkdir()
    watcher = SyncWatcher(tmp_path, folder)
    yield folder
    watcher.unregister()


def after_power_cut(durable: Path, tmp_path: Path) -> Path:
    """A copy of what the disk holds if the power goes now."""
    folder = tmp_path / f"cut-{len(list(tmp_path.iterdir()))}"
    shutil.copytree(durable, folder)
    return folder / "s.db"


def test_what_was_acknowledged_or_published_is_there_after_a_power_cut(durable: Path, tmp_path: Path) -> None:
    with SqliteStore(tmp_path / "s.db", EAGER) as store:
        for number in range(5):
            store.put_reports([report(number)])
            with SqliteStore(after_power_cut(durable, tmp_path)) as survivor:
                assert [row.report_id for row in survivor.reports()] == [report_id(n) for n in range(number + 1)]
                assert survivor.dirty_count() == 1
        store.put_tiles([tile_of_voxels(TILE, 1)])
        merge_once(store, 1, 2)
        with SqliteStore(after_power_cut(durable, tmp_path)) as survivor:
            assert [v.kind for v in survivor.history("ndt", TILE)] == ["base", "merged"]
            assert (survivor.dirty_count(), survivor.counts().waiting) == (0, 0)


@pytest.mark.parametrize(("synchronous", "expected"), [("off", 0), ("normal", 0), ("full", 5)])
def test_the_power_cut_is_real(durable: Path, tmp_path: Path, synchronous: str, expected: int) -> None:
    """The same cut loses what a weaker setting has not synced: the test above can fail."""
    SqliteStore(tmp_path / "s.db").close()
    with SqliteStore(tmp_path / "s.db", EAGER) as store:
        # Outside a transaction: the level cannot change inside one.
        store._writer._connection.pragma("synchronous", synchronous)
        store.put_reports([report(number) for number in range(5)])
        with SqliteStore(after_power_cut(durable, tmp_path)) as survivor:
            assert survivor.counts().reports == expected
