"""Tracks of reports: the scans that saw their tiles, no others; what is reported is forgotten."""

import numpy as np
import pytest

from gnd.gnd_map.errors import TrackError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.tracks import Tracks

SECOND = 1_000_000_000
# Tiles from west to east; the map frame is that of the first.
WEST = TileId((497353963152 & ~1023) + 5)
ROW = [TileId.from_indices(WEST.lon_index + k, WEST.lat_index) for k in range(12)]
ROW = [tile for tile in ROW if tile.district == WEST.district]
FRAME = LocalFrame.of_tile(WEST)


def see(tracks: Tracks, t_s: float, x_m: float) -> None:
    T = np.eye(4)
    T[:3, 3] = x_m, 0.0, 2.0
    points = T[:3, 3] + np.array([[5.0, 0.0, -2.0], [0.0, 9.0, -1.0], [-7.0, 1.0, 0.5]])
    tracks.add_scan(int(t_s * SECOND), points, np.broadcast_to(T[:3, 3], points.shape), T)


def drive(tracks: Tracks, first_s: float, xs: np.ndarray) -> None:
    for k, x_m in enumerate(xs.tolist()):
        see(tracks, first_s + 0.1 * k, x_m)


def test_a_report_has_the_scans_that_were_near_its_tiles() -> None:
    tracks = Tracks(FRAME)
    drive(tracks, 0.0, np.arange(0.0, 300.0, 2.0))
    tracks.touched(ROW[:2])
    track = tracks.take(WEST.district, ROW[:2])
    assert [len(piece.vertices) for piece in track.pieces] == [2], "a straight line"
    near_m = 38.2 * np.cos(FRAME.lat_rad) * 1.5 + 60.0
    assert track.scans == pytest.approx(near_m / 2.0, abs=2)


def test_a_second_visit_has_a_track_of_its_own() -> None:
    tracks = Tracks(FRAME)
    drive(tracks, 0.0, np.arange(0.0, 60.0, 2.0))
    tracks.touched([WEST])
    assert tracks.take(WEST.district, [WEST]).scans == 30
    tracks.touched([])
    drive(tracks, 100.0, np.arange(10.0, 0.0, -1.0))
    tracks.touched([WEST])
    assert tracks.take(WEST.district, [WEST]).scans in (10, 11)  # perhaps with the last scan before


def test_tiles_that_wait_keep_their_scans_when_others_are_reported() -> None:
    tracks = Tracks(FRAME)
    drive(tracks, 0.0, np.arange(0.0, 100.0, 2.0))
    tracks.touched(ROW[:4])
    tracks.take(WEST.district, ROW[:1])
    assert len(tracks) == 50
    assert tracks.take(WEST.district, ROW[1:4]).scans == 50
    assert len(tracks) <= 1, "nothing waits: all is forgotten but the last look"


def test_memory_does_not_grow_with_the_way() -> None:
    tracks, most = Tracks(FRAME), 0
    for lap in range(20):
        drive(tracks, 100.0 * lap, np.arange(0.0, 100.0, 2.0))
        tracks.touched(ROW[:2])
        tracks.take(WEST.district, ROW[:2])
        most = max(most, len(tracks))
    assert most <= 51


def test_a_report_without_scans_near_it_has_no_track_and_is_forgotten_all_the_same() -> None:
    tracks = Tracks(FRAME)
    drive(tracks, 0.0, np.arange(0.0, 10.0, 2.0))
    tracks.touched(ROW[-1:])
    with pytest.raises(TrackError, match="none of 5 scans was within"):
        tracks.take(WEST.district, ROW[-1:])
    assert len(tracks) <= 1
