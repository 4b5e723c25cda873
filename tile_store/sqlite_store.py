"""The store in one SQLite file that several processes of a machine may open (WAL, every commit synced)."""

import logging
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Protocol, Self, TypeVar

from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District, TileId
from gnd.schemas.district_list import DistrictList
from gnd.schemas.tiles import Catalog, CatalogEntry
from gnd.tile_store import borders, clocks
from gnd.tile_store import sql_accounts as accounts
from gnd.tile_store import sql_catalogs as catalogs
from gnd.tile_store import sql_confirmation as confirmation
from gnd.tile_store import sql_district_lists as lists
from gnd.tile_store import sql_inbox as inbox
from gnd.tile_store import sql_journal as journal
from gnd.tile_store import sql_refuted as refuted
from gnd.tile_store import sql_roads as roads
from gnd.tile_store import sql_standing as standing
from gnd.tile_store import sql_trials as trials
from gnd.tile_store import sql_trust as trust
from gnd.tile_store import sql_uploads as uploads
from gnd.tile_store import sql_versions as versions
from gnd.tile_store.backup import copy_store
from gnd.tile_store.bodies import Bodies, bodies_at, bodies_at_start, place_of_bodies
from gnd.tile_store.connection import QueueClock, SqlConnection, Writer, change, fetch
from gnd.tile_store.districts import DistrictOwners, DistrictState, owners_of_districts
from gnd.tile_store.errors import StoreDamaged, StoreError, StoreMoved, UnknownVersion
from gnd.tile_store.provenance import Provenance, decode_provenance
from gnd.tile_store.regions import morton_range
from gnd.tile_store.retention import QUARANTINE, trim_quarantine
from gnd.tile_store.roads import RoadPart
from gnd.tile_store.rows_kept import RowsKept
from gnd.tile_store.signing import Signing, chain_of, check_signed
from gnd.tile_store.sqlite_connection import ReaderPool, open_writer, require_current
from gnd.tile_store.sqlite_writer import SqliteWriter
from gnd.tile_store.trials import VersionTrial
from gnd.tile_store.uploads import FirstHalf, Settled, Upload, UploadClaim, UploadCounts, UploadStatus
from gnd.tile_store.values import (
    DEFAULT_LAYER,
    NS_PER_S,
    Basis,
    Claim,
    ClosedWindow,
    Content,
    DayAlone,
    DirtyTile,
    GcResult,
    HeadLine,
    ImpossibleSaid,
    JournalMark,
    LoneWord,
    Notice,
    Publication,
    PublishResult,
    PutStatus,
    Quarantined,
    QueueState,
    ReportRow,
    ShardSeen,
    StoreConfig,
    StoreCounts,
    StoredTile,
    TileJournal,
    TileSetAside,
    TileWork,
    VehicleAccount,
    VehiclePair,
    VehicleTrust,
    VersionInfo,
    VersionKind,
    WaitingChange,
    WindowCounts,
    check_fits,
    check_layer,
)
from gnd.tile_store.writer import NoWriter

_T = TypeVar("_T")
BUSY_TIMEOUT_S: Final = 30.0
"""A writer waits this long for the writers of other processes."""
GROUP_MAX: Final = 256
"""At most so many calls share one commit."""
REPORTS_A_PAGE: Final = 256
LAGS_LOOKED_AT: Final = 256
SHARD_FORGOTTEN_NS: Final = 86_400 * NS_PER_S
"""A shard that ended without saying so is told of for a day."""
WINDOWS_AT_ONCE: Final = 8
"""So many windows of a tile are folded in one go, where it was left alone for long."""
_LOG = logging.getLogger(__name__)


class Readers(Protocol):
    """Connections that only read."""

    def snapshot(self) -> AbstractContextManager[SqlConnection]:
        """A connection on which everything is read at one instant."""

    def single(self) -> AbstractContextManager[SqlConnection]:
        """A connection for one question."""

    def close(self) -> None:
        """Free them; those in use when they come back."""


