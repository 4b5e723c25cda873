"""What a load offers to each shard: loads are compared only where a shard is offered the same in each."""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from gnd.cloud_merger.ownership import shared_out
from gnd.deploy.load.drives import KeptRuns
from gnd.deploy.load.shift import shifted_district
from gnd.deploy.load.streets import Streets
from gnd.gnd_map.tile_id import District
from studies.scale.loads import LoadSetting


@dataclass(frozen=True, slots=True)
class OfferedMix:
    """What the shards of a load are offered.

    Attributes:
        reports: number of all.
        changed: share of those about streets that have changed; they cost another time than settled ones.
        a_street: vehicles, the mean.
        largest: reports of the shard with most of them, against the mean.
    """

    reports: int
    changed: float
    a_street: float
    largest: float

    @classmethod
    def of(cls, setting: LoadSetting, runs: KeptRuns) -> "OfferedMix":
        """Of the timetable and the districts, as shards own them."""
        options = setting.options()
        streets = Streets.of(runs, options)
        districts = {tile.district for street in (streets.changed, streets.settled) for tile in street.tiles}
        owners = owners_of(districts, streets.places, options.shards)
        of_shard, changed = Counter[int](), 0
        for due in streets.timetable().due(range(options.vehicles)):
            said = streets.edition(due.street).drives[due.drive].reports[due.report].whole
            of_shard[owners[shifted_district(said.district, streets.places[due.street])]] += 1
            changed += options.is_changed(due.street)
        reports = of_shard.total()
        largest = max(of_shard.values()) * options.shards / reports
        return cls(reports, changed / reports, options.vehicles / options.streets, largest)


def owners_of(districts: Collection[District], places: Sequence[int], shards: int) -> dict[District, int]:
    """Number of the shard of each district of the copies of a street, as the shards of `gnd load` share them out.

    Args:
        districts: of the street.
        places: how far each copy is shifted, districts.
        shards: how many.
    """
    names = {f"shard-{number}": number for number in range(shards)}
    copies = {shifted_district(one, place) for one in districts for place in places}
    return {district: names[owner] for district, owner in shared_out(copies, list(names)).items()}
