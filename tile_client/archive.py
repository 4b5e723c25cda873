"""An archive of a region on any web server (`gnd map publish`): what it holds, and its tiles, checked.

Neither the server nor what lies between is believed: a tile is taken where its content has its hash and, for who has
an authority, where one of its publishers has signed it and no newer version was seen; its index likewise.
"""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Generic, Self, TypeVar

from gnd.fleet_bus.errors import BusError, RequestFailed, SealError
from gnd.fleet_bus.ledger import Ledger, Share
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.content import AnyTile, TileT, fits_layer, noun_of
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.archive import (
    ROOT_NAME,
    ArchiveEntry,
    ArchiveIndex,
    ArchiveRoot,
    certificate_name,
    index_name,
    pack_name,
)
from gnd.schemas.errors import SchemaError
from gnd.schemas.tiles import TileBlob, TileReply, content_of
from gnd.schemas.version_signature import VersionSignature
from gnd.tile_client.archive_check import ArchiveCheck, SeenStates
from gnd.tile_client.checking import VersionCheck
from gnd.tile_client.errors import ArchiveAway, ArchiveError, ArchiveWrong
from gnd.tile_client.exchange import TileHolder
from gnd.tile_client.http_reader import PATIENT, HttpFile, HttpReader, Patience

GAP_BYTES: Final = 4_096
"""What lies between two tiles and is not wanted is read along up to this: a request costs more."""
SPAN_BYTES: Final = 1_000_000
"""Of one request: what a slow link carries before its time is up."""
MOST_CERTIFICATE_BYTES: Final = 16 * 1024
INDEX_KEPT_S: Final = 30.0
"""A vehicle asks again whether the index of a district has changed after this time."""
INDEXES_KEPT: Final = 64
AWAY_S: Final = 5.0
"""A vehicle leaves an archive alone for so long after it did not answer, ..."""
LONGEST_AWAY_S: Final = 300.0
"""... twice as long each time, up to this."""
_SELDOM: Final = Seldom(logging.getLogger(__name__))
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class ArchiveTile:
    """A tile that came, decoded, with its content as it came and its signature; it has its hash."""

    tile: AnyTile
    blob: TileBlob
    signature: VersionSignature | None


@dataclass(frozen=True, slots=True)
class _Kept:
    """An index that was read, None: there is none; what the server calls it, and when that was."""

    index: ArchiveIndex | None
    etag: str
    read_s: float


