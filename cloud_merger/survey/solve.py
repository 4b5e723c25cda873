"""From drives to placed submaps: anchors and the published map first, then closures, then all together."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from gnd.cloud_merger.survey.closures import Fate, closures, map_ties
from gnd.cloud_merger.survey.drives import SurveyedDrive, first_poses
from gnd.cloud_merger.survey.graph import PlacedSubmaps, SurveyGraph, SurveyTie
from gnd.cloud_merger.survey.matching import Surface
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.submap import CELL_M
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId

MOST_STRAIN: Final = 12.0
"""A step that the rest bends by more than this (chi-square over its 6 degrees of freedom) makes its drive doubtful."""
MOST_OFFSET: Final = 4.0
"""So does an error of all its fixes of more than so many sigmas of what satellites are off by."""
_ROUNDS: Final = 2


@dataclass(frozen=True, slots=True, eq=False)
class SolvedPiece:
    """Drives that have to do with each other, placed.

    Attributes:
        frame: the working frame.
        drives: that could be placed at all.
        graph, placed: of them.
        ties: that were tried in the last solution.
        fate: what became of matches, by reason.
        doubts: by drive, why it is not believed.
        unplaced: drives without anchor and without fixes.
    """

    frame: LocalFrame
    drives: tuple[SurveyedDrive, ...]
    graph: SurveyGraph
    placed: PlacedSubmaps
    ties: tuple[SurveyTie, ...]
    fate: Fate
    doubts: Mapping[int, str] = field(default_factory=dict)
    unplaced: tuple[SurveyedDrive, ...] = ()

    @property
    def left_out(self) -> Counter[str]:
        """Ties that the graph does not believe, by kind."""
        return Counter(tie.kind for tie, taken in zip(self.ties, self.placed.believed, strict=True) if not taken)


def solve_piece(
    drives: Sequence[SurveyedDrive], published: Mapping[TileId, Tile], frame: LocalFrame
) -> SolvedPiece | None:
    """Place the submaps of drives that have to do with each other; None where none has an anchor or fixes.

    Args:
        drives: of one piece.
        published: the map around, as it was before any survey.
        frame: the working frame, near the drives.
    """
    first = [first_poses(drive, frame) for drive in drives]
    known = tuple(drive for drive, T in zip(drives, first, strict=True) if T is not None)
    if not known:
        return None
    graph = SurveyGraph(known, np.concatenate([T for T in first if T is not None]), frame)
    surfaces = [Surface.of(node.gaussians.mean_m, node.gaussians.cov_m2, CELL_M) for one in known for node in one.nodes]
    target, fate = map_surface(published, frame), Counter[str]()
    anchors = graph.anchors()
    ties, placed = anchors, graph.solve(anchors)
    for _ in range(
        _ROUNDS
    ):  # from the solution of the first, matches are found that odometry alone was too far off for
        fate = Counter()
        held = [*anchors, *map_ties(placed, surfaces, target, fate)]
        placed = graph.solve(held)
        between = graph.relative_covariances(placed, held)
        ties = [*held, *closures(placed, graph.drive_of, between, surfaces, fate)]
        placed = graph.solve(ties)
    unplaced = tuple(drive for drive, T in zip(drives, first, strict=True) if T is None)
    return SolvedPiece(frame, known, graph, placed, tuple(ties), fate, _doubts(graph, placed, ties), unplaced)


def map_surface(tiles: Mapping[TileId, Tile], frame: LocalFrame) -> Surface:
    """The Gaussians of tiles in a frame, ready to be matched with."""
    means, covs = [np.empty((0, 3))], [np.empty((0, 3, 3))]
    for tile_id, tile in tiles.items():
        T = frame.T_self_other(LocalFrame.of_tile(tile_id))
        g = tile.gaussians
        means.append(transform(T, VoxelGrid.of(tile_id).centre_m(g.voxel_id) + g.mean_m))
        covs.append(T[:3, :3] @ g.full_cov() @ T[:3, :3].T)
    return Surface.of(np.concatenate(means), np.concatenate(covs), 1.0)


def _doubts(graph: SurveyGraph, placed: PlacedSubmaps, ties: Sequence[SurveyTie]) -> dict[int, str]:
    """Why drives are not believed: satellites say that they were elsewhere, or their own steps are bent."""
    found: dict[int, str] = {}
    for k in range(len(graph.drives)):
        off_m = placed.fix_offset_m[k]
        if off_m is not None and off_m > MOST_OFFSET * placed.fix_sigma_m[k]:
            found[k] = (
                f"its satellites lie {off_m:.1f} m off where it was placed, {off_m / placed.fix_sigma_m[k]:.1f} sigma"
            )
        elif placed.strain_of[k] > MOST_STRAIN:
            found[k] = f"a step of its odometry is bent by {placed.strain_of[k]:.0f} times its variance"
        elif not _is_anchored(graph, ties, placed, k):
            found[k] = "the map has never held it: its place rests on satellites, and on what looks alike"
    return found


def _is_anchored(graph: SurveyGraph, ties: Sequence[SurveyTie], placed: PlacedSubmaps, k: int) -> bool:
    """Whether an anchor of the drive is believed. Without one, a street that repeats itself puts it anywhere."""
    return any(
        taken and tie.kind == "anchor" and graph.drive_of[tie.late] == k
        for tie, taken in zip(ties, placed.believed, strict=True)
    )


def cov_sigma_m(covariance: F64) -> float:
    """Largest one-sigma axis of the position of a pose covariance (6, 6)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
