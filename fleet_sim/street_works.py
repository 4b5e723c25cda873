"""Smaller works along the rest of a street that is longer than the 200 m around its construction zone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.parts import Lot
from gnd.fleet_sim.shapes import Shape
from gnd.fleet_sim.street_site import Site, x_of, y_of
from gnd.fleet_sim.world import Edit, WorldObject

ZONE_REACH_M: Final = 85.0
"""The construction zone and what belongs to it lie within this distance of the street's middle."""
_SPACING_M: Final = 25.0
"""One work for so much of the street beyond."""


@dataclass(frozen=True, slots=True)
class Work:
    """One place where something is done.

    Attributes:
        site: the street being edited.
        lots: its buildings, in the order of their names.
        number: distinguishes the works of a street.
        side: +1 left, -1 right.
        x_m: middle of the work along the street.
        reach_m: nothing farther from the street's middle is touched.
    """

    site: Site
    lots: Sequence[Lot]
    number: int
    side: int
    x_m: float
    reach_m: float

    def nearest(self, kind: str, count: int = 1) -> list[WorldObject]:
        """Return up to `count` untouched things of a kind on this side, nearest first."""
        found = [o for o in self.site.kept(kind) if y_of(o) * self.side > 0 and abs(x_of(o)) <= self.reach_m]
        return sorted(found, key=lambda o: abs(x_of(o) - self.x_m))[:count]

    def add(self, kind: str, *pieces: Shape) -> None:
        """Put a thing that was not there before."""
        self.site.add(f"works {self.number} {kind} {len(self.site.objects)}", kind, pieces)

    def lot(self, building: WorldObject) -> Lot:
        """Return the lot of a building."""
        return self.lots[int(building.name.split()[-1])]

    def rebuild(self, building: WorldObject, edit: Edit, **changes: float) -> None:
        """Build a building anew on a changed lot."""
        changed = replace(self.lot(building), **changes)  # type: ignore[arg-type]
        self.site.change(building, parts.building(changed), edit)


