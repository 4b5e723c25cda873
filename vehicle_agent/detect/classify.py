"""From evidence to classes (GND 4.4) and to what is uploaded (GND 4.5)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnd_map.classes import CHANGED, ChangeClass
from gnd_map.evidence import ChangeState, masses, states
from gnd_map.gaussian import Gaussians, concat
from gnd_map.similarity import similarity
from schemas.changes import TileChange
from vehicle_agent.detect.evidence import TileEvidence
from vehicle_agent.detect.parameters import DetectParameters


@dataclass(frozen=True, slots=True, eq=False)
class Classification:
    """A class for every voxel of a `TileEvidence`; `UNMEASURED` where the drive abstains."""

    evidence: TileEvidence
    change_class: NDArray[np.uint8]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """(K,) True where the drive makes a statement."""
        return np.asarray(self.change_class != ChangeClass.UNMEASURED)

    @property
    def changed(self) -> NDArray[np.bool_]:
        """(K,) True where the statement is not "as in the map"."""
        return np.isin(self.change_class, CHANGED)


def classify(evidence: TileEvidence, parameters: DetectParameters) -> Classification:
    """Decide every voxel of a tile by its evidence.

    The state is the largest mass after Eq. (11); a voxel is new, modified or deleted when it is `changed`. `default`
    mode adds: a new Gaussian that resembles the map's keeps the voxel normal, one that does not makes even a sustained
    voxel modified; deletion needs rays that passed; too few hits, too few rays or a tie abstain.
    """
    decide = _decide_paper if parameters.mode == "paper" else _decide_default
    return Classification(evidence, decide(evidence, parameters).astype(np.uint8))


def _state(e: TileEvidence, parameters: DetectParameters) -> NDArray[np.uint8]:
    return states(masses(e.n_bi, e.n_bo, e.n_be, e.n_pi, parameters.masses))  # Eq. (11) and (12) in closed form


def _decide_paper(e: TileEvidence, p: DetectParameters) -> NDArray[np.int64]:
    """GND 4.4 plainly: a changed voxel with points has a new Gaussian, one without is deleted."""
    state = _state(e, p)
    sustained, changed = state == ChangeState.SUSTAINED, state == ChangeState.CHANGED
    has_gaussian, has_points = e.measured.cells >= p.min_cells, e.measured.count > 0
    of_map = np.select(
        [sustained, changed & has_gaussian, changed & ~has_points],
        [ChangeClass.NORMAL, ChangeClass.MODIFIED, ChangeClass.DELETED],
        ChangeClass.UNMEASURED,
    )
    of_empty = np.select(
        [changed & has_gaussian, ~has_points], [ChangeClass.NEW, ChangeClass.EMPTY], ChangeClass.UNMEASURED
    )
    return np.where(e.in_map, of_map, of_empty)


def _decide_default(e: TileEvidence, p: DetectParameters) -> NDArray[np.int64]:
    return np.where(e.in_map, _decide_of_map(e, p), _decide_of_empty(e, p))


def _decide_of_map(e: TileEvidence, p: DetectParameters) -> NDArray[np.int64]:
    """Voxels in which the map has a Gaussian: normal, modified or deleted."""
    state = _state(e, p)
    has_gaussian = e.measured.cells >= p.min_cells
    alike = _similar_to_map(e) >= p.similar
    covered = e.measured.cells >= p.min_coverage * _cells_of_map(e)
    sustained, changed = state == ChangeState.SUSTAINED, state == ChangeState.CHANGED
    reshaped = has_gaussian & ~alike & (changed | covered)
    gone = changed & (e.measured.cells < p.weak_cells) & (e.n_pi >= p.min_pass_inside)
    return np.select(
        [reshaped & (sustained | changed), sustained | (changed & has_gaussian), gone],
        [ChangeClass.MODIFIED, ChangeClass.NORMAL, ChangeClass.DELETED],
        ChangeClass.UNMEASURED,
    )


def _decide_of_empty(e: TileEvidence, p: DetectParameters) -> NDArray[np.int64]:
    """Voxels in which the map has none: new or empty; weak hits and few passes abstain."""
    new = e.measured.cells >= p.new_cells
    empty = (e.measured.cells < p.weak_cells) & (e.n_pe >= p.min_passes)
    return np.select([new, empty], [ChangeClass.NEW, ChangeClass.EMPTY], ChangeClass.UNMEASURED)


def _similar_to_map(e: TileEvidence) -> NDArray[np.float64]:
    """(K,) similarity of the new Gaussian with the map's, both about the voxel's centre; 0 where the map has none."""
    result = np.zeros(len(e))
    rows, base, new = np.flatnonzero(e.in_map), e.base.gaussians, e.measured
    at = e.map_row[rows]
    result[rows] = similarity(
        base.exists[at], base.mean_m[at], base.cov_m2[at], new.exists[rows], new.mean_m[rows], new.cov_m2[rows]
    )
    return result


def _cells_of_map(e: TileEvidence) -> NDArray[np.int32]:
    """(K,) occupied sub-cells of the map's Gaussian, 0 where there is none."""
    result = np.zeros(len(e), np.int32)
    result[e.in_map] = e.base.gaussians.cells[e.map_row[e.in_map]]
    return result


def tile_change(found: Classification, *, pose_sigma_m: float, pose_sigma_rad: float) -> TileChange:
    """What is reported of a tile: all observed voxels, and the changed ones with their new Gaussian or none."""
    e, base = found.evidence, found.evidence.base
    rows = np.flatnonzero(found.changed)
    return TileChange(
        tile=base.tile_id,
        base_version=base.version,
        base_sha=base.sha if base.version else b"",
        observed=e.voxel_id[found.observed],
        changed=_uploaded(e.measured.take(rows), found.change_class[rows]),
        change_class=found.change_class[rows],
        evidence=e.counters[rows],
        pose_sigma_m=pose_sigma_m,
        pose_sigma_rad=pose_sigma_rad,
    )


def _uploaded(measured: Gaussians, change_class: NDArray[np.uint8]) -> Gaussians:
    """The new Gaussians of new and modified voxels; nothing at the deleted ones, whatever few points ended there."""
    gone = change_class == ChangeClass.DELETED
    parts = [measured.take(~gone), Gaussians.nothing_at(measured.voxel_id[gone])]
    return concat(parts)
