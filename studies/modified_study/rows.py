"""Voxels with a surface before and after, as they were measured, and whether the truth calls them modified.

One row is one voxel of one drive: of our detector, of the point-cloud baseline, or of a real recording. Two Gaussians
and counts of rays are kept, not features: so rules can be compared on rows that were collected once.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.truth import LEVELS, Level
from gnd.gnd_map.arrays import F64, check_array
from gnd.gnd_map.gaussian import Gaussians
from gnd.vehicle_agent.detect.shape_change import shape_features

Mask = NDArray[np.bool_]
Method = Literal["gnd", "cloud"]


@dataclass(frozen=True, slots=True, eq=False)
class ShapeRows:
    """What a drive measured in N voxels, beside the truth.

    Attributes:
        was, now: the Gaussians before and as measured, numbered 0 … N - 1.
        rays: int32 (N, 4), BI, BO, PI and PO; of point clouds the points that stayed, came and went, and 0.
        modified: bool (N,), whether the truth calls the voxel modified.
        held: bool (N,), whether the truth has a surface there before and after: the others serve no fit.
        observable, scored: bool (N,), whether the voxel counts at that level; at "all" each does.
        missed: int64 (3,), modified voxels of each level of `LEVELS` that have no row: no rule can find them.
    """

    was: Gaussians
    now: Gaussians
    rays: NDArray[np.int32]
    modified: Mask
    held: Mask
    observable: Mask
    scored: Mask
    missed: NDArray[np.int64]

    def __post_init__(self) -> None:
        n = len(self)
        check_array("now", self.now.count, np.int32, (n,))
        check_array("rays", self.rays, np.int32, (n, 4))
        for name in ("modified", "held", "observable", "scored"):
            check_array(name, getattr(self, name), np.bool_, (n,))
        check_array("missed", self.missed, np.int64, (len(LEVELS),))

    def __len__(self) -> int:
        return len(self.was)

    @property
    def features(self) -> F64:
        """What the trees ask about, see `shape_features`."""
        return shape_features(self.was, self.now, *self.rays.T[:3])

    def mask(self, level: Level) -> Mask:
        """(N,) which rows count at a level."""
        return {"observable": self.observable, "all": np.ones(len(self), np.bool_), "scored": self.scored}[level]

    def missed_at(self, level: Level) -> int:
        """Modified voxels of a level that have no row."""
        return int(self.missed[LEVELS.index(level)])


def joined(parts: Iterable[ShapeRows]) -> ShapeRows:
    """All rows together; at least one part is needed."""
    many = list(parts)
    names = ("rays", "modified", "held", "observable", "scored")
    columns = {name: np.concatenate([getattr(part, name) for part in many]) for name in names}
    return ShapeRows(
        was=numbered([part.was for part in many]),
        now=numbered([part.now for part in many]),
        **columns,
        missed=np.sum([part.missed for part in many], axis=0),
    )


def numbered(parts: Sequence[Gaussians]) -> Gaussians:
    """Gaussians of several tiles one after the other, with their row in place of the voxel's id."""
    columns = [np.concatenate(column) for column in zip(*(part.columns[1:] for part in parts), strict=True)]
    return Gaussians(np.arange(len(columns[0]), dtype=np.int32), *columns)


def taken(rows: ShapeRows, chosen: NDArray[np.int64]) -> ShapeRows:
    """Some of the rows (K,), increasing, in order."""
    names = ("rays", "modified", "held", "observable", "scored")
    columns = {name: getattr(rows, name)[chosen] for name in names}
    was, now = (numbered([g.take(chosen)]) for g in (rows.was, rows.now))
    return ShapeRows(was=was, now=now, **columns, missed=rows.missed)
