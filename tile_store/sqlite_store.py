"""The store in one SQLite file that several processes of a machine may open (WAL, every commit synced)."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from hashlib import sha256
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeVar

import apsw

from gnd_map.content import AnyTile
from gnd_map.features import is_feature_layer
from gnd_map.tile_id import TileId
from schemas.tiles import CatalogEntry
from tile_store import sqlite_accounts as accounts
from tile_store import sqlite_confirmation as confirmation
from tile_store import sqlite_inbox as inbox
from tile_store import sqlite_journal as journal
from tile_store import sqlite_refuted as refuted
from tile_store import sqlite_uploads as uploads
from tile_store import sqlite_versions as versions
from tile_store.errors import StoreError, UnknownVersion
from tile_store.provenance import Provenance, decode_provenance
from tile_store.regions import morton_range
from tile_store.sqlite_connection import ReaderPool, change, fetch, open_writer
from tile_store.uploads import FirstHalf, Settled, Upload, UploadClaim, UploadCounts, UploadStatus
from tile_store.values import (
    DEFAULT_LAYER,
    Basis,
    Claim,
    Content,
    DirtyTile,
    GcResult,
    Notice,
    Publication,
    PublishResult,
    PutStatus,
    Quarantined,
    ReportRow,
    StoreConfig,
    StoreCounts,
    StoredTile,
    TileJournal,
    TileWork,
    VehicleAccount,
    VersionInfo,
    VersionKind,
    WaitingChange,
    WindowCounts,
    check_fits,
    check_layer,
)
from tile_store.writer import GroupWriter

_T = TypeVar("_T")
NS_PER_S: Final = 1_000_000_000
REPORTS_A_PAGE: Final = 256
WINDOWS_AT_ONCE: Final = 8
"""So many windows of a tile are folded in one go, where it was left alone for long."""


class SqliteStore:
    """`Store` in an SQLite file: one writer thread that groups commits, read-only connections for readers.

    Args:
        path: the file; with `create` it is made when missing (its folder must exist).
        config: batching and waiting of this process.
        now_ns: the clock, int ns UTC.

    Raises:
        StoreUnavailable: no such file or folder, no permission, not a store, written by a newer release.
    """

    def __init__(
        self,
        path: str | Path,
        config: StoreConfig | None = None,
        *,
        create: bool = True,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.path = Path(path)
        self._config = config or StoreConfig()
        self._now_ns = now_ns
        connection = open_writer(self.path, create=create, busy_timeout_s=self._config.busy_timeout_s)
        self._writer = GroupWriter(connection, group_max=self._config.group_max)
        self._readers = ReaderPool(self.path, busy_timeout_s=self._config.busy_timeout_s)

    def __enter__(self) -> "SqliteStore":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Finish what is queued and close the file. Calling it twice is harmless."""
        self._readers.close()
        self._writer.close()  # the last connection folds the log into the file, which a reader could not

    def _timing(self) -> dict[str, Any]:
        return inbox.timing_of(self._config, self._now_ns())

    # Uploads

    def put_upload(self, upload: Upload, home: str) -> PutStatus:
        """See `Store.put_upload`."""
        return self._writer.run(lambda c: uploads.put(c, upload, home))

    def claim_uploads(self, owner: str, n: int, lease_s: float) -> list[UploadClaim]:
        """See `Store.claim_uploads`."""
        # As with tiles: who looks often takes no write lock for nothing.
        with self._readers.snapshot() as c:
            if not uploads.any_claimable(c, owner):
                return []
        return self._writer.run(lambda c: uploads.claim(c, owner, n, lease_s))

    def postpone_upload(self, claim: UploadClaim, delay_s: float) -> None:
        """See `Store.postpone_upload`."""
        self._writer.run(lambda c: uploads.postpone(c, claim, delay_s))

    def settle_upload(self, settled: Settled) -> bool:
        """See `Store.settle_upload`."""
        return self._writer.run(lambda c: uploads.settle(c, settled, self._config, self._now_ns()))

    def first_halves(self, key: str, report_id: str) -> list[FirstHalf]:
        """See `Store.first_halves`."""
        with self._readers.snapshot() as c:
            return uploads.first_halves(c, key, report_id)

    def first_parts(self, layer: str, report_id: str, tiles: Sequence[TileId]) -> list[ReportRow]:
        """See `Store.first_parts`."""
        with self._readers.snapshot() as c:
            return uploads.parts(c, layer, report_id, tiles)

    def upload_statuses(self, vehicle: str, report_ids: Sequence[str]) -> list[UploadStatus]:
        """See `Store.upload_statuses`."""
        with self._readers.snapshot() as c:
            return uploads.statuses(c, vehicle, report_ids)

    def upload_counts(self) -> UploadCounts:
        """See `Store.upload_counts`."""
        with self._readers.snapshot() as c:
            return uploads.counts(c)

    def forget_uploads(self, before_ns: int) -> int:
        """See `Store.forget_uploads`."""
        return self._writer.run(lambda c: uploads.forget(c, before_ns))

    # The inbox

    def put_reports(self, rows: Sequence[ReportRow]) -> list[PutStatus]:
        """See `Store.put_reports`."""
        if not rows:
            return []
        return self._writer.run(lambda c: inbox.put_reports(c, rows, self._config, self._now_ns()))

    def reports(self, layer: str = DEFAULT_LAYER, vehicle: str | None = None) -> Iterator[ReportRow]:
        """See `Store.reports`."""
        after, page = self._report_page(layer, vehicle, 0)
        while page:
            yield from page
            after, page = self._report_page(layer, vehicle, after)

    def _report_page(self, layer: str, vehicle: str | None, after: int) -> tuple[int, list[ReportRow]]:
        with self._readers.snapshot() as c:
            return inbox.page(c, layer, vehicle, after, REPORTS_A_PAGE)

    def in_play(self, layer: str, tile: TileId) -> TileJournal:
        """See `Store.in_play`."""
        with self._readers.snapshot() as c:
            return self._in_play(c, layer, tile)

    def _in_play(self, c: apsw.Connection, layer: str, tile: TileId) -> TileJournal:
        version = versions.epoch_of(c, layer, tile)
        epoch = versions.stored(c, "stored_version", layer, tile, version=version) if version else None
        if is_feature_layer(layer):
            rows = inbox.in_play_of_vehicles(c, layer, tile, version, self._config)
            return TileJournal(epoch, rows, seq=journal.newest(c, layer, tile).seq)
        first = journal.folded(c, layer, tile, version) + 1
        last = first + WINDOWS_AT_ONCE - 1
        rows = inbox.in_play(c, layer, tile, version, first, last)
        memory = journal.memory_of(c, layer, tile, version)
        newest = journal.newest(c, layer, tile)
        if newest.window <= last:
            return TileJournal(epoch, rows, memory, newest.window, newest.seq)
        return TileJournal(epoch, rows, memory, last + 1, max(row.seq for row in rows), is_whole=False)

    def quarantine(self, body: bytes, reason: str, source: str = "") -> None:
        """See `Store.quarantine`."""
        row = {"sha": sha256(body).digest(), "source": source, "reason": reason, "body": body}
        self._writer.run(lambda c: change(c, "insert_quarantine", row | {"received_ns": self._now_ns()}))

    def quarantined(self) -> list[Quarantined]:
        """See `Store.quarantined`."""
        with self._readers.snapshot() as c:
            return [Quarantined(*row) for row in fetch(c, "quarantined")]

    # The queue

    def claim(self, owner: str, n: int, lease_s: float, prefer: Sequence[str] = ()) -> list[Claim]:
        """See `Store.claim`."""
        # Idle mergers look often: they take no write lock for nothing.
        ready_ns = self.next_ready_ns()
        if ready_ns is None or ready_ns > self._now_ns():
            return []
        return self._writer.run(lambda c: inbox.claim(c, owner, n, lease_s, prefer, self._now_ns()))

    def renew(self, claims: Sequence[Claim], lease_s: float) -> list[bool]:
        """See `Store.renew`."""
        return self._writer.run(lambda c: inbox.renew(c, claims, lease_s, self._now_ns()))

    def release(self, owner: str) -> int:
        """See `Store.release`."""
        return self._writer.run(lambda c: (inbox.release(c, owner), uploads.release(c, owner))[0])

    def postpone(self, claim: Claim, delay_s: float) -> None:
        """See `Store.postpone`."""
        self._writer.run(lambda c: inbox.postpone(c, claim, self._now_ns() + round(delay_s * NS_PER_S)))

    def dirty_count(self) -> int:
        """See `Store.dirty_count`."""
        with self._readers.snapshot() as c:
            return int(fetch(c, "dirty_count")[0][0])

    def next_ready_ns(self) -> int | None:
        """See `Store.next_ready_ns`."""
        with self._readers.snapshot() as c:
            ready: int | None = fetch(c, "next_ready")[0][0]
            return ready

    # Merging and publishing

    def load(self, claim: Claim) -> TileWork:
        """See `Store.load`."""
        with self._readers.snapshot() as c:
            head = versions.stored(c, "stored_head", claim.layer, claim.tile)
            return TileWork(claim, head, self._in_play(c, claim.layer, claim.tile))

    def basis(self, layer: str, tile: TileId, version: int) -> Basis | None:
        """See `Store.basis`."""
        with self._readers.snapshot() as c:
            return journal.basis_of(c, layer, tile, version)

    def closed_windows(self, layer: str, tile: TileId) -> dict[int, frozenset[str]]:
        """See `Store.closed_windows`."""
        with self._readers.snapshot() as c:
            return journal.closed_windows(c, layer, tile)

    def reports_of_windows(self, layer: str, tile: TileId, first: int, last: int, seq: int) -> tuple[ReportRow, ...]:
        """See `Store.reports_of_windows`."""
        with self._readers.snapshot() as c:
            return inbox.of_windows(c, layer, tile, first, last, seq)

    def windows(self) -> list[WindowCounts]:
        """See `Store.windows`."""
        with self._readers.snapshot() as c:
            return journal.windows(c)

    def publish(self, publications: Sequence[Publication]) -> list[PublishResult]:
        """See `Store.publish`."""
        if not publications:
            return []
        pairs = [(one, None if one.tile is None else Content.of(one.tile)) for one in publications]

        def work(c: apsw.Connection) -> list[PublishResult]:
            return [versions.publish(c, one, content, self._timing()) for one, content in pairs]

        return self._writer.run(work)

    def put_tiles(
        self,
        tiles: Iterable[AnyTile],
        reason: VersionKind = "base",
        layer: str = DEFAULT_LAYER,
        surveyed_ns: int | None = None,
    ) -> list[PublishResult]:
        """See `Store.put_tiles`."""
        check_layer(layer)
        pairs = [(tile.tile_id, _content(tile, layer)) for tile in tiles]

        def work(c: apsw.Connection) -> list[PublishResult]:
            now = self._now_ns()
            return [versions.put_base(c, layer, tile, content, reason, now, surveyed_ns) for tile, content in pairs]

        return self._writer.run(work)

    def transact(self, work: Callable[[apsw.Connection, int], _T]) -> _T:
        """Run `work(connection, now)` in one durable write transaction: all that it writes, or nothing if it raises."""
        return self._writer.run(lambda c: work(c, self._now_ns()))

    def look(self, work: Callable[[apsw.Connection], _T]) -> _T:
        """Run `work(connection)` on the store as it is at one instant."""
        with self._readers.snapshot() as c:
            return work(c)

    def rollback(self, layer: str, tile: TileId, version: int) -> StoredTile:
        """See `Store.rollback`."""
        return self._writer.run(lambda c: versions.rollback(c, layer, tile, version, self._now_ns()))

    def notices(self, older_than_s: float = 0.0, n: int = 1000) -> list[Notice]:
        """See `Store.notices`."""
        before = self._now_ns() - round(older_than_s * NS_PER_S)
        with self._readers.snapshot() as c:
            rows = fetch(c, "notices", {"before": before, "n": n})
            return [Notice(layer, TileId(tile), version) for layer, tile, version in rows]

    def announced(self, notices: Sequence[Notice]) -> None:
        """See `Store.announced`."""
        keys = [{"layer": one.layer, "tile": one.tile.morton, "version": one.version} for one in notices]
        self._writer.run(lambda c: [change(c, "delete_notice", key) for key in keys])

    # Confirmation

    def waiting_changes(self) -> list[WaitingChange]:
        """See `Store.waiting_changes`."""
        with self._readers.snapshot() as c:
            return confirmation.waiting_changes(c)

    def shifted_vehicles(self) -> frozenset[str]:
        """See `Store.shifted_vehicles`."""
        with self._readers.snapshot() as c:
            return accounts.shifted_vehicles(c)

    def refuted_reports(self, layer: str, vehicles: Iterable[str]) -> dict[str, str]:
        """See `Store.refuted_reports`."""
        with self._readers.snapshot() as c:
            return refuted.refuted(c, layer, vehicles)

    def vehicle_accounts(self) -> list[VehicleAccount]:
        """See `Store.vehicle_accounts`."""
        with self._readers.snapshot() as c:
            return accounts.accounts(c)

    def dirty_tiles(self) -> list[DirtyTile]:
        """See `Store.dirty_tiles`."""
        with self._readers.snapshot() as c:
            rows = fetch(c, "dirty_tiles")
        return [DirtyTile(layer, TileId(tile), *rest) for layer, tile, *rest in rows]

    # Reading

    def get(self, layer: str, tile: TileId, version: int | None = None, at_ns: int | None = None) -> StoredTile | None:
        """See `Store.get`."""
        if version is not None and at_ns is not None:
            raise StoreError(f"get {tile.path}: give a version ({version}) or a time ({at_ns}), not both")
        with self._readers.snapshot() as c:
            if version is not None:
                return versions.stored(c, "stored_version", layer, tile, version=version)
            if at_ns is not None:
                return versions.stored(c, "stored_at", layer, tile, at_ns=at_ns)
            return versions.stored(c, "stored_head", layer, tile)

    def by_sha(self, layer: str, tile: TileId, sha: bytes) -> StoredTile | None:
        """See `Store.by_sha`."""
        with self._readers.snapshot() as c:
            return versions.stored(c, "stored_by_sha", layer, tile, sha=sha)

    def layers(self) -> list[str]:
        """See `Store.layers`."""
        with self._readers.snapshot() as c:
            return [layer for (layer,) in fetch(c, "layers")]

    def heads(self, layer: str = DEFAULT_LAYER, prefix: str = "") -> list[CatalogEntry]:
        """See `Store.heads`."""
        first, end = morton_range(prefix)
        with self._readers.snapshot() as c:
            rows = fetch(c, "heads", {"layer": layer, "first": first, "end": end})
        return [CatalogEntry(TileId(tile), version, sha) for tile, version, sha in rows]

    def history(self, layer: str, tile: TileId) -> list[VersionInfo]:
        """See `Store.history`."""
        with self._readers.snapshot() as c:
            return [VersionInfo(*row) for row in fetch(c, "history", {"layer": layer, "tile": tile.morton})]

    def provenance(self, layer: str, tile: TileId, version: int) -> tuple[str, ...]:
        """See `Store.provenance`."""
        return self._provenance(layer, tile, version).report_ids

    def voxel_provenance(self, layer: str, tile: TileId, version: int) -> dict[int, tuple[str, ...]]:
        """See `Store.voxel_provenance`."""
        return self._provenance(layer, tile, version).of_voxels()

    def _provenance(self, layer: str, tile: TileId, version: int) -> Provenance:
        place = {"layer": layer, "tile": tile.morton, "version": version}
        with self._readers.snapshot() as c:
            rows = fetch(c, "provenance", place)
        if not rows:
            raise UnknownVersion(f"tile {tile.path} of layer {layer} has no version {version}")
        return decode_provenance(rows[0][0])

    def counts(self) -> StoreCounts:
        """See `Store.counts`."""
        with self._readers.snapshot() as c:
            return StoreCounts(*fetch(c, "counts")[0])

    # Upkeep

    def gc(self, keep_versions: int) -> GcResult:
        """See `Store.gc`."""
        if keep_versions < 1:
            raise StoreError(f"keep_versions is {keep_versions}; at least the newest version stays")
        return self._writer.run(lambda c: versions.collect(c, keep_versions))

    def backup(self, path: str | Path) -> None:
        """See `Store.backup` (VACUUM INTO)."""
        if Path(path).exists():
            raise StoreError(f"{path}: exists; a backup never overwrites")
        with self._readers.connection() as c:
            c.execute("VACUUM INTO ?", (str(path),))


def _content(tile: AnyTile, layer: str) -> Content:
    check_fits(tile, layer)
    return Content.of(tile)
