"""Which map a vehicle drove on, from its milestones."""

from pathlib import Path

import numpy as np
import pytest
from vehicle_scene import FRAME, GRID_FRAME, HEIGHT_M, ground, tiles_of

from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.way import Way, read_way


def place_at(east_m: float) -> Place:
    lat, lon, height = FRAME.geodetic_from_enu(np.array([[east_m, 0.0, HEIGHT_M]]))
    place = Place(FRAME, GnssFix(10**9, float(lat[0]), float(lon[0]), float(height[0]), 2.5))
    place.odometer_m = east_m
    return place


def drive(path: Path, local_map: LocalMap, *east_m: float) -> None:
    with Way(path, local_map.tile) as way:
        for x_m in east_m:
            way.note(place_at(x_m))


def test_a_milestone_names_the_version_under_the_wheels_every_few_metres(tmp_path: Path) -> None:
    local_map, path = LocalMap(GRID_FRAME), tmp_path / "agent" / "way.jsonl"
    here = TileId.from_geodetic(*place_at(0.0).geodetic)
    drive(path, local_map, 0.0)
    tiles = tiles_of(ground(20.0), version=7)
    local_map.set_tile(tiles[here])
    drive(path, local_map, 0.0, 4.0, 5.5, 9.0)  # another life of the agent
    found = list(read_way(path))
    assert [(one.odometer_m, one.version) for one in found][-2:] == [(0.0, 7), (5.5, 7)]
    assert {(one.tile, one.health) for one in found} == {(here.morton, "lost")}
    local_map.set_absent(here)
    drive(path, local_map, 6.0, 12.0)
    assert [one.version for one in read_way(path)][-2:] == [0, 0]


def test_a_restarted_agent_is_read_from_its_last_start_on(tmp_path: Path) -> None:
    path = tmp_path / "way.jsonl"
    drive(path, LocalMap(GRID_FRAME), 0.0, 20.0, 40.0)
    drive(path, LocalMap(GRID_FRAME), 0.0, 10.0)
    assert [one.odometer_m for one in read_way(path)] == [0.0, 10.0]


def test_what_is_no_way_is_refused_and_a_line_that_is_being_written_waits(tmp_path: Path) -> None:
    path = tmp_path / "way.jsonl"
    assert list(read_way(path)) == []
    drive(path, LocalMap(GRID_FRAME), 0.0)
    path.write_text(path.read_text() + '{"t_ns":1')
    assert len(list(read_way(path))) == 1
    path.write_text('{"t_ns":1}\n')
    with pytest.raises(VehicleError, match="no milestone"):
        read_way(path)
