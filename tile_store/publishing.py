"""A store's released versions as a static archive in a folder or a bucket (`gnd.schemas.archive` says of what).

Packs are written before the index that names them, and an index is replaced as a whole: whoever reads sees a district
as it was before or as it is now. Whoever is interrupted publishes again; districts that are done stay done. Nothing is
removed but by `prune`.

Who publishes with an identity signs each index that it writes, and each time the root, which names all indexes: a
mirror can neither mix states nor pass an older one off as a newer one.
"""

import logging
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from hashlib import sha256
from itertools import groupby
from typing import Final

from gnd.fleet_bus.errors import SealError
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.archive import (
    CERTIFICATE_FOLDER,
    INDEX_FOLDER,
    PACK_FOLDER,
    ROOT_NAME,
    SIGNED_BYTES,
    UNSIGNED,
    ArchiveEntry,
    ArchiveIndex,
    ArchiveRoot,
    Pack,
    certificate_name,
    index_name,
    pack_name,
    place_of_index,
)
from gnd.schemas.archive_seal import ARCHIVE_ID_BYTES, Sealed, SealedPart, digest_of_index, with_seal
from gnd.schemas.catalog_signature import CatalogSignature, CatalogStatement
from gnd.schemas.district_list import DistrictList
from gnd.schemas.errors import SchemaError
from gnd.schemas.limits import MAX_ARCHIVE_INDEX_BYTES, MAX_ARCHIVE_ROOT_BYTES, MAX_PACK_BYTES
from gnd.schemas.tile_answer import ANSWER_HASH_BYTES
from gnd.schemas.tiles import Catalog, CatalogEntry, TileReply
from gnd.tile_store.connection import fetch
from gnd.tile_store.errors import StoreError
from gnd.tile_store.objects import FolderObjects, NamedObjects
from gnd.tile_store.regions import morton_range
from gnd.tile_store.released import released_heads
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import NS_PER_S, StoredTile

MOST_PACKS: Final = 8
"""A district in more packs is packed anew: a client asks once for each."""
LEAST_LIVE: Final = 0.5
"""So is one of whose packs less than this share is still named."""
PRUNED_AFTER_S: Final = 3600.0
"""What nothing names stays for so long: a publisher may be about to name it, a reader hold an index that does."""
CATALOG_SHOWN_S: Final = 6 * 3600
"""A mirror may show a catalog's signature that is so much older than the newest one, s."""
_DISTRICT_DIGITS: Final = 15
_LOG = logging.getLogger(__name__)
Progress = Callable[[str, int, int], None]


@dataclass(slots=True)
class Published:
    """What publishing has done.

    Attributes:
        districts: looked at, ...
        switched: ... of which so many have a new index, ...
        repacked: ... so many of them because their tiles lay in too many packs, or among too much that is outdated.
        tiles: published in these districts, ...
        written: ... of which so many were written now.
        objects, bytes: written, all together.
        unsigned: published tiles that nobody has signed.
        set_back: tiles whose published version had a higher number.
        damaged: tiles that cannot be read, and why; what was published of them stays.
        number: how often the archive was published by somebody who signs; 0: nobody does.
    """

    districts: int = 0
    switched: int = 0
    repacked: int = 0
    tiles: int = 0
    written: int = 0
    objects: int = 0
    bytes: int = 0
    unsigned: int = 0
    set_back: int = 0
    damaged: dict[str, str] = field(default_factory=dict)
    number: int = 0


@dataclass(frozen=True, slots=True)
class Pruned:
    """What `prune` has removed, and how many packs are still named."""

    objects: int
    bytes: int
    named: int


def check_whole_districts(region: str) -> str:
    """The region itself; StoreError where it is smaller than a district, which has one index."""
    morton_range(region)
    if len(region.replace("/", "")) > _DISTRICT_DIGITS:
        raise StoreError(f"region {region!r} is smaller than a district; its first three chunks name the whole one")
    return region


