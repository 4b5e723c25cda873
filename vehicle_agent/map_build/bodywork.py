"""The vehicle's own bodywork among its points: what keeps its place in the vehicle frame while the ground passes.

Where the vehicle itself drives nothing can stand: what is seen in the box around its own lane at the same place of the
vehicle frame, metre of way after metre of way, travels along. That holds for a bonnet, a rack, a trailer, and for
somebody who follows or leads at a constant distance. A guard rail or a tunnel's wall also keeps its distance, but never
lies inside the box, which is no wider than a vehicle.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64

Mask = NDArray[np.bool_]

CELL_M: Final = 0.2
LOW_M: Final = np.array([-15.0, -1.6, -4.0])
HIGH_M: Final = np.array([10.0, 1.6, 5.0])
"""The box, vehicle frame: a car with a trailer, as wide as a lorry with its mirrors."""
ABOVE_ROAD_M: Final = (0.35, 3.2)
"""Of the road itself, which keeps its place too, nothing is taken; of bridges and wires neither."""
EVERY_M: Final = 1.0
MIN_SCANS: Final = 25
"""So many scans, each a metre further, before anything is decided."""
MIN_SHARE: Final = 0.6
"""Of these scans have a point in a cell of the bodywork."""

_SHAPE: Final = tuple(int(n) for n in np.rint((HIGH_M - LOW_M) / CELL_M))


class BodyworkSurvey:
    """Counts in how many scans each cell around the vehicle holds a point."""

    def __init__(self) -> None:
        self._seen = np.zeros(_SHAPE, np.int32)
        self.scans = 0

    def add(self, points_vehicle_m: F64) -> None:
        """Take the points (N, 3) of a scan, vehicle frame; the vehicle has moved `EVERY_M` since the one before."""
        cells, inside = _cells(points_vehicle_m)
        hit = np.zeros(_SHAPE, np.bool_)
        hit[tuple(cells[inside].T)] = True
        self._seen += hit
        self.scans += 1

    def bodywork(self, road_z_m: float) -> "Bodywork":
        """What travels along, with the road at this height of the vehicle frame."""
        if self.scans < MIN_SCANS:
            return Bodywork(np.zeros(_SHAPE, np.bool_))
        core = self._seen >= MIN_SHARE * self.scans
        z = LOW_M[2] + CELL_M * (np.arange(_SHAPE[2]) + 0.5) - road_z_m
        over_road = (z > ABOVE_ROAD_M[0]) & (z < ABOVE_ROAD_M[1])
        return Bodywork(_grown(core & over_road) & over_road)


class Bodywork:
    """The cells of the vehicle frame in which what is seen travels along."""

    def __init__(self, cells: Mask) -> None:
        self.cells = cells
        self._any = bool(cells.any())

    def of(self, points_vehicle_m: F64) -> Mask:
        """(N,) bool: which points (N, 3), vehicle frame, lie on it."""
        result = np.zeros(len(points_vehicle_m), np.bool_)
        if self._any:
            cells, inside = _cells(points_vehicle_m)
            result[inside] = self.cells[tuple(cells[inside].T)]
        return result


def _cells(points_m: F64) -> tuple[NDArray[np.int64], Mask]:
    """(N, 3) cell of each point, and (N,) whether it lies in the box."""
    inside = ((points_m >= LOW_M) & (points_m < HIGH_M)).all(axis=1)
    cells = np.floor((points_m - LOW_M) / CELL_M).astype(np.int64)
    return cells, inside & (cells < _SHAPE).all(axis=1)


def _grown(cells: Mask) -> Mask:
    """With every neighbour of every cell: an edge that trembles lies in the next cell at times."""
    grown = cells.copy()
    for axis in range(3):
        before = grown.copy()
        for step in (1, -1):
            moved = np.roll(before, step, axis)
            edge: list[slice | int] = [slice(None)] * 3
            edge[axis] = 0 if step == 1 else -1
            moved[tuple(edge)] = False
            grown |= moved
    return grown
