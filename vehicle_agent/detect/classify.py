"""From evidence to classes (GND 4.4) and to what is uploaded (GND 4.5)."""

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.classes import CHANGED, ChangeClass
from gnd.gnd_map.evidence import ChangeState, masses, states
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.schemas.changes import TileChange
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.extension import cells_at_half, extends_neighbour
from gnd.vehicle_agent.detect.kernel import ETA_BLOCK
from gnd.vehicle_agent.detect.parameters import MIN_CELLS, DetectParameters
from gnd.vehicle_agent.detect.permeable import is_gone
from gnd.vehicle_agent.detect.shape_change import NOISE_M, fitted, shape_features
from gnd.vehicle_agent.detect.unsure import has_met, is_unsure, told

_MANY_RAYS: Final = 100
"""So many rays into a voxel without a Gaussian make too few hits a statement: by the one rule it is empty."""
INSIDE_SHARE: Final = 1.0 - ETA_BLOCK
"""Of the points in a voxel, so many lie outside of a Gaussian that has not changed (Eq. 1)."""
_EMPTY_CELLS: Final = 15
"""From here on a voxel is never called empty: another vehicle may find the sub-cells that are missing."""


@dataclass(frozen=True, slots=True, eq=False)
class Classification:
    """A class for every voxel of a `TileEvidence`; `UNMEASURED` where the drive abstains."""

    evidence: TileEvidence
    change_class: NDArray[np.uint8]
    unsure: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(U,) rows, ascending, upon which the drive does not decide and the cloud may: it met something there."""

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
    mode adds: a new Gaussian of the map's shape keeps the voxel normal, one of another shape makes even a sustained
    voxel modified (`shape_change`); deletion needs fewer hits than chance explains (`permeable`); a new Gaussian must
    be more than the edge of a known surface (`extension`); too few hits, too few rays or a tie abstain, and with
    `together` what was met is told to the cloud (`unsure`). Rays at one height delete planes only, and modify only
    where something lies outside the map's Gaussian.
    """
    if parameters.mode == "paper":
        return Classification(evidence, _decide_paper(evidence, parameters).astype(np.uint8))
    found = _decide_default(evidence, parameters).astype(np.uint8)
    if not parameters.together:
        return Classification(evidence, found)
    unsure = is_unsure(evidence, found == ChangeClass.NEW, found == ChangeClass.UNMEASURED)
    return Classification(evidence, found, np.flatnonzero(unsure))


def _state(e: TileEvidence, parameters: DetectParameters) -> NDArray[np.uint8]:
    return states(masses(e.n_bi, e.n_bo, e.n_be, e.n_pi, parameters.masses))  # Eq. (11) and (12) in closed form


def _decide_paper(e: TileEvidence, p: DetectParameters) -> NDArray[np.int64]:
    """GND 4.4 plainly: a changed voxel with points has a new Gaussian, one without is deleted."""
    state = _state(e, p)
    sustained, changed = state == ChangeState.SUSTAINED, state == ChangeState.CHANGED
    has_gaussian, has_points = e.measured.cells >= MIN_CELLS, e.measured.count > 0
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
    has_gaussian = e.measured.cells >= MIN_CELLS
    sustained, changed = state == ChangeState.SUSTAINED, state == ChangeState.CHANGED
    reshaped = has_gaussian & ~_same_shape(e, p)
    if e.at_one_height:
        reshaped &= _is_outside(e)
    gone = changed & (e.measured.cells < p.rules.weak_cells)
    rows = np.flatnonzero(gone & e.in_map)
    was = e.base.gaussians.take(e.map_row[rows])
    gone[rows] = is_gone(was, (e.n_bi + e.n_bo)[rows], e.n_pi[rows], at_one_height=e.at_one_height)
    return np.select(
        [reshaped & (sustained | changed), sustained | (changed & has_gaussian), gone],
        [ChangeClass.MODIFIED, ChangeClass.NORMAL, ChangeClass.DELETED],
        ChangeClass.UNMEASURED,
    )


def _decide_of_empty(e: TileEvidence, p: DetectParameters) -> NDArray[np.int64]:
    """Voxels in which the map has none: new or empty; few passes abstain, and weak hits unless many rays looked; with
    `together` more than a chance share of hits, too.
    """
    weak = (e.measured.cells >= p.rules.weak_cells) & (e.n_pe + e.n_be < _MANY_RAYS)
    empty = ~weak & (e.measured.cells < _EMPTY_CELLS) & (e.n_pe >= p.rules.min_passes)
    if p.together:
        empty &= ~has_met(e)
    return np.select([_is_new(e, p), empty], [ChangeClass.NEW, ChangeClass.EMPTY], ChangeClass.UNMEASURED)


def _is_new(e: TileEvidence, p: DetectParameters) -> NDArray[np.bool_]:
    """(K,) whether half as many points would have shown a new Gaussian, too; at the edge of a known surface, more."""
    cells = cells_at_half(e.measured.cells, e.measured.count)
    new = ~e.in_map & (e.measured.cells >= MIN_CELLS) & (cells >= p.new_cells)
    rows = np.flatnonzero(new & (cells < p.new_cells_at_edge))
    new[rows] = ~extends_neighbour(e.base, e.measured.take(rows))
    return np.asarray(new)


def _is_outside(e: TileEvidence) -> NDArray[np.bool_]:
    """(K,) whether more points ended outside the map's Gaussian than of one that stands there unchanged.

    A part of what the map holds has another shape, too: of a wall's foot, in one Gaussian with the ground, a few level
    layers meet the wall alone. It lies inside all the same. Many layers would have met the rest.
    """
    return np.asarray(e.n_bo > INSIDE_SHARE * (e.n_bi + e.n_bo))


def _same_shape(e: TileEvidence, p: DetectParameters) -> NDArray[np.bool_]:
    """(K,) whether the new Gaussian shows the surface that the map holds; False where there are not both."""
    result = np.zeros(len(e), np.bool_)
    rows = np.flatnonzero(e.in_map & (e.measured.cells >= MIN_CELLS))
    if len(rows):
        was = e.base.gaussians.take(e.map_row[rows])
        noise_m = math.sqrt(NOISE_M**2 + p.excess_m2(e.pose))  # the pose's Σ in Eq. (15)
        features = shape_features(was, e.measured.take(rows), e.n_bi[rows], e.n_bo[rows], e.n_pi[rows], noise_m)
        result[rows] = ~fitted().reshaped(features)
    return result


def shape_candidates(e: TileEvidence, p: DetectParameters) -> NDArray[np.int64]:
    """Rows (C,) in which the shape alone decides between normal and modified: two Gaussians, and evidence enough."""
    decided = np.isin(_state(e, p), (ChangeState.SUSTAINED, ChangeState.CHANGED))
    return np.flatnonzero(e.in_map & (e.measured.cells >= MIN_CELLS) & decided)


def tile_change(found: Classification) -> TileChange:
    """What is reported of a tile: all observed voxels, the changed ones with their new Gaussian or none, and how well
    the poses were known.
    """
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
        pose_sigma_m=e.pose.sigma_m,
        pose_sigma_rad=e.pose.sigma_rad,
        unsure=told(e.measured.take(found.unsure)),
    )


def _uploaded(measured: Gaussians, change_class: NDArray[np.uint8]) -> Gaussians:
    """The new Gaussians of new and modified voxels; nothing at the deleted ones, whatever few points ended there."""
    gone = change_class == ChangeClass.DELETED
    parts = [measured.take(~gone), Gaussians.nothing_at(measured.voxel_id[gone])]
    return concat(parts)