class Archive:
    """Reads an archive. Safe in several threads.

    Args:
        url: http://… or https://…, where `archive.gnd` is.
        ledger: is told all that is sent and comes.
        patience: with the server.

    Raises:
        ArchiveError: the URL cannot be one.
    """

    def __init__(self, url: str, ledger: Ledger | None = None, patience: Patience = PATIENT) -> None:
        self._reader, self._ledger = HttpReader(url, patience), Ledger() if ledger is None else ledger
        self._lock, self._indexes = threading.Lock(), OrderedDict[tuple[str, District], _Kept]()

    @property
    def url(self) -> str:
        """Where it is."""
        return self._reader.url

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._reader.close()

    def root(self) -> ArchiveRoot:
        """Which districts there are.

        Raises:
            ArchiveError: it is not to be had, or none.
        """
        found = self._reader.get(ROOT_NAME, limits.MAX_ARCHIVE_ROOT_BYTES)
        if found is None or found.body is None:
            raise ArchiveWrong(f"{self.url}: no archive of `gnd map publish`: no {ROOT_NAME} there")
        self._book("catalog", found)
        return self._decoded(ROOT_NAME, ArchiveRoot.decode, found.body)

    def index(self, layer: str, district: District, kept_s: float = 0.0) -> ArchiveIndex | None:
        """What there is of a district; None: nothing.

        Args:
            layer: name of the layer.
            district: which one.
            kept_s: one that was read within this time will do.

        Raises:
            ArchiveError: it is not to be had, or none.
        """
        place = layer, district
        with self._lock:
            kept = self._indexes.get(place)
        if kept is not None and time.monotonic() - kept.read_s < kept_s:
            return kept.index
        name = index_name(layer, district)
        etag = "" if kept is None else kept.etag
        found = self._reader.get(name, limits.MAX_ARCHIVE_INDEX_BYTES, etag=etag)
        now = _Kept(None, "", time.monotonic())
        if found is not None:
            self._book("catalog", found)
            index = kept.index if found.body is None and kept else self._index(name, place, found.body or b"")
            now = _Kept(index, found.etag or etag, now.read_s)
        with self._lock:
            self._indexes[place] = now
            self._indexes.move_to_end(place)
            if len(self._indexes) > INDEXES_KEPT:
                self._indexes.popitem(last=False)
        return now.index

    def _index(self, name: str, place: tuple[str, District], body: bytes) -> ArchiveIndex:
        index = self._decoded(name, ArchiveIndex.decode, body)
        if (index.layer, index.district) != place:
            raise ArchiveWrong(f"{self.url}{name}: is that of {index.layer} {index.district}")
        return index

    def tiles(self, layer: str, entries: Sequence[ArchiveEntry]) -> Iterator[ArchiveTile | tuple[ArchiveEntry, str]]:
        """Tiles of one index, those of a span together; of one that is wrong its entry and what is wrong with it.

        Raises:
            ArchiveError: a span of them is not to be had.
        """
        for span in spans(entries):
            for entry, record in self._records(span):
                try:
                    yield self._tile(layer, entry, record)
                except GndError as error:
                    yield entry, f"{self.url}: tile {entry.tile} of layer {layer} version {entry.version}: {error}"

    def _records(self, span: Sequence[ArchiveEntry]) -> Iterator[tuple[ArchiveEntry, bytes]]:
        pack, start, end = span[0].pack, span[0].start, max(entry.end for entry in span)
        name = pack_name(pack.sha)
        found = self._reader.get(name, end - start, (start, end, pack.size_bytes))
        if found is None or found.body is None:
            raise ArchiveAway(f"{self.url}{name}: not there, though an index names it")
        records = [(entry, found.body[entry.start - start : entry.end - start]) for entry in span]
        shares = [Share("tile", len(record), entry.tile) for entry, record in records]
        between = len(found.body) - sum(share.app_bytes for share in shares)
        self._book("tile", found, [Share("tile", between), *shares])
        yield from records

    def _tile(self, layer: str, entry: ArchiveEntry, record: bytes) -> ArchiveTile:
        reply = TileReply.decode(record)
        blob = reply.blob
        if blob is None or (blob.tile, blob.version) != (entry.tile, entry.version):
            raise ArchiveWrong("another tile or version lies there")
        tile = content_of(blob)
        if not fits_layer(tile, layer):
            raise ArchiveWrong(f"holds {noun_of(tile)}")
        if not tile.sha.startswith(entry.hash):
            raise ArchiveWrong("another content than the index names")
        return ArchiveTile(tile, blob, reply.signature)

    def certificate(self, signer: bytes) -> bytes:
        """The certificates of somebody who has signed versions.

        Raises:
            ArchiveError: they are not to be had.
        """
        name = certificate_name(signer)
        found = self._reader.get(name, MOST_CERTIFICATE_BYTES)
        if found is None or found.body is None:
            raise ArchiveWrong(f"{self.url}{name}: not there")
        self._book("control", found)
        return found.body

    def fetch_certificate(self, signer: bytes) -> bytes:
        """`certificate`, as `Publishers` asks; `RequestFailed` where it is not to be had."""
        try:
            return self.certificate(signer)
        except ArchiveError as error:
            raise RequestFailed(certificate_name(signer), 1, str(error)) from error

    def _decoded(self, name: str, decode: Callable[[bytes], _T], body: bytes) -> _T:
        try:
            return decode(body)
        except SchemaError as error:
            raise ArchiveWrong(f"{self.url}{name}: {error}") from error

    def _book(self, kind: str, found: HttpFile, shares: Sequence[Share] = ()) -> None:
        self._ledger.record("up", kind, 0, head_bytes=found.sent_bytes)
        told = shares or [Share(kind, len(found.body or b""))]
        self._ledger.record_shares("down", told, head_bytes=found.head_bytes, took_s=found.took_s)


