"""The copies of the street: which map each has, and what its vehicles say about it."""

from dataclasses import dataclass

from gnd.deploy.errors import LoadError
from gnd.deploy.load.drives import KeptRuns, KeptStreet, gaussians_by_sha, read_street
from gnd.deploy.load.plan import LoadOptions, Timetable
from gnd.deploy.load.shift import DistrictShift, places_of_streets, shifted_tile
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile


@dataclass(frozen=True, slots=True, eq=False)
class Streets:
    """All copies.

    Attributes:
        options: of the load.
        places: how far each copy is shifted, districts.
        changed: the street as it was driven on the map of before.
        settled: as it was driven on the map that had been healed.
    """

    options: LoadOptions
    places: list[int]
    changed: KeptStreet
    settled: KeptStreet

    @classmethod
    def of(cls, runs: KeptRuns, options: LoadOptions) -> "Streets":
        """The streets of a load; the same in every process.

        Raises:
            LoadError: a run has no drives that can be replayed, there is none of the settled street though one is
                asked for, or there is no room for so many streets.
        """
        if runs.settled is None and options.changed_share < 1.0:
            raise LoadError(
                f"--changed-share {options.changed_share:g} needs drives on a settled street: --settled RUN"
            )
        changed = read_street(runs.changed)
        settled = changed if runs.settled is None else read_street(runs.settled)
        places = places_of_streets([*changed.tiles, *settled.tiles], options.streets)
        return cls(options, places, changed, settled)

    @property
    def bases(self) -> dict[bytes, Gaussians]:
        """All maps of vehicles by content hash."""
        return gaussians_by_sha(self.changed.tiles) | gaussians_by_sha(self.settled.tiles)

    def edition(self, street: int) -> KeptStreet:
        """What a street is."""
        return self.changed if self.options.is_changed(street) else self.settled

    def shift(self, street: int) -> DistrictShift:
        """Where it is."""
        return DistrictShift(self.places[street], self.edition(street).tiles)

    def tiles(self, street: int) -> list[Tile]:
        """Its map."""
        return [shifted_tile(tile, self.places[street]) for tile in self.edition(street).tiles.values()]

    def timetable(self) -> Timetable:
        """When which vehicle sends."""
        return Timetable(
            self.options, _ways(self.changed), _ways(self.settled), max(self.changed.length_m, self.settled.length_m)
        )


def _ways(edition: KeptStreet) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(report.at_m for report in drive.reports) for drive in edition.drives)
