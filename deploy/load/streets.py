"""The copies of the street: which map each has, and what its vehicles say about it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from deploy.load.drives import KeptDrive, KeptStreet, gaussians_by_sha, read_street
from deploy.load.plan import LoadOptions, Timetable
from deploy.load.shift import Shift, places_of_streets, shifted_tile
from gnd_map.gaussian import Gaussians
from gnd_map.tile import Tile
from gnd_map.tile_id import TileId


@dataclass(frozen=True, slots=True, eq=False)
class Edition:
    """The street with one map, and the drives as they are reported against it."""

    tiles: Mapping[TileId, Tile]
    drives: tuple[KeptDrive, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Streets:
    """All copies.

    Attributes:
        kept: the street as it was driven.
        options: of the load.
        places: how far each copy is shifted, districts.
        changed: the street with the map of before.
        settled: the street with the map that its drives have healed.
    """

    kept: KeptStreet
    options: LoadOptions
    places: list[int]
    changed: Edition
    settled: Edition

    @classmethod
    def of(cls, run: Path, options: LoadOptions) -> "Streets":
        """The streets of a load; the same in every process.

        Raises:
            LoadError: the run has no drives that can be replayed, or there is no room for so many streets.
        """
        kept = read_street(run)
        changed = Edition(kept.tiles, kept.drives)
        return cls(kept, options, places_of_streets(kept.tiles, options.streets), changed, changed)

    @property
    def bases(self) -> dict[bytes, Gaussians]:
        """All maps of vehicles by content hash."""
        return gaussians_by_sha(self.changed.tiles) | gaussians_by_sha(self.settled.tiles)

    def edition(self, street: int) -> Edition:
        """What a street is."""
        return self.changed if self.options.is_changed(street) else self.settled

    def shift(self, street: int) -> Shift:
        """Where it is."""
        return Shift(self.places[street], self.edition(street).tiles)

    def tiles(self, street: int) -> list[Tile]:
        """Its map."""
        return [shifted_tile(tile, self.places[street]) for tile in self.edition(street).tiles.values()]

    def timetable(self) -> Timetable:
        """When which vehicle sends."""
        return Timetable(self.options, _ways(self.changed), _ways(self.settled), self.kept.length_m)


def _ways(edition: Edition) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(report.at_m for report in drive.reports) for drive in edition.drives)
