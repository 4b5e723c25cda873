"""What one vehicle's drive came to: reports, evidence by the truth's voxels, accounts; and its file in the cache."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.detect.classify import classify
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.segment import SegmentedScan
from studies.frame.errors import FolderError
from studies.frame.kept import read_value, write_value
from studies.pcd import PcdReport
from studies.simulation.options import MethodParameters

EVIDENCE: Final = ("n_bi", "n_bo", "n_pi", "n_po", "n_be", "n_pe", "cells", "map_cells", "change_class")
"""Columns of `VehicleResult.evidence`: the counters of the detector, occupied sub-cells of the new and of the map's
Gaussian (0: none), the class that the vehicle decided."""


@dataclass(frozen=True, slots=True, eq=False)
class VehicleResult:
    """One drive.

    Attributes:
        vehicle, sensor: name, and the sensor's short name.
        reports: encoded `ChangeReport`s, exactly what is uploaded.
        row: int32 (K,) rows of the truth about which there is evidence, ascending.
        evidence: int32 columns (K,), see `EVIDENCE`.
        stats: counts, localisation errors; plain values.
        pcd: the baseline's report; None without it.
        packed: the first half of each report in short, as the vehicle's outbox holds it; empty where it has none.
    """

    vehicle: str
    sensor: str
    reports: tuple[bytes, ...]
    row: NDArray[np.int32]
    evidence: Mapping[str, NDArray[np.int32]]
    stats: Mapping[str, Any]
    pcd: PcdReport | None = None
    packed: tuple[bytes, ...] = ()

    @property
    def upload_bytes(self) -> int:
        """Bytes of all reports."""
        return sum(len(report) for report in self.reports)


@dataclass(frozen=True, slots=True, eq=False)
class _Keyed:
    """A result with the key of all that decided it."""

    key: str
    result: VehicleResult


def write_result(result: VehicleResult, key: str, path: Path) -> None:
    """Write a result; the file appears complete or not at all."""
    write_value(path, _Keyed(key, result))


def read_result(path: Path, key: str | None = None) -> VehicleResult:
    """Read a result, of whatever key where none is given.

    Raises:
        FolderError: it is missing, damaged or belongs to another key.
    """
    kept = read_value(path, _Keyed)
    if key not in (None, kept.key):
        raise FolderError(f"{path} belongs to another run")
    return kept.result


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
        return read_value(path, cls)

    def write(self, path: Path) -> None:
        """Write the voxels; the file appears complete or not at all."""
        write_value(path, self)

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


COUNTS: Final = ("movers", "movers_left", "static", "static_lost")
"""Points on movers, of these taken for static, points on what stands, of these taken for movers."""


class MoverLabels:
    """Keeps the labels of each scan until it has been segmented.

    Attributes:
        counts: `COUNTS`, of points within the range of detection.
    """

    def __init__(self, range_m: float) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(COUNTS, 0))
        self._range_m = range_m
        self._waiting: dict[int, NDArray[np.bool_]] = {}

    def take(self, t_ns: int, moving: NDArray[np.bool_]) -> None:
        """Keep the labels (N,) of the scan that begins at `t_ns`."""
        self._waiting[t_ns] = moving

    def compare(self, segmented: SegmentedScan) -> None:
        """Count right and wrong points of a scan; scans that the vehicle dropped before are forgotten."""
        begun = [t_ns for t_ns in self._waiting if t_ns <= segmented.scan.t_ns]
        labels = [self._waiting.pop(t_ns) for t_ns in begun][-1:]
        if not labels or len(labels[0]) != len(segmented.moving):
            return
        scan, said = segmented.scan, segmented.moving
        x, y, z = (scan.points_map_m - scan.origins_map_m).T
        near = np.sqrt(x * x + y * y + z * z) <= self._range_m
        true, said = labels[0][near], said[near]
        found = (true.sum(), (true & ~said).sum(), (~true).sum(), (~true & said).sum())
        self.counts.update(dict(zip(COUNTS, map(int, found), strict=True)))
