"""Why a vehicle got a voxel wrong: what its evidence says, against what is true there."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.classes import ChangeClass
from gnd.vehicle_agent.detect.parameters import MIN_CELLS, DetectParameters
from studies.simulation.result import EVIDENCE, VehicleResult

RIGHT: Final = "right"
UNSEEN: Final = "never observed"
FEW_CELLS: Final = "abstains: too few sub-cells"
EDGE: Final = "abstains: may be the edge of a neighbour"
FEW_RAYS: Final = "abstains: too few rays, or a tie"
OTHER: Final = "other"

Causes = NDArray[np.str_]
N, A, M, D, E = (
    int(c) for c in (ChangeClass.NORMAL, ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED, ChangeClass.EMPTY)
)


def columns_at(result: VehicleResult, rows: I64) -> dict[str, I32]:
    """Return the vehicle's evidence at rows (R,) of the truth: columns `EVIDENCE` and `seen` (0 or 1), int32 (R,)."""
    at = np.searchsorted(result.row, rows)
    at[at == len(result.row)] = 0
    seen = result.row[at] == rows if len(result.row) else np.zeros(len(rows), np.bool_)
    columns = {name: np.where(seen, result.evidence[name][at], 0) for name in EVIDENCE if len(result.row)}
    columns = columns or {name: np.zeros(len(rows), np.int32) for name in EVIDENCE}
    columns["change_class"] = np.where(seen, columns["change_class"], int(ChangeClass.UNMEASURED))
    columns["seen"] = seen.astype(np.int32)
    return columns


def causes(true_class: NDArray[np.uint8], e: Mapping[str, I32], p: DetectParameters) -> Causes:
    """Return for each voxel why the vehicle did not say what is true, or `RIGHT`.

    Args:
        true_class: uint8 (R,).
        e: the vehicle's evidence there, of `columns_at`.
        p: the parameters that it decided with.
    """
    said, t = e["change_class"], true_class
    silent = said == int(ChangeClass.UNMEASURED)
    weak = (e["cells"] >= p.weak_cells) & (e["cells"] < np.where(e["map_cells"] > 0, MIN_CELLS, p.new_cells))
    many = (e["map_cells"] == 0) & (e["cells"] >= p.new_cells)
    part = e["cells"] < 0.5 * e["map_cells"]
    cases = (
        (e["seen"] == 0, UNSEEN),
        (said == t, RIGHT),
        (silent & weak, FEW_CELLS),
        (silent & many, EDGE),
        (silent, FEW_RAYS),
        ((t == A) & (said == E) & (e["cells"] > 0), "empty: too few sub-cells met"),
        ((t == A) & (said == E), "empty: rays pass, nothing met"),
        ((t == E) & (said == A), "new: something stood or moved there"),
        ((t == M) & (said == N) & (e["cells"] < MIN_CELLS), "normal: too few sub-cells for a Gaussian"),
        ((t == M) & (said == N) & part, "normal: only a part of it seen"),
        ((t == M) & (said == N), "normal: the Gaussians are too alike"),
        ((t == M) & (said == D), "deleted: rays pass, too few sub-cells"),
        ((t == N) & (said == M) & part, "modified: only a part of it seen"),
        ((t == N) & (said == M), "modified: unlike the map's Gaussian"),
        ((t == N) & (said == D), "deleted: rays pass through what stands"),
        ((t == D) & (said == N) & (e["cells"] >= p.weak_cells), "normal: points met where it stood"),
        ((t == D) & (said == N), "normal: too few rays passed"),
        ((t == D) & (said == M), "modified: something else met there"),
    )
    return np.select([case for case, _ in cases], [name for _, name in cases], OTHER)
