"""What a vehicle tells of voxels upon which it does not decide; and when it tells nothing."""

import numpy as np
import pytest
from vehicle_scene import FIGURE_2

from gnd.gnd_map.arrays import I32
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import REPORT, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.schemas.limits import MAX_UNSURE_CELLS
from gnd.vehicle_agent.detect.classify import Classification, classify, tile_change
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.detect.unsure import MUCH, SOME, told

TILE = FIGURE_2[0]
FACING_X = (0.0008, 0.0, 0.0, 0.08, 0.0, 0.08)


def barrier(n: int = 10, apart: int = 1) -> I32:
    """Voxels of a wall, two high, that the map does not have."""
    grid = VoxelGrid.of(TILE)
    return np.sort([int(grid.voxel_id(7, 3 + apart * k, floor)) for k in range(n) for floor in (40, 41)]).astype(
        np.int32
    )


def met(ids: I32, cells: int, hits: int, passes: int, held: I32 | None = None) -> TileEvidence:
    """Evidence of a drive that met so many sub-cells with so many hits in each voxel; the map holds `held`."""
    n, zeros = len(ids), np.zeros(len(ids), np.int32)
    measured = of(ids, hits, cells)
    base = Tile(TILE, 3, of(np.zeros(0, np.int32) if held is None else held, 200, 60))
    return TileEvidence(
        base, ids, np.full(n, -1, np.int64), zeros, zeros, zeros, zeros, measured.count,
        np.full(n, passes, np.int32), measured,
    )  # fmt: skip


def of(ids: I32, count: int, cells: int) -> Gaussians:
    n = len(ids)
    columns = np.full(n, count, np.int32), np.full(n, cells, np.int32)
    return Gaussians(ids, *columns, np.zeros((n, 3), np.float32), np.tile(np.float32(FACING_X), (n, 1)))


def said(e: TileEvidence) -> Classification:
    return classify(e, DetectParameters(together=True))


def test_a_wall_that_was_met_too_seldom_is_told_and_not_called_empty() -> None:
    found = said(met(barrier(), cells=12, hits=14, passes=150))
    assert (found.change_class == ChangeClass.UNMEASURED).all()
    change = tile_change(found)
    assert change.unsure.voxel_id.tolist() == barrier().tolist()
    assert change.unsure.count.tolist() == change.unsure.cells.tolist() == [MUCH] * 20
    assert not len(change.observed) + len(change.changed)


@pytest.mark.parametrize(("cells", "hits", "number"), [(9, 9, SOME), (12, 12, MUCH), (9, 40, MUCH), (30, 900, MUCH)])
def test_the_number_says_what_half_of_the_points_would_have_met_and_travels(cells: int, hits: int, number: int) -> None:
    """Nine sub-cells of one point each may be any; of four points each they are all that there is."""
    unsure = told(of(barrier(), hits, cells))
    moved = snap(unsure, REPORT)
    assert unsure.count.tolist() == moved.count.tolist() == moved.cells.tolist() == [number] * 20
    assert number <= MAX_UNSURE_CELLS
    assert snap(moved, REPORT) == moved


@pytest.mark.parametrize(
    ("what", "evidence", "is_empty"),
    [
        ("chance: fewer than one ray in twenty ends there", met(barrier(), cells=12, hits=14, passes=280), True),
        ("hits of hardly any sub-cell", met(barrier(), cells=4, hits=14, passes=200), False),
        ("too few sub-cells", met(barrier(), cells=7, hits=7, passes=90), False),
        ("every voxel stands alone", met(barrier(apart=2)[::2], cells=12, hits=14, passes=150), False),
        ("too few voxels", met(barrier(5), cells=12, hits=14, passes=150), False),
    ],
)
def test_what_may_be_noise_is_not_told(what: str, evidence: TileEvidence, is_empty: bool) -> None:
    found = said(evidence)
    assert not len(tile_change(found).unsure), what
    assert (found.change_class == (ChangeClass.EMPTY if is_empty else ChangeClass.UNMEASURED)).all(), what


def test_the_edge_of_a_known_surface_beside_it_vouches_for_nothing() -> None:
    """Each voxel continues a plane that the map holds a voxel on: none of them counts as a thing beside another."""
    grid = VoxelGrid.of(TILE)
    held = np.sort([int(grid.voxel_id(7, y, floor)) for y in range(2, 14) for floor in (39, 42)]).astype(np.int32)
    assert not len(tile_change(said(met(barrier(), cells=12, hits=14, passes=150, held=held))).unsure)


def test_who_decides_upon_most_of_what_it_met_tells_nothing_of_the_rest() -> None:
    """A street: 20 voxels are left, 22 are called new."""
    grid, ids = VoxelGrid.of(TILE), barrier()
    clear = np.array([int(grid.voxel_id(9, 3 + k, floor)) for k in range(11) for floor in (40, 41)], np.int32)
    both = np.sort(np.concatenate([ids, clear]))
    is_clear = np.isin(both, clear)
    few, many = met(both, cells=12, hits=14, passes=150), met(both, cells=60, hits=300, passes=150)
    mixed = TileEvidence(
        few.base, both, few.map_row, few.n_bi, few.n_bo, few.n_pi, few.n_po, np.where(is_clear, many.n_be, few.n_be),
        few.n_pe, Gaussians(*(np.where(is_clear.reshape(-1, *[1] * (a.ndim - 1)), b, a) for a, b in zip(
            few.measured.columns, many.measured.columns, strict=True))),
    )  # fmt: skip
    found = said(mixed)
    assert found.change_class[is_clear].tolist() == [ChangeClass.NEW] * 22
    assert found.change_class[~is_clear].tolist() == [ChangeClass.UNMEASURED] * 20
    assert not len(tile_change(found).unsure)


def test_paper_mode_tells_nothing() -> None:
    found = classify(met(barrier(), cells=12, hits=14, passes=150), DetectParameters.paper())
    assert not len(found.unsure)
    assert not len(tile_change(found).unsure)
