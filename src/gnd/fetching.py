"""Tiles from the tile server, many at a time: what `Client.tiles` and `Client.subscribe` ask with."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import RequestFailed
from gnd.gnd_map.content import AnyTile, codecs_of_layer, kind_of_layer
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.errors import WrongHash
from gnd.schemas.keys import batch_key, catalog_keys
from gnd.schemas.tile_answer import TileAnswer, content_of_answer
from gnd.schemas.tiles import Catalog, CatalogEntry
from gnd.schemas.tiles_batch import HeldVersion, TilesReply, TilesRequest

BATCH_BYTES: Final = 1_000_000
"""Bodies of one answer: large enough that a district comes in a few, small enough for a slow link."""
_NOTHING_HELD: Final[Mapping[TileId, AnyTile]] = {}


@dataclass(frozen=True, slots=True)
class TileServerClient:
    """Questions about one layer.

    Attributes:
        bus: an open bus.
        layer: name of the layer.
        timeout_s: how long one question is asked again before it fails.
    """

    bus: Bus
    layer: str
    timeout_s: float

    def catalog(self, region: Region) -> list[CatalogEntry]:
        """The newest version of each tile of the region, by tile.

        Raises:
            RequestFailed: nobody answers within `timeout_s`.
        """
        keys = catalog_keys(self.layer, region.prefix)
        replies = self.bus.request_many(keys, b"", kind="catalog", timeout_s=self.timeout_s)
        entries = (entry for _, payload in replies for entry in Catalog.decode(payload).entries)
        return sorted((entry for entry in entries if entry.tile in region), key=lambda entry: entry.tile)

    def fetch(self, tiles: Sequence[TileId], held: Mapping[TileId, AnyTile] = _NOTHING_HELD) -> Iterator[AnyTile]:
        """The newest versions of tiles, by tile; those that the server has not are left out.

        Args:
            tiles: any tiles, each once.
            held: what the caller holds of them: only what differs is sent.

        Raises:
            RequestFailed: no answer, or one that is wrong twice.
            SchemaError: an answer that is none.
        """
        for district, group in groupby(sorted(tiles), key=lambda tile: tile.district):
            wanted, usable = list(group), dict(held)
            while wanted:
                before = len(wanted), len(usable)
                found, wanted = self._some(district, wanted, usable)
                yield from found
                if (len(wanted), len(usable)) == before:
                    raise RequestFailed(batch_key(self.layer, district), 1, f"none of {len(wanted)} tiles came")

    def _some(
        self, district: District, wanted: list[TileId], usable: dict[TileId, AnyTile]
    ) -> tuple[list[AnyTile], list[TileId]]:
        """Tiles of one answer, and those that are still wanted. `usable` loses what a delta did not fit."""
        answers = self._ask(district, wanted, usable, with_hashes=False)
        unclear = [tile for tile, answer in answers.items() if answer.status == "hash"]
        if unclear:
            answers |= self._ask(district, unclear, usable, with_hashes=True)
        found, left = list[AnyTile](), list[TileId]()
        for tile, answer in answers.items():
            if answer.status in ("later", "hash"):
                left.append(tile)
            elif answer.status == "unchanged":
                found.append(usable[tile])
            elif answer.status != "absent":
                try:
                    found.append(content_of_answer(tile, answer, kind_of_layer(self.layer), usable.get(tile)))
                except WrongHash as error:
                    if usable.pop(tile, None) is None:
                        raise RequestFailed(batch_key(self.layer, district), 1, str(error)) from error
                    left.append(tile)
        return found, left

    def _ask(
        self, district: District, wanted: Sequence[TileId], usable: Mapping[TileId, AnyTile], *, with_hashes: bool
    ) -> dict[TileId, TileAnswer]:
        held = [
            HeldVersion(tile, usable[tile].version, usable[tile].sha) if tile in usable else HeldVersion(tile)
            for tile in wanted
        ]
        codecs = codecs_of_layer(self.layer)
        request = TilesRequest.of(held, codecs=codecs, max_bytes=BATCH_BYTES, with_hashes=with_hashes)
        key = batch_key(self.layer, district)
        payload = self.bus.request(key, request.encode(), kind="tile", timeout_s=self.timeout_s)
        return dict(TilesReply.decode(payload).of_request(request, district))
