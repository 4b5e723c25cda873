"""The map on its way along a drive, from a real store."""

from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_bus.links import load_link
from gnd.fleet_sim.street import street
from gnd.gnd_map.codec import CODEC_FLOAT32, LATTICES, is_on, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.surroundings import tiles_along
from studies.traffic_study.download import (
    DownloadTrack,
    Server,
    along_drive,
    fetched_tiles,
    partly_changed,
    store_of,
    total_bytes,
)
from studies.traffic_study.options import TrafficOptions, street_of

LATTICE = LATTICES["standard"]


def some_gaussians(n: int, seed: int) -> Gaussians:
    rng = np.random.default_rng(seed)
    voxel_id = np.sort(rng.choice(20_000, n, replace=False)).astype(np.int32)
    cov = np.zeros((n, 6), np.float32)
    cov[:, (0, 3, 5)] = rng.uniform(1e-4, 0.05, (n, 3))
    columns = (voxel_id, np.full(n, 50, np.int32), np.full(n, 20, np.int32))
    return snap(Gaussians(*columns, rng.uniform(-0.3, 0.3, (n, 3)).astype(np.float32), cov), LATTICE)


@pytest.fixture(scope="module")
def track() -> DownloadTrack:
    options = TrafficOptions(seed=5, street=street_of("usual", 150.0))
    return DownloadTrack.of(street(5, options.street), options)


@pytest.fixture(scope="module")
def tiles(track: DownloadTrack) -> dict[TileId, Gaussians]:
    return {tile: some_gaussians(120, k) for k, tile in enumerate(tiles_along(track.frame, track.position_m, 30.0))}


def test_the_drive_is_looked_at_every_five_metres(track: DownloadTrack) -> None:
    assert track.km == pytest.approx(0.15, abs=0.01)
    assert np.diff(track.way_m).max() < 6.5
    assert (np.hypot(*track.velocity_mps[5:-1].T) > 1.0).all()


@pytest.mark.parametrize("link", ["3g", "5g"])
def test_every_tile_near_the_way_comes_once_and_whole(
    track: DownloadTrack, tiles: dict[TileId, Gaussians], tmp_path: Path, link: str
) -> None:
    with store_of(tmp_path / "map.sqlite", tiles) as store:
        questions = along_drive(track, Server(store), load_link(link))
        floats = along_drive(track, Server(store), load_link(link), codecs=(CODEC_FLOAT32,))
    fetched = fetched_tiles(questions)
    assert len(set(fetched)) == len(fetched)
    assert set(tiles) <= set(fetched) == set(fetched_tiles(floats))
    assert total_bytes(floats) > 48 * sum(map(len, tiles.values()))
    assert total_bytes(questions) < total_bytes(floats) / 4
    assert [q.way_m for q in questions] == sorted(q.way_m for q in questions)


def test_who_comes_back_gets_what_changed_only(
    track: DownloadTrack, tiles: dict[TileId, Gaussians], tmp_path: Path
) -> None:
    held = {tile: Tile(tile, 1, gaussians) for tile, gaussians in tiles.items()}
    changed = partly_changed(tiles, 0.02, 1)
    sizes = []
    for number, states in enumerate([(tiles,), (tiles, changed)]):
        with store_of(tmp_path / f"{number}.sqlite", *states) as store:
            sizes.append(total_bytes(along_drive(track, Server(store), load_link("4g"), held=held)))
    with store_of(tmp_path / "new.sqlite", changed) as store:
        first = total_bytes(along_drive(track, Server(store), load_link("4g")))
    assert sizes[0] < sizes[1] < first / 3


@pytest.mark.parametrize("share", [0.0001, 0.02, 0.5])
def test_the_share_that_changes_is_what_was_asked_for(share: float) -> None:
    before = {TileId(7): some_gaussians(1000, 3)}
    after = partly_changed(before, share, 9)[TileId(7)]
    assert is_on(after, LATTICE)
    delta = diff(before[TileId(7)], after)
    n = max(1, round(1000 * share))
    assert 0.7 * n <= len(delta.removed) + len(delta.put) <= 1.3 * n
    assert partly_changed(before, share, 9)[TileId(7)].voxel_id.tolist() == after.voxel_id.tolist()
