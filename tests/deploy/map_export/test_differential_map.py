"""A client that asks for what it lacks holds, after every answer, exactly the cells of its area as they are."""

from pathlib import Path

import numpy as np
import pytest
from export_testing import read_cell
from map_export_maps import TILE, some_tile

from gnd.deploy.map_export.autoware import CELL_M, export_autoware, read_metadata
from gnd.deploy.map_export.differential import Area, differential_map
from gnd.gnd_map.tile import Tile
from gnd.tile_store.export import ExportError
from gnd.tile_store.sqlite_store import SqliteStore


def test_a_client_follows_its_way_and_the_updates(tmp_path: Path) -> None:
    out, held = tmp_path / "autoware", {}
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([some_tile(1)])
        export_autoware(store, "ndt", "", out)
        first = set(read_metadata(out))
        for step, x in enumerate(np.linspace(-30.0, 30.0, 7)):
            if step == 4:  # the map changes under way
                gaussians = some_tile(1).gaussians
                store.put_tiles([Tile(TILE, 2, gaussians.take(np.arange(1, len(gaussians))))])
                export_autoware(store, "ndt", "", out)
            area = Area(float(x), 0.0, 12.0)
            answer = differential_map(out, area, held)
            assert held.keys() >= set(answer.ids_to_remove)
            held = {name: cloud for name, cloud in held.items() if name not in answer.ids_to_remove}
            assert held.keys().isdisjoint(answer.new)
            held |= {name: read_cell(path) for name, path in answer.new.items()}
            wanted = {
                name
                for name, corner in read_metadata(out).items()
                if np.hypot(*(np.clip((x, 0.0), corner, np.add(corner, CELL_M)) - (x, 0.0))) <= 12.0
            }
            assert held.keys() == wanted
    assert set(read_metadata(out)) != first


def test_what_it_cannot_answer_it_refuses(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"no pointcloud_map_metadata\.yaml"):
        differential_map(tmp_path / "none", Area(0.0, 0.0, 10.0), ())
    for values in ((0.0, 0.0, -1.0), (float("nan"), 0.0, 1.0)):
        with pytest.raises(ExportError, match="an area needs"):
            Area(*values)
