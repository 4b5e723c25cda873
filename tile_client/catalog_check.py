"""Whether a catalog is one to use: a publisher of the pinned authority has signed it as it is, with nothing left out,
and no newer one was seen; and whether it goes back behind what its reader has seen otherwise.

A catalog is sealed by the tile server that answers, and bound to the question, so neither router nor cache can forge or
keep one. A tile server that was broken into can only hand out what was signed once: who has seen a newer one refuses
it, and who has seen nothing yet sees how old it is.
"""

import logging
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Final

from gnd.fleet_bus.publishers import Publishers
from gnd.fleet_bus.refusals import counted
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.archive_seal import SealNumber
from gnd.schemas.catalog_signature import CatalogSignature, CatalogStatement
from gnd.schemas.errors import BadValue, NotSigned
from gnd.schemas.tiles import Catalog, CatalogEntry
from gnd.tile_client.archive_check import SeenStates
from gnd.tile_client.signed_state import RefusedStateError, check_answered, check_order

_SELDOM: Final = Seldom(logging.getLogger(__name__))
NOTICED_AFTER_S: Final = 86_400.0
"""A catalog that was signed longer ago is told of in the log; running shards sign each once an hour."""


class CatalogCheck:
    """Checks the catalogs of one layer. Safe in several threads.

    Args:
        publishers: whose signature counts.
        layer: name of the layer.
        seen: which states of districts were seen before.
        oldest_s: a catalog that was signed longer ago is refused, s; None: any age will do, and a great one is told.
    """

    def __init__(
        self, publishers: Publishers, layer: str, seen: SeenStates | None = None, oldest_s: float | None = None
    ) -> None:
        self._publishers, self._layer, self._oldest_s = publishers, layer, oldest_s
        self._seen = SeenStates() if seen is None else seen

    def check(self, layer: str, district: District, catalog: Catalog) -> float:
        """Take note of the catalog that came under the key of a layer and a district; how long ago it was signed, s.

        Raises:
            NotSigned: it is not to be used; why. It is counted (`gnd_refusals`, kind "catalog").
        """
        try:
            return self._check(layer, district, catalog)
        except RefusedStateError as refused:
            counted("catalog", refused.reason)
            raise NotSigned(f"catalog of district {district} of layer {self._layer}: {refused}") from refused

    def _check(self, layer: str, district: District, catalog: Catalog) -> float:
        if layer != self._layer:
            raise RefusedStateError("wrong", f"is that of layer {layer[:40]}")
        newest, signed = self._seen.newest(self._name(district)), catalog.signature
        if signed is None:
            if not catalog.entries and newest == SealNumber():
                return 0.0  # nothing is mapped there, or the list of districts names it (`list_check`)
            raise RefusedStateError(
                "unsigned",
                "nobody has signed it: the tile server or the shards may be of an older release (shards sign each"
                " district when they start, `gnd map sign` does where there are none)",
            )
        try:
            statement = CatalogStatement.of(self._layer, district, catalog.entries)
        except BadValue as error:
            raise RefusedStateError("wrong", str(error)) from error
        check_answered(self._publishers, signed, signed.text(statement), f"{len(catalog.entries)} tiles")
        return self._check_order(district, signed, newest)

    def _check_order(self, district: District, signed: CatalogSignature, newest: SealNumber) -> float:
        age_s = check_order(signed, newest, self._oldest_s)
        if age_s > NOTICED_AFTER_S:
            counted("catalog", "old")
            _SELDOM.warning(
                "the catalog of district %s of layer %s was signed %.1f h ago: newer ones are withheld, or no shard has"
                " run since",
                district,
                self._layer,
                age_s / 3600,
            )
        if signed.number < newest.number:
            _SELDOM.warning(
                "the catalog of district %s of layer %s is number %d (%s), and number %d was seen before: its store was"
                " restored from a backup, or built anew",
                district,
                self._layer,
                signed.number,
                signed.kind,
                newest.number,
            )
        self._seen.note(self._name(district), signed.order)
        return age_s

    def _name(self, district: District) -> str:
        return f"{self._layer}/{district}"


def set_back(
    layer: str, seen: Mapping[TileId, int], entries: Iterable[CatalogEntry], *, newest: bool
) -> dict[TileId, int | None]:
    """The tiles of which a catalog names an older version than was seen, with that version; None: no version at all.

    Each is told in the log and counted. Two good reasons look the same, and pass: a store that was built anew counts
    from 1 until its tiles are fetched, and tiles are missing while the tile server of their region does not answer.

    Args:
        layer: of the catalog.
        seen: newest version of each tile that was seen before the catalog was asked for.
        entries: of the catalog.
        newest: versions on trial were seen, too, which a catalog does not name: numbers say nothing then.
    """
    named = {entry.tile: entry.version for entry in entries}
    found: dict[TileId, int | None] = {
        tile: named.get(tile)
        for tile, version in seen.items()
        if tile not in named or (named[tile] < version and not newest)
    }
    for reason, n in Counter("left out" if version is None else "older" for version in found.values()).items():
        counted("catalog", reason, n)
    if found:
        tile, version = next(iter(found.items()))
        what = "no version" if version is None else f"version {version}"
        _SELDOM.warning(
            "the catalog of layer %s goes back behind what was seen of %d tiles: %s of tile %s, of which version %d was"
            " seen. Either the map was built anew, or its tile server is away, or it withholds versions",
            layer,
            len(found),
            what,
            tile,
            seen[tile],
        )
    return found
