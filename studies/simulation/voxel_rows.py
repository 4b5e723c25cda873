"""The truth's voxels as rows: evidence of a drive is kept by row."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.arrays import I32, I64
from gnd.vehicle_agent.detect.evidence import TileEvidence
from studies.simulation.result import EVIDENCE


@dataclass(frozen=True, slots=True, eq=False)
class VoxelRows:
    """V voxels sorted by (morton, voxel_id): int64 (V,), int32 (V,)."""

    morton: I64
    voxel_id: I32

    @classmethod
    def of(cls, truth: Truth) -> "VoxelRows":
        """Return the voxels of a truth."""
        return cls(truth.morton, truth.voxel_id)

    @classmethod
    def read(cls, path: Path) -> "VoxelRows":
        """Read what `write` wrote."""
        with np.load(path, allow_pickle=False) as file:
            return cls(file["morton"], file["voxel_id"])

    def write(self, path: Path) -> None:
        """Write the voxels; the file appears complete or not at all."""
        partial = path.with_name(f".{path.name}.part")
        with partial.open("wb") as file:
            np.savez(file, morton=self.morton, voxel_id=self.voxel_id)
        partial.replace(path)

    def columns(
        self, found: Iterable[TileEvidence], columns_of: Callable[[TileEvidence], Mapping[str, I32]]
    ) -> tuple[I32, dict[str, I32]]:
        """Return the rows with evidence, int32 (K,) ascending, and its columns (K,), tiles joined.

        Of a tile that was decided twice, the evidence that came first stays.
        """
        rows, parts = [], []
        for evidence in found:
            row, at = self._rows(evidence.base.tile_id.morton, evidence.voxel_id)
            rows.append(row)
            parts.append({name: column[at] for name, column in columns_of(evidence).items()})
        if not parts:
            return np.zeros(0, np.int32), {name: np.zeros(0, np.int32) for name in EVIDENCE}
        row, first = np.unique(np.concatenate(rows), return_index=True)
        joined = {name: np.concatenate([part[name] for part in parts])[first] for name in parts[0]}
        return row.astype(np.int32), joined

    def _rows(self, morton: int, voxel_id: I32) -> tuple[I64, I64]:
        """Rows of those of a tile's voxels that are among ours, and where they are in `voxel_id`."""
        low, high = np.searchsorted(self.morton, [morton, morton + 1])
        inside = self.voxel_id[low:high]
        if not len(inside):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        at = np.minimum(np.searchsorted(inside, voxel_id), len(inside) - 1)
        known = np.flatnonzero(inside[at] == voxel_id)
        return low + at[known], known
