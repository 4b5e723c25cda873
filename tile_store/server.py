"""The tile server: answers tile and catalog queries from a store. All that it remembers is what it has encoded."""

import logging
from collections.abc import Iterator
from itertools import groupby
from typing import Final, Self

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import NotMine, Refused
from gnd.fleet_bus.sealing import CERTIFICATE_ROOT
from gnd.fleet_bus.serving import Answer, Request, Serving
from gnd.gnd_map.codec import CODEC_FLOAT32
from gnd.gnd_map.content import FEATURE_CODECS
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import keys
from gnd.schemas.errors import SchemaError
from gnd.schemas.limits import MAX_TILES_OF_DISTRICT
from gnd.schemas.tiles import Catalog, TileRequest
from gnd.schemas.tiles_batch import TilesRequest
from gnd.tile_store.answers import TileAnswers, reads_layer
from gnd.tile_store.regions import TileRegion
from gnd.tile_store.released import released, released_each, released_heads
from gnd.tile_store.store import Store
from gnd.tile_store.warm import warm_up

# Four districts: 40 MB of tiles of a dense city, and what a wildcard may cost everybody else.
_LOG = logging.getLogger(__name__)
MOST_TILES_OF_REGION: Final = 4 * MAX_TILES_OF_DISTRICT
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

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def start(self) -> Self:
        """Begin to answer, once the kernels of the codecs are ready."""
        warm_up()
        for keyexpr, handler, kind in (
            (f"{TILE_ROOT}**", self.tiles, "tile"),
            (keys.batch_keys(), self.batch, "tile"),
            (f"{CATALOG_ROOT}**", self.catalogs, "catalog"),
        ):
            serving = self._bus.serve(keyexpr, handler, complete=True, workers=self._workers, kind=kind)
            self._servings.append(serving)
        if self._bus.config.identity is not None:  # others may have them, too: shards their own
            self._servings.append(self._bus.serve(f"{CERTIFICATE_ROOT}/*", self.certificates, kind="control"))
            if n := self._store.unsigned():
                _LOG.warning("nobody has signed %d tiles of this store: no client takes them (`gnd map sign`)", n)
        return self

    def close(self) -> None:
        """Answer what is in hand, then no more. The store and the bus stay open."""
        while self._servings:
            self._servings.pop().close()

    def tiles(self, request: Request) -> Answer:
        """Reply for the tile of an exact key, or for each tile that exists in a wildcard region that is not too large;
        of a wildcard over layers for those that the client reads.
        """
        try:
            wanted = TileRequest.decode(request.payload) if request.payload else PLAIN_REQUEST
            if not request.is_wild:
                layer, tile = keys.parse_tile_key(request.key)
                return self._answers.one(released(self._store, layer, tile), wanted).encode()
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
        """Reply about several tiles of one district."""
        try:
            layer, district = keys.parse_batch_key(request.key)
            wanted = TilesRequest.decode(request.payload)
        except SchemaError as error:
            raise _refusal(request, error) from None
        return self._answers.many(layer, district, wanted).encode()

    def catalogs(self, request: Request) -> Answer:
        """The catalog of an exact key's district (it may be empty), or of each district with tiles in a region."""
        try:
            if not request.is_wild:
                layer, district = keys.parse_catalog_key(request.key)
                return self._catalog(layer, district)
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
                yield keys.tile_key(layer, tile), self._answers.one(stored, wanted).encode()

    def _catalogs(self, region: TileRegion) -> Iterator[tuple[str, bytes]]:
        for (layer, district), _ in groupby(self._tiles(region), lambda found: (found[0], found[1].district)):
            if region.matches(layer, *district.path.split("/")):
                yield keys.catalog_key(layer, district), self._catalog(layer, district)

    def _catalog(self, layer: str, district: District) -> bytes:
        return Catalog(tuple(released_heads(self._store, layer, district.path))).encode()

    def _tiles(self, region: TileRegion) -> Iterator[tuple[str, TileId]]:
        for layer in self._store.layers() if region.layer is None else [region.layer]:
            for head in self._store.heads(layer, region.prefix):
                yield layer, head.tile


def _refusal(request: Request, error: SchemaError) -> Refused:
    return Refused(f"{type(error).__name__}: {error} (asked for {request.key[:160]})")
