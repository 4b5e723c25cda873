"""The tile server: answers tile and catalog queries from a store. All that it remembers is what it has encoded.

Alone it answers for all keys. Where several stores share a map, it answers for the districts that its store owns: it
declares each of them, so that the router asks nobody else about them, and hears of all others with everybody. What it
reads, it reads between two looks at who owns the district: while a district moves, a part of it is never taken for all.
"""

import logging
import threading
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from itertools import groupby
from typing import Final, Self

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import NotMine, Refused
from gnd.fleet_bus.sealing import CERTIFICATE_ROOT
from gnd.fleet_bus.serving import Answer, Handler, Request, Serving
from gnd.gnd_map.codec import CODEC_FLOAT32
from gnd.gnd_map.content import FEATURE_CODECS
from gnd.gnd_map.errors import TileError
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import keys
from gnd.schemas.district_list import HEAD_ONLY
from gnd.schemas.errors import SchemaError
from gnd.schemas.limits import MAX_TILES_OF_DISTRICT
from gnd.schemas.tiles import TileRequest
from gnd.schemas.tiles_batch import TilesRequest
from gnd.tile_store.answers import TileAnswers, reads_layer
from gnd.tile_store.districts import DistrictOwners, KnownOwners
from gnd.tile_store.errors import StoreError
from gnd.tile_store.regions import TileRegion
from gnd.tile_store.released import released, released_each
from gnd.tile_store.store import Store
from gnd.tile_store.warm import warm_up

# Four districts: 40 MB of tiles of a dense city, and what a wildcard may cost everybody else.
_LOG = logging.getLogger(__name__)
MOST_TILES_OF_REGION: Final = 4 * MAX_TILES_OF_DISTRICT
MAX_DECLARED: Final = 1024
"""Districts that are declared; of others everybody hears, and the owner answers."""
LOOK_EVERY_S: Final = 0.2
"""It is looked so often whether the store owns other districts now ..."""
DISTRICTS_EVERY: Final = 25
"""... and every so many times which districts its map has."""
_ANY: Final = "x/**"
# Only `gnd.schemas.keys` knows how a key begins.
TILE_ROOT: Final = keys.tiles_key("x").removesuffix(_ANY)
# Who asks without a message reads what everybody reads.
PLAIN_REQUEST: Final = TileRequest(codecs=(CODEC_FLOAT32, *FEATURE_CODECS), deltas=False)
CATALOG_ROOT: Final = keys.catalog_keys("x").removesuffix(_ANY)