class SqlStore(ABC):
    """`Store` over named statements: a writer that groups commits, and connections for readers.

    Whoever inherits from it opens the database. What it says of locks (`about`) is for databases in which several
    processes write at the same time; see decision 0161 for what each may change beside the others.

    Args:
        location: what messages call it.
        readers, writer: the connections.
        config: batching and waiting of this process.
        signing: who signs what is published, and checks what is built upon; None: nobody does.
        now_ns: the time of day, int ns UTC; it may step.
        clock: of the queue; one for all processes that share the store.
        upload_clock: of the leases of uploads, which connections know, too.
    """

    def __init__(
        self,
        location: str,
        readers: Readers,
        writer: Writer,
        config: StoreConfig | None,
        signing: Signing | None,
        now_ns: Callable[[], int],
        clock: QueueClock,
        upload_clock: QueueClock,
    ) -> None:
        self.location = location
        self.signing = signing
        self._readers, self._writer = readers, writer
        self._config = config or StoreConfig()
        self._now_ns, self._clock, self._upload_clock = now_ns, clock, upload_clock
        self._rows = RowsKept()
        self._turns_after = ""
        self._owners = trust.OwnersNoted()
        self._bodies: Bodies | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Finish what is queued and free the store. Calling it twice is harmless."""
        self._readers.close()
        self._writer.close()  # the last connection folds SQLite's log into the file, which a reader could not

    @abstractmethod
    def backup(self, path: str | Path) -> None:
        """See `Store.backup`."""

    @abstractmethod
    def sizes(self) -> dict[str, int]:
        """What the store takes on disk, bytes, by part."""

    def disk_free_bytes(self) -> int | None:
        """Room on the disk of the store, bytes; None: it is not known, as that of a database's host."""
        return None

    def _steady_ns(self) -> int:
        return self._clock.steady_ns()

    def _enter_boot(self) -> None:
        """What another clock has left in the queue ends; a store is written to only where there is something."""
        try:
            with self._readers.snapshot() as c:
                is_known = fetch(c, "boot_of_queue") == [(self._clock.name,)]
            if not is_known:
                self._writer.run(lambda c: inbox.enter_boot(c, self._clock.name, self._steady_ns()))
            place = self.look(place_of_bodies)
            if place is not None:
                self._bodies = bodies_at_start(place)
        except (StoreDamaged, StoreMoved) as error:  # what can be read shall be read
            _LOG.error("%s", error)
        except BaseException:
            self.close()
            raise

    def whole(self, stored: StoredTile) -> StoredTile:
        """A version with its body, where it lies among objects.

        Raises:
            StoreDamaged: it is not there, or nobody says where.
            StoreUnavailable: the objects cannot be read.
        """
        if stored.body:
            return stored
        if self._bodies is None:
            place = self.look(place_of_bodies)
            if place is None:
                raise StoreDamaged(
                    f"tile {stored.tile.path} of layer {stored.layer} version {stored.version}: its body lies among"
                    " objects, and the store does not say where (`gnd map bodies`)"
                )
            self._bodies = bodies_at(place, to_write=False)
        return replace(stored, body=self._bodies.read(stored.sha, stored.codec_id))

    def _whole(self, stored: StoredTile | None) -> StoredTile | None:
        return None if stored is None else self.whole(stored)

    def _kept(self, contents: Sequence[Content | None]) -> list[Content | None]:
        """Contents whose bodies lie among the objects, where the store has any; before the transaction, that is."""
        if self._bodies is None:
            return list(contents)
        kept = iter(self._bodies.keep([one for one in contents if one is not None]))
        return [None if one is None else next(kept) for one in contents]

    def timing(self) -> dict[str, Any]:
        """Now, and when a tile that is marked becomes ready, as statements take it."""
        return inbox.timing_of(self._config, self._now_ns(), self._steady_ns())

    # Uploads

    def put_upload(self, upload: Upload, home: str, patient_s: float = 0.0) -> PutStatus:
        """See `Store.put_upload`."""
        row = uploads.row_of(upload, home, self._upload_clock)
        is_new = self._writer.change("insert_upload", row, uploads.locks_of(upload), patient_s)
        return "stored" if is_new else "duplicate"

    def claim_uploads(
        self, owner: str, n: int, lease_s: float, in_turn: uploads.InTurnOf = sorted
    ) -> list[UploadClaim]:
        """See `Store.claim_uploads`."""
        # As with tiles: who looks often takes no write lock for nothing, and whose turn it is is found without it.
        with self._readers.snapshot() as c:
            if not uploads.any_claimable(c, owner):
                return []
            names, self._turns_after = uploads.turns(c, self._turns_after)
            is_any_left = uploads.any_left_behind(c)
            helps = uploads.others_lag(c, owner)
        vehicles = in_turn(names)
        if not vehicles and not is_any_left:
            return []
        return self._writer.run(lambda c: uploads.claim(c, owner, n, lease_s, vehicles, helps=helps), [inbox.CLAIMS])

    def uploads_waiting(self, vehicle: str | None, at_most: int) -> int:
        """See `Store.uploads_waiting`."""
        with self._readers.single() as c:
            return uploads.waiting(c, vehicle, at_most)

    def postpone_upload(self, claim: UploadClaim, delay_s: float, *, blameless: bool = False) -> None:
        """See `Store.postpone_upload`."""
        self._writer.run(
            lambda c: uploads.postpone(c, claim, delay_s, blameless=blameless), uploads.locks_of(claim.upload)
        )

    def settle_upload(self, settled: Settled) -> bool:
        """See `Store.settle_upload`."""
        return self._writer.run(
            lambda c: uploads.settle(c, settled, self._config, self.timing()), uploads.locks_to_settle(settled)
        )

    def first_halves(self, key: str, report_id: str) -> list[FirstHalf]:
        """See `Store.first_halves`."""
        with self._readers.single() as c:
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

    def put_road_part(self, part: RoadPart) -> PutStatus:
        """See `Store.put_road_part`."""
        return self._writer.run(lambda c: roads.put_part(c, part))

    def road_reports(self, layer: str) -> set[str]:
        """See `Store.road_reports`."""
        with self._readers.single() as c:
            return roads.report_ids(c, layer)

    def put_reports(self, rows: Sequence[ReportRow]) -> list[PutStatus]:
        """See `Store.put_reports`."""
        if not rows:
            return []
        return self._writer.run(lambda c: inbox.put_reports(c, rows, self._config, self.timing()), inbox.locks_of(rows))

    def reports(self, layer: str = DEFAULT_LAYER, vehicle: str | None = None) -> Iterator[ReportRow]:
        """See `Store.reports`."""
        after, page = self._report_page(layer, vehicle, 0)
        while page:
            yield from page
            after, page = self._report_page(layer, vehicle, after)

    def _report_page(self, layer: str, vehicle: str | None, after: int) -> tuple[int, list[ReportRow]]:
        with self._readers.single() as c:
            return inbox.page(c, layer, vehicle, after, REPORTS_A_PAGE)

    def in_play(self, layer: str, tile: TileId) -> TileJournal:
        """See `Store.in_play`."""
        with self._readers.snapshot() as c:
            journal_of_tile = self._in_play(c, layer, tile)
        return replace(journal_of_tile, epoch=self._whole(journal_of_tile.epoch))

    def _in_play(self, c: SqlConnection, layer: str, tile: TileId) -> TileJournal:
        version = versions.epoch_of(c, layer, tile)
        epoch = versions.stored(c, "stored_version", layer, tile, version=version) if version else None
        first = journal.folded(c, layer, tile, version) + 1
        last = first + WINDOWS_AT_ONCE - 1
        rows = inbox.in_play(c, self._rows, layer, tile, version, first, last)
        memory = journal.memory_of(c, layer, tile, version)
        newest = journal.newest(c, layer, tile)
        if newest.window <= last:
            mark = JournalMark(version, first - 1, newest.seq)
            return TileJournal(epoch, rows, memory, newest.window, newest.seq, mark=mark)
        return TileJournal(epoch, rows, memory, last + 1, max(row.seq for row in rows), is_whole=False)

    def in_play_since(self, layer: str, tile: TileId, mark: JournalMark) -> tuple[JournalMark, list[ReportRow]] | None:
        """See `Store.in_play_since`."""
        with self._readers.snapshot() as c:
            epoch = versions.epoch_of(c, layer, tile)
            now = JournalMark(epoch, journal.folded(c, layer, tile, epoch), journal.newest(c, layer, tile).seq)
            if (now.epoch, now.folded) != (mark.epoch, mark.folded):
                return None
            return now, inbox.since(c, self._rows, layer, tile, mark) if now.seq > mark.seq else []

    def quarantine(self, body: bytes, reason: str, source: str = "") -> None:
        """See `Store.quarantine`."""
        row = {"sha": sha256(body).digest(), "source": source, "reason": reason, "body": body}

        def work(c: SqlConnection) -> None:
            change(c, "insert_quarantine", row | {"received_ns": self._now_ns()})
            trim_quarantine(c, self._config.quarantine_bytes)

        self._writer.run(work, [QUARANTINE])

    def quarantined(self) -> list[Quarantined]:
        """See `Store.quarantined`."""
        with self._readers.single() as c:
            return [Quarantined(*row) for row in fetch(c, "quarantined")]

    # The queue

    def claim(self, owner: str, n: int, lease_s: float, is_own: inbox.IsOwn | None = None) -> list[Claim]:
        """See `Store.claim`."""
        # Idle mergers look often: they take no write lock for nothing.
        ready_in_s = self.ready_in_s()
        if ready_in_s is None or ready_in_s > 0.0:
            return []
        return self._writer.run(lambda c: inbox.claim(c, owner, n, lease_s, is_own, self._steady_ns()), [inbox.CLAIMS])

    def begin(self, claims: Sequence[Claim], lease_s: float) -> list[bool]:
        """See `Store.begin`."""
        return self._writer.run(
            lambda c: [inbox.begin(c, one, lease_s, self._steady_ns()) for one in claims], inbox.locks_of(claims)
        )

    def release(self, owner: str) -> int:
        """See `Store.release`."""
        return self._writer.run(lambda c: (inbox.release(c, owner), uploads.release(c, owner))[0])

    def postpone(self, claim: Claim, delay_s: float, *, blameless: bool = False) -> None:
        """See `Store.postpone`."""
        self._writer.run(
            lambda c: inbox.postpone(c, claim, self._steady_ns() + round(delay_s * NS_PER_S), blameless=blameless),
            inbox.locks_of([claim]),
        )

    def set_aside(self, claim: Claim, reason: str) -> bool:
        """See `Store.set_aside`."""
        return self._writer.run(
            lambda c: inbox.set_aside(c, claim, reason, self._now_ns(), self._steady_ns()), inbox.locks_of([claim])
        )

    def tiles_set_aside(self) -> list[TileSetAside]:
        """See `Store.tiles_set_aside`."""
        with self._readers.single() as c:
            rows = fetch(c, "tiles_set_aside")
        return [TileSetAside(layer, TileId(tile), *rest) for layer, tile, *rest in rows]

    def take_up_again(self, tiles: Iterable[tuple[str, TileId]]) -> int:
        """See `Store.take_up_again`."""
        wanted = list(tiles)
        return self._writer.run(lambda c: inbox.take_up_again(c, wanted, self._steady_ns()))

    # Shards

    def join(self, owner: str) -> None:
        """See `Store.join`."""
        boot, steady = self._clock.name, self._steady_ns()
        row = {"owner": owner, "boot": boot, "steady": steady, "now": self._now_ns()}

        def work(c: SqlConnection) -> None:
            inbox.release(c, owner)
            uploads.release(c, owner)
            change(c, "forget_shards", {"boot": boot, "before": steady - SHARD_FORGOTTEN_NS})
            change(c, "join", row)

        self._writer.run(work)

    def beat(self, owner: str, claims: Sequence[Claim], lease_s: float) -> list[bool]:
        """See `Store.beat`."""
        row = {"owner": owner, "boot": self._clock.name, "steady": self._steady_ns(), "now": self._now_ns()}

        def work(c: SqlConnection) -> list[bool]:
            change(c, "beat", row)
            return inbox.renew(c, claims, lease_s, self._steady_ns())

        return self._writer.run(work, [("shard", owner), *inbox.locks_of(claims)])

    def leave(self, owner: str) -> None:
        """See `Store.leave`."""

        def work(c: SqlConnection) -> None:
            inbox.release(c, owner)
            uploads.release(c, owner)
            change(c, "leave", {"owner": owner})

        self._writer.run(work)

    def shards(self) -> list[ShardSeen]:
        """See `Store.shards`."""
        with self._readers.single() as c:
            rows = fetch(c, "shards")
        steady, boot = self._steady_ns(), self._clock.name
        return [
            ShardSeen(owner, since_ns, (steady - beat_ns) / NS_PER_S if of_boot == boot else None)
            for owner, of_boot, beat_ns, since_ns in rows
        ]

    def dirty_count(self) -> int:
        """See `Store.dirty_count`."""
        with self._readers.single() as c:
            return int(fetch(c, "dirty_count")[0][0])

    def ready_in_s(self) -> float | None:
        """See `Store.ready_in_s`."""
        with self._readers.single() as c:
            ready_ns: int | None = fetch(c, "next_ready")[0][0]
        return None if ready_ns is None else (ready_ns - self._steady_ns()) / NS_PER_S

    def queue_state(self) -> QueueState:
        """See `Store.queue_state`."""
        with self._readers.snapshot() as c:
            ready_ns, oldest_ns = fetch(c, "queue_state")[0]
            lags = fetch(c, "published_lags", {"n": LAGS_LOOKED_AT})
            messages, refused_bytes = fetch(c, "quarantine_size")[0]
        overdue_s = 0.0 if ready_ns is None else max(self._steady_ns() - ready_ns, 0) / NS_PER_S
        waiting_s = 0.0 if oldest_ns is None else max(self._now_ns() - oldest_ns, 0) / NS_PER_S
        return QueueState(overdue_s, waiting_s, tuple(lag / NS_PER_S for (lag,) in lags), messages, refused_bytes)

    # Merging and publishing

    def load(self, claim: Claim) -> TileWork:
        """See `Store.load`."""
        with self._readers.snapshot() as c:
            (head,) = versions.stored_heads(c, claim.layer, [claim.tile])
            work = TileWork(claim, head, self._in_play(c, claim.layer, claim.tile))
            check_signed(c, self.signing, work.epoch)
        play = replace(work.journal, epoch=self._whole(work.journal.epoch))
        return replace(work, head=self._whole(work.head), journal=play)

    def basis(self, layer: str, tile: TileId, version: int) -> Basis | None:
        """See `Store.basis`."""
        with self._readers.snapshot() as c:
            return journal.basis_of(c, layer, tile, version)

    def closed_windows(self, layer: str, tile: TileId) -> dict[int, ClosedWindow]:
        """See `Store.closed_windows`."""
        with self._readers.snapshot() as c:
            return journal.closed_windows(c, layer, tile)

    def reports_of_windows(self, layer: str, tile: TileId, first: int, last: int, seq: int) -> tuple[ReportRow, ...]:
        """See `Store.reports_of_windows`."""
        with self._readers.snapshot() as c:
            return inbox.of_windows(c, layer, tile, first, last, seq)

    def windows(self) -> list[WindowCounts]:
        """See `Store.windows`."""
        with self._readers.single() as c:
            return journal.windows(c)

    def publish(self, publications: Sequence[Publication]) -> list[PublishResult]:
        """See `Store.publish`."""
        if not publications:
            return []
        contents = self._kept([None if one.tile is None else Content.of(one.tile) for one in publications])
        pairs = list(zip(publications, contents, strict=True))

        def work(c: SqlConnection) -> list[PublishResult]:
            return [versions.publish(c, one, content, self.timing(), self.signing) for one, content in pairs]

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
        some = list(tiles)
        contents = self._kept([_content(tile, layer) for tile in some])
        pairs = [(tile.tile_id, one) for tile, one in zip(some, contents, strict=True) if one is not None]

        def work(c: SqlConnection) -> list[PublishResult]:
            now = self._now_ns()
            return [
                versions.put_base(c, layer, tile, content, reason, now, surveyed_ns, signing=self.signing)
                for tile, content in pairs
            ]

        return self._writer.run(work)

    def transact(self, work: Callable[[SqlConnection, int], _T]) -> _T:
        """Run `work(connection, now)` in one durable write transaction: all that it writes, or nothing if it raises."""
        return self._writer.run(lambda c: work(c, self._now_ns()))

    def look(self, work: Callable[[SqlConnection], _T]) -> _T:
        """Run `work(connection)` on the store as it is at one instant."""
        with self._readers.snapshot() as c:
            return work(c)

    def rollback(self, layer: str, tile: TileId, version: int) -> StoredTile:
        """See `Store.rollback`."""
        return self.whole(
            self._writer.run(lambda c: versions.rollback(c, layer, tile, version, self._now_ns(), self.signing))
        )

    def notices(self, older_than_s: float = 0.0, n: int = 1000) -> list[Notice]:
        """See `Store.notices`."""
        # All are all: the clock may have been set back since they were written.
        before = self._now_ns() - round(older_than_s * NS_PER_S) if older_than_s else 2**63 - 1
        with self._readers.single() as c:
            rows = fetch(c, "notices", {"before": before, "n": n})
            return [Notice(layer, TileId(tile), version) for layer, tile, version in rows]

    def announced(self, notices: Sequence[Notice]) -> None:
        """See `Store.announced`."""
        keys = [{"layer": one.layer, "tile": one.tile.morton, "version": one.version} for one in notices]

        def work(c: SqlConnection) -> None:
            for key in keys:
                c.post("delete_notice", key)

        self._writer.run(work, inbox.locks_of(notices))

    def check_signed(self, stored: StoredTile) -> None:
        """See `Store.check_signed`."""
        if self.signing is not None:
            with self._readers.snapshot() as c:
                check_signed(c, self.signing, stored)

    def unsigned(self) -> int:
        """See `Store.unsigned`."""
        with self._readers.single() as c:
            return int(fetch(c, "unsigned_heads")[0][0])

    def publisher_chain(self, signer: bytes) -> bytes | None:
        """See `Store.publisher_chain`."""
        with self._readers.single() as c:
            return chain_of(c, signer)

    # Confirmation

    def waiting_changes(self) -> list[WaitingChange]:
        """See `Store.waiting_changes`."""
        with self._readers.single() as c:
            return confirmation.waiting_changes(c)

    def shifted_vehicles(self) -> frozenset[str]:
        """See `Store.shifted_vehicles`."""
        with self._readers.single() as c:
            return accounts.shifted_vehicles(c)

    def quarantined_vehicles(self) -> frozenset[str]:
        """See `Store.quarantined_vehicles`."""
        with self._readers.single() as c:
            return frozenset(one.vehicle for one in trust.quarantined(c))

    def vehicle_trusts(self) -> list[VehicleTrust]:
        """See `Store.vehicle_trusts`."""
        with self._readers.snapshot() as c:
            return trust.trusts(c)

    def quarantine_vehicle(self, vehicle: str, why: str) -> None:
        """See `Store.quarantine_vehicle`."""
        self._writer.run(lambda c: trust.quarantine(c, vehicle, why, self.timing()))

    def release_vehicle(self, vehicle: str) -> bool:
        """See `Store.release_vehicle`."""
        return self._writer.run(lambda c: trust.release(c, vehicle, self.timing()))

    def marks_of_tile(self, layer: str, tile: TileId) -> frozenset[str]:
        """See `Store.marks_of_tile`."""
        with self._readers.snapshot() as c:
            return standing.marks_of_tile(c, layer, tile)

    def lone_words(self) -> list[LoneWord]:
        """See `Store.lone_words`."""
        with self._readers.snapshot() as c:
            return standing.lone_words(c)

    def impossible_places(self) -> list[ImpossibleSaid]:
        """See `Store.impossible_places`."""
        with self._readers.snapshot() as c:
            return [ImpossibleSaid(*row) for row in c.fetch("impossible_places")]

    def unheard_vehicles(self) -> dict[str, int]:
        """See `Store.unheard_vehicles`."""
        with self._readers.snapshot() as c:
            return {vehicle: int(n) for vehicle, n in c.fetch("unheard_vehicles")}

    def days_alone(self) -> list[DayAlone]:
        """See `Store.days_alone`."""
        with self._readers.snapshot() as c:
            return [DayAlone(*row) for row in c.fetch("days_alone")]

    def pairs_of_groups(self) -> list[VehiclePair]:
        """See `Store.pairs_of_groups`."""
        with self._readers.snapshot() as c:
            return standing.pairs_of_groups(c)

    def refuted_tests(self) -> list[tuple[str, TileId, str, str]]:
        """See `Store.refuted_tests`."""
        with self._readers.single() as c:
            return trust.refuted_tests(c)

    def note_owner(self, vehicle: str, owner: str, since_ns: int) -> None:
        """See `Store.note_owner`."""
        if not self._owners.is_news(vehicle, owner):
            return
        self._writer.run(lambda c: trust.note_owner(c, vehicle, owner, since_ns), [("owner", vehicle)])
        self._owners.note(vehicle, owner)

    def owners_of(self, vehicles: Iterable[str]) -> dict[str, tuple[tuple[int, str], ...]]:
        """See `Store.owners_of`."""
        with self._readers.single() as c:
            return trust.owners_of(c, vehicles)

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
        with self._readers.single() as c:
            rows = fetch(c, "dirty_tiles")
        now_ns = self._steady_ns()
        return [
            DirtyTile(layer, TileId(tile), reports, attempts, is_leased, max(now_ns - ready_ns, 0) / NS_PER_S)
            for layer, tile, reports, attempts, is_leased, ready_ns in rows
        ]

    # Trials

    def trials(self, layer: str, prefix: str = "") -> dict[TileId, VersionTrial]:
        """See `Store.trials`."""
        with self._readers.snapshot() as c:
            return trials.open_trials(c, layer, prefix)

    def doubted_vehicles(self, layer: str, tile: TileId) -> frozenset[str]:
        """See `Store.doubted_vehicles`."""
        with self._readers.single() as c:
            return trials.doubted_vehicles(c, layer, tile)

    # Reading

    def get(self, layer: str, tile: TileId, version: int | None = None, at_ns: int | None = None) -> StoredTile | None:
        """See `Store.get`."""
        if version is not None and at_ns is not None:
            raise StoreError(f"get {tile.path}: give a version ({version}) or a time ({at_ns}), not both")
        with self._readers.single() as c:
            if version is not None:
                found = versions.stored(c, "stored_version", layer, tile, version=version)
            elif at_ns is not None:
                found = versions.stored(c, "stored_at", layer, tile, at_ns=at_ns)
            else:
                (found,) = versions.stored_heads(c, layer, [tile])
        return self._whole(found)

    def get_each(self, layer: str, tiles: Sequence[TileId]) -> list[StoredTile | None]:
        """See `Store.get_each`."""
        with self._readers.single() as c:
            found = versions.stored_heads(c, layer, tiles)
        return [self._whole(one) for one in found]

    def by_sha(self, layer: str, tile: TileId, sha: bytes) -> StoredTile | None:
        """See `Store.by_sha`."""
        with self._readers.single() as c:
            found = versions.stored(c, "stored_by_sha", layer, tile, sha=sha)
        return self._whole(found)

    def layers(self) -> list[str]:
        """See `Store.layers`."""
        with self._readers.single() as c:
            return [layer for (layer,) in fetch(c, "layers")]

    def district_owners(self) -> DistrictOwners:
        """See `Store.district_owners`."""
        with self._readers.single() as c:
            return owners_of_districts(c)

    def districts(self) -> frozenset[District]:
        """See `Store.districts`."""
        with self._readers.snapshot() as c:
            layers = [layer for (layer,) in fetch(c, "layers")]
            found = {number for layer in layers for (number,) in fetch(c, "districts", {"layer": layer})}
        return frozenset(TileId(number * TILES_OF_DISTRICT).district for number in found)

    def border_rows(self, n: int) -> list[ReportRow]:
        """The oldest rows of reports that wait to be carried to the store that owns their districts."""
        return self.look(lambda c: borders.waiting(c, n))

    def forget_border_rows(self, rows: Sequence[ReportRow]) -> None:
        """Forget rows that the other store has."""
        self._writer.run(lambda c: borders.forget(c, rows))

    def set_region(self, name: str, rest: DistrictState) -> None:
        """Give the store's region a name, and say whose the districts are of which nothing else is said."""
        row = {"region": name, "state": rest, "since_ns": self._now_ns()}
        self._writer.run(lambda c: change(c, "put_rest", row))

    def catalog(self, layer: str, district: District) -> Catalog:
        """See `Store.catalog`."""
        with self._readers.snapshot() as c:
            return catalogs.catalog_of(c, layer, district)

    def district_list(self, layer: str) -> DistrictList | None:
        """See `Store.district_list`."""
        with self._readers.snapshot() as c:
            return lists.list_of(c, layer)

    def heads(self, layer: str = DEFAULT_LAYER, prefix: str = "") -> list[CatalogEntry]:
        """See `Store.heads`."""
        first, end = morton_range(prefix)
        with self._readers.single() as c:
            rows = fetch(c, "heads", {"layer": layer, "first": first, "end": end})
        return [CatalogEntry(TileId(tile), version, sha) for tile, version, sha in rows]

    def head_lines(self, layer: str = DEFAULT_LAYER, prefix: str = "") -> list[HeadLine]:
        """See `Store.head_lines`."""
        first, end = morton_range(prefix)
        with self._readers.single() as c:
            rows = fetch(c, "head_lines", {"layer": layer, "first": first, "end": end})
        return [HeadLine(TileId(tile), *rest) for tile, *rest in rows]

    def history(self, layer: str, tile: TileId) -> list[VersionInfo]:
        """See `Store.history`."""
        with self._readers.single() as c:
            return [VersionInfo(*row) for row in fetch(c, "history", {"layer": layer, "tile": tile.morton})]

    def provenance(self, layer: str, tile: TileId, version: int) -> tuple[str, ...]:
        """See `Store.provenance`."""
        return self._provenance(layer, tile, version).report_ids

    def voxel_provenance(self, layer: str, tile: TileId, version: int) -> dict[int, tuple[str, ...]]:
        """See `Store.voxel_provenance`."""
        return self._provenance(layer, tile, version).of_voxels()

    def _provenance(self, layer: str, tile: TileId, version: int) -> Provenance:
        place = {"layer": layer, "tile": tile.morton, "version": version}
        with self._readers.single() as c:
            rows = fetch(c, "provenance", place)
        if not rows:
            raise UnknownVersion(f"tile {tile.path} of layer {layer} has no version {version}")
        return decode_provenance(rows[0][0])

    def counts(self) -> StoreCounts:
        """See `Store.counts`."""
        with self._readers.single() as c:
            return StoreCounts(*fetch(c, "counts")[0])

    # Upkeep

    def gc(self, keep_versions: int) -> GcResult:
        """See `Store.gc`."""
        if keep_versions < 1:
            raise StoreError(f"keep_versions is {keep_versions}; at least the newest version stays")
        return self._writer.run(lambda c: versions.collect(c, keep_versions))


