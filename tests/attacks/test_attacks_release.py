"""Attacks on the staged release, against a real router, two real shard processes and a real tile server."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

from release_scene import BASE, SHARDS, SHIFTED_WALL, ReleaseCloud, visit, wait_for

from gnd.cloud_merger.ownership import Members
from gnd.cloud_merger.release.keeper import ReleaseKeeper
from gnd.cloud_merger.release.verdict import SILENT_S
from gnd.gnd_map.gaussian import Gaussians
from gnd.schemas.generated import health_report_pb2, tile_health_pb2
from gnd.schemas.health import HealthReport
from gnd.schemas.tiles_batch import HeldVersion, TilesReply, TilesRequest
from gnd.tile_store import clocks
from gnd.tile_store import sql_trials as trials

BADLY, WELL = [400, 410, 390, 405, 395, 402, 398, 401], [785 + k for k in range(9)]

pytestmark = pytest.mark.xdist_group("shards")


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    from suite_ports import new_port

    cloud = ReleaseCloud(tmp_path_factory.mktemp("release"), new_port())
    cloud.open()
    cloud.start(*SHARDS)
    yield cloud
    cloud.close()


def held_by(cloud: ReleaseCloud, cars: list[str], tile) -> list[Gaussians]:
    return [cloud.fetched(car, tile).gaussians for car in cars]


def test_attack_colluding_vehicles_move_a_wall(cloud):
    """Three colluding vehicles report a wall 0.6 m off: a share of the fleet gets it, fares worse, and everybody has
    the old content again.
    """
    tile = cloud.place()
    trial = cloud.poisoned(tile)
    first, others = cloud.cars(trial, "new", 3), cloud.cars(trial, "old", 3)
    assert all(one != BASE for one in held_by(cloud, first, tile))
    assert all(one == BASE for one in held_by(cloud, others, tile))
    cloud.others_fare_well(trial)
    cloud.fare(trial, "new", BADLY)
    cloud.settle(trial, "withdrawn")
    poisoned = cloud.store.get("ndt", tile, trial.version).decode()
    for car in [*first, *others]:
        assert cloud.fetched(car, tile, poisoned if car in first else None).gaussians == BASE
    wait_for("the withdrawal is announced", lambda: (tile, trial.version + 1) in cloud.announced())
    assert (tile, trial.version) not in cloud.announced()
    (notice,) = [one for one in cloud.updates if (one.tile, one.version) == (tile, trial.version + 1)]
    assert (notice.reason, notice.previous_sha, notice.sha) == ("rollback", trial.sha, trial.base_sha)


def test_attack_colluders_repeat_themselves_after_the_withdrawal(cloud):
    """The vehicles behind a withdrawn version report the same again: alone they change nothing in that tile."""
    tile = cloud.place()
    trial = cloud.poisoned(tile)
    cloud.others_fare_well(trial)
    cloud.fare(trial, "new", BADLY)
    cloud.settle(trial, "withdrawn")
    doubted = sorted(cloud.store.doubted_vehicles("ndt", tile))
    assert len(doubted) == 3
    cloud.report(tile, doubted, {1: SHIFTED_WALL}, version=trial.version + 1)
    wait_for("they are merged", lambda: cloud.is_settled())
    assert cloud.store.get("ndt", tile).version == trial.version + 1
    assert cloud.store.get("ndt", tile).decode().gaussians == BASE


def test_attack_one_liar_wants_a_good_version_withdrawn(cloud):
    """One vehicle that has the new version tells the worst there is, again and again: it has one vote, the worst vote
    is left out, and the version is released.
    """
    trial = cloud.good(cloud.place())
    (liar,) = cloud.cars(trial, "new", 1, "liar")
    for _ in range(50):
        cloud.tell(liar, visit(trial, "new", fit_permille=0, gated=15, not_good=15))
    cloud.others_fare_well(trial)
    cloud.fare(trial, "new", WELL[:4])
    cloud.stays_open(trial)
    cloud.fare(trial, "new", WELL)
    cloud.settle(trial, "released")


def test_attack_one_flatterer_wants_a_poisoned_version_released(cloud):
    """A colluder that has the poisoned version tells that all is perfect: the best vote does not release it, and the
    others' votes withdraw it.
    """
    trial = cloud.poisoned(cloud.place())
    (flatterer,) = cloud.cars(trial, "new", 1, "flatterer")
    cloud.tell(flatterer, visit(trial, "new", fit_permille=1000, matched_permille=1000))
    cloud.others_fare_well(trial)
    cloud.stays_open(trial)
    cloud.fare(trial, "new", BADLY)
    cloud.settle(trial, "withdrawn")


def test_attack_one_vehicle_asks_with_many_tickets(cloud):
    """A client asks for a tile with hundreds of tickets that are not its own: it gets published content only, gives no
    vote by that, and nothing is decided.
    """
    tile = cloud.place()
    trial = cloud.good(tile)
    seen = set()
    for ticket in range(1, 300):
        request = TilesRequest.of([HeldVersion(tile)], ticket=ticket)
        key = f"gnd/v1/tiles/ndt/{tile.district.path}"
        reply = TilesReply.decode(cloud.vehicles.request(key, request.encode(), kind="tile", timeout_s=10.0))
        seen.add(reply.answers[0].version)
    assert seen == {trial.base_version, trial.version}
    assert cloud.store.look(lambda c: trials.health(c, trial)) == []
    cloud.stays_open(trial)


def test_attack_forged_numbers_and_broken_messages(cloud):
    """Health messages with shares above one, counts that cannot be, cut and random bytes, a foreign layer and another
    major version are refused: the shard goes on, and honest votes decide.
    """
    tile = cloud.place()
    trial = cloud.good(tile)
    (car,) = cloud.cars(trial, "new", 1, "forger")
    good = HealthReport("ndt", tile.district, 1, (visit(trial, "new"),)).encode()
    rows = [
        tile_health_pb2.TileHealth(index=5, version=trial.version, scans=9, fit_permille=4_000_000_000),
        tile_health_pb2.TileHealth(index=5, version=trial.version, scans=9, inside=1, gated=9),
        tile_health_pb2.TileHealth(index=99_999, version=trial.version, scans=9),
        tile_health_pb2.TileHealth(index=5, version=0, scans=9),
    ]
    district = tile.morton >> 10
    forged = [
        health_report_pb2.HealthReport(major=1, layer=layer, district=number, t_ns=1, tiles=[row]).SerializeToString()
        for row in rows
        for layer, number in (("ndt", district), ("../x", district), ("ndt", 2**31 - 1))
    ]
    for body in (*forged, good[:-4], b"\x08\x09" + good[2:], b"\xff" * 300, b"", good * 500):
        cloud.put(car, body)
    cloud.tell(car, visit(trial, "new", version=trial.version + 50))
    cloud.others_fare_well(trial)
    assert cloud.heard(trial, "new") == 0
    cloud.fare(trial, "new", WELL)
    cloud.settle(trial, "released")


def test_attack_a_vehicle_votes_on_the_version_that_it_was_not_to_have(cloud):
    """Vehicles of the old version claim to fare badly on the new one, which they were not given: not one is heard."""
    trial = cloud.good(cloud.place())
    for car in cloud.cars(trial, "old", 30, "pretender"):
        cloud.tell(car, visit(trial, "new", fit_permille=0))
    for car in cloud.cars(trial, "new", 30, "pretender"):
        cloud.tell(car, visit(trial, "old", fit_permille=1000))
    cloud.others_fare_well(trial)  # after them, in order
    assert (cloud.heard(trial, "new"), cloud.heard(trial, "old")) == (0, 30)
    cloud.stays_open(trial)


def test_attack_old_health_messages_are_replayed_against_the_next_version(cloud):
    """Recorded messages about a withdrawn version are sent again, while it is settled and while the next one is on
    trial: they speak of another version, and count for none.
    """
    tile = cloud.place()
    trial = cloud.poisoned(tile)
    cloud.others_fare_well(trial)
    cars = cloud.fare(trial, "new", BADLY)
    cloud.settle(trial, "withdrawn")
    recorded = [HealthReport("ndt", tile.district, 2**62, (visit(trial, "new", fit_permille=0),)).encode()] * 3
    for car in cars:
        for body in recorded:
            cloud.put(car, body)
    again = cloud.trial(tile, ["stranger-1", "stranger-2"], {2: (-0.3, 0.2, 0.0, 0.03, 0.03, 0.28)}, trial.version + 1)
    for car in cars:
        for body in recorded:
            cloud.put(car, body)
    cloud.others_fare_well(again)
    assert cloud.heard(again, "new") == 0
    cloud.fare(again, "new", WELL)
    cloud.settle(again, "released")


def test_attack_a_map_that_silences_vehicles(cloud):
    """On the poisoned version vehicles get so lost that they send nothing more: silence after taking it counts against
    it, and it is withdrawn.
    """
    tile = cloud.place()
    trial = cloud.poisoned(tile)
    nothing = {"scans": 0, "matched_permille": 0, "fit_permille": 0, "elsewhere_permille": 0, "inside": 0}
    for car in cloud.cars(trial, "new", 8, "lost"):
        cloud.tell(car, visit(trial, "new", **nothing, left=False))
    cloud.others_fare_well(trial)
    wait_for("they are heard", lambda: cloud.heard(trial, "new") == 8)
    cloud.stays_open(trial, 1.5)
    later = ReleaseKeeper(cloud.store, Members("later"), lambda: clocks.day_ns() + round((SILENT_S + 5) * 1e9))
    later.work()
    assert cloud.state(trial) == "withdrawn"
    assert "fell silent" in cloud.store.look(lambda c: trials.steered(c, "ndt", tile))[-1].why
    assert cloud.store.get("ndt", tile).decode().gaussians == BASE


def test_attack_one_vehicle_floods_the_health_key(cloud):
    """A thousand messages of one vehicle fill no bound: it has one row, and the honest ones are heard."""
    trial = cloud.good(cloud.place())
    (flooder,) = cloud.cars(trial, "old", 1, "flooder")
    for _ in range(1000):
        cloud.tell(flooder, visit(trial, "old", fit_permille=0))
    cloud.fare(trial, "old", WELL)
    cloud.fare(trial, "new", WELL)
    cloud.settle(trial, "released")