class TileServer:
    """Answers on every tile key and every catalog key, of all layers, exact or wildcard, and on keys for several tiles
    of a district.

    Where a version is on trial, vehicles get it by their tickets (`released.heads_for`), all others the one before it.

    A request that can never be answered (bad key, bad payload, codecs that no tile comes in) is refused by name; a
    store that fails makes the asker try again.
    """

    def __init__(self, store: Store, bus: Bus, *, workers: int = 4) -> None:
        self._store, self._bus, self._workers = store, bus, workers
        self._answers = TileAnswers(store)
        self._servings: list[Serving] = []
        self._owners = KnownOwners(store)
        self._wide: tuple[bool, list[Serving]] = (False, [])
        """Whether they are those of one of several stores, and what hears of all districts."""
        self._declared: dict[District, list[Serving]] = {}
        self._of_map: frozenset[District] = frozenset()
        self._stop = threading.Event()
        self._looking = threading.Thread(target=self._look, name="districts", daemon=True)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def start(self) -> Self:
        """Begin to answer, once the kernels of the codecs are ready."""
        warm_up()
        owners = self._owners.looked_again()
        self._declare(owners, self._store.districts() if owners.are_several else ())
        self._looking.start()
        if self._bus.config.identity is not None:  # others may have them, too: shards their own
            self._servings.append(self._bus.serve(f"{CERTIFICATE_ROOT}/*", self.certificates, kind="control"))
            if n := self._store.unsigned():
                _LOG.warning("nobody has signed %d tiles of this store: no client takes them (`gnd map sign`)", n)
        return self

    def close(self) -> None:
        """Answer what is in hand, then no more. The store and the bus stay open."""
        self._stop.set()
        if self._looking.is_alive():
            self._looking.join()
        for serving in (*self._servings, *self._wide[1], *(one for some in self._declared.values() for one in some)):
            serving.close()
        self._servings, self._wide, self._declared = [], (False, []), {}

    def _look(self) -> None:
        n = 0
        while not self._stop.wait(LOOK_EVERY_S):
            owners, n = self._owners(), n + 1
            if not owners.are_several and not self._wide[0]:
                continue
            try:
                if n % DISTRICTS_EVERY == 0 or not self._wide[0]:
                    self._of_map = self._store.districts()
                self._declare(owners, self._of_map)
            except StoreError as error:
                _LOG.warning("cannot see which districts there are: %s", error)

    def _declare(self, owners: DistrictOwners, of_map: Collection[District]) -> None:
        """Hear what is to be heard: first what is new, then what goes, so that nothing is heard by nobody."""
        are_several, before = owners.are_several, self._wide
        if not before[1] or before[0] != are_several:
            self._wide = are_several, self._hear_all(alone=not are_several)
        told = {District(path) for path, row in owners.by_path.items() if path and row.state == "owned"}
        wanted = {one for one in {*of_map, *told} if owners.answers(one)} if are_several else set[District]()
        for district in sorted(wanted - self._declared.keys(), key=lambda one: one.path):
            if len(self._declared) < MAX_DECLARED:
                self._declared[district] = self._hear(district)
        if before is not self._wide:
            for serving in before[1]:  # what has come to it is answered
                serving.retire()
                self._servings.append(serving)
        for district in self._declared.keys() - wanted:
            for serving in self._declared.pop(district):
                serving.close()

    def _hear_all(self, *, alone: bool) -> list[Serving]:
        told = (
            (f"{TILE_ROOT}**", self.tiles, "tile"),
            (keys.batch_keys(), self.batch, "tile"),
            (f"{CATALOG_ROOT}**", self.catalogs, "catalog"),
        )
        return [
            self._bus.serve(keyexpr, self._undeclared(handler), complete=alone, workers=self._workers, kind=kind)
            for keyexpr, handler, kind in told
        ]

    def _hear(self, district: District) -> list[Serving]:
        handlers = ((self.tiles, "tile"), (self.batch, "tile"), (self.catalogs, "catalog"))
        return [
            self._bus.serve(keyexpr, _of_one(handler), complete=True, kind=kind, beside=beside)
            for keyexpr, (handler, kind), beside in zip(
                keys.district_keys(district), handlers, self._wide[1], strict=True
            )
        ]

    def _undeclared(self, handler: Handler) -> Handler:
        """Of a declared district the declaration's handler hears, too; of a region the one for all districts alone."""

        def handle(request: Request) -> Answer:
            if not request.is_wild and self._declared and _district_of(request.key) in self._declared:
                raise NotMine
            return handler(request)

        return handle

    def _of_owned(self, district: District, read: Callable[[], bytes]) -> bytes:
        """What is read of a district, if the store owns it before and after.

        Raises:
            NotMine: another store does.
        """
        if not self._owners().are_several:
            return read()
        self._require_owned(district)
        answer = read()
        self._require_owned(district)
        return answer

    def _require_owned(self, district: District) -> None:
        if not self._owners.looked_again().answers(district):
            raise NotMine

    def _is_owned(self, district: District) -> bool:
        return not self._owners().are_several or self._owners.looked_again().answers(district)

    def tiles(self, request: Request) -> Answer:
        """Reply for the tile of an exact key, or for each tile that exists in a wildcard region that is not too large;
        of a wildcard over layers for those that the client reads.
        """
        try:
            wanted = TileRequest.decode(request.payload) if request.payload else PLAIN_REQUEST
            if not request.is_wild:
                layer, tile = keys.parse_tile_key(request.key)
                return self._of_owned(
                    tile.district, lambda: self._answers.one(released(self._store, layer, tile), wanted).encode()
                )
            region = TileRegion.of_key(request.key, TILE_ROOT)
        except SchemaError as error:
            raise _refusal(request, error) from None
        all_below = region.is_prefix
        found = [
            (layer, tile)
            for layer, tile in self._tiles(region)
            if (region.layer is not None or reads_layer(layer, wanted.codecs))
            and (all_below or region.matches(layer, *tile.path.split("/")))
        ]
        if len(found) > MOST_TILES_OF_REGION:
            raise Refused(
                f"region with {len(found)} tiles, more than {MOST_TILES_OF_REGION}: ask for its catalogs, then for its"
                f" districts (asked for {request.key[:160]})"
            )
        return self._region(found, region.prefix, wanted)

    def batch(self, request: Request) -> Answer:
        """Reply about several tiles of a district, and of those others of the request that the store owns, too."""
        try:
            layer, district = keys.parse_batch_key(request.key)
            wanted = TilesRequest.decode(request.payload)
        except SchemaError as error:
            raise _refusal(request, error) from None
        return self._of_owned(district, lambda: self._batch(request, layer, district, wanted))

    def _batch(self, request: Request, layer: str, district: District, wanted: TilesRequest) -> bytes:
        try:
            others = [one for one in wanted.by_district(district) if one != district]
        except SchemaError as error:
            raise _refusal(request, error) from None
        owned = list(filter(self._is_owned, others))
        reply = self._answers.many(layer, district, wanted, owned)
        told = zip(others, reply.others, strict=True)  # some may have moved meanwhile
        still = (answer if answer is not None and self._is_owned(one) else None for one, answer in told)
        return replace(reply, others=tuple(still)).encode()

    def catalogs(self, request: Request) -> Answer:
        """The catalog of an exact key's district (it may be empty), or of each district with tiles in a region; or the
        list of a layer's districts.
        """
        layer_of_list = keys.layer_of_lists(request.key)
        if layer_of_list is not None:
            return self._lists(layer_of_list, request.payload)
        try:
            if not request.is_wild:
                layer, district = keys.parse_catalog_key(request.key)
                return self._of_owned(district, lambda: self._catalog(layer, district))
            region = TileRegion.of_key(request.key, CATALOG_ROOT)
        except SchemaError as error:
            raise _refusal(request, error) from None
        return self._catalogs(region)

    def certificates(self, request: Request) -> Answer:
        """The certificates of who has signed versions of the store, by id, also of those who are gone.

        Raises:
            NotMine: nobody of that id has.
        """
        try:
            signer = bytes.fromhex(request.key.rpartition("/")[2])
        except ValueError:
            raise NotMine from None
        chain = self._store.publisher_chain(signer)
        if chain is None:
            raise NotMine
        return chain

    def _region(self, found: list[tuple[str, TileId]], prefix: str, wanted: TileRequest) -> Iterator[tuple[str, bytes]]:
        for layer, some in groupby(found, lambda one: one[0]):
            for tile, stored in released_each(self._store, layer, [tile for _, tile in some], prefix):
                if not self._is_owned(tile.district):
                    continue  # it has moved meanwhile
                yield keys.tile_key(layer, tile), self._answers.one(stored, wanted).encode()

    def _catalogs(self, region: TileRegion) -> Iterator[tuple[str, bytes]]:
        for (layer, district), _ in groupby(self._tiles(region), lambda found: (found[0], found[1].district)):
            if region.matches(layer, *district.path.split("/")):
                catalog = self._catalog(layer, district)
                if self._is_owned(district):
                    yield keys.catalog_key(layer, district), catalog

    def _lists(self, layer: str, payload: bytes) -> list[tuple[str, bytes]]:
        told = self._store.district_list(layer)
        if told is None:
            return []
        said = told.without_districts if payload == HEAD_ONLY else told
        return [(keys.list_key(layer, told.head.region), said.encode())]

    def _catalog(self, layer: str, district: District) -> bytes:
        return self._store.catalog(layer, district).encode()

    def _tiles(self, region: TileRegion) -> Iterator[tuple[str, TileId]]:
        for layer in self._store.layers() if region.layer is None else [region.layer]:
            owners = self._owners()
            for head in self._store.heads(layer, region.prefix):
                if owners.answers(head.tile.district):
                    yield layer, head.tile


def _of_one(handler: Handler) -> Handler:
    """Answers for one thing; regions are answered once, by who hears of all districts."""

    def handle(request: Request) -> Answer:
        if request.is_wild:
            raise NotMine
        return handler(request)

    return handle


def _district_of(key: str) -> District | None:
    """The district that an exact key is about; None: it is no such key."""
    chunks = key.split("/")
    try:
        return District("/".join(chunks[-4:-1] if key.startswith(TILE_ROOT) else chunks[-3:]))
    except TileError:
        return None


def _refusal(request: Request, error: SchemaError) -> Refused:
    return Refused(f"{type(error).__name__}: {error} (asked for {request.key[:160]})")