def spans(entries: Sequence[ArchiveEntry]) -> list[list[ArchiveEntry]]:
    """Entries in groups that one request brings: of one pack, near each other, not too long."""
    order = sorted(entries, key=lambda entry: (entry.pack.sha, entry.start))
    groups: list[list[ArchiveEntry]] = [order[:1]] if order else []
    for before, entry in pairwise(order):
        first = groups[-1][0]
        is_near = entry.pack == before.pack and before.end <= entry.start <= before.end + GAP_BYTES
        if is_near and entry.end - first.start <= SPAN_BYTES:
            groups[-1].append(entry)
        else:
            groups.append([entry])
    return groups


class ArchiveTiles(Generic[TileT]):
    """Fills a holder from an archive with tiles of which it has nothing, so that the bus need not bring them whole.

    It never fails: what does not come this way, or is not to be used, comes over the bus. Safe in several threads.

    Args:
        archive: where from; others may read it, too.
        holder: where to.
        check: of the versions that come, and of the archive's indexes; None: they are taken as they are.
        seen: which states of indexes were seen before.
    """

    def __init__(
        self, archive: Archive, holder: TileHolder[TileT], check: VersionCheck | None, seen: SeenStates | None = None
    ) -> None:
        self._archive, self._holder, self._check = archive, holder, check
        self._indexes = None if check is None else ArchiveCheck(check.publishers, seen or SeenStates())
        self._asking, self._lock = threading.Lock(), threading.Lock()
        self._not_before_s, self._away_s = 0.0, AWAY_S

    @property
    def is_left_alone(self) -> bool:
        """Whether it did not answer a moment ago."""
        with self._lock:
            return time.monotonic() < self._not_before_s

    def bring(self, tiles: Sequence[TileId]) -> int:
        """Bring tiles of one district that are not held; how many came."""
        if not tiles or self.is_left_alone:
            return 0
        try:
            missing = set(tiles) - self._holder.heads(tiles).keys()
            brought = self._bring(tiles[0].district, missing) if missing else 0
        except (ArchiveError, BusError) as error:
            self._leave_alone(error)
            return 0
        except GndError as error:  # of the holder
            _SELDOM.warning("nothing is brought from %s: %s", self._archive.url, error)
            return 0
        with self._lock:
            self._away_s = AWAY_S
        return brought

    def _bring(self, district: District, missing: set[TileId]) -> int:
        with self._asking:  # threads that begin together need it once
            index = self._archive.index(self._holder.layer, district, INDEX_KEPT_S)
        if self._indexes is not None and index is not None:
            self._indexes.index(self._archive, index)
        entries = [entry for entry in index.entries if entry.tile in missing] if index else []
        brought = 0
        for found in self._archive.tiles(self._holder.layer, entries):
            brought += self._take(found)
        return brought

    def _take(self, found: ArchiveTile | tuple[ArchiveEntry, str]) -> bool:
        if isinstance(found, tuple):
            _SELDOM.warning("%s", found[1])
            return False
        try:
            if self._check is not None:
                signed = found.signature
                if signed is not None and not self._check.publishers.knows(signed.signer):
                    self._check.publishers.learn(self._archive.certificate(signed.signer))
                self._check.check(found.tile, signed)
        except (SchemaError, SealError) as error:
            _SELDOM.warning("%s: %s", self._archive.url, error)
            return False
        return self._holder.put(found.tile, b"", found.blob)  # type: ignore[arg-type]  # `fits_layer` has looked

    def _leave_alone(self, error: GndError) -> None:
        with self._lock:
            self._not_before_s = time.monotonic() + self._away_s
            self._away_s = min(2 * self._away_s, LONGEST_AWAY_S)
        _SELDOM.warning("tiles come over the bus alone: %s", error)
