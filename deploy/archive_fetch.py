"""A store filled, or brought up to date, from an archive on a web server: it becomes a mirror of what was published."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.archive import ArchiveEntry, ArchiveIndex, ArchiveRoot, index_name
from gnd.schemas.errors import SchemaError
from gnd.schemas.tiles import CatalogEntry
from gnd.tile_client.archive import Archive
from gnd.tile_client.archive_check import ArchiveCheck, SeenStates
from gnd.tile_client.checking import SeenVersion, VersionCheck
from gnd.tile_client.errors import ArchiveAway, ArchiveStale
from gnd.tile_store.district_lists import mirror_list
from gnd.tile_store.mirroring import MirroredTile, check_mirror, mirror, mirror_catalog
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import NS_PER_S

TOGETHER: Final = 256
"""So many tiles go into the store in one transaction."""
Progress = Callable[[str, int, int], None]


@dataclass(slots=True)
class FetchedArchive:
    """What has come.

    Attributes:
        districts: looked at.
        tiles: that the archive holds there, ...
        unchanged: ... of which so many were here already, ...
        fetched: ... so many have come, ...
        unsigned: ... of these so many without a signature, or with one that nobody looked at, ...
        wrong: ... and what is wrong with the others; of these what was here stays.
        signed_by: who has signed the archive; empty: nobody looked at that.
        number: how often it was published until then; 0: nobody looked.
        signed_s: when that was, POSIX seconds; 0: nobody looked.
    """

    districts: int = 0
    tiles: int = 0
    unchanged: int = 0
    fetched: int = 0
    unsigned: int = 0
    wrong: dict[str, str] = field(default_factory=dict)
    signed_by: str = ""
    number: int = 0
    signed_s: int = 0


class ArchiveFetcher:
    """Brings a store to what an archive holds.

    Args:
        archive: where from.
        store: where to; it must take no reports.
        publishers: whose signatures count; None: nobody looks at signatures, and none are kept.
        seen: which states of archives were seen before.
        oldest_s: an archive that was signed longer ago is refused, s; None: any age will do.

    Raises:
        StoreError: the store takes reports.
    """

    def __init__(
        self,
        archive: Archive,
        store: SqlStore,
        publishers: Publishers | None,
        seen: SeenStates | None = None,
        oldest_s: float | None = None,
    ) -> None:
        check_mirror(store)
        self._archive, self._store, self._publishers = archive, store, publishers
        self._check = None if publishers is None else ArchiveCheck(publishers, seen or SeenStates(), oldest_s)
        self._chains: dict[bytes, bytes] = {}
        self.done = FetchedArchive()

    def fetch(
        self, layers: Sequence[str], region: Region, progress: Progress = lambda _step, _done, _total: None
    ) -> FetchedArchive:
        """Bring what differs, district by district; what has come stays, also where a later one fails.

        Args:
            layers: which layers; none: all that the archive has.
            region: which tiles.
            progress: is told the layer, districts done, and how many there are.

        Raises:
            ArchiveError: the archive, or a part of it, is not to be had, or not to be believed.
            StoreError: the store fails.
        """
        root = self._root()
        for layer in layers or sorted(root.districts):
            districts = [one for one in root.districts.get(layer, ()) if region.touches(one)]
            for place, district in enumerate(districts, 1):
                self._district(root, layer, district, region)
                progress(layer, place, len(districts))
            self._keep_list(root, layer)
        return self.done

    def _root(self) -> ArchiveRoot:
        """The root of the archive, and who has signed it."""
        root = self._archive.root()
        if self._check is not None:
            self.done.signed_by = self._check.root(self._archive, root)
            assert root.sealed is not None
            self.done.number, self.done.signed_s = root.sealed.seal.number, root.sealed.seal.signed_s
        return root

    def _district(self, root: ArchiveRoot, layer: str, district: District, region: Region) -> None:
        """A pack that was removed since its index was read is no reason to give up: there is a newer index."""
        self.done.districts += 1
        try:
            self._bring(layer, self._index(root, layer, district), region)
        except (ArchiveAway, ArchiveStale):
            self._bring(layer, self._index(root, layer, district), region)

    def _index(self, root: ArchiveRoot, layer: str, district: District) -> ArchiveIndex | None:
        index = self._archive.index(layer, district)
        if self._check is None:
            return index
        if index is None:
            raise self._check.missing(self._archive, index_name(layer, district))
        self._check.index(self._archive, index, root)
        return index

    def _bring(self, layer: str, index: ArchiveIndex | None, region: Region) -> None:
        if index is None:
            return
        held = {head.tile: head for head in self._store.heads(layer, index.district.path)}
        entries = [entry for entry in index.entries if entry.tile in region]
        wanted = list(self._wanted(layer, entries, held))
        check = None
        if self._publishers is not None:
            check = VersionCheck(self._publishers, layer, _SeenInStore(self._store, layer))
        came = list[MirroredTile]()
        try:
            for one in self._checked(layer, wanted, check):
                came.append(one)
                if len(came) == TOGETHER:
                    self._keep(layer, came)
        finally:
            self._keep(layer, came)
        self._keep_catalog(layer, index)
        self.done.tiles += len(entries)
        self.done.unchanged += len(entries) - len(wanted)

    def _keep_list(self, root: ArchiveRoot, layer: str) -> None:
        """Who answers for the list of the map's districts is kept, also where a part of them is mirrored."""
        told, publishers = root.lists.get(layer), self._publishers
        if told is None or publishers is None or self._store.district_list(layer) == told:
            return
        signer = told.signature.signer
        if not mirror_list(self._store, publishers, told, self._store.publisher_chain(signer) or self._chain(signer)):
            why = "nobody of ours answers for it, or it is an older one than is here"
            self.done.wrong[f"{layer}, list of districts"] = why

    def _keep_catalog(self, layer: str, index: ArchiveIndex) -> None:
        """Who answers for the catalog is kept where the whole district is here as it was signed."""
        signed, publishers, district = index.catalog, self._publishers, index.district
        if signed is None or publishers is None or self._store.catalog(layer, district).signature == signed:
            return
        chain = self._store.publisher_chain(signed.signer) or self._chain(signed.signer)
        mirror_catalog(self._store, publishers, layer, district, signed, chain)

    def _wanted(
        self, layer: str, entries: Sequence[ArchiveEntry], held: dict[TileId, CatalogEntry]
    ) -> Iterator[ArchiveEntry]:
        """The entries that are not here; of those that are older than what is here it is said, and they are left."""
        for entry in entries:
            head = held.get(entry.tile)
            if head is None or head.version < entry.version:
                yield entry
            elif head.version > entry.version or not head.sha.startswith(entry.hash):
                self.done.wrong[f"{layer} {entry.tile.path}"] = (
                    f"version {entry.version} is offered, version {head.version} is here: an older state, or a store"
                    " that was built anew; in that case fetch into another file"
                )

    def _checked(
        self, layer: str, entries: Sequence[ArchiveEntry], check: VersionCheck | None
    ) -> Iterator[MirroredTile]:
        for found in self._archive.tiles(layer, entries):
            if isinstance(found, tuple):
                entry, why = found
                self.done.wrong[f"{layer} {entry.tile.path}"] = why
                continue
            try:
                if check is not None:
                    check.check(found.tile, found.signature)
            except SchemaError as error:
                self.done.wrong[f"{layer} {found.tile.tile_id.path}"] = str(error)
                continue
            signature = None if check is None else found.signature
            chain = b"" if signature is None else self._chain(signature.signer)
            yield MirroredTile(found.tile, found.blob, signature, chain)

    def _chain(self, signer: bytes) -> bytes:
        """The certificates behind a signature that was checked, to be kept with it."""
        if signer not in self._chains:
            chain = self._archive.certificate(signer)
            assert self._publishers is not None
            self._publishers.learn(chain)  # or anything could be kept
            self._chains[signer] = chain
        return self._chains[signer]

    def _keep(self, layer: str, came: list[MirroredTile]) -> None:
        some, came[:] = list(came), []
        if some:
            mirror(self._store, layer, some)
            self.done.fetched += len(some)
            self.done.unsigned += sum(one.signature is None for one in some)


@dataclass(frozen=True, slots=True)
class _SeenInStore:
    """What is in the store was seen."""

    store: SqlStore
    layer: str

    def seen(self, tile: TileId) -> SeenVersion:
        """See `SeenVersions.seen`."""
        stored = self.store.get(self.layer, tile)
        if stored is None or stored.signature is None:
            return SeenVersion()
        return SeenVersion(stored.created_ns // NS_PER_S, stored.version)

    def note(self, tile: TileId, seen: SeenVersion) -> None:
        """It is noted when it is put there."""
