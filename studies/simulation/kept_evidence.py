"""The evidence of a drive, kept beside what is reported, for the analysis of errors."""

from collections.abc import Collection

import numpy as np

from gnd.gnd_map.arrays import I32
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.detect.classify import classify
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.evidence import TileEvidence
from studies.simulation.method import MethodParameters
from studies.simulation.result import EVIDENCE


class RecordingDetector(ChangeDetector):
    """The detector, which also keeps the evidence that was taken out of it."""

    taken: list[TileEvidence]

    def finish(self, tiles: Collection[TileId]) -> dict[TileId, TileEvidence]:
        """Take out the evidence of tiles, and keep it."""
        found = super().finish(tiles)
        self.taken = [*getattr(self, "taken", []), *found.values()]
        return found


def evidence_columns(found: TileEvidence, method: MethodParameters) -> dict[str, I32]:
    """Return the columns `EVIDENCE` of a tile's evidence, int32 (K,) each."""
    columns = {name: getattr(found, name) for name in EVIDENCE if name.startswith("n_")}
    columns["cells"] = found.measured.cells
    columns["map_cells"] = np.zeros(len(found), np.int32)
    columns["map_cells"][found.in_map] = found.base.gaussians.cells[found.map_row[found.in_map]]
    columns["change_class"] = classify(found, method.detect).change_class.astype(np.int32)
    return columns
