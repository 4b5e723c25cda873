"""`gnd reproduce release`: how soon a wrong tile is withdrawn, how often a right one is, and what telling costs.

Vehicles drive a simulated street on its surveyed map, each for itself, through the agent's own localiser and the
agent's own telemetry of tiles on trial: once on the map as it is, and some once more for each shift of one tile. What
each one told is then dealt out as a fleet would: vehicles come in a random order, a share of them has the new version,
and the shard's verdict is asked after each on it and after every fourth other.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import mean, median, pstdev
from typing import Any, Final

import numpy as np

from gnd.cloud_merger.release.verdict import ENOUGH, FALSE_ALARM, LooksTaken, judged, score_of
from gnd.fleet_sim.drives import simulate_drive
from gnd.fleet_sim.prepare import agent_configs, mapping_configs
from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.health import HealthReport, TileHealth
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.trials import ARM_MOST, Arm, VehicleHealth, VersionTrial
from gnd.tile_store.values import DEFAULT_LAYER
from studies.frame.command import Bench, StudyReport, study
from studies.frame.errors import ReproduceError
from studies.frame.options import check, option
from studies.frame.tables import Sheet, sheet_of
from studies.release_study.shifted import shifted
from studies.release_study.visits import MapWith, tiles_driven_through, visits

MOST_VEHICLES: Final = 400
"""Of a fleet that is drawn."""
_HOUR_NS: Final = 3_600_000_000_000
_START_NS: Final = 1_800_000_000_000_000_000


@dataclass(frozen=True, slots=True)
class ReleaseOptions:
    """Drives of one street, and fleets that are drawn of them."""

    seed: int = option(907, "Seed of the street and its drives.", "--seed")
    drives: int = option(24, "Vehicles that drive on the map as it is.", span=(8, 200))
    first: int = option(8, "Those of them that also drive on each shifted tile.", span=(4, 200))
    scans: int = option(140, "Scans of a drive.", span=(50, 2000))
    shifts_m: tuple[float, ...] = option((0.3, 0.5, 1.0), "Shifts of the tile, metres.", "--shifts", repeated=True)
    share: float = option(0.1, "Share of the fleet that gets a version first.", span=(0.01, 0.5))
    releases: int = option(2000, "Releases that are drawn of each kind.", span=(10, 1_000_000))

    def __post_init__(self) -> None:
        check(self)


@study(ReleaseOptions, out="runs/reproduce-release", jobs=1)
def release(options: ReleaseOptions, bench: Bench) -> StudyReport:
    """How soon a version with a shifted tile is withdrawn, and how often one that does no harm."""
    home = bench.folder.root / f"street-{options.seed}-{options.scans}"
    drives, base = _prepared(options, home, bench)
    tile = _tile_of_most(drives, base)
    told = _driven(options, drives, base, tile, home, bench)
    scores = {kind: [s for one in rows if (s := score_of(_row(one))) is not None] for kind, rows in told.items()}
    fleets = {kind: _fleets(options, told, kind) for kind in told}
    found = {
        "tile": tile.path,
        "false_alarm_bound": FALSE_ALARM,
        "share": options.share,
        "scores": {kind: _spread(values) for kind, values in scores.items()},
        "fleets": fleets,
        "bytes": _bytes(tile, told["0"][0]),
    }
    return StudyReport(found, [_sheet_of_scores(found), _sheet_of_fleets(found)])


def _prepared(options: ReleaseOptions, home: Path, bench: Bench) -> tuple[list[Path], dict[TileId, Tile]]:
    """The vehicles' drives and the surveyed map, made where they are missing."""
    folder = home / "drives"
    folder.mkdir(parents=True, exist_ok=True)
    world, made = street(options.seed, StreetOptions()), list[Path]()
    mapping, vehicles = mapping_configs(options.seed), agent_configs(options.seed, options.drives)
    short = [replace(one, scans=options.scans, camera=None, sensor="VLP-16") for one in vehicles]
    for n, config in enumerate([*mapping, *short]):
        made.append(folder / f"{n:03d}-{config.vehicle}.mcap")
        if not made[-1].exists():
            simulate_drive(world, config, made[-1])
        bench.step("drives", n + 1, len(mapping) + len(short))
    path = home / "base.sqlite"
    if not path.exists():
        with SqliteStore(path) as store:
            build_map(made[: len(mapping)], store)
    with SqliteStore(path) as store:
        heads = [store.get(DEFAULT_LAYER, head.tile) for head in store.heads()]
    tiles = [stored.decode_gaussians() for stored in heads if stored is not None]
    return made[len(mapping) :], {one.tile_id: one for one in tiles}


def _tile_of_most(drives: Sequence[Path], base: Mapping[TileId, Tile]) -> TileId:
    """The tile through which most drives lead; of equals that with most Gaussians."""
    through = Counter(tile for drive in drives for tile in tiles_driven_through(drive) if tile in base)
    return max(through, key=lambda tile: (through[tile], len(base[tile].gaussians)))


