"""`gnd map rollback vehicle:NAME`, `memory` and `verify` on a store whose history is known."""

import json
from dataclasses import replace

import pytest
from click.testing import CliRunner
from merger_world import BALL, POLE, TILE, gaussians_of
from test_windows import BASE, Cloud, crowd

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.features import FeatureMergeParameters
from gnd.cloud_merger.map_parameters import digest_of, text_of, with_text
from gnd.cloud_merger.parameters import MergeParameters
from gnd.deploy.map_cli import map_group
from gnd.schemas.feature_layer import LayerParameters


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


# Parameters travel with the journal


OTHERWISE = ShardConfig(
    merge=MergeParameters(mode="paper"), codec="compact", features=FeatureMergeParameters(reliability=0.8)
)


def test_a_map_of_other_parameters_is_what_its_journal_gives(tmp_path):
    cloud = Cloud(tmp_path / "map.sqlite")
    cloud.config = replace(OTHERWISE, store_path=cloud.store.path)
    cloud.sees(crowd(3), THREE, base=gaussians_of(BASE))
    cloud.sees(["later"], {7: POLE}, later_s=4000)
    cloud.config = ShardConfig(store_path=cloud.store.path)  # a shard of other parameters goes on
    cloud.sees(crowd(3, "then"), {8: POLE}, later_s=4000)
    told = json.loads(call(cloud, "verify", "--json", "--all-versions").output)
    assert (told["identical"], told["unknown"], told["given"]) == (True, 0, 1)
    assert told["same"] == len(cloud.store.history("ndt", TILE)) - 1 > 2
    assert "assumed" not in told
    without = json.loads(call(cloud, "rollback", "vehicle:later", "--dry-run", "--json").output)
    assert without["tiles"][0]["status"] in ("same", "changes")
    cloud.store.close()


def forget_parameters(cloud):
    def work(c, _now):
        c.execute("UPDATE version_basis SET parameters = NULL")
        c.execute("UPDATE closed_window SET parameters = NULL")
        c.execute("DELETE FROM merge_parameters")

    cloud.store.transact(work)


def test_a_store_of_before_says_which_parameters_were_assumed(cloud):
    cloud.sees(crowd(3), THREE, base=gaussians_of(BASE))
    cloud.sees(["later"], later_s=4000)
    forget_parameters(cloud)
    told = json.loads(call(cloud, "verify", "--json").output)
    digest = digest_of(text_of(ShardConfig()))
    assert (told["same"], told["with parameters assumed"]) == (1, 1)
    assert told["assumed"] == f"codec standard, merge mode default, else defaults: {digest[:16]}…"
    assert "assumed" in call(cloud, "verify").output


def test_wrong_assumptions_are_said_to_be_assumptions(tmp_path):
    cloud = Cloud(tmp_path / "map.sqlite")
    cloud.config = ShardConfig(store_path=cloud.store.path, merge=MergeParameters(mode="paper"))
    cloud.sees(["one"], {3: BALL}, base=gaussians_of(BASE))  # in the mode of the paper one vehicle is enough
    assert cloud.ids() == [0, 1, 2, 3]
    assert call(cloud, "verify", "--json").exit_code == 0
    forget_parameters(cloud)
    (wrong,) = json.loads(call(cloud, "verify", "--json").output)["versions"]
    assert wrong["status"] == "differs"
    assert "does not say with which parameters it was merged, assumed were" in wrong["reason"]
    assert json.loads(call(cloud, "verify", "--json", "--merge-mode", "paper").output)["identical"]
    cloud.store.close()


@pytest.mark.parametrize(
    ("how", "says"),
    [
        (
            "UPDATE merge_parameters SET body = replace(body, 'standard', 'compact')",
            "not what they were: their digest is",
        ),
        ("DELETE FROM merge_parameters", "are named and not in the store"),
    ],
)
def test_parameters_that_are_not_what_their_digest_says_are_told(cloud, how, says):
    cloud.sees(crowd(3), THREE, base=gaussians_of(BASE))
    cloud.store.transact(lambda c, _now: c.execute(how))
    told = call(cloud, "verify", "--json")
    assert told.exit_code == 1
    assert says in json.loads(told.output)["versions"][0]["reason"]
    cloud.sees(crowd(2, "then"), {4: BALL})  # and the merging goes on
    assert 4 in cloud.ids()


