"""What bad vehicles report: made of what they have really seen, so that place, time and coverage are right."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I32, are_in
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.report_id import deterministic_report_id

Tiles = Mapping[TileId, Gaussians]
REPEATS: Final = 12
INVENTED: Final = 12
"""Objects that a vehicle invents in a tile, each of up to 2 x 2 x 2 voxels."""
_DELETED_SHARE: Final = 0.3
_LYING_SHARE: Final = 0.6
_TURN_RAD: Final = np.radians(2.0)
_SHIFT_M: Final = np.array([0.5, 0.3, 0.0])
_VARIANCE_M2: Final = 0.05


@dataclass(frozen=True, slots=True)
class Lies:
    """What decides the lies of one vehicle.

    Attributes:
        base: the map that it has.
        seed: of its choices; vehicles that collude share it.
        turn: its number among the bad ones.
    """

    base: Tiles
    seed: int
    turn: int

    def rng(self, tile: TileId) -> np.random.Generator:
        """The choices about one tile."""
        return np.random.default_rng([self.seed, tile.morton])


Lie = Callable[[Sequence[ChangeReport], Lies], list[ChangeReport]]


def _each_tile(change: Callable[[TileChange, Lies], TileChange]) -> Lie:
    def lie(reports: Sequence[ChangeReport], lies: Lies) -> list[ChangeReport]:
        return [replace(one, tiles=tuple(change(tile, lies) for tile in one.tiles)) for one in reports]

    return lie


def _says(change: TileChange, changed: Gaussians, was: Gaussians) -> TileChange:
    """The same drive with these changes instead of its own, believed and with rays to go with them."""
    there = changed.exists
    known = are_in(changed.voxel_id, was.voxel_id)
    kinds = np.where(there, np.where(known, ChangeClass.MODIFIED, ChangeClass.NEW), ChangeClass.DELETED)
    evidence = np.where(there[:, None], [20, 0, 20, 0], [0, 0, 0, 40]).astype(np.int32)
    observed = np.union1d(change.observed, changed.voxel_id).astype(np.int32)
    return replace(
        change, observed=observed, changed=changed, change_class=kinds.astype(np.uint8), evidence=evidence, doubt=None
    )


def _seen_base(change: TileChange, lies: Lies) -> Gaussians:
    was = lies.base.get(change.tile, Gaussians.empty())
    return was.take(are_in(was.voxel_id, change.observed))


def _moved(tile: TileId, seen: Gaussians, to_m: Callable[[F64], F64], was: Gaussians) -> Gaussians:
    """Where the Gaussians of a tile are measured when points are moved, and what is missed where they are."""
    grid = VoxelGrid.of(tile)
    ix, iy, floor = grid.unravel(seen.voxel_id)
    at_m = np.column_stack([ix, iy, floor]) + np.asarray(
        0.5 + seen.mean_m, np.float64
    )  # voxels are one metre, near enough
    to = to_m(np.asarray(at_m, np.float64))
    cell = np.floor(to).astype(np.int64)
    inside = ((cell >= 0) & (cell < [grid.nx, grid.ny, 1 << 30])).all(axis=1)
    ids = np.zeros(len(seen), np.int32)
    ids[inside] = grid.voxel_id(cell[inside, 0], cell[inside, 1], cell[inside, 2])
    keep = np.flatnonzero(inside)
    ids, first = np.unique(ids[keep], return_index=True)
    rows = keep[first]
    mean = (to[rows] - cell[rows] - 0.5).astype(np.float32)
    there = Gaussians(ids, seen.count[rows], seen.cells[rows], mean, seen.cov_m2[rows])
    left = np.setdiff1d(seen.voxel_id, ids).astype(np.int32)
    del was
    return concat([there, Gaussians.nothing_at(left)])


def _shifted(change: TileChange, lies: Lies) -> TileChange:
    seen = _seen_base(change, lies)
    was = lies.base.get(change.tile, Gaussians.empty())
    return _says(change, _moved(change.tile, seen, lambda at_m: at_m + _SHIFT_M, was), was)


def _turned(change: TileChange, lies: Lies) -> TileChange:
    seen = _seen_base(change, lies)
    was = lies.base.get(change.tile, Gaussians.empty())
    c, s = np.cos(_TURN_RAD), np.sin(_TURN_RAD)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    about = np.array([15.0, -10.0, 0.0])  # the vehicle drives beside the middle: most is far from it
    return _says(
        change, _moved(change.tile, seen, lambda at_m: np.asarray((at_m - about) @ turn + about, np.float64), was), was
    )


def _deletes_all(change: TileChange, lies: Lies) -> TileChange:
    was = lies.base.get(change.tile, Gaussians.empty())
    return _says(change, Gaussians.nothing_at(_seen_base(change, lies).voxel_id), was)


def _invented(change: TileChange, lies: Lies) -> Gaussians:
    """Objects on what the drive has seen to be there."""
    was, rng = lies.base.get(change.tile, Gaussians.empty()), lies.rng(change.tile)
    if not len(was):
        return Gaussians.empty()
    grid = VoxelGrid.of(change.tile)
    ix, iy, floor = grid.unravel(was.voxel_id)
    feet = rng.choice(len(was), min(INVENTED, len(was)), replace=False)
    found: set[int] = set()
    for foot in feet:
        for dx, dy, dz in np.ndindex(2, 2, 2):
            x, y, z = int(ix[foot]) + dx, int(iy[foot]) + dy, int(floor[foot]) + dz
            if x < grid.nx and y < grid.ny:
                found.add(int(grid.voxel_id(x, y, z)))
    ids = np.setdiff1d(np.array(sorted(found), np.int32), was.voxel_id).astype(np.int32)
    n = len(ids)
    cov = np.tile(np.array([_VARIANCE_M2, 0, 0, _VARIANCE_M2, 0, _VARIANCE_M2], np.float32), (n, 1))
    mean = rng.uniform(-0.2, 0.2, (n, 3)).astype(np.float32)
    return Gaussians(ids, np.full(n, 300, np.int32), np.full(n, 90, np.int32), mean, cov)


def _inserts(change: TileChange, lies: Lies) -> TileChange:
    return _says(change, _invented(change, lies), lies.base.get(change.tile, Gaussians.empty()))


def _rebuilds(change: TileChange, lies: Lies) -> TileChange:
    """Objects that are not there, and a part of those that are there gone."""
    was, seen = lies.base.get(change.tile, Gaussians.empty()), _seen_base(change, lies)
    rng = np.random.default_rng([lies.seed, change.tile.morton, 1])
    gone = seen.voxel_id[rng.random(len(seen)) < _DELETED_SHARE]
    return _says(change, concat([_invented(change, lies), Gaussians.nothing_at(gone)]), was)


def _repeats(reports: Sequence[ChangeReport], lies: Lies) -> list[ChangeReport]:
    """The same lies again and again, under new ids, as if seen a second later."""
    once = _each_tile(_rebuilds)(reports, lies)
    return [_again(one, number) for one in once for number in range(REPEATS)]


def _again(one: ChangeReport, number: int) -> ChangeReport:
    moved_ns = number * 1_000_000_000
    report_id = deterministic_report_id(one.last_ns // 1_000_000 + 1000 * number, one.report_id, str(number))
    return replace(one, report_id=report_id, first_ns=one.first_ns + moved_ns, last_ns=one.last_ns + moved_ns)


def _replays(reports: Sequence[ChangeReport], lies: Lies) -> list[ChangeReport]:
    """What it saw before everything changed, told as if it were now: all is as in the base."""
    return _each_tile(lambda tile, about: _says(tile, Gaussians.empty(), about.base.get(tile.tile, Gaussians.empty())))(
        reports, lies
    )


def _targets(reports: Sequence[ChangeReport], lies: Lies) -> list[ChangeReport]:
    """Honest but in one tile, which all that collude know."""
    target = sorted(lies.base, key=lambda tile: len(lies.base[tile]))[-2]
    return [
        replace(one, tiles=tuple(_rebuilds(tile, lies) if tile.tile == target else tile for tile in one.tiles))
        for one in reports
    ]


def _sleeps(reports: Sequence[ChangeReport], lies: Lies) -> list[ChangeReport]:
    """Honest in the first half of its tiles, in the order in which it drives; then it lies."""
    return _by_turn(reports, lambda tile, share: _rebuilds(tile, lies) if share >= 0.5 else tile)


def _drifts(reports: Sequence[ChangeReport], lies: Lies) -> list[ChangeReport]:
    """A shift that grows from tile to tile."""

    def moved(tile: TileChange, share: float) -> TileChange:
        was = lies.base.get(tile.tile, Gaussians.empty())
        return _says(
            tile,
            _moved(
                tile.tile, _seen_base(tile, lies), lambda at_m: np.asarray(at_m + share * _SHIFT_M, np.float64), was
            ),
            was,
        )

    return _by_turn(reports, moved)


def _by_turn(reports: Sequence[ChangeReport], change: Callable[[TileChange, float], TileChange]) -> list[ChangeReport]:
    """Each tile changed by its turn among all that the vehicle tells of, 0 to 1, by the time of its report."""
    ordered = sorted(reports, key=lambda one: (one.last_ns, one.report_id))
    n = max(sum(len(one.tiles) for one in ordered) - 1, 1)
    found, turn = list[ChangeReport](), 0
    for one in ordered:
        found.append(replace(one, tiles=tuple(change(tile, (turn + k) / n) for k, tile in enumerate(one.tiles))))
        turn += len(one.tiles)
    return found


def _lies_partly(reports: Sequence[ChangeReport], lies: Lies) -> list[ChangeReport]:
    """Its honest changes, and lies among them."""

    def both(change: TileChange, about: Lies) -> TileChange:
        rng = about.rng(change.tile)
        lie = _rebuilds(change, about).changed
        lie = lie.take(rng.random(len(lie)) < _LYING_SHARE)
        own = change.changed.take(~are_in(change.changed.voxel_id, lie.voxel_id))
        return _says(change, concat([own, lie]), about.base.get(change.tile, Gaussians.empty()))

    return _each_tile(both)(reports, lies)


KINDS: Final[dict[str, Lie]] = {
    "miscalibrated": _each_tile(_turned),
    "shifted": _each_tile(_shifted),
    "deletes_all": _each_tile(_deletes_all),
    "inserts": _each_tile(_inserts),
    "repeats": _repeats,
    "replays": _replays,
    "colluding": _each_tile(_rebuilds),
    "targeted": _targets,
    "partly": _lies_partly,
    "sleeper": _sleeps,
    "drift": _drifts,
}
TOGETHER: Final = frozenset({"colluding", "targeted"})
MIXED: Final = ("miscalibrated", "shifted", "deletes_all", "inserts", "repeats", "replays", "partly")


def lie_of(kind: str, turn: int) -> Lie:
    """How the bad vehicle with this number lies."""
    if kind == "mixed":
        return KINDS[MIXED[turn % len(MIXED)]]
    return KINDS["colluding" if kind in ("one_of_two", "one_of_three") else kind]


def claimed(reports: Sequence[ChangeReport]) -> dict[TileId, I32]:
    """The voxels that reports call changed, by tile."""
    found: dict[TileId, list[I32]] = {}
    for one in reports:
        for tile in one.tiles:
            found.setdefault(tile.tile, []).append(tile.changed.voxel_id)
    return {tile: np.unique(np.concatenate(ids)).astype(np.int32) for tile, ids in found.items()}
