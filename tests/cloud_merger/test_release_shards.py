"""Trials through two real shard processes that are killed (kill -9) in between: decided once, nothing told is lost."""

import sys
from pathlib import Path
from time import sleep

import pytest

sys.path.append(str(Path(__file__).parents[1] / "attacks"))

from release_scene import BASE, SHARDS, ReleaseCloud, wait_for

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.ownership import owner_of
from gnd.cloud_merger.verify import Verifier
from gnd.tile_store import sql_trials as trials

BADLY, WELL = [400 + k for k in range(8)], [785 + k for k in range(9)]

pytestmark = [pytest.mark.xdist_group("shards"), pytest.mark.slow]


@pytest.fixture
def cloud(tmp_path, free_port):
    cloud = ReleaseCloud(tmp_path, free_port)
    cloud.open()
    cloud.start(*SHARDS)
    yield cloud
    cloud.close()


def actions(cloud, tile):
    return [one.action for one in cloud.store.look(lambda c: trials.steered(c, "ndt", tile))]


def told_until(cloud, trial, fits, state):
    """Vehicles tell again, as they do: the worker of the shard that is left may have begun to listen only now."""
    while cloud.is_open(trial):
        cloud.fare(trial, "new", fits)
        sleep(2.0)
    assert cloud.state(trial) == state


def test_what_one_shard_has_heard_another_decides_on(cloud):
    good, bad = cloud.good(cloud.place()), cloud.poisoned(cloud.place())
    for trial, fits in ((good, WELL), (bad, BADLY)):
        cloud.others_fare_well(trial)
        cloud.fare(trial, "new", fits[:3])
        wait_for("three are heard", lambda trial=trial: cloud.heard(trial, "new") == 3)
    owner = owner_of(good.tile.district, SHARDS)
    cloud.kill(owner)
    told_until(cloud, good, WELL, "released")
    told_until(cloud, bad, BADLY, "withdrawn")
    assert cloud.released_version(good.tile) == good.version
    assert cloud.store.get("ndt", bad.tile).decode().gaussians == BASE
    wait_for("both are announced", lambda: {(good.tile, 2), (bad.tile, 3)} <= cloud.announced())
    assert (bad.tile, 2) not in cloud.announced()


def test_shards_that_are_all_killed_decide_once_when_they_are_back(cloud):
    bad = cloud.poisoned(cloud.place())
    cloud.others_fare_well(bad)
    cloud.fare(bad, "new", BADLY)
    wait_for("some are heard", lambda: cloud.heard(bad, "new") >= 2 or not cloud.is_open(bad))
    cloud.kill(*SHARDS)
    cloud.start(*SHARDS)
    told_until(cloud, bad, BADLY, "withdrawn")  # what was lost with them is told by the next messages
    wait_for("it is announced", lambda: (bad.tile, 3) in cloud.announced())
    assert [one.version for one in cloud.store.history("ndt", bad.tile)] == [1, 2, 3]
    assert actions(cloud, bad.tile) == ["withdrawn"]
    found = Verifier(cloud.store, ShardConfig(store_path=cloud.path)).history("ndt", bad.tile)
    assert [one.status for one in found] == ["given", "same", "given"]
