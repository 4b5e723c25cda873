"""The new versions of a region's tiles: from notices, and from the catalog where notices were lost."""

import time
from dataclasses import dataclass

from gnd.fleet_bus.bus import Bus
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import update_keys
from gnd.schemas.tiles import CatalogEntry
from gnd.tile_client.fetching import TileServerClient
from gnd.tile_client.notices import Notices, QueuedNotice


@dataclass(frozen=True, slots=True)
class NewVersion:
    """A version of a tile.

    Attributes:
        layer: name of the layer.
        tile: which tile.
        version: its number.
        notice: the notice; None where it was lost and the catalog names the version: on the word of a tile server
            alone, until the tile is fetched.
    """

    layer: str
    tile: TileId
    version: int
    notice: QueuedNotice | None


class RegionFollower:
    """Follows the layers of a region. One thread owns it.

    Args:
        bus: an open bus.
        asking: questions about each layer, by its name.
        region: which tiles.
        compared_every_s: how often the catalogs are compared with what is known.
        history: also the notices that publishers remember.

    Attributes:
        known: version by (layer, tile): what `compare` finds is newer. The owner notes here what it has used.
    """

    def __init__(
        self,
        bus: Bus,
        asking: dict[str, TileServerClient],
        region: Region,
        compared_every_s: float,
        *,
        history: bool = False,
    ) -> None:
        self.known: dict[tuple[str, TileId], int] = {}
        self._told: dict[tuple[str, TileId], int] = {}
        self._asking, self._region, self._compared_every_s = asking, region, compared_every_s
        self._notices = Notices(bus, history=history)
        self._notices.follow([update_keys(layer, region.prefix) for layer in asking])
        self._compared_s = time.monotonic()

    def begin(self) -> dict[str, list[CatalogEntry]]:
        """Learn which versions there are now; the catalog of each layer.

        Raises:
            RequestFailed: nobody answers.
        """
        catalogs = {layer: asking.catalog(self._region) for layer, asking in self._asking.items()}
        for layer, entries in catalogs.items():
            for entry in entries:
                self._told[layer, entry.tile] = entry.version
                if self._asking[layer].check is None:  # else a number too high would hide the versions to come
                    self.known.setdefault((layer, entry.tile), entry.version)
        self._compared_s = time.monotonic()
        return catalogs

    def next(self, wait_s: float) -> list[NewVersion]:
        """The version of the next notice of the region, or, when it is time, all whose notices never came.

        Raises:
            BusError: the catalog was not to be had; it is asked for again later.
            SchemaError: a notice, or a catalog, that is none.
        """
        if time.monotonic() - self._compared_s >= self._compared_every_s:
            return self._missed()
        notice = self._notices.take(wait_s)
        if notice is None:
            return self._missed() if self._notices.may_have_been_lost() else []
        update = notice.update
        if update.layer in self._asking:
            self._asking[update.layer].note_announced(update)
        return [NewVersion(update.layer, update.tile, update.version, notice)] if update.tile in self._region else []

    def _missed(self) -> list[NewVersion]:
        self._compared_s = time.monotonic()
        found = []
        for layer, asking in self._asking.items():
            for entry in asking.catalog(self._region):
                place = layer, entry.tile
                told, self._told[place] = self._told.get(place, 0), entry.version
                is_news = asking.check is None or entry.version != told
                if is_news and entry.version > self.known.get(place, 0):
                    found.append(NewVersion(layer, entry.tile, entry.version, None))
        return found

    def look_again(self, found: NewVersion) -> None:
        """What the catalog names could not be fetched: the next comparison gives it again."""
        self._told.pop((found.layer, found.tile), None)

    def close(self) -> None:
        """Listen to nothing any more."""
        self._notices.close()
