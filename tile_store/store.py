"""What a store of tiles and reports can do, whatever keeps it. `tests/tile_store/` holds every implementation to it."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.district_list import DistrictList
from gnd.schemas.tiles import Catalog, CatalogEntry
from gnd.tile_store.districts import DistrictOwners
from gnd.tile_store.roads import RoadPart
from gnd.tile_store.trials import VersionTrial
from gnd.tile_store.uploads import FirstHalf, Settled, Upload, UploadClaim, UploadCounts, UploadStatus
from gnd.tile_store.values import (
    DEFAULT_LAYER,
    Basis,
    Claim,
    ClosedWindow,
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
)


class Store(Protocol):
    """Versioned tiles, the inbox of reports, and the queue of tiles to merge.

    Every method may be called from any thread, and several processes may use one store at a time. What writes returns
    only when the change is durable. Every method raises StoreError (one line) when the store cannot do it.
    """

    # Uploads

    def put_upload(self, upload: Upload, home: str, patient_s: float = 0.0) -> PutStatus:
        """Keep a message as it came, received by shard `home`; the same bytes on the same key are a "duplicate". It may
        wait so long for a commit that others cause.
        """

    def claim_uploads(
        self, owner: str, n: int, lease_s: float, in_turn: Callable[[list[str]], list[str]] = sorted
    ) -> list[UploadClaim]:
        """Lease up to `n` uploads that wait: of the vehicles in the order into which `in_turn` brings them ("":
        Gaussians, which do not tell whose they are), a few of each, its oldest first; of those that it leaves out
        none. One that was claimed before comes alone.
        """

    def uploads_waiting(self, vehicle: str | None, at_most: int) -> int:
        """How many uploads wait, of one vehicle only those that nobody has looked at; at most so many are counted."""

    def postpone_upload(self, claim: UploadClaim, delay_s: float, *, blameless: bool = False) -> None:
        """Give an upload back, to be claimed again after `delay_s`; blameless: its attempts until now do not count."""

    def settle_upload(self, settled: Settled) -> bool:
        """Apply what has become of a claimed upload, all or nothing: its rows in the journal, its state, that of the
        flags that it answers. False, and nothing is applied: its lease is another's. IdTaken: the report id is another
        vehicle's on one of the tiles.
        """

    def first_halves(self, key: str, report_id: str) -> list[FirstHalf]:
        """The flags that have come under a report id on a key."""

    def first_parts(self, layer: str, report_id: str, tiles: Sequence[TileId]) -> list[ReportRow]:
        """The parts 0 that the journal holds of a report about these tiles, in this order."""

    def upload_statuses(self, vehicle: str, report_ids: Sequence[str]) -> list[UploadStatus]:
        """How far a vehicle's reports have come; those of which the store holds nothing are left out."""

    def upload_counts(self) -> UploadCounts:
        """How many uploads are in which state."""

    def forget_uploads(self, before_ns: int) -> int:
        """Forget what came before a time and is settled; the number forgotten. The journal keeps its reports."""

    def put_road_part(self, part: RoadPart) -> PutStatus:
        """Keep a part of a survey of a road that the map does not have; one that is known is a "duplicate". IdTaken:
        its survey is another vehicle's or layer's, or the part has come with another report id.
        """

    def road_reports(self, layer: str) -> set[str]:
        """The ids of the reports that brought surveys; `reports` does not give these."""

    # The inbox

    def put_reports(self, rows: Sequence[ReportRow]) -> list[PutStatus]:
        """Keep reports, all of a call or none. A row whose (layer, tile, report id, part) is known is a "duplicate" and
        changes nothing. Each new row gets its place in the tile's journal, and makes the tile dirty unless it is quiet
        about the newest version.
        """

    def reports(self, layer: str = DEFAULT_LAYER, vehicle: str | None = None) -> Iterator[ReportRow]:
        """All reports of a layer (and of one vehicle) in order of arrival, read in pages."""

    def in_play(self, layer: str, tile: TileId) -> TileJournal:
        """What counts of a tile since its epoch: what closed windows have come to, and the reports of those that are
        not folded. All is read at one instant.
        """

    def in_play_since(self, layer: str, tile: TileId, mark: JournalMark) -> tuple[JournalMark, list[ReportRow]] | None:
        """The reports in play that have come since, by number, and how far that reaches; None: a window has been folded
        or another epoch has begun since, so `in_play` is to be read again.
        """

    def quarantine(self, body: bytes, reason: str, source: str = "") -> None:
        """Keep refused bytes with the reason; the same bytes again are only counted."""

    def quarantined(self) -> list[Quarantined]:
        """What was refused, oldest first."""

    # The queue

    def claim(
        self, owner: str, n: int, lease_s: float, is_own: Callable[[District], bool] | None = None
    ) -> list[Claim]:
        """Lease up to `n` tiles that are ready to merge, those first that have waited longest. `is_own` says of which
        districts they belong to the owner: others it gets only where they have waited for long, and for much longer
        than its own.

        Leases and delays run by a clock that does not step; those of an earlier boot of the machine are over.
        """

    def begin(self, claims: Sequence[Claim], lease_s: float) -> list[bool]:
        """Count an attempt to merge each of these tiles and prolong its lease; False where another owner has it."""

    def release(self, owner: str) -> int:
        """Free all leases of an owner (it has died), those of uploads too; the number of tiles freed."""

    def postpone(self, claim: Claim, delay_s: float, *, blameless: bool = False) -> None:
        """Give a tile back, to be ready again after `delay_s` (its merge has failed); blameless: the attempt that was
        begun does not count.
        """

    def dirty_count(self) -> int:
        """Tiles that wait to be merged, leased ones included, those set aside not."""

    def ready_in_s(self) -> float | None:
        """How soon the next tile can be claimed (a lease's end included), at most 0 when it can be now; None: nothing
        waits.
        """

    def set_aside(self, claim: Claim, reason: str) -> bool:
        """Leave a tile that cannot be merged as it is; its reports go on waiting. It is tried again when a report about
        it arrives, when somebody takes it up again, and once after a minute, then ever more seldom. False where the
        lease has gone to another owner.
        """

    def tiles_set_aside(self) -> list[TileSetAside]:
        """The tiles that are set aside, by layer and tile."""

    def take_up_again(self, tiles: Iterable[tuple[str, TileId]]) -> int:
        """Make tiles that are set aside ready to merge; how many of them were."""

    # Shards

    def join(self, owner: str) -> None:
        """A merger shard begins: leases of an earlier life of the same name are freed."""

    def beat(self, owner: str, claims: Sequence[Claim], lease_s: float) -> list[bool]:
        """A shard's sign of life, with which it prolongs its leases; False where one has gone to another owner."""

    def leave(self, owner: str) -> None:
        """A shard ends: its leases are freed."""

    def shards(self) -> list[ShardSeen]:
        """The shards that have joined and not left, by name."""

    def queue_state(self) -> QueueState:
        """How far the merging lags behind what has arrived, and how much is in quarantine."""

    # Merging and publishing

    def load(self, claim: Claim) -> TileWork:
        """All that the merge of a claimed tile needs, read at one instant."""

    def basis(self, layer: str, tile: TileId, version: int) -> Basis | None:
        """What of its tile's journal a version was made of; None: it is older than the journal, or the first base.

        Raises:
            StoreDamaged: its parameters are not what their digest says.
        """

    def closed_windows(self, layer: str, tile: TileId) -> dict[int, ClosedWindow]:
        """How each folded window of a tile was folded.

        Raises:
            StoreDamaged: parameters are not what their digest says.
        """

    def reports_of_windows(self, layer: str, tile: TileId, first: int, last: int, seq: int) -> tuple[ReportRow, ...]:
        """The reports of the windows `first` to `last` with numbers up to `seq`, by report id and part."""

    def windows(self) -> list[WindowCounts]:
        """The open window of each tile that anybody has reported about, by layer and tile."""

    def publish(self, publications: Sequence[Publication]) -> list[PublishResult]:
        """Publish merges in one transaction: each by compare-and-swap of the head from `base_version`, together with
        the consumption of its reports. A tile stays dirty when a report has arrived since its claim. Stale: the head
        has moved or the lease is another's; nothing of that publication is applied.
        """

    def put_tiles(
        self,
        tiles: Iterable[AnyTile],
        reason: VersionKind = "base",
        layer: str = DEFAULT_LAYER,
        surveyed_ns: int | None = None,
    ) -> list[PublishResult]:
        """Import tiles, all or none; each starts a new epoch. The same content over an equal epoch is "unchanged".
        Tiles hold what their layer holds: Gaussians where its name begins with ndt, else features. `surveyed_ns`: when
        the world was measured; of content that is there already the newest survey counts.
        """

    def rollback(self, layer: str, tile: TileId, version: int) -> StoredTile:
        """Publish the next version with the body of `version`; it starts a new epoch: merged reports count no more."""

    def notices(self, older_than_s: float = 0.0, n: int = 1000) -> list[Notice]:
        """Versions published at least `older_than_s` ago whose notice is not confirmed, oldest first."""

    def announced(self, notices: Sequence[Notice]) -> None:
        """Confirm that the update notices of these versions have gone out."""

    def check_signed(self, stored: StoredTile) -> None:
        """Whether one of our publishers answers for a version; a process without an identity takes what is there.

        Raises:
            StoreDamaged: nobody does.
        """

    def unsigned(self) -> int:
        """How many of the newest versions nobody has signed."""

    def publisher_chain(self, signer: bytes) -> bytes | None:
        """The certificates of somebody who has signed versions, by id (8 bytes): each as DER with its length (2 bytes)
        before it; None: nobody of that id has.
        """

    # Confirmation

    def waiting_changes(self) -> list[WaitingChange]:
        """What single vehicles claim and nobody has confirmed, by layer, tile, vehicle and reason."""

    def shifted_vehicles(self) -> frozenset[str]:
        """The vehicles whose reports are explained by shifts again and again. When one comes or goes, all tiles that it
        has reported about wait to be merged again.
        """

    def quarantined_vehicles(self) -> frozenset[str]:
        """The vehicles whose reports do not count. When one comes or goes, all tiles that it has reported about wait to
        be merged again.
        """

    def vehicle_trusts(self) -> list[VehicleTrust]:
        """What is known of the word of each vehicle that others could judge, or that is quarantined, by vehicle."""

    def quarantine_vehicle(self, vehicle: str, why: str) -> None:
        """Let a vehicle's reports count no more, until `release_vehicle`."""

    def release_vehicle(self, vehicle: str) -> bool:
        """Let a vehicle's reports count again, and pardon what was held against it; False: it was not quarantined."""

    def marks_of_tile(self, layer: str, tile: TileId) -> frozenset[str]:
        """Words (`marks`) about the vehicles that have reported about a tile and are not believed alone, or have one
        vote with others. When one comes or goes, the tiles in whose open windows its vehicle has spoken wait to be
        merged again.
        """

    def lone_words(self) -> list[LoneWord]:
        """Who is not believed alone, on which day or in general, and why; of all vehicles of an owner as `@DIGEST`."""

    def impossible_places(self) -> list[ImpossibleSaid]:
        """Vehicles of which reports were refused because they cannot have been there, by vehicle."""

    def unheard_vehicles(self) -> dict[str, int]:
        """Vehicles of which statements of some kind do not count somewhere, and in how many windows of tiles."""

    def days_alone(self) -> list[DayAlone]:
        """What each vehicle has changed alone and with others on each day, by vehicle and day."""

    def pairs_of_groups(self) -> list[VehiclePair]:
        """Vehicles two by two that say the same false things, by name."""

    def refuted_tests(self) -> list[tuple[str, TileId, str, str]]:
        """The newest reports that others contradict as a whole: layer, tile, report id, vehicle; the newest first."""

    def note_owner(self, vehicle: str, owner: str, since_ns: int) -> None:
        """Whose a vehicle is from then on, as its certificate says; it stands in the store before its report does."""

    def owners_of(self, vehicles: Iterable[str]) -> dict[str, tuple[tuple[int, str], ...]]:
        """Of those vehicles whose owner is known: since when, UTC ns, and a digest of the owner's name; ascending."""

    def refuted_reports(self, layer: str, vehicles: Iterable[str]) -> dict[str, str]:
        """The reports of some vehicles about a layer that others contradict in most tiles, and whose each is. When one
        comes or goes, all tiles that its vehicle speaks of wait to be merged again.
        """

    def vehicle_accounts(self) -> list[VehicleAccount]:
        """What shift tests and courses say of each vehicle of which there are any, by vehicle."""

    def dirty_tiles(self) -> list[DirtyTile]:
        """Tiles that wait to be merged, by layer and tile."""

    # Trials

    def trials(self, layer: str, prefix: str = "") -> Mapping[TileId, VersionTrial]:
        """The versions on trial of a region (a prefix of tile paths), by tile."""

    def doubted_vehicles(self, layer: str, tile: TileId) -> frozenset[str]:
        """The vehicles behind a version of a tile that was withdrawn, until their reports are cleared."""

    # Reading

    def get(self, layer: str, tile: TileId, version: int | None = None, at_ns: int | None = None) -> StoredTile | None:
        """A tile's newest version, or the one named, or the newest at a time; None: there is none."""

    def get_each(self, layer: str, tiles: Sequence[TileId]) -> list[StoredTile | None]:
        """The newest versions of some tiles, in their order, read at once; None: there is none."""

    def by_sha(self, layer: str, tile: TileId, sha: bytes) -> StoredTile | None:
        """The newest version of a tile with this content."""

    def layers(self) -> list[str]:
        """The layers that hold tiles."""

    def districts(self) -> frozenset[District]:
        """The districts in which any layer holds tiles."""

    def district_owners(self) -> DistrictOwners:
        """Which districts this store owns, where several share a map."""

    def catalog(self, layer: str, district: District) -> Catalog:
        """The newest released versions of a district's tiles, with the signature of who answers for all of them, as
        they are at one instant.
        """

    def district_list(self, layer: str) -> DistrictList | None:
        """Which districts a layer has, as a publisher has signed it; None: nobody has."""

    def heads(self, layer: str = DEFAULT_LAYER, prefix: str = "") -> list[CatalogEntry]:
        """The newest versions of a region's tiles (a prefix of their path), sorted by tile."""

    def head_lines(self, layer: str = DEFAULT_LAYER, prefix: str = "") -> list[HeadLine]:
        """The same with their times, codecs and sizes; no body is read."""

    def history(self, layer: str, tile: TileId) -> list[VersionInfo]:
        """The versions of a tile that retention has left, oldest first."""

    def provenance(self, layer: str, tile: TileId, version: int) -> tuple[str, ...]:
        """The report ids that a version comes from, sorted."""

    def voxel_provenance(self, layer: str, tile: TileId, version: int) -> dict[int, tuple[str, ...]]:
        """The report ids of each changed voxel (of a feature layer: by feature id), where its publication gave them."""

    def counts(self) -> StoreCounts:
        """How much the store holds."""

    # Upkeep

    def gc(self, keep_versions: int) -> GcResult:
        """Remove old versions. Kept: a tile's newest `keep_versions`, its epoch, and what reports cite that are not
        folded.
        """

    def backup(self, path: str | Path) -> None:
        """A consistent copy while the store is in use, compared with its hashes; nothing is overwritten."""

    def close(self) -> None:
        """Finish what is queued and free the store. Calling it twice is harmless."""
