"""The map that vehicles used: how much of it others have updated, and how long before."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.deploy.run_folder import RunFolder
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import DEFAULT_LAYER, VersionInfo
from gnd.vehicle_agent.way import Milestone, read_way

_NS_PER_S: Final = 1e9

Ways = Mapping[str, list[Milestone]]
"""The milestones of each vehicle, by its name."""


@dataclass(frozen=True, slots=True)
class MapUse:
    """The map under one vehicle's wheels.

    Attributes:
        renewed_share: share of its milestones at which the version under the wheels was one that a run has merged.
        age_s: median time from the publication of these versions to the moment of driving there; None: there are none.
        newest_age_s: the same at the last milestone; None: the version there is that of the base map.
    """

    renewed_share: float
    age_s: float | None
    newest_age_s: float | None


class Versions:
    """What is known of tile versions; each tile's history is read once for all the versions it has by then."""

    def __init__(self, store: SqlStore, layer: str = DEFAULT_LAYER) -> None:
        self._store, self._layer = store, layer
        self._known: dict[tuple[int, int], VersionInfo | None] = {}

    def info(self, tile: int, version: int) -> VersionInfo | None:
        """A line of a tile's history; None where the store has no such version."""
        if (tile, version) not in self._known:
            self._known[tile, version] = None
            for info in self._store.history(self._layer, TileId(tile)):
                self._known[tile, info.version] = info
        return self._known[tile, version]

    def age_s(self, at: Milestone) -> float | None:
        """How long before a vehicle was there the merged version under its wheels was published; None: not merged."""
        info = self.info(at.tile, at.version) if at.version else None
        return None if info is None or info.kind != "merged" else (at.wall_ns - info.created_ns) / _NS_PER_S


def map_use(way: Iterable[Milestone], versions: Versions) -> MapUse | None:
    """Return which map a vehicle drove on; None where it has no milestone on a tile that it held."""
    ages = [versions.age_s(one) for one in way if one.version is not None]
    if not ages:
        return None
    renewed = [age for age in ages if age is not None]
    return MapUse(len(renewed) / len(ages), float(np.median(renewed)) if renewed else None, ages[-1])


def read_ways(folder: RunFolder) -> dict[str, list[Milestone]]:
    """Return the milestones of every vehicle of a run that wrote any."""
    found = {path.parent.name: list(read_way(path)) for path in sorted(folder.agents.glob("*/way.jsonl"))}
    return {vehicle: way for vehicle, way in found.items() if way}