def add_works(site: Site, lots: Sequence[Lot], reach_m: float, rng: np.random.Generator) -> None:
    """Spread works over the street beyond the construction zone, up to `reach_m` from its middle; all kinds in turn.

    A street of 200 m has none.
    """
    count = round(2 * max(0.0, reach_m - ZONE_REACH_M) / _SPACING_M)
    step_m = 2 * (reach_m - ZONE_REACH_M) / max(count, 1)
    order = rng.permutation(len(_KINDS)).tolist()
    for number in range(count):
        out = ZONE_REACH_M + (number // 2 + float(rng.uniform(0.3, 0.7))) * step_m
        side = 1 if rng.random() < 0.5 else -1
        x = round((1 if number % 2 else -1) * out, 2)
        work = Work(site, lots, number, side, x, reach_m)
        _KINDS[order[number % len(order)]](work, rng)


def _new_fronts(work: Work, rng: np.random.Generator) -> None:
    """Neighbours get another relief; one of them grows."""
    for building, taller in zip(work.nearest("building", 3), (0.0, 3.0, 0.0), strict=False):
        lot = work.lot(building)
        work.rebuild(building, "reshaped", height_m=lot.height_m + taller, style=int(rng.integers(2**31)))


def _moved_fronts(work: Work, rng: np.random.Generator) -> None:
    """Neighbours' fronts move by half a metre, forwards or backwards."""
    for building, sign in zip(work.nearest("building", 3), (1.0, -1.0, 1.0), strict=False):
        forward = sign * float(rng.uniform(0.35, 0.7))
        work.rebuild(building, "moved", front_m=work.lot(building).front_m - forward)


def _demolition(work: Work, rng: np.random.Generator) -> None:
    """A building goes; hoarding and rubble take its place."""
    for building in work.nearest("building"):
        lot, base = work.lot(building), work.site.base_m
        work.site.remove(building)
        y = lot.side * (lot.front_m + 0.2)
        work.add("hoarding", parts.slab(lot.x0_m - 0.5, lot.x1_m + 0.5, y - 0.05, y + 0.05, base, base + 2.2))
        work.add("heap", *parts.heap(lot.x_m, lot.side * (lot.front_m + 5.0), base, float(rng.uniform(3.0, 4.5))))


def _scaffolding(work: Work, rng: np.random.Generator) -> None:
    """A scaffold before a front, a container and a site sign beside it."""
    for building in work.nearest("building"):
        lot, base, y = work.lot(building), work.site.base_m, work.side * (work.lot(building).front_m - 1.2)
        work.add("scaffold", *parts.scaffold(lot.x0_m + 0.5, lot.x1_m - 0.5, y, base, work.side, 3))
        work.add("container", *parts.container(lot.x1_m + 4.0, work.side * 7.7, base, float(rng.normal(0.0, 0.05))))
        work.add("sign", *parts.sign(lot.x0_m - 2.0, work.side * 5.6, -0.1, 1.2, 1.4, 0.0))


def _wider_pavement(work: Work, rng: np.random.Generator) -> None:
    """The kerb comes out on some 20 m; a terrace is raised before the houses, one of which gets another front."""
    half, base = float(rng.uniform(8.0, 12.0)), work.site.base_m
    x0, x1 = work.x_m - half, work.x_m + half
    work.add("pavement", parts.slab(x0, x1, work.side * 5.0, work.side * 6.2, -1.0, base))
    work.add("pavement", parts.slab(x0, x1, work.side * 7.2, work.side * 10.3, -0.5, base + 0.35))
    for building in work.nearest("building"):
        work.rebuild(building, "reshaped", style=int(rng.integers(2**31)))


def _lay_by(work: Work, rng: np.random.Generator) -> None:
    """Two pieces of pavement are taken out, with what stands on them; barriers close the place off."""
    for piece in work.nearest("pavement", 2):
        work.site.remove(piece)
        for kind in ("sign", "lamp", "tree"):
            for thing in [o for o in work.nearest(kind, 2) if abs(x_of(o) - x_of(piece)) < 5.0]:
                work.site.remove(thing)
    for dx in (-9.0, 9.0):
        work.add("barrier", *parts.barrier(work.x_m + dx, work.side * 4.75, -0.1, float(rng.normal(0.0, 0.04))))


def _planting(work: Work, rng: np.random.Generator) -> None:
    """A tree is felled, one is planted elsewhere, the house behind it is built anew nearer to the road."""
    for tree in work.nearest("tree"):
        work.site.remove(tree)
    work.add("tree", *parts.tree(work.x_m + 6.0, work.side * 8.1, work.site.base_m, int(rng.integers(2**31))))
    for building in work.nearest("building"):
        front_m = max(10.4, work.lot(building).front_m - float(rng.uniform(0.5, 1.5)))
        work.rebuild(building, "reshaped", front_m=front_m, style=int(rng.integers(2**31)))


def _walling(work: Work, rng: np.random.Generator) -> None:
    """A front wall moves back, another is raised, a house front moves back."""
    walls = [o for o in work.nearest("wall", 5) if o.name.startswith("wall")]
    for wall in walls[:1]:
        work.site.shift(wall, 0.0, work.side * float(rng.uniform(0.4, 1.5)))
    for wall in walls[1:2]:
        lot = work.lot(wall)
        raised = parts.wall(lot.x0_m + 0.3, lot.x1_m - 2.5, work.side * 10.35, 2.3, work.site.base_m)
        work.site.change(wall, raised, "reshaped")
    for building in work.nearest("building"):
        work.rebuild(building, "moved", front_m=work.lot(building).front_m + float(rng.uniform(0.4, 0.8)))


_KINDS: Final[tuple[Callable[[Work, np.random.Generator], None], ...]] = (
    _new_fronts,
    _moved_fronts,
    _demolition,
    _scaffolding,
    _wider_pavement,
    _lay_by,
    _planting,
    _walling,
)