def test_parameters_come_back_from_their_text_and_say_when_they_cannot():
    assert with_text(ShardConfig(), text_of(OTHERWISE)) == OTHERWISE
    hydrants = LayerParameters("hydrants", "camera", ("hydrant",), reach_m=4.0)
    declared = replace(OTHERWISE, feature_layer=(hydrants,))
    assert with_text(ShardConfig(), text_of(declared)).merge_of("hydrants").reach_m == 4.0
    assert with_text(declared, text_of(OTHERWISE)) == OTHERWISE  # a map that was made without the declaration
    assert text_of(OTHERWISE) != text_of(ShardConfig()) == text_of(ShardConfig("another", poll_s=1.0))
    said = json.loads(text_of(OTHERWISE))
    for wrong in (said | {"format": 2}, said | {"merge": {"knob": 1}}, {"format": 1}, []):
        with pytest.raises(MergerError, match=r"parameters"):
            with_text(ShardConfig(), json.dumps(wrong))


def test_constants_travel_as_the_parameters_that_they_were(tmp_path):
    """Stores of releases in which they could be set are read: where one was set, it is named."""
    text = text_of(ShardConfig())
    before = text.replace('"together":false,', "").replace('"copies":true,', "")  # 0166
    assert digest_of(before) == "7c6fc73dfd8249cad95a54d0618f78c07cd8510753651be66105ed8d01729278"
    said = json.loads(text)
    assert said["shift"]["max_m"] == 1.0
    said["shift"]["max_m"] = 0.5
    with pytest.raises(MergerError, match=r"shift\.max_m is 0\.5; it is 1\.0 in this release"):
        with_text(ShardConfig(), json.dumps(said))
    del said["shift"]["max_m"]  # an older text that lacks it
    assert with_text(ShardConfig(), json.dumps(said)) == ShardConfig()


def test_a_text_stands_in_the_store_once(cloud):
    cloud.sees(crowd(3), THREE, base=gaussians_of(BASE))
    cloud.sees(crowd(4), {7: POLE}, later_s=4000)
    n = cloud.store.look(lambda c: c.execute("SELECT COUNT(*) FROM merge_parameters").fetchall()[0][0])
    assert n == 1


@pytest.mark.parametrize(
    ("then", "now"),
    [
        ({"merge": MergeParameters(sensor_weights={"VLP-16": 0.2})}, {}),
        ({}, {"merge": MergeParameters(sensor_weights={"VLP-16": 0.2})}),
        ({"codec": "compact"}, {"codec": "standard"}),
    ],
    ids=["weighted", "weighted now", "codec"],
)
def test_windows_that_are_folded_anew_keep_the_parameters_of_their_time(tmp_path, then, now):
    """A shard goes on with other parameters; then a vehicle is quarantined, so what is closed is folded anew."""
    cloud = Cloud(tmp_path / "map.sqlite", base={} if "codec" in then else BASE)
    usual = cloud.config
    cloud.config = replace(usual, **then)
    cloud.sees(["bad"], {11: BALL}, observed=[11])
    cloud.sees(["none", "neither"], observed=[3, 4], sensor="HDL-64E")
    cloud.sees(crowd(4), {3: BALL, 4: POLE}, observed=[3, 4])
    cloud.sees(["c"], {7: POLE}, observed=[7], later_s=4000)
    cloud.config = replace(usual, **now)
    cloud.sees(crowd(2, "then"), {8: POLE}, observed=[8], later_s=4000)
    cloud.store.quarantine_vehicle("bad", "for this test")
    cloud.sees(["last"], {9: POLE}, observed=[9], later_s=60)
    told = json.loads(call(cloud, "verify", "--json", "--all-versions").output)
    assert (told["identical"], told["unknown"]) == (True, 0), told
    assert told["same"] >= 3
    cloud.store.close()