def _driven(
    options: ReleaseOptions,
    drives: Sequence[Path],
    base: Mapping[TileId, Tile],
    tile: TileId,
    home: Path,
    bench: Bench,
) -> dict[str, list[TileHealth]]:
    """What each vehicle told: by shift ("0": the map as it is)."""
    plan = [(drive, 0.0) for drive in drives]
    plan += [(drive, shift) for shift in options.shifts_m for drive in drives[: options.first]]
    told: dict[str, list[TileHealth]] = {}
    for n, (drive, shift) in enumerate(plan):
        instead = {tile: shifted(base[tile], 0.0, shift)} if shift else {}
        found = _told(home / "told" / f"{drive.stem}-{tile.morton}-{shift:g}.json", drive, MapWith(base, instead), tile)
        if found is not None:
            told.setdefault(f"{shift:g}", []).append(found)
        bench.step("visits", n + 1, len(plan))
    if len(told.get("0", ())) < 2 * ENOUGH:
        raise ReproduceError(f"only {len(told.get('0', ()))} vehicles told of tile {tile.path}")
    return told


def _told(file: Path, drive: Path, source: MapWith, tile: TileId) -> TileHealth | None:
    """What one vehicle tells of the tile; kept in a file, so that a second start goes on."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        found = visits(drive, source, [tile]).get(tile)
        file.write_text(json.dumps(None if found is None else asdict(found) | {"tile": tile.morton}))
    values = json.loads(file.read_text())
    return None if values is None else TileHealth(**{**values, "tile": TileId(values["tile"])})


def _fleets(options: ReleaseOptions, told: Mapping[str, Sequence[TileHealth]], kind: str) -> dict[str, Any]:
    """Releases in fleets whose vehicles are drawn from those that drove: what became of them, and after how many."""
    rng, trial = np.random.default_rng(options.seed), _trial(options.share)
    ends, vehicles, first = Counter[str](), list[int](), list[int]()
    for _ in range(options.releases):
        decision, n_new, n = _one_fleet(rng, trial, {"new": told[kind], "old": told["0"]})
        ends[decision] += 1
        if decision != "wait":
            vehicles.append(n)
            first.append(n_new)
    return {
        "releases": options.releases,
        "withdrawn": ends["withdraw"],
        "released": ends["release"],
        "undecided": ends["wait"],
        "vehicles_median": median(vehicles) if vehicles else None,
        "vehicles_most": max(vehicles, default=None),
        "first_median": median(first) if first else None,
        "first_most": max(first, default=None),
    }


def _one_fleet(
    rng: np.random.Generator, trial: VersionTrial, told: Mapping[Arm, Sequence[TileHealth]]
) -> tuple[str, int, int]:
    """The decision on one release, and of how many vehicles (those of the new version, all). Vehicles are drawn from
    those that drove, with repetition.
    """
    said, looks, n_new = list[VehicleHealth](), LooksTaken(), 0
    for k in range(MOST_VEHICLES):
        arm: Arm = "new" if rng.random() < trial.share else "old"
        n_new += arm == "new"
        drawn = told[arm][int(rng.integers(len(told[arm])))]
        if sum(one.arm == arm for one in said) < ARM_MOST:
            said.append(_row(drawn, arm))
        if arm == "old" and k % 4:
            continue
        found = judged(trial, said, _START_NS + _HOUR_NS, looks)
        looks = found.looks
        if found.decision != "wait":
            return found.decision, n_new, k + 1
    return "wait", n_new, MOST_VEHICLES


def _trial(share: float) -> VersionTrial:
    return VersionTrial(DEFAULT_LAYER, TileId(0), 2, 1, share, 24 * _HOUR_NS, _START_NS, "trial")


def _row(told: TileHealth, arm: Arm = "old") -> VehicleHealth:
    return VehicleHealth(
        vehicle="",
        arm=arm,
        first_ns=_START_NS,
        t_ns=_START_NS,
        scans=told.scans,
        matched=told.matched_permille,
        fit=told.fit_permille,
        elsewhere=told.elsewhere_permille,
        inside=told.inside,
        gated=told.gated,
        not_good=told.not_good,
        has_left=told.left,
    )


def _spread(values: Sequence[float]) -> dict[str, Any]:
    return {"vehicles": len(values), "mean": round(mean(values), 4), "sd": round(pstdev(values), 4)}


def _bytes(tile: TileId, told: TileHealth) -> dict[str, int]:
    """Payloads of a vehicle's two messages about one tile on trial."""
    taken = HealthReport(DEFAULT_LAYER, tile.district, _START_NS, (TileHealth(tile, told.version),))
    left = HealthReport(DEFAULT_LAYER, tile.district, _START_NS, (told,))
    return {"taken": len(taken.encode()), "left": len(left.encode())}


def _sheet_of_scores(found: Mapping[str, Any]) -> Sheet:
    columns = {"vehicles": "{vehicles}", "mean score": "{mean:+.3f}", "sd": "{sd:.3f}"}
    return sheet_of("What vehicles tell, by shift of the tile (m)", columns, found["scores"], "shift")


def _sheet_of_fleets(found: Mapping[str, Any]) -> Sheet:
    columns = {
        "releases": "{releases}",
        "withdrawn": "{withdrawn}",
        "released": "{released}",
        "undecided": "{undecided}",
        "on it, median": "{first_median}",
        "most": "{first_most}",
        "of all, median": "{vehicles_median}",
    }
    sheet = sheet_of(f"Releases, share {found['share']:g}", columns, found["fleets"], "shift")
    sheet.notes.append(f"bound on false withdrawals: {100 * found['false_alarm_bound']:g} %")
    sheet.notes.append("payloads of a visit to a tile on trial: {taken} B and {left} B".format(**found["bytes"]))
    return sheet