def _content(tile: AnyTile, layer: str) -> Content:
    check_fits(tile, layer)
    return Content.of(tile)


@dataclass(frozen=True, slots=True)
class _SteppedClock:
    """A clock of a queue that reads what it is told to."""

    name: str
    read_ns: Callable[[], int]

    def steady_ns(self) -> int:
        return self.read_ns()


class SqliteStore(SqlStore):
    """`Store` in an SQLite file: one writer that groups commits, read-only connections for readers.

    Args:
        path: the file; with `create` it is made when missing (its folder must exist).
        config: batching and waiting of this process.
        signing: who signs what is published, and checks what is built upon; None: nobody does.
        read_only: nothing is written, also not beside the file; whatever would write is StoreUnavailable.
        now_ns: the time of day, int ns UTC; it may step.
        steady_ns: the clock of the queue, ns; it never steps, and is the same in all processes of the machine.

    Raises:
        StoreUnavailable: no such file or folder, no permission, not a store, written by a newer release.
    """

    def __init__(
        self,
        path: str | Path,
        config: StoreConfig | None = None,
        *,
        create: bool = True,
        signing: Signing | None = None,
        read_only: bool = False,
        now_ns: Callable[[], int] = clocks.day_ns,
        steady_ns: Callable[[], int] = clocks.steady_ns,
    ) -> None:
        self.path = Path(path)
        readers = ReaderPool(self.path)
        clock = _SteppedClock(clocks.boot_id(), steady_ns)
        if read_only:
            require_current(self.path)
            super().__init__(str(path), readers, NoWriter(self.path), config, signing, now_ns, clock, clocks.MACHINE)
        else:
            connection = open_writer(self.path, create=create, busy_timeout_s=BUSY_TIMEOUT_S)
            writer = SqliteWriter(connection, group_max=GROUP_MAX)
            super().__init__(str(path), readers, writer, config, signing, now_ns, clock, clocks.MACHINE)
            self._enter_boot()

    def backup(self, path: str | Path) -> None:
        """See `Store.backup`."""
        copy_store(self.path, Path(path))

    def sizes(self) -> dict[str, int]:
        """Of the file ("store") and of its log."""
        return {name: _size(Path(f"{self.path}{suffix}")) for name, suffix in (("store", ""), ("-wal", "-wal"))}

    def disk_free_bytes(self) -> int | None:
        """Of the file."""
        return shutil.disk_usage(Path(self.path).absolute().parent).free


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