def publish(
    store: SqlStore,
    objects: NamedObjects,
    layers: Sequence[str],
    regions: Sequence[str] = ("",),
    progress: Progress = lambda _step, _done, _total: None,
    signing: Signing | None = None,
) -> Published:
    """Bring an archive to the store's released versions.

    Args:
        store: it is only read.
        objects: where the archive is, or will be.
        layers: which layers.
        regions: leading parts of tile paths, whole districts.
        progress: is told the layer, districts done, and how many there are.
        signing: of who publishes; None: the archive is not signed.

    Raises:
        StoreError: a region that cuts through districts; the store or the objects fail; somebody else publishes there;
            the archive is signed, and who publishes has no identity.
    """
    done = Published()
    with _alone(objects):
        writing = _Writing(store, objects, signing)
        for layer in layers:
            heads = {
                head.tile: head
                for region in map(check_whole_districts, regions)
                for head in released_heads(store, layer, region)
            }
            districts = groupby(sorted(heads.values(), key=lambda head: head.tile), key=lambda head: head.tile.district)
            listed = [(district, list(some)) for district, some in districts]
            for place, (district, some) in enumerate(listed, 1):
                writing.district(layer, district, some, done)
                progress(layer, place, len(listed))
        writing.root(done, layers)
    return done


def prune(objects: NamedObjects, older_than_s: float = PRUNED_AFTER_S) -> Pruned:
    """Remove packs that no index names and that were written so long ago. What an index names stays, whoever wrote it.

    Raises:
        StoreError: an index cannot be read, so that nobody knows what it names; nothing is removed then.
    """
    before_ns = time.time_ns() - round(older_than_s * NS_PER_S)
    with _alone(objects):
        listed = {one.name for one in objects.each(PACK_FOLDER)}  # before the indexes are read: later ones stay
        named = {pack_name(pack.sha) for index in _indexes(objects) for pack in index.packs}
        # and after: one that a publisher has written again meanwhile is young now
        old = [one for one in objects.each(PACK_FOLDER) if one.name in listed - named and one.written_ns < before_ns]
        objects.remove(one.name for one in old)
        if isinstance(objects, FolderObjects):
            objects.remove_partial(before_ns)
    return Pruned(len(old), sum(one.size_bytes for one in old), len(named))


