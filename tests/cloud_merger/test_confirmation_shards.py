"""A real shard process, killed while a tile waits for confirmation: nothing is lost, nothing comes out too early."""

import signal

import pytest
from merger_processes import TAKEN, Cloud, wait_for
from merger_world import GROUND, TILE, WALL, change_of, gaussians_of, report_of, seen_by

from gnd.gnd_map.tile import Tile

VOXELS = range(300)
EPOCH = gaussians_of(dict.fromkeys(VOXELS, GROUND))
THIRD = dict.fromkeys(range(0, 300, 3), WALL)


@pytest.fixture
def cloud(tmp_path, free_port):
    cloud = Cloud(tmp_path, free_port)
    cloud.open()
    cloud.store.put_tiles([Tile(TILE, 1, EPOCH)])
    yield cloud
    cloud.close()


def claims(number):
    return report_of(number, change_of(EPOCH, list(VOXELS), seen_by(f"car-{number}", THIRD)))


@pytest.mark.slow
def test_what_waits_outlives_its_shard_and_is_published_when_it_is_confirmed(cloud):
    cloud.start("first")
    assert cloud.send(claims(1)).status in TAKEN
    wait_for("the tile waits", lambda: cloud.store.waiting_changes() and cloud.is_settled())
    cloud.signal("first", signal.SIGKILL)
    cloud.shards["first"].wait(5)
    before = cloud.store.waiting_changes()
    assert [(one.vehicle, one.voxels, one.reason) for one in before] == [("car-1", 100, "share")]

    cloud.start("second")
    assert cloud.send(claims(1)).status == "duplicate"
    assert cloud.store.waiting_changes() == before
    assert cloud.store.get("ndt", TILE).version == 1
    assert cloud.send(claims(2)).status in TAKEN
    cloud.signal("second", signal.SIGKILL)  # perhaps before, perhaps after the merge
    cloud.shards["second"].wait(5)
    cloud.start("third")
    wait_for("it is merged and announced", cloud.is_settled)
    assert cloud.store.waiting_changes() == []
    assert cloud.store.voxel_provenance("ndt", TILE, 2) == {
        voxel: (claims(1).report_id, claims(2).report_id) for voxel in THIRD
    }
