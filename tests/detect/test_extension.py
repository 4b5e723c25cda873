"""Edges of what the map holds: who continues a Gaussian next door, beside a plain search; cells at half the points."""

import numpy as np
import pytest
from vehicle_scene import FIGURE_2

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.vehicle_agent.detect.extension import DETECT_EDGE_M, cells_at_half, extends_neighbour
from gnd.vehicle_agent.detect.records import planar_normals

TILE = FIGURE_2[0]
GRID = VoxelGrid.of(TILE)
FLAT, ROUND = (0.08, 0.0, 0.0, 0.08, 0.0, 0.0004), (0.05, 0.0, 0.0, 0.05, 0.0, 0.05)


def gaussians(
    at: list[tuple[int, int, int]], z_m: list[float] | np.ndarray, cov: tuple[float, ...] = FLAT
) -> Gaussians:
    ids = np.array([GRID.voxel_id([x], [y], [f])[0] for x, y, f in at], np.int32)
    order, n = np.argsort(ids), len(at)
    mean = np.column_stack([np.zeros((n, 2)), z_m]).astype(np.float32)
    counts = np.full(n, 100, np.int32)
    return Gaussians(ids[order], counts, counts, mean[order], np.tile(np.array(cov, np.float32), (n, 1)))


@pytest.mark.parametrize(
    ("place", "z_m", "cov", "continues"),
    [
        ((11, 10, 31), 0.05, FLAT, True),  # the same level, one voxel on
        ((11, 11, 31), 0.0, FLAT, True),  # across the corner
        ((11, 10, 31), 0.4, FLAT, False),  # above the plane
        ((12, 10, 31), 0.0, FLAT, False),  # two voxels on
        ((11, 10, 31), 0.05, ROUND, False),  # the neighbour is no plane
    ],
)
def test_what_continues_the_plane_next_door(
    place: tuple[int, int, int], z_m: float, cov: tuple[float, ...], continues: bool
) -> None:
    base = Tile(TILE, 1, gaussians([(10, 10, 31)], [0.0], cov))
    assert extends_neighbour(base, gaussians([place], [z_m])).tolist() == [continues]


def test_the_row_at_the_edge_of_the_tile_does_not_go_on_at_the_other_edge() -> None:
    base = Tile(TILE, 1, gaussians([(GRID.nx - 1, 10, 31)], [0.0]))
    assert not extends_neighbour(base, gaussians([(0, 11, 31)], [0.0])).any()


def test_nothing_measured_or_nothing_mapped_is_no_edge() -> None:
    some = gaussians([(10, 10, 31)], [0.0])
    assert extends_neighbour(Tile(TILE, 1, some), Gaussians.empty()).shape == (0,)
    assert not extends_neighbour(Tile(TILE, 0, Gaussians.empty()), some).any()


def test_a_plain_search_through_all_pairs_finds_the_same() -> None:
    rng = np.random.default_rng(3)
    cells = [(x, y, f) for x in range(8) for y in range(8) for f in (30, 31, 32)]
    mapped = rng.random(len(cells)) < 0.3
    base = gaussians(
        [c for c, m in zip(cells, mapped, strict=True) if m], rng.uniform(-0.3, 0.3, mapped.sum()).tolist()
    )
    new = gaussians([c for c, m in zip(cells, mapped, strict=True) if not m], rng.uniform(-0.4, 0.4, (~mapped).sum()))
    normal = planar_normals(base.full_cov())
    at = [np.stack(GRID.unravel(g.voxel_id), axis=1) for g in (base, new)]
    mean = [GRID.centre_m(g.voxel_id) + g.mean_m for g in (base, new)]
    expected = [
        any(
            np.abs(at[0][j] - at[1][i]).max() == 1 and abs(normal[j] @ (mean[1][i] - mean[0][j])) <= DETECT_EDGE_M
            for j in range(len(base))
        )
        for i in range(len(new))
    ]
    assert extends_neighbour(Tile(TILE, 1, base), new).tolist() == expected
    assert 0 < sum(expected) < len(new)


@pytest.mark.parametrize(("K", "n"), [(25, 400), (40, 80), (100, 60), (300, 40)])
def test_sub_cells_at_half_the_points_are_those_of_points_thrown_at_random(K: int, n: int) -> None:
    rng = np.random.default_rng(K)
    thrown = rng.integers(0, K, (2000, n))
    whole, half = (np.mean([len(np.unique(row[:m])) for row in thrown]) for m in (n, n // 2))
    assert cells_at_half(np.array([round(whole)], np.int32), np.array([n], np.int32))[0] == pytest.approx(
        half, rel=0.05
    )


def test_sub_cells_at_half_the_points_lie_between_half_and_all() -> None:
    cells = np.array([1, 30, 30, 30, 0], np.int32)
    found = cells_at_half(cells, np.array([1, 30, 60, 100_000, 0], np.int32))
    np.testing.assert_allclose(found, [0.5, 15.0, 20.7, 30.0, 0.0], atol=0.1)
