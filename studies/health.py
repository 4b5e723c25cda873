"""Does the health tell a wrong pose from a stale map from a poor place? Cases with known truth, sensor by sensor.

Each case is a drive through the tuning world (or a corridor, or an open field) with a localiser that starts at its true
pose, trusted, 2.5 m GNSS. After 3 s something may happen: the pose is put off by so much, the tiles are taken away or
exchanged for those of the next tile. The seven seconds after that are judged: what is said (health and cause, share of
the estimates), how long the pose was called good while it was wrong (beyond Ford's 0.44 m or 0.5 degrees), and when it
was right again.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from gnd.fleet_sim.shapes import Block
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.world import STATES, State, World, WorldObject
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise import PoseEstimate
from gnd.vehicle_agent.tiles_at_hand import localising_on
from studies.frame.measure import Figure
from studies.frame.scans import local_map_of
from studies.localisation_scenes import Localising
from studies.short_drives import MappedStreet, ShortDrive, gnss_offset_m, is_wrong

SEED, LENGTH_M = 101, 300.0
SENSORS = ("VLP-16", "Scala")
AT_S, EVENT_S, END_S, FIX_NS = 8.0, 3.0, 10.0, 100_000_000
WALL_Y_M, WALL_M = 8.3, 5.0


@dataclass(frozen=True, slots=True)
class HealthCase:
    """What the world is like, and what happens to the pose (metres ahead, metres left, degrees) or to the tiles."""

    name: str
    truth: str
    state: State = "before"
    ahead_m: float = 0.0
    left_m: float = 0.0
    turn_deg: float = 0.0
    place: str = "street"
    tiles: str = "right"

    @property
    def is_pushed(self) -> bool:
        """True when the pose is put off."""
        return (self.ahead_m, self.left_m, self.turn_deg) != (0.0, 0.0, 0.0)


PUSHES = ((1, 0, 0), (3, 0, 0), (6, 0, 0), (0, 0.5, 0), (0, 1, 0), (0, 3, 0), (0, 0, 2), (0, 0, 5))
CASES = (
    HealthCase("fresh map, right pose", "none"),
    HealthCase("changed map, right pose", "stale_map", "after"),
    *(
        HealthCase(f"{state}: {x} m ahead, {y} m left, {turn} deg", "wrong_pose", state, x, y, turn)
        for state in STATES
        for x, y, turn in PUSHES
    ),
    HealthCase("corridor", "poor_place", place="corridor"),
    HealthCase("open field", "poor_place", place="field"),
    HealthCase("tiles are taken away", "no_map", tiles="none"),
    HealthCase("tiles of the next place", "wrong map", tiles="shifted"),
)


@dataclass(slots=True)
class ToldHealth:
    """What a localiser said after the event."""

    said: Counter[tuple[str, str]] = field(default_factory=Counter)
    estimates: int = 0
    wrong_good: int = 0
    last_wrong_good_s: float = 0.0
    right_again_s: float = np.inf
    worst_good_m: float = 0.0
    longitudinal_free: int = 0
    sigma_m: float = 0.0


def run() -> list[Figure]:
    """Every case with every sensor."""
    world = street(SEED, StreetOptions(length_m=LENGTH_M, site="wangsimni"))
    places = {
        "street": MappedStreet(world),
        "corridor": MappedStreet(_only(world, walls=True)),
        "field": MappedStreet(_only(world)),
    }
    figures = [_figure(sensor, case, _tried(sensor, case, places[case.place])) for sensor in SENSORS for case in CASES]
    total = Figure("good while wrong, all cases", sum(f.value for f in figures), "estimates")
    return [*figures, total]


def _only(world: World, *, walls: bool = False) -> World:
    """The street without anything that stands, or with nothing but one even wall along either side."""
    ground = tuple(o for o in world.objects if o.kind == "road")
    return replace(world, objects=(*ground, *(_walls(world) if walls else ())))


def _walls(world: World) -> tuple[WorldObject, ...]:
    half_m = world.half_length_m + 60.0
    sides = (("left wall", WALL_Y_M), ("right wall", -WALL_Y_M))
    blocks = ((name, Block(0.0, y, half_m, 0.2, -2.0, WALL_M)) for name, y in sides)
    return tuple(WorldObject(name, "wall", STATES, "kept", (block,)) for name, block in blocks)


def _tried(sensor: str, case: HealthCase, place: MappedStreet) -> ToldHealth:
    """Drive one case."""
    drive = place.drive(sensor, case.state, 1, 7, empty=case.place != "street")
    rng, told = np.random.default_rng(SEED), ToldHealth()
    held = place.local_map()
    first_ns = int(drive.truth.t_ns[0]) + int(AT_S * 1e9)
    event_ns, end_ns = first_ns + int(EVENT_S * 1e9), first_ns + int(END_S * 1e9)
    offset_m, next_fix_ns, happened = gnss_offset_m(rng), first_ns, False
    vehicle = localising_on(held, drive.simulation.header(), drive.true_fix(first_ns))
    vehicle.start_at(first_ns, drive.truth.at(first_ns), trusted=True)
    for item in drive.items():
        if not first_ns <= item.t_ns < end_ns:
            continue
        if item.t_ns >= event_ns and not happened:
            happened = True
            _happens(case, vehicle, held, drive, item.t_ns)
        if item.t_ns >= next_fix_ns:
            vehicle.push(drive.fix(item.t_ns, offset_m, rng))
            next_fix_ns += FIX_NS
        output = vehicle.push(item)
        if isinstance(item, Scan) and happened:
            _note(told, output.online, drive, event_ns)
    return told


def _happens(case: HealthCase, vehicle: Localising, held: LocalMap, drive: ShortDrive, t_ns: int) -> None:
    """The event of a case."""
    if case.is_pushed:
        push = T_from_R_t(exp_so3([0.0, 0.0, np.radians(case.turn_deg)]), [case.ahead_m, case.left_m, 0.0])
        vehicle.start_at(t_ns, drive.truth.at(t_ns) @ push, trusted=True)
    if case.tiles == "none":
        for tile_id in held.tiles:
            held.remove_tile(tile_id)
    if case.tiles == "shifted":
        tiles = drive.street.tiles
        there = {TileId.from_indices(t.lon_index + 1, t.lat_index): g for t, g in tiles.items()}
        shifted = local_map_of(drive.street.grid_frame, {t: there[t] for t in tiles if t in there})
        for tile_id in held.tiles:
            held.remove_tile(tile_id)
        for tile_id in shifted.tiles:
            held.set_tile(Tile(tile_id, 2, there[tile_id]))


def _note(told: ToldHealth, online: PoseEstimate | None, drive: ShortDrive, event_ns: int) -> None:
    """What is said now, and whether it is true."""
    if online is None or online.t_ns < event_ns:
        return
    after_s, off = (online.t_ns - event_ns) * 1e-9, drive.off(online.t_ns, online.T_map_vehicle)
    wrong, good = is_wrong(*off), online.health == "good"
    told.estimates += 1
    told.said[(online.health, online.cause)] += 1
    told.longitudinal_free += "longitudinal" in online.degenerate
    told.sigma_m = online.sigma_m
    if good:
        told.worst_good_m = max(told.worst_good_m, off[0])
    if good and wrong:
        told.wrong_good += 1
        told.last_wrong_good_s = after_s
    if good and not wrong:
        told.right_again_s = min(told.right_again_s, after_s)


def _figure(sensor: str, case: HealthCase, told: ToldHealth) -> Figure:
    return Figure(f"{sensor}: {case.name}", float(told.wrong_good), "good while wrong", " | ".join(_details(told)))


def _details(told: ToldHealth) -> Iterator[str]:
    for (health, cause), n in told.said.most_common(4):
        yield f"{health}/{cause} {n / max(told.estimates, 1):.0%}"
    if told.wrong_good:
        yield f"noticed after {told.last_wrong_good_s:.1f} s"
    if np.isfinite(told.right_again_s):
        yield f"good and right from {told.right_again_s:.1f} s, at most {told.worst_good_m:.2f} m off while good"
    if told.longitudinal_free:
        free = told.longitudinal_free / told.estimates
        yield f"longitudinal named free in {free:.0%}, sigma {told.sigma_m:.2f} m at the end"
