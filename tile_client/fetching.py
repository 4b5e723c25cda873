"""Tiles of any region from the tile server, in batches of one district."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import RequestFailed
from gnd.fleet_bus.refusals import counted
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.errors import NotSigned
from gnd.schemas.keys import batch_key, catalog_keys, parse_catalog_key
from gnd.schemas.tiles import Catalog, CatalogEntry
from gnd.schemas.updates import TileUpdate
from gnd.tile_client.archive_check import SeenStates
from gnd.tile_client.catalog_check import NOTICED_AFTER_S, CatalogCheck, set_back
from gnd.tile_client.checking import SeenInMemory, VersionCheck
from gnd.tile_client.exchange import Exchange, ExchangeOutcome, TilesInMemory
from gnd.tile_client.list_check import ListCheck, ListedDistricts

BATCH_BYTES: Final = 1_000_000
"""Bodies of one answer: large enough that a district comes in a few, small enough for a slow link."""
_SELDOM: Final = Seldom(logging.getLogger(__name__))
_NOTHING_HELD: Final[Mapping[TileId, AnyTile]] = {}


@dataclass(frozen=True, slots=True)
class TileServerClient:
    """Questions about one layer.

    Attributes:
        bus: an open bus.
        layer: name of the layer.
        timeout_s: how long one question is asked again before it fails.
        newest: fetch the newest versions, also those that are on trial with a share of the vehicles.
        oldest_catalog_s: a catalog that was signed longer ago is refused, s; None: any age will do. A session without
            an identity looks at no signatures.
        seen: which states of catalogs and of lists of districts were seen before.
        check: of the versions that come: by the identity of the bus; None where it has none.
        refused: districts whose catalog was refused when it was last asked for, and why.
        stale: districts whose catalog was signed more than `catalog_check.NOTICED_AFTER_S` before it was last asked
            for, with its age, s.
        behind: tiles of which the last catalog names an older version than was seen, or none: see
            `catalog_check.set_back`.
    """

    bus: Bus
    layer: str
    timeout_s: float
    newest: bool = False
    oldest_catalog_s: float | None = None
    seen: SeenStates = field(repr=False, default_factory=SeenStates)
    check: VersionCheck | None = field(init=False, repr=False)
    behind: dict[TileId, int | None] = field(init=False, repr=False, default_factory=dict)
    refused: dict[District, str] = field(init=False, repr=False, default_factory=dict)
    stale: dict[District, float] = field(init=False, repr=False, default_factory=dict)
    _seen: SeenInMemory = field(init=False, repr=False, default_factory=SeenInMemory)
    _catalogs: CatalogCheck | None = field(init=False, repr=False, default=None)
    _lists: ListCheck | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        check = VersionCheck.on_the_bus(self.bus, self.layer, self._seen)
        object.__setattr__(self, "check", check)
        if check is not None:
            catalogs = CatalogCheck(check.publishers, self.layer, self.seen, self.oldest_catalog_s)
            object.__setattr__(self, "_catalogs", catalogs)
            lists = ListCheck(check.publishers, self.layer, self.seen, self.oldest_catalog_s)
            object.__setattr__(self, "_lists", lists)

    def catalog(self, region: Region) -> list[CatalogEntry]:
        """The newest version of each tile of the region, by tile; that it goes back behind what was seen is noticed.

        A district whose catalog nobody answers for, or that is an older one than was seen, is left out, told in the log
        and in `refused`; so is one that does not come although the signed list of districts names it, or that comes
        and is not in the list.

        Raises:
            RequestFailed: nobody answers within `timeout_s`.
            NotSigned: of no district that was answered for there is a catalog to use, or nobody answers for the list
                of districts.
            SchemaError: an answer that is none.
        """
        keys, seen = catalog_keys(self.layer, region.prefix), self._seen.versions(region)
        self.refused.clear()
        self.stale.clear()
        with self.seen.together():
            # first: it names no more than there is then
            listed = None if self._lists is None else self._lists.ask(self.bus, self.timeout_s)
            replies = self.bus.request_many(keys, b"", kind="catalog", timeout_s=self.timeout_s)
            found = {key: some for key, payload in replies if (some := self._entries(key, payload)) is not None}
            if listed is not None:
                self._compare(listed, region, found)
        entries = [entry for some in found.values() for entry in some if entry.tile in region]
        told = {tile: version for tile, version in seen.items() if tile.district not in self.refused}
        behind = set_back(self.layer, told, entries, newest=self.newest)
        self.behind.clear()
        self.behind.update(behind)
        if not any(found.values()) and self.refused:
            raise NotSigned(next(iter(self.refused.values())))
        return sorted(entries, key=lambda entry: entry.tile)

    def _entries(self, key: str, payload: bytes) -> tuple[CatalogEntry, ...] | None:
        """What a district's catalog names; None: it is refused."""
        catalog = Catalog.decode(payload)
        if self._catalogs is None:
            return catalog.entries
        layer, district = parse_catalog_key(key)
        try:
            age_s = self._catalogs.check(layer, district, catalog)
        except NotSigned as error:
            self.refused[district] = str(error)
            _SELDOM.warning("%s", error)
            return None
        if age_s > NOTICED_AFTER_S:
            self.stale[district] = age_s
        return catalog.entries

    def _compare(self, listed: ListedDistricts, region: Region, found: dict[str, tuple[CatalogEntry, ...]]) -> None:
        """Refuse districts that no list names, and note those that a list names and that did not come."""
        assert self._lists is not None
        came = {parse_catalog_key(key)[1]: key for key, entries in found.items() if entries}
        if any(district not in listed for district in came):  # it may be new
            listed = self._lists.ask(self.bus, self.timeout_s, again=True)
        for district in [one for one in came if one not in listed]:
            del found[came[district]]
            why = "no list of districts names it: an older list, or a district that was taken off"
            self._refuse(district, "not listed", why)
        for district in listed.below("/".join(region.prefix.split("/")[:3])):
            if region.touches(district) and district not in came and district not in self.refused:
                why = "it does not come, and the list of districts names it: withheld, or its tile server is away"
                self._refuse(district, "withheld", why)

    def _refuse(self, district: District, reason: str, why: str) -> None:
        counted("catalog", reason)
        self.refused[district] = f"catalog of district {district} of layer {self.layer}: {why}"
        _SELDOM.warning("%s", self.refused[district])

    def note_announced(self, update: TileUpdate) -> None:
        """A notice that a shard has sealed: from now on an older version will not do, nor a catalog that names one."""
        if self.check is not None:
            self.check.note_announced(update.tile, update.made_s, update.version)

    def fetch(self, tiles: Sequence[TileId], held: Mapping[TileId, AnyTile] = _NOTHING_HELD) -> Iterator[AnyTile]:
        """The newest versions of tiles, by tile; those that the server has not are left out.

        Args:
            tiles: any tiles, each once.
            held: what the caller holds of them: only what differs is sent.

        Raises:
            RequestFailed: no answer, or one that is wrong twice: no content of its hash, or nobody answers for it.
            SchemaError: an answer that is none.
        """
        exchange: Exchange[AnyTile] = Exchange(
            self.bus, TilesInMemory(self.layer, held), self.timeout_s, newest=self.newest, check=self.check
        )
        for _, group in groupby(sorted(tiles), key=lambda tile: tile.district):
            wanted, whole = list(group), {tile for tile in tiles if tile not in held}
            while wanted:
                outcome = exchange.ask(wanted, whole, BATCH_BYTES)
                self._check(outcome, whole)
                yield from (one.tile for one in outcome.fetched if one.tile is not None)
                whole |= outcome.wrong.keys()
                wanted = sorted([*outcome.later, *outcome.wrong])

    def _check(self, outcome: ExchangeOutcome[AnyTile], whole: set[TileId]) -> None:
        """`RequestFailed` where a tile was wrong although it came whole, or nothing came at all."""
        for tile, why in outcome.wrong.items():
            if tile in whole:
                raise RequestFailed(batch_key(self.layer, tile.district), 1, why)
        if not outcome.fetched and not outcome.wrong:
            why = f"none of {len(outcome.later)} tiles came"
            raise RequestFailed(batch_key(self.layer, outcome.later[0].district), 1, why)
