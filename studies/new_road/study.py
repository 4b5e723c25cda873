"""`gnd reproduce new-road`: a street whose map is cut, drives over it, and the road that the cloud makes of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gnd.fleet_sim.drives import EPOCH_NS
from gnd.fleet_sim.families.catalogue import FAMILIES
from gnd.fleet_sim.prepare import agent_configs
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.world import World, read_world, write_world
from gnd.gnd_map.config import to_mapping
from studies.frame.command import Bench, StudyReport, study
from studies.frame.kept import LOCALISER, SIMULATOR, Kept, key_of, sources_sha
from studies.frame.options import check, option, seeds
from studies.frame.pool import Job
from studies.frame.tables import Sheet, sheet_of
from studies.new_road.cloud import map_error, map_roads, pose_errors, published, road_places
from studies.new_road.driving import DrivenRoad, RoadTask, drive_road
from studies.new_road.street import BEFORE_M, BETWEEN_M, MapCut, TrueSurface, split_map
from studies.simulation.base_map import BaseMap, driven, read_base, write_base

FORMAT: Final = "gnd.new-road"
MUST_M, AIM_M = 0.15, 0.05
_BASE: Final = (*SIMULATOR, "studies/simulation/base_map.py", "studies/new_road/street.py")
_DRIVE: Final = (*LOCALISER, "vehicle_agent/survey", "vehicle_agent/segment", "studies/new_road/driving.py")
_COLUMNS: Final = {
    "vehicles": "{vehicles}",
    "tiles draft / waiting / published": "{tiles.draft} / {tiles.waiting} / {tiles.published}",
    "Gaussians": "{map.gaussians}",
    "off the true surface m, 50 / 95 %": "{map.surface_m.median:.3f} / {map.surface_m.p95:.3f}",
    "all m, 95 %": "{map.all_m.p95:.3f}",
    "road covered": "{map.road_covered:.0%}",
    "s": "{seconds:.0f}",
}
_POSES: Final = {
    "submaps": "{submaps}",
    "horizontal m, 50 / 95 % / max": "{horizontal_m.median:.3f} / {horizontal_m.p95:.3f} / {horizontal_m.max:.3f}",
    "vertical m": "{vertical_m.median:.3f} / {vertical_m.p95:.3f} / {vertical_m.max:.3f}",
    "heading °": "{heading_deg.median:.3f} / {heading_deg.p95:.3f} / {heading_deg.max:.3f}",
    "in sigmas": "{sigmas.median:.1f} / {sigmas.p95:.1f} / {sigmas.max:.1f}",
}


@dataclass(frozen=True, slots=True)
class NewRoadOptions:
    """What to run."""

    seeds: tuple[int, ...] = seeds(11, text="Of the streets, such as 1401,1402.")
    vehicles: int = option(3, "Vehicles that drive the street.", span=(1, 20))
    length_m: float = option(400.0, "Length of the street.", span=(300, 1000))
    gap_m: float = option(100.0, "Length of the hole in the map.", span=(20, 600))
    edge_m: float = option(90.0, "Length of the street beyond the map's edge.", span=(20, 600))
    family: str = option("street", "Kind of street.", known=tuple(FAMILIES))

    def __post_init__(self) -> None:
        check(self)
        needed_m = BEFORE_M + self.gap_m + BETWEEN_M + self.edge_m
        if self.length_m < needed_m:
            from studies.frame.errors import OptionError

            raise OptionError(f"a street of {self.length_m:g} m is too short for these cuts: {needed_m:g} m are needed")


@study(NewRoadOptions, out="runs/new-road")
def new_road(options: NewRoadOptions, bench: Bench) -> StudyReport:
    """Roads that the map does not have: how well vehicles map them, at its edge and across a gap.

    A second start with the same folder continues where the first ended.
    """
    places = {seed: RoadPlace.of(bench.folder.root, seed, options) for seed in options.seeds}
    bench.run("maps", [Job(f"map {seed}", make_base, (one,)) for seed, one in places.items() if not one.is_made])
    tasks = {seed: road_tasks(one, seed, options) for seed, one in places.items()}
    missing = [task for some in tasks.values() for task in some if not task.kept.done]
    bench.run("drives", [Job(f"{t.drive.vehicle} {t.kept.name}", drive_road, (t,), ticks=True) for t in missing])
    jobs = [Job(f"road {seed}", road_of, (places[seed], tasks[seed], options)) for seed in options.seeds]
    found = dict(zip(map(str, options.seeds), bench.run("roads", jobs), strict=True))
    result = {"format": FORMAT, "version": 1, "options": to_mapping(options), "must_m": MUST_M, "aim_m": AIM_M}
    worst = [one["error_p95_m"] for one in found.values()]
    result |= {"worlds": found, "error_p95_m": None if None in worst else max(worst, default=None)}
    return StudyReport(result, [sheet for seed, one in found.items() for sheet in sheets_of(seed, one)])


@dataclass(frozen=True, slots=True)
class RoadPlace:
    """Files of one street: its world, its whole map, and the map with the cut."""

    home: Path
    key: str
    seed: int
    street: StreetOptions
    gap_m: float
    edge_m: float

    @classmethod
    def of(cls, root: Path, seed: int, options: NewRoadOptions) -> "RoadPlace":
        """Of a seed."""
        street_options = StreetOptions(length_m=options.length_m, site="wangsimni", family=options.family)
        key = key_of(sources=sources_sha(_BASE), seed=seed, street=to_mapping(street_options))
        return cls(root / f"seed-{seed}-{options.family}-{options.length_m:g}m", key, seed, street_options,
                   options.gap_m, options.edge_m)  # fmt: skip

    @property
    def world(self) -> Path:
        """The street."""
        return self.home / "world.json"

    @property
    def whole(self) -> Path:
        """The map of the whole street."""
        return self.home / f"whole-{self.key}.npz"

    @property
    def cut_map(self) -> Path:
        """The map with the cut."""
        return self.home / f"cut-{self.gap_m:g}-{self.edge_m:g}-{self.key}.npz"

    @property
    def is_made(self) -> bool:
        """Whether all is there."""
        return all(path.is_file() for path in (self.world, self.whole, self.cut_map))

    def cut_of(self, world: World) -> MapCut:
        """Where the map ends."""
        return MapCut.of(world.half_length_m, self.gap_m, self.edge_m)


def make_base(place: RoadPlace) -> None:
    """Make the street, its map, and the map with the cut."""
    place.home.mkdir(parents=True, exist_ok=True)
    world = street(place.seed, place.street)
    write_world(world, place.world)
    if not place.whole.is_file():
        write_base(driven(world, "after"), place.whole)
    write_base(split_map(world, read_base(place.whole), place.cut_of(world))[0], place.cut_map)


def road_tasks(place: RoadPlace, seed: int, options: NewRoadOptions) -> list[RoadTask]:
    """The drives of a street."""
    tasks = []
    for drive in agent_configs(seed, options.vehicles):
        key = key_of(base=place.cut_map.name, drive=to_mapping(drive), sources=sources_sha(_DRIVE))
        tasks.append(RoadTask(place.world, place.cut_map, drive, Kept(place.home / "drives", drive.vehicle, key)))
    return tasks


def road_of(place: RoadPlace, tasks: list[RoadTask], options: NewRoadOptions) -> dict[str, Any]:
    """What the cloud makes of the drives of a street, one vehicle after the other, and how good it is."""
    world, drives = read_world(place.world), [task.kept.read(DrivenRoad) for task in tasks]
    cut, truth = place.cut_of(world), TrueSurface.of(world)
    whole = read_base(place.whole)
    made = map_roads(place.home / "store.sqlite", read_base(place.cut_map), drives, EPOCH_NS)
    road, rows = road_places(world, cut), list[dict[str, Any]]()
    for number, one in made["rounds"].items():
        states = [tile.state for tile in one["roads"]]
        rows.append(
            {
                "vehicles": number,
                "tiles": {state: states.count(state) for state in ("draft", "waiting", "published")},
                "versions": one["made"].versions,
                "seconds": round(one["seconds"], 2),
                "map": map_error(world, cut, truth, published(one["roads"]), road),
                "reasons": sorted({tile.reason for tile in one["roads"] if tile.reason}),
            }
        )
    new_km = (options.gap_m + options.edge_m) / 1000
    uploaded = sum(len(body) for one in drives for body in one.bodies)
    return {
        "rows": rows,
        "floor": map_error(world, cut, truth, split_map(world, BaseMap(whole.tiles), cut)[1].tiles, road),
        "poses": pose_errors(world, made["last"], drives),
        "matches": [dict(piece.fate) for piece in made["last"]],
        "left_out": [dict(piece.left_out) for piece in made["last"]],
        "surveys": {one.vehicle: one.counts for one in drives},
        "uploaded_bytes": uploaded,
        "bytes_per_km_and_vehicle": round(uploaded / len(drives) / new_km),
        "error_p95_m": rows[-1]["map"]["surface_m"]["p95"],
        "meets": {"must": _below(rows[-1], MUST_M), "aim": _below(rows[-1], AIM_M)},
    }


def _below(row: dict[str, Any], limit_m: float) -> bool:
    error_m = row["map"]["surface_m"]["p95"]
    return error_m is not None and error_m <= limit_m


def sheets_of(seed: str, one: dict[str, Any]) -> list[Sheet]:
    """The tables of a street."""
    floor = {"vehicles": "map at true poses", "tiles": None, "map": one["floor"], "seconds": None}
    table = sheet_of(f"New road, seed {seed}", _COLUMNS, [*one["rows"], floor])
    verdict = "pass" if one["meets"]["must"] else "FAIL"
    table.notes.append(
        f"{verdict}: 95 % within {MUST_M:g} m is a must, {AIM_M:g} m the aim; "
        f"{one['bytes_per_km_and_vehicle'] / 1e6:.2f} MB a vehicle for each km of new road"
    )
    return [table, sheet_of("Poses of the submaps against the true ones", _POSES, [one["poses"]])]