class _Writing:
    """Writes districts of one store to one archive."""

    def __init__(self, store: SqlStore, objects: NamedObjects, signing: Signing | None) -> None:
        self._store, self._objects, self._signing = store, objects, signing
        self._certificates = {one.name for one in objects.each(CERTIFICATE_FOLDER)}
        self._root_data = objects.get(ROOT_NAME)
        self._root = self._root_before()
        sealed = self._root.sealed
        if signing is None and sealed is not None:
            raise StoreError(
                f"{objects.location}: the archive is signed; publish with the identity of a shard or an operator"
                " (--identity FOLDER)"
            )
        self._archive = secrets.token_bytes(ARCHIVE_ID_BYTES) if sealed is None else sealed.seal.archive
        self._digests = dict[tuple[str, District], bytes]()  # of the indexes that were looked at

    def _root_before(self) -> ArchiveRoot:
        """The root as it was published; who signs takes none that nobody answers for."""
        try:
            root = ArchiveRoot() if self._root_data is None else ArchiveRoot.decode(self._root_data)
        except SchemaError as error:
            _LOG.warning("%s: %s is none and is written anew: %s", self._objects.location, ROOT_NAME, error)
            return ArchiveRoot()
        return root if self._signing is None or self._is_ours(root.sealed) else ArchiveRoot()

    def _is_ours(self, sealed: Sealed | None) -> bool:
        """Whether one of our publishers answers for a part of the archive."""
        if self._signing is None or sealed is None:
            return False
        signer = sealed.seal.signer
        is_known = self._signing.publishers.knows(signer)
        return self._signing.answers_for(sealed, None if is_known else self._objects.get(certificate_name(signer)))

    def district(self, layer: str, district: District, heads: Sequence[CatalogEntry], done: Published) -> None:
        """Write what is new of a district, then its index, where anything is."""
        name = index_name(layer, district)
        before, catalog = self._published(name), self._store.catalog(layer, district)
        why = self._not_as_signed(layer, district, catalog)
        if why:  # what was published stays: the seal of who publishes would make it ours
            done.damaged[f"{layer} {district.path}"] = why
            return
        signed = self._signed(layer, district)
        held = {} if before is None else dict(before.by_tile)
        kept = {head.tile: held[head.tile] for head in heads if _is_same(held.get(head.tile), head, signed)}
        done.districts += 1
        done.tiles += len(heads)
        done.set_back += sum(head.tile in held and held[head.tile].version > head.version for head in heads)
        if before is None or len(kept) < len(heads) or len(held) > len(heads):
            entries = self._entries(layer, heads, kept, held, done)
            index = ArchiveIndex(layer, district, tuple(sorted(entries, key=lambda entry: entry.tile)))
            kept = dict(index.by_tile)
        else:
            index = before
        index = replace(index, catalog=self._shown(catalog) if catalog.entries == tuple(heads) else None, sealed=None)
        self._write_index(name, index, before, done)
        done.unsigned += sum(entry.signed == UNSIGNED for entry in kept.values())

    def _not_as_signed(self, layer: str, district: District, catalog: Catalog) -> str:
        """Why a publisher's signature under a catalog does not fit what is in the store; "": it does, or there is
        none, or nobody looks.
        """
        signed = catalog.signature
        if signed is None or self._signing is None:
            return ""
        publishers = self._signing.publishers
        try:
            if not publishers.knows(signed.signer):
                publishers.learn(self._store.publisher_chain(signed.signer) or b"")
            text = signed.text(CatalogStatement.of(layer, district, catalog.entries))
            publishers.check(signed.signer, signed.signed_s, text, signed.signature)
        except SealError as error:
            return f"the catalog is not as it was signed (`gnd map verify --signatures`): {error}"
        return ""

    def _shown(self, catalog: Catalog) -> CatalogSignature | None:
        """The signature under a catalog, its certificates beside it."""
        if catalog.signature is not None:
            self._put_certificate(catalog.signature.signer, self._store.publisher_chain(catalog.signature.signer))
        return catalog.signature

    def _write_index(self, name: str, index: ArchiveIndex, before: ArchiveIndex | None, done: Published) -> None:
        """Write an index where it, or who answers for it, has changed."""
        sealed = None if before is None else before.sealed
        is_good = self._signing is None or self._is_ours(sealed)
        if index != before or not is_good or _is_outdated(before.catalog, index.catalog):
            body = index.encode()
            self._digests[index.layer, index.district] = digest_of_index(sha256(body).digest())
            data = self._sealed("index", body, sealed if is_good else None, MAX_ARCHIVE_INDEX_BYTES)
            self._put(name, data, done, changes=True)
            done.switched += 1
        elif sealed is not None:
            self._digests[index.layer, index.district] = digest_of_index(sealed.body_sha)

    def _sealed(self, part: SealedPart, body: bytes, before: Sealed | None, limit: int) -> bytes:
        """A part as it is written: with a seal where somebody signs."""
        if self._signing is None:
            return body
        seal, chain = self._signing.seal(part, body, self._archive, None if before is None else before.seal)
        self._put_certificate(seal.signer, chain)
        return with_seal(part, body, seal, limit)

    def root(self, done: Published, layers: Sequence[str]) -> None:
        """Name the districts that have an index: where that has changed; who signs says each time what holds now. With
        the lists of districts as they are signed, of layers that were not looked at as they were published.
        """
        places = sorted(place_of_index(one.name) for one in self._objects.each(INDEX_FOLDER))
        digests = dict[str, tuple[bytes, ...]]()
        if self._signing is not None:
            found = {place: digest for place in places if (digest := self._digest(*place))}
            digests = {layer: tuple(found[one] for one in some) for layer, some in _by_layer(list(found)).items()}
            places = list(found)
        districts = {layer: tuple(one for _, one in some) for layer, some in _by_layer(places).items()}
        before = self._root.sealed
        root = ArchiveRoot(districts, digests, lists=self._lists(layers, districts))
        data = self._sealed("root", root.encode(), before, MAX_ARCHIVE_ROOT_BYTES)
        if self._root_data != data:
            self._put(ROOT_NAME, data, done, changes=True)
        if self._signing is not None:
            done.number = 1 if before is None else before.seal.number + 1

    def _lists(self, layers: Sequence[str], districts: Mapping[str, object]) -> dict[str, DistrictList]:
        """The signed lists of districts, the certificates beside them; one that is not as it was signed is left out."""
        found = {layer: one for layer, one in self._root.lists.items() if layer not in layers}
        for layer in layers:
            told = self._store.district_list(layer)
            if told is None:
                continue
            chain = self._store.publisher_chain(told.signature.signer)
            try:
                if self._signing is not None:
                    self._signing.publishers.learn(chain or b"")
                    signed = told.signature
                    self._signing.publishers.check(signed.signer, signed.signed_s, told.text, signed.signature)
            except SealError as error:
                _LOG.warning("the list of districts of layer %s is not published: %s", layer, error)
                continue
            self._put_certificate(told.signature.signer, chain)
            found[layer] = told
        return {layer: one for layer, one in found.items() if layer in districts}

    def _digest(self, layer: str, district: District) -> bytes:
        """How an index is named: as it was looked at now, or else as the root names it; only else it is read. Empty: it
        is not, since none of our publishers answers for it.
        """
        known = self._digests.get((layer, district)) or self._root.digest(layer, district)
        if known:
            return known
        name = index_name(layer, district)
        index = self._published(name)
        if index is None or index.sealed is None or not self._is_ours(index.sealed):
            _LOG.warning("%s: %s is not signed, and the root does not name it", self._objects.location, name)
            return b""
        return digest_of_index(index.sealed.body_sha)

    def _published(self, name: str) -> ArchiveIndex | None:
        data = self._objects.get(name)
        try:
            return None if data is None else ArchiveIndex.decode(data)
        except SchemaError as error:
            _LOG.warning("%s: %s is none and is written anew: %s", self._objects.location, name, error)
            return None

    def _signed(self, layer: str, district: District) -> dict[TileId, bytes]:
        """Of the newest versions of a district the first bytes of their signatures; no body is read."""
        first, end = morton_range(district.path)
        rows = self._store.look(lambda c: fetch(c, "signed_heads", {"layer": layer, "first": first, "end": end}))
        released = {TileId(tile): bytes(signature or UNSIGNED)[:SIGNED_BYTES] for tile, signature in rows}
        for tile, trial in self._store.trials(layer, district.path).items():
            base = self._store.get(layer, tile, trial.base_version)
            released[tile] = UNSIGNED if base is None else _signed_of(base)
        return released

    def _entries(
        self,
        layer: str,
        heads: Sequence[CatalogEntry],
        kept: dict[TileId, ArchiveEntry],
        held: dict[TileId, ArchiveEntry],
        done: Published,
    ) -> list[ArchiveEntry]:
        """What the index will say; what it names is written."""
        if _is_scattered(list(kept.values())):
            kept = {}
            done.repacked += 1
        entries, records = list(kept.values()), list[tuple[StoredTile, bytes]]()
        for head in heads:
            if head.tile in kept:
                continue
            try:
                stored = self._readable(layer, head)
            except GndError as error:
                done.damaged[f"{layer} {head.tile.path}"] = str(error)
                entries += [held[head.tile]] if head.tile in held else []
                continue
            records.append((stored, _record(stored)))
        done.written += len(records)
        for some in _packs(records):
            entries += self._pack(some, done)
        return entries

    def _readable(self, layer: str, head: CatalogEntry) -> StoredTile:
        stored = self._store.get(layer, head.tile, head.version)
        if stored is None:
            raise StoreError(f"version {head.version} is gone")
        stored.decode()  # no client could use it else
        self._show_certificate(stored)
        return stored

    def _pack(self, records: Sequence[tuple[StoredTile, bytes]], done: Published) -> Iterator[ArchiveEntry]:
        data = b"".join(record for _, record in records)
        pack, start = Pack(sha256(data).digest(), len(data)), 0
        # written also where it is there: it is young then, and nobody prunes it before the index names it
        self._put(pack_name(pack.sha), data, done)
        for stored, record in records:
            content = stored.sha[:ANSWER_HASH_BYTES]
            yield ArchiveEntry(stored.tile, stored.version, content, _signed_of(stored), pack, start, len(record))
            start += len(record)

    def _show_certificate(self, stored: StoredTile) -> None:
        if stored.signature is None:
            return
        signer = stored.signature.signer
        if certificate_name(signer) not in self._certificates:
            self._put_certificate(signer, self._store.publisher_chain(signer))

    def _put_certificate(self, signer: bytes, chain: bytes | None) -> None:
        name = certificate_name(signer)
        if chain is not None and name not in self._certificates:
            self._objects.put(name, chain)
            self._certificates.add(name)

    def _put(self, name: str, data: bytes, done: Published, *, changes: bool = False) -> None:
        self._objects.put(name, data, changes=changes)
        done.objects += 1
        done.bytes += len(data)


