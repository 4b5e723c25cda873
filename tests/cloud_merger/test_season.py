"""Leaves that fell: reports of vehicles, a real shard, and what `gnd map status` and `gnd map verify` say of them."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from merger_processes import TAKEN, Cloud, wait_for
from merger_world import TILE, change_of, measured_anew, report_of

from gnd.cloud_merger import window
from gnd.deploy.map_cli import map_group
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.tile import Tile, diff

sys.path.append(str(Path(__file__).parents[1] / "gnd_map"))
from things_testing import GROUND_M, box, gaussians, street
from tree_testing import FRONT, LEAVES, TWIGS, X, Y, trunk

HOUSE = box(X, Y - 8.0, 9.0, 3.0, GROUND_M, GROUND_M + 6.0)
SUMMER = gaussians(street(), FRONT, trunk(), TWIGS, LEAVES[0])
WINTER = gaussians(street(), FRONT, trunk(), TWIGS, HOUSE)


@pytest.fixture
def cloud(tmp_path, free_port):
    cloud = Cloud(tmp_path, free_port)
    cloud.open()
    cloud.store.put_tiles([Tile(TILE, 1, SUMMER)])
    yield cloud
    cloud.close()


def of_winter(number):
    """What a vehicle reports that comes in winter, with the map of summer."""
    change = diff(SUMMER, WINTER)
    gone = np.zeros(len(change.removed), np.int32)
    nothing = Gaussians(change.removed, gone, gone, *(np.zeros((len(gone), k), np.float32) for k in (3, 6)))
    changed = concat([change.put, nothing])
    changed = changed.take(np.argsort(changed.voxel_id))
    observed = np.union1d(SUMMER.voxel_id, WINTER.voxel_id).tolist()
    return report_of(number, measured_anew(f"car-{number}", change_of(SUMMER, observed, changed)))


def gnd_map(*arguments):
    return CliRunner().invoke(map_group, list(map(str, arguments)))


@pytest.mark.slow
def test_leaves_that_fell_wait_as_such_and_are_computed_anew(cloud, monkeypatch):
    cloud.start("first")
    for number in (1, 2, 3):
        assert cloud.send(of_winter(number)).status in TAKEN
    wait_for("all are merged", lambda: cloud.is_settled() and len(cloud.store.in_play("ndt", TILE).reports) == 3)
    head = cloud.store.get("ndt", TILE).decode_gaussians().gaussians
    new_house = np.setdiff1d(WINTER.voxel_id, SUMMER.voxel_id)
    fallen = np.setdiff1d(SUMMER.voxel_id, WINTER.voxel_id)
    assert np.isin(new_house, head.voxel_id).all()
    kept = int(np.isin(fallen, head.voxel_id).sum())
    assert 10 <= kept <= len(fallen)

    status = gnd_map("status", cloud.path, "--json")
    waiting = json.loads(status.stdout)["waiting_for_confirmation"]
    (claim,) = waiting["claims"]
    assert (claim["vehicle"], claim["reason"]) == ("car-1", "season"), "told of the first who reported it"
    assert claim["voxels"] >= kept
    assert (waiting["voxels"], waiting["parked"], waiting["season"]) == (0, 0, claim["voxels"])
    assert f"; leaves: {waiting['season']} voxels" in " ".join(gnd_map("status", cloud.path).stdout.split())

    said = json.loads(gnd_map("verify", cloud.path, "--all-versions", "--json").stdout)
    assert (said["identical"], said["differs"], said["unknown"]) == (True, 0, 0)
    assert said["same"] >= 1
    monkeypatch.setattr(window, "hold_season", lambda _epoch, merged, _reports: (merged, ()))
    without = gnd_map("verify", cloud.path, "--json")
    assert without.exit_code == 1
    assert json.loads(without.stdout)["differs"] == 1
