"""What a place takes: plain arithmetic on measured costs, prices, and how much is driven."""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Final

from gnd.fleet_bus.config import MAX_SESSIONS
from gnd.gnd_map.config import from_mapping
from studies.frame.errors import OptionError

S_PER_YEAR: Final = 365.25 * 86_400
HOURS_PER_YEAR: Final = S_PER_YEAR / 3600
GB: Final = 1e9


@dataclass(frozen=True, slots=True)
class MeasuredFigure:
    """One measured number.

    Attributes:
        value, unit: what it is.
        command: that prints it; run it again and `python -m studies.scale.collect` to refresh the number.
        machine, at: where and when it was measured.
    """

    value: float
    unit: str
    command: str
    machine: str
    at: str

    def __post_init__(self) -> None:
        if not (self.value > 0.0 and self.unit and self.command and self.machine and self.at):
            raise OptionError(f"a figure needs a value above 0, unit, command, machine and date, got {self}")


@dataclass(frozen=True, slots=True)
class DrivingHabits:
    """How much is driven; `*_source`: who says so."""

    km_a_year: float
    km_source: str
    peak_to_mean: float
    peak_source: str
    speed_kmh: float
    speed_source: str
    new_road_share: float
    new_road_source: str


@dataclass(frozen=True, slots=True)
class Keeping:
    """How full hosts are and what is kept, as `prices.toml` explains."""

    use_of_a_core: float
    journal_days: float
    versions_kept: float
    copies: float
    cores_of_a_database: int
    source: str


@dataclass(frozen=True, slots=True)
class Prices:
    """List prices, each with its source and date."""

    currency: str
    core_hour: float
    core_source: str
    object_gb_month: float
    object_source: str
    disk_gb_month: float
    disk_source: str
    egress_gb: float
    egress_source: str


@dataclass(frozen=True, slots=True)
class ServedPlace:
    """Where vehicles drive."""

    name: str
    vehicles: float
    road_km: float


@dataclass(frozen=True, slots=True)
class ScaleParameters:
    """`prices.toml`; an unknown key is an error."""

    driving: DrivingHabits
    keeping: Keeping
    prices: Prices
    place: tuple[ServedPlace, ...]

    @classmethod
    def read(cls, path: Path | None = None) -> "ScaleParameters":
        """From a file; None: that which is committed."""
        text = path.read_text(encoding="utf-8") if path else _committed("prices.toml")
        return from_mapping(cls, tomllib.loads(text), where="prices")


def measured_figures() -> dict[str, MeasuredFigure]:
    """The committed figures by name."""
    told = json.loads(_committed("costs.json"))
    return {name: MeasuredFigure(**one) for name, one in told.items()}