def _by_layer(places: Sequence[tuple[str, District]]) -> dict[str, list[tuple[str, District]]]:
    """Sorted places of indexes by their layer."""
    return {layer: list(some) for layer, some in groupby(places, key=lambda one: one[0])}


def _alone(objects: NamedObjects) -> AbstractContextManager[None]:
    """One publisher at a time, where that can be told; of two, each index is as the later one wrote it."""
    return objects.locked() if isinstance(objects, FolderObjects) else nullcontext()


def _is_same(entry: ArchiveEntry | None, head: CatalogEntry, signed: dict[TileId, bytes]) -> bool:
    if entry is None:
        return False
    told = entry.version, entry.hash, entry.signed
    return told == (head.version, head.sha[:ANSWER_HASH_BYTES], signed.get(head.tile, UNSIGNED))


def _is_outdated(before: CatalogSignature | None, now: CatalogSignature | None) -> bool:
    """Whether an index that says the same is written anew for who answers for the catalog: seldom, for shards sign it
    again once an hour.
    """
    if before is None or now is None:
        return before is not now
    return now.signer != before.signer or now.signed_s - before.signed_s > CATALOG_SHOWN_S


def _is_scattered(kept: Sequence[ArchiveEntry]) -> bool:
    """Whether what stays lies in so many packs, or in packs so empty, that it is packed anew with what comes."""
    packs = {entry.pack for entry in kept}
    live = sum(entry.size for entry in kept)
    return len(packs) >= MOST_PACKS or live < LEAST_LIVE * sum(pack.size_bytes for pack in packs)


def _signed_of(stored: StoredTile) -> bytes:
    return UNSIGNED if stored.signature is None else stored.signature.signature[:SIGNED_BYTES]


def _record(stored: StoredTile) -> bytes:
    """A tile as it lies in a pack."""
    return TileReply("blob", stored.to_blob(), signature=stored.signature).encode()


def _packs(records: Sequence[tuple[StoredTile, bytes]]) -> Iterator[list[tuple[StoredTile, bytes]]]:
    """In groups that a pack holds."""
    group, size = list[tuple[StoredTile, bytes]](), 0
    for one in records:
        if group and size + len(one[1]) > MAX_PACK_BYTES:
            yield group
            group, size = [], 0
        group.append(one)
        size += len(one[1])
    if group:
        yield group


def _indexes(objects: NamedObjects) -> Iterator[ArchiveIndex]:
    for one in objects.each(INDEX_FOLDER):
        data = objects.get(one.name)
        try:
            if data is None:
                raise StoreError(f"{objects.location}: {one.name} has gone meanwhile")
            yield ArchiveIndex.decode(data)
        except SchemaError as error:
            raise StoreError(f"{objects.location}: {one.name} is no index, so nothing is removed: {error}") from error
