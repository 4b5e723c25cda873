"""`gnd map rollback vehicle:NAME`, `memory` and `verify` on a store whose history is known."""

import json

import pytest
from click.testing import CliRunner
from merger_world import BALL, POLE, TILE, gaussians_of
from test_windows import BASE, Cloud, crowd

from cloud_merger.config import ShardConfig
from deploy.map_cli import map_group


@pytest.fixture
def cloud(tmp_path):
    made = Cloud(tmp_path / "map.sqlite")
    made.config = ShardConfig(store_path=made.store.path)  # what the commands take for granted
    yield made
    made.store.close()


def call(cloud, command, *arguments):
    result = CliRunner().invoke(map_group, [command, str(cloud.store.path), *arguments])
    assert not result.exception or isinstance(result.exception, SystemExit), result.exception
    return result


THREE = {3: BALL, 4: BALL, 5: BALL}
OTHERS = {7: POLE, 8: POLE, 9: POLE}


def test_a_vehicles_word_is_taken_back_and_the_others_stay(cloud):
    stale = gaussians_of(BASE)
    cloud.sees(["liar"], OTHERS, base=stale, observed=[7])
    cloud.sees(crowd(3), THREE, base=stale)
    assert cloud.ids() == [0, 1, 2, 3, 4, 5, 7, 8, 9]
    tried = json.loads(call(cloud, "rollback", "vehicle:liar", "--dry-run", "--json").output)
    assert [(one["status"], one["reports"], one["voxels"]) for one in tried["tiles"]] == [("changes", 1, 3)]
    assert cloud.ids() == [0, 1, 2, 3, 4, 5, 7, 8, 9]
    assert "1 of 1 tiles have changed" in call(cloud, "rollback", "vehicle:liar").output
    assert cloud.ids() == [0, 1, 2, 3, 4, 5]
    assert cloud.store.get("ndt", TILE).kind == "rollback"
    assert json.loads(call(cloud, "rollback", "vehicle:liar", "--json").output)["tiles"][0]["status"] == "same"


def test_what_it_said_before_a_time_stays(cloud):
    cloud.sees(["turned"], OTHERS, observed=[7])
    cloud.sees(["turned"], THREE, observed=[3], later_s=86_400)
    assert cloud.ids() == [0, 1, 2, 3, 4, 5, 7, 8, 9]
    call(cloud, "rollback", "vehicle:turned", "--to", "2027-01-15T12:00:00Z")
    assert cloud.ids() == [0, 1, 2, 7, 8, 9]


def test_a_vehicle_that_nobody_knows_is_said_so(cloud):
    result = CliRunner().invoke(map_group, ["rollback", str(cloud.store.path), "vehicle:nobody"])
    assert "nobody has reported nothing about layer ndt" in str(result.exception)


def test_a_tile_tells_what_it_remembers(cloud):
    cloud.sees(crowd(3), THREE)
    none = CliRunner().invoke(map_group, ["memory", str(cloud.store.path), TILE.path])
    assert "no window is closed yet" in str(none.exception)
    cloud.sees(["later"], later_s=4000)
    cloud.sees(["again"], later_s=4000)
    told = json.loads(call(cloud, "memory", TILE.path, "--json").output)
    assert (told["window"], told["voxels"], told["with a Gaussian"]) == (2, 6, 6)
    ball = told["each"][3]
    assert (ball["is_there"], ball["observers"], ball["votes"]) == (True, 4, 2.0)
    assert ball["last_day"].startswith("2027-01-15")


def test_verify_ends_with_one_where_a_version_is_not_what_was_reported(cloud):
    cloud.sees(crowd(3), THREE, base=gaussians_of(BASE))
    same = call(cloud, "verify", "--json")
    assert (same.exit_code, json.loads(same.output)["identical"]) == (0, True)
    base = cloud.store.get("ndt", TILE, version=1)
    new = "UPDATE tile_version SET body = ?, sha = ?, codec_id = ? WHERE version = 2"
    cloud.store.transact(lambda c, _now: c.execute(new, (base.body, base.sha, base.codec_id)))
    assert call(cloud, "verify", "--json", "--all-versions").exit_code == 1
