"""Where a drive has looked: cells against `cell_of`, the field of view, and what hides."""

from math import pi, radians

import numpy as np
import pytest

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.feature_change import GRID, cell_of
from gnd.vehicle_agent.features.coverage import Coverage
from gnd.vehicle_agent.features.view import CAMERA, LIDAR, Occlusion

START = TileId.from_path("13033/03021/23031/22102")
FRAME = LocalFrame.of_tile(START)


def place_of(tile: TileId, cell: int) -> np.ndarray:
    """The middle of a cell in the map frame."""
    (south, west), (north, east) = tile.south_west_rad, tile.north_east_rad
    lat = south + (cell // GRID + 0.5) / GRID * (north - south)
    lon = west + (cell % GRID + 0.5) / GRID * (east - west)
    assert cell_of(tile, lat, lon) == cell
    return FRAME.enu_from_geodetic(lat, lon, 0.0)


def cells(coverage: Coverage) -> dict[tuple[TileId, int], np.ndarray]:
    return {
        (tile, cell): place_of(tile, cell)
        for tile in coverage.tiles
        for cell in range(GRID * GRID)
        if coverage.viewed(tile) >> cell & 1
    }


@pytest.mark.parametrize("heading_deg", [0.0, 77.0, -150.0])
def test_the_cells_in_view_are_those_whose_middle_lies_in_the_field_of_view(heading_deg: float) -> None:
    coverage, heading = Coverage(FRAME, CAMERA, 2.0, looks=1), radians(heading_deg)
    x, y = 400.0, -250.0
    coverage.look(x, y, heading, None)
    seen = cells(coverage)
    for place in seen.values():
        off = np.arctan2(place[1] - y, place[0] - x) - heading
        assert abs((off + pi) % (2 * pi) - pi) < CAMERA.field_rad / 2 + 1e-4
        assert np.hypot(place[0] - x, place[1] - y) < CAMERA.range_m + 1e-2
    area = CAMERA.field_rad / 2 * CAMERA.range_m**2
    cell_m2 = 30.33 * 38.10 / GRID**2
    assert len(seen) * cell_m2 == pytest.approx(area, rel=0.1)


def test_a_cell_counts_after_looks_from_several_places() -> None:
    coverage = Coverage(FRAME, LIDAR, 2.0, looks=3)
    moved = [coverage.look(x, 0.0, 0.0, None) for x in (0.0, 0.3, 1.0, 1.5)]
    assert moved == [True, False, True, False]
    assert not cells(coverage)
    coverage.look(2.5, 0.0, 0.0, None)
    assert cells(coverage)


def test_what_is_hidden_is_not_looked_at() -> None:
    free = np.where(np.arange(360) < 180, 10.0, np.inf)  # all to the right is hidden beyond 10 m
    coverage = Coverage(FRAME, LIDAR, 2.0, looks=1)
    coverage.look(0.0, 0.0, 0.0, Occlusion.of_ranges(free, -pi, radians(1.0)))
    places = np.array(list(cells(coverage).values()))
    right = places[:, 1] < -0.5
    assert np.hypot(*places[right, :2].T).max() < 11.1
    assert np.hypot(*places[~right, :2].T).max() > 45.0


def test_a_tile_that_was_reported_is_forgotten() -> None:
    coverage = Coverage(FRAME, LIDAR, 2.0, looks=1)
    coverage.look(0.0, 0.0, 0.0, None)
    assert coverage.viewed(START) == 2**64 - 1
    coverage.forget(START)
    assert coverage.viewed(START) == 0