def _committed(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


@dataclass(frozen=True, slots=True)
class CostsOfUse:
    """What one thing costs, all from measurements.

    Attributes:
        reports_a_km: of a vehicle that knows its street.
        worker_s, database_s: CPU of a report with its merges: in router, receivers and workers; in the database.
        merges: of a report.
        publish_s: time for which a merge has a database alone.
        questions_a_km, question_s: whether the map still holds, and the tile server's CPU for one.
        up_bytes_a_km, down_bytes_a_km: on the wire of a vehicle, all of it.
        map_bytes_a_km: a road's tiles.
        journal_bytes: a report in the journal, with all of its tiles.
        tile_row_bytes, tiles_a_km: of a stored tile what is not its body; tiles of a road.
    """

    reports_a_km: float
    worker_s: float
    database_s: float
    merges: float
    publish_s: float
    questions_a_km: float
    question_s: float
    up_bytes_a_km: float
    down_bytes_a_km: float
    map_bytes_a_km: float
    journal_bytes: float
    tile_row_bytes: float
    tiles_a_km: float


@dataclass(frozen=True, slots=True)
class PlannedPlace:
    """What a place takes at its peak, and in a year.

    Attributes:
        km_s: kilometres driven a second, at the peak.
        on_road: vehicles that drive then.
        reports_s, merges_s, questions_s: a second, then.
        shard_cores, database_cores, tile_cores: with what is kept free for bursts.
        databases: hosts that are needed: for their cores, and because publications have a database alone.
        databases_by_publishing: the second of these alone.
        routers: by the sessions that one takes.
        bodies_gb, journal_gb, rows_gb: stored, one copy.
        up_gbit_s, down_gbit_s: at the peak.
        egress_gb: in a year.
        money: a year, by part.
    """

    place: ServedPlace
    km_s: float
    on_road: float
    reports_s: float
    merges_s: float
    questions_s: float
    shard_cores: float
    database_cores: float
    tile_cores: float
    databases: float
    databases_by_publishing: float
    routers: float
    bodies_gb: float
    journal_gb: float
    rows_gb: float
    up_gbit_s: float
    down_gbit_s: float
    egress_gb: float
    money: Mapping[str, float]


def planned(place: ServedPlace, costs: CostsOfUse, given: ScaleParameters) -> PlannedPlace:
    """What a place takes."""
    driving, keeping = given.driving, given.keeping
    km_a_year = place.vehicles * driving.km_a_year
    km_s = driving.peak_to_mean * km_a_year / S_PER_YEAR
    reports_s, questions_s = km_s * costs.reports_a_km, km_s * costs.questions_a_km
    merges_s, use = reports_s * costs.merges, keeping.use_of_a_core
    database_cores = reports_s * costs.database_s / use
    by_publishing = merges_s * costs.publish_s / use
    map_bytes_a_km = driving.new_road_share * costs.map_bytes_a_km
    down_bytes_a_km = costs.down_bytes_a_km + map_bytes_a_km
    reports_a_day = km_a_year * costs.reports_a_km / 365.25
    cores = {
        "shards": reports_s * costs.worker_s / use,
        "databases": keeping.copies * database_cores,
        "tile servers": questions_s * costs.question_s / use,
    }
    bodies_gb = place.road_km * costs.map_bytes_a_km * keeping.versions_kept / GB
    rows_gb = place.road_km * costs.tiles_a_km * keeping.versions_kept * costs.tile_row_bytes / GB
    journal_gb = reports_a_day * keeping.journal_days * costs.journal_bytes / GB
    egress_gb = km_a_year * down_bytes_a_km / GB
    prices = given.prices
    money = {name: count * HOURS_PER_YEAR * prices.core_hour for name, count in cores.items()} | {
        "bodies": 12 * bodies_gb * prices.object_gb_month,
        "disks of databases": 12 * keeping.copies * (rows_gb + journal_gb) * prices.disk_gb_month,
        "egress": egress_gb * prices.egress_gb,
    }
    return PlannedPlace(
        place=place,
        km_s=km_s,
        on_road=km_s * 3600 / driving.speed_kmh,
        reports_s=reports_s,
        merges_s=merges_s,
        questions_s=questions_s,
        shard_cores=cores["shards"],
        database_cores=database_cores,
        tile_cores=cores["tile servers"],
        databases=max(by_publishing, database_cores / keeping.cores_of_a_database),
        databases_by_publishing=by_publishing,
        routers=km_s * 3600 / driving.speed_kmh / MAX_SESSIONS,
        bodies_gb=bodies_gb,
        journal_gb=journal_gb,
        rows_gb=rows_gb,
        up_gbit_s=km_s * costs.up_bytes_a_km * 8 / 1e9,
        down_gbit_s=km_s * down_bytes_a_km * 8 / 1e9,
        egress_gb=egress_gb,
        money=money,
    )


@dataclass(frozen=True, slots=True)
class ScaleLimit:
    """What ends at how many vehicles (at the peak of their day), and what takes over."""

    what: str
    vehicles: float
    then: str


def limits(costs: CostsOfUse, given: ScaleParameters) -> list[ScaleLimit]:
    """What breaks, the first first."""
    keeping, unit = given.keeping, planned(ServedPlace("one", 1.0, 1.0), costs, given)
    found = [
        ScaleLimit(
            "one host of 2 cores with its store in a file: CPU of reports",
            2 / (unit.shard_cores + unit.database_cores),
            "a store in PostgreSQL, and shards on several hosts",
        ),
        ScaleLimit(
            "one worker process: a core",
            1 / unit.shard_cores,
            "more shards; districts are shared out among them",
        ),
        ScaleLimit(
            "one tile server process: a core of questions whether the map still holds",
            1 / unit.tile_cores,
            "more tile servers; archives behind a CDN for what has not changed",
        ),
        ScaleLimit(
            "one database: publications have it alone",
            1 / unit.databases_by_publishing,
            "a database for each region; then locks by tile instead of the whole store",
        ),
        ScaleLimit(
            f"one database: {keeping.cores_of_a_database} cores",
            keeping.cores_of_a_database / unit.database_cores,
            "a database for each region",
        ),
        ScaleLimit(
            f"one router: {MAX_SESSIONS:,} sessions",
            1 / unit.routers,
            "more routers, linked to each other",
        ),
    ]
    return sorted(found, key=lambda one: one.vehicles)
