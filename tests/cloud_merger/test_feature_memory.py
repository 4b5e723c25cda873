"""What a feature layer remembers over its windows: what is settled stays, a world that changes is followed, and all of
it can be computed anew."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
import zstandard
from click.testing import CliRunner
from feature_cloud import ABSENT, EAST, EXIST, TILE, change, feature, found, line, published, report, report_id, seen
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.expel import without_vehicle
from gnd.cloud_merger.features import FeatureMergeParameters
from gnd.cloud_merger.features import fold as folding
from gnd.cloud_merger.features.fold import MEASURERS_KEPT, NAMES_KEPT, VOTES_KEPT
from gnd.cloud_merger.features.kept import FeatureInbox
from gnd.cloud_merger.features.memory import LayerMemory
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.deploy.map_cli import map_group
from gnd.gnd_map.features import FeatureTile, geodetic_in_tile, points_in_tile
from gnd.schemas.features import EVERY_CELL
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

MAP = published([feature(7, -5.0, 3.0), feature(9, 6.0, -2.0), feature(10, -6.0, -8.0)])
GONE, STAYS, FAR = 7, 9, 10
START_NS = 1_800_000_000_000_000_000
HOUR_S = 3600.0
WEST = 0x0F0F0F0F0F0F0F0F
"""Cells of a tile's western half."""


class Cloud:
    """A store and a worker on one tile of signs; vehicles come by, each with the newest version unless told."""

    def __init__(self, path, parameters=None, epoch=MAP, **store):
        self.config = ShardConfig(store_path=path, features=parameters or FeatureMergeParameters())
        self.now_ns, self.number, self.heard = START_NS, 0, []
        self.store = SqliteStore(path, StoreConfig(merge_delay_s=0.0, **store), now_ns=lambda: self.now_ns)
        self.store.put_tiles([FeatureTile.of(TILE, 1, epoch)], layer="signs")
        self.inbox = FeatureInbox(self.store, self.config.features, (), reach_tiles=3)
        self.worker = Worker(self.store, self.config)

    def head(self):
        return self.store.get("signs", TILE).decode_features().features

    def ids(self):
        return {one.feature_id for one in self.head()}

    def hears(self, vehicle, *said, base=None, viewed=0, later_s=60.0):
        self.now_ns += round(later_s * 1e9)
        self.number += 1
        one = report(
            self.number, change(*said, base=self.head() if base is None else base, viewed=viewed), vehicle=vehicle
        )
        self.heard += self.inbox.rows(one, self.now_ns)

    def keeps(self):
        self.store.put_reports(self.heard)
        self.heard = []

    def merges(self):
        self.keeps()
        n = 0
        while claims := self.store.claim("one", 4, 30.0):
            n += sum(one.status == "published" for one in self.store.publish(self.worker.merge(claims)))
        return n

    def sees(self, vehicles, *said, **how):
        return sum(self.sees_once(vehicle, *said, **how) for vehicle in vehicles)

    def sees_once(self, vehicle, *said, **how):
        self.hears(vehicle, *said, **how)
        return self.merges()

    def memory(self):
        stored = self.store.in_play("signs", TILE).memory
        return None if stored is None else LayerMemory.decode(stored.memory)

    def verified(self):
        return [one.status for one in Verifier(self.store, self.config).history("signs", TILE)]


@pytest.fixture
def cloud(tmp_path):
    made = Cloud(tmp_path / "map.sqlite")
    yield made
    made.store.close()


def crowd(n, name="car"):
    return [f"{name}-{k}" for k in range(n)]


def heal(cloud):
    """One sign goes, another comes, near the eastern border of the tile."""
    cloud.sees(crowd(6), seen(GONE, ABSENT), found(9.0, 4.0), base=MAP)
    healed = cloud.head()
    assert GONE not in cloud.ids()
    assert len(healed) == len(MAP)
    return healed


SAID = {
    "others": ([seen(FAR)], MAP, 0),
    "half": ([seen(FAR)], None, WEST),
    "stale": ([seen(FAR)], MAP, WEST),
    "blind": ([], None, 1),
}


def later_passes(cloud, n, what, at_once=100):
    """Reports of many vehicles over weeks, merged in batches."""
    said, base, viewed = SAID[what]
    for first in range(0, n, at_once):
        newest = cloud.head() if base is None else base
        for k in range(first, first + at_once):
            cloud.hears(f"later-{k % 700}", *said, base=newest, viewed=viewed, later_s=120)
        cloud.merges()


@pytest.mark.slow
def test_ten_thousand_later_reports_of_a_part_leave_what_is_healed_as_it_is(cloud):
    """The western half of the tile with a sign that stayed, by vehicles whose maps are the newest."""
    healed = heal(cloud)
    later_passes(cloud, 10_000, "half", at_once=500)
    assert [one for one in cloud.head() if one.feature_id != FAR] == [one for one in healed if one.feature_id != FAR]
    assert cloud.ids() == {one.feature_id for one in healed}
    assert len(cloud.store.history("signs", TILE)) < 12


@pytest.mark.parametrize("what", ["others", "half", "stale", "blind"])
def test_later_reports_of_a_part_leave_what_is_healed_as_it_is(cloud, what):
    healed = heal(cloud)
    later_passes(cloud, 400, what)  # more than ever counted of a tile
    assert [one for one in cloud.head() if one.feature_id != FAR] == [one for one in healed if one.feature_id != FAR]
    assert cloud.ids() == {one.feature_id for one in healed}
    assert set(cloud.verified()) == {"given", "same"}


def test_a_sign_that_goes_and_comes_twice_is_followed(cloud):
    for turn in range(2):
        cloud.sees(crowd(5, f"gone-{turn}"), seen(GONE, ABSENT), later_s=HOUR_S)
        assert GONE not in cloud.ids(), turn
        cloud.sees(crowd(4, f"idle-{turn}"), seen(STAYS), later_s=HOUR_S)
        assert GONE not in cloud.ids(), turn
        cloud.sees(crowd(5, f"back-{turn}"), seen(GONE), base=MAP, later_s=HOUR_S)
        assert GONE in cloud.ids(), turn
    assert set(cloud.verified()) == {"given", "same"}


def test_who_denies_and_who_confirms_in_other_windows_decide_together(cloud):
    for k, vehicle in enumerate(crowd(4)):
        cloud.sees([vehicle], seen(GONE, ABSENT), later_s=HOUR_S)
        assert (GONE in cloud.ids()) == (k < 1)


def test_what_was_found_once_waits_for_its_second_witness_over_windows(cloud):
    cloud.sees(["one"], found(2.0, 2.0))
    cloud.sees(crowd(40, "idle"), seen(FAR), later_s=HOUR_S)
    assert cloud.head() == MAP
    cloud.sees(["two"], found(2.2, 2.0), later_s=HOUR_S)
    (new,) = set(cloud.head()) - set(MAP)
    np.testing.assert_allclose(new.points_m[0, :2], [2.1, 2.0], atol=2e-3)
    assert new.vehicles == 2
    first, second = report_id(1), report_id(42)
    head = cloud.store.get("signs", TILE)
    assert cloud.store.voxel_provenance("signs", TILE, head.version)[new.feature_id] == (first, second)


def test_a_sign_that_two_vehicles_measure_elsewhere_in_other_windows_has_moved(cloud):
    cloud.sees(["one"], seen(GONE, EXIST, (-1.0, 3.0)), later_s=HOUR_S)
    assert cloud.head() == MAP
    cloud.sees(["two"], seen(GONE, EXIST, (-1.0, 3.0)), later_s=HOUR_S)
    (new,) = set(cloud.head()) - set(MAP)
    assert GONE not in cloud.ids()
    np.testing.assert_allclose(new.points_m[0, :2], [-1.0, 3.0], atol=1e-3)


def test_two_signs_that_a_report_has_told_apart_stay_two_in_later_windows(cloud):
    pair = [found(1.0, 1.0), found(1.9, 1.0)]
    cloud.sees(crowd(2), *pair)
    assert len(cloud.head()) == len(MAP) + 2
    for k in range(12):
        cloud.sees([f"later-{k}"], pair[k % 2], base=MAP, later_s=HOUR_S)
    assert len(cloud.head()) == len(MAP) + 2
    apart = [track.apart for track in cloud.memory().tracks if track.epoch is None]
    assert sorted(map(len, apart)) == [0, 1]


def test_a_place_becomes_as_sure_over_windows_as_in_one(tmp_path, monkeypatch):
    """The same measurements: in one window, and in as many as there are; of 40 vehicles, each twice."""
    monkeypatch.setattr("gnd.tile_store.sql_journal.WINDOW_VEHICLES", 999)
    rng = np.random.default_rng(7)
    at = rng.normal([1.0, 1.0], 0.3, (80, 2))
    got = []
    for name, later_s in (("one", 1.0), ("many", HOUR_S)):
        cloud = Cloud(tmp_path / f"{name}.sqlite", FeatureMergeParameters(renewal_gain=1.0))
        for k, spot in enumerate(at):
            cloud.sees([f"car-{k % 40}"], found(*spot), base=MAP, later_s=later_s)
        (new,) = set(cloud.head()) - set(MAP)
        got.append(new)
        cloud.store.close()
    one, many = got
    assert np.hypot(*(one.points_m - many.points_m)[0, :2]) < 0.02
    assert 0.5 < many.cov_m2[0] / one.cov_m2[0] < 1.1
    assert many.vehicles >= 40


@pytest.mark.parametrize("seed", range(4))
def test_a_lamp_at_the_border_is_published_once_however_the_windows_cut(tmp_path, seed):
    """Found now in this tile, now in the next, by vehicles that know their place to metres; two or three a window."""
    rng = np.random.default_rng([17, seed])
    (south, _), (north, east) = TILE.south_west_rad, TILE.north_east_rad
    border_m = points_in_tile(TILE, (south + north) / 2, east, 0.0)[0, 0]
    cloud = Cloud(tmp_path / "map.sqlite")
    others = 0  # reports about the next tile only, which its neighbour does not hear of
    for k in range(30):
        at = np.array([[border_m + rng.normal(0.1, 1.5), rng.normal(0, 0.3), 0.0]])
        tile = TILE if at[0, 0] < border_m else EAST
        local = points_in_tile(tile, *geodetic_in_tile(TILE, at))[0]
        cloud.now_ns += round(rng.uniform(300, 900) * 1e9)
        lamp = change(found(local[0], local[1], sigma_m=1.5, kind="streetlight"), tile=tile)
        cloud.heard += cloud.inbox.rows(report(2 * k, lamp, vehicle=f"car-{k}"), cloud.now_ns)
        if rng.random() < 0.5:
            far = change(found(10.0, 0.0, sigma_m=0.2), tile=EAST)
            cloud.heard += cloud.inbox.rows(report(2 * k + 1, far, vehicle=f"other-{k}"), cloud.now_ns)
            others += 1
        cloud.merges()
        lamps = [one for tile in (TILE, EAST) for one in features_of(cloud, tile) if one.kind == "streetlight"]
        assert len(lamps) == (k > 0)
    assert others > 5
    assert lamps[0].vehicles > 15
    assert all(one.is_away for one in cloud.memory().tracks if one.kind == "streetlight") == (
        lamps[0] not in features_of(cloud, TILE)
    )
    cloud.store.close()


def features_of(cloud, tile):
    stored = cloud.store.get("signs", tile)
    return () if stored is None else stored.decode_features().features


def test_lines_are_carried_on(tmp_path):
    cloud = Cloud(tmp_path / "map.sqlite", FeatureMergeParameters(renewal_gain=1.0), epoch=())
    for k in range(24):
        cloud.sees([f"car-{k}"], line((-10.0, 0.01 * k), (10.0, 0.01 * k)), base=(), later_s=HOUR_S)
    longer = line((-12.0, 0.1), (0.0, 0.1), (12.0, 0.1))
    cloud.sees(["longer"], longer, base=(), later_s=HOUR_S)
    (lane,) = cloud.head()
    np.testing.assert_allclose(lane.points_m[:, 0], [-12.0, 0.0, 12.0], atol=1e-2)
    np.testing.assert_allclose(lane.points_m[:, 1], 0.115, atol=0.02)
    assert set(cloud.verified()) == {"given", "same"}
    cloud.store.close()


def test_the_flood_of_a_vehicle_is_one_vote(tmp_path):
    cloud = Cloud(tmp_path / "map.sqlite", window_reports=8)
    cloud.sees(crowd(3), seen(GONE), seen(STAYS))
    for k in range(10):
        for _ in range(20):
            cloud.hears("liar", seen(GONE, ABSENT), found(0.0, 0.0), found(-9.0 + k, 8.0), viewed=EVERY_CELL, later_s=1)
        cloud.merges()
    assert cloud.head() == MAP
    (votes,) = [track.votes for track in cloud.memory().tracks if track.feature_id == GONE]
    assert sum(vote.vehicle == "liar" for _, vote in votes) == 1
    cloud.sees(["honest"], seen(STAYS), later_s=HOUR_S)
    assert cloud.head() == MAP
    cloud.store.close()


def test_what_is_remembered_of_a_feature_is_bounded(cloud):
    for k in range(400):
        at = (-5.0 + 0.05 * (k % 7), 3.0)
        cloud.hears(f"car-{k}", seen(GONE, EXIST, at), found(3.0 + 0.05 * (k % 9), 6.0), base=MAP, later_s=900)
        if k == 199:
            cloud.merges()
            half = len(cloud.store.in_play("signs", TILE).memory.memory)
    cloud.merges()
    memory = cloud.memory()
    assert len(cloud.store.in_play("signs", TILE).memory.memory) < 1.3 * half
    assert len(memory.witnesses) <= VOTES_KEPT * len(memory.tracks)
    for track in memory.tracks:
        assert len(track.votes) <= VOTES_KEPT
        assert len(track.measured) <= MEASURERS_KEPT
        assert len(track.names) <= NAMES_KEPT
    assert [track.vehicles_before > 380 for track in memory.tracks].count(True) == 2


def test_no_vehicle_can_push_out_what_others_have_found(cloud, monkeypatch):
    monkeypatch.setattr(folding, "MOST_LONELY", 40)
    cloud.sees(["honest"], found(2.0, 5.6), base=MAP)
    for k in range(40):
        spots = [found(-14.0 + 0.7 * k, -14.0 + 5.6 * j, sigma_m=0.05) for j in range(5)]
        cloud.sees(["spammer"], *spots, base=MAP, later_s=HOUR_S)
    lonely = [track for track in cloud.memory().tracks if track.finder]
    assert 20 < len(lonely) <= 40
    assert [track.finder for track in lonely].count("honest") == 1


def test_what_nobody_has_confirmed_for_half_a_year_is_forgotten(cloud):
    cloud.sees(["one"], found(2.0, 2.0), base=MAP)
    cloud.sees(crowd(2, "soon"), seen(FAR), later_s=100 * 24 * HOUR_S)
    assert len(cloud.memory().tracks) == len(MAP) + 1
    cloud.sees(crowd(3, "late"), seen(FAR), later_s=100 * 24 * HOUR_S)
    assert len(cloud.memory().tracks) == len(MAP)


def test_a_memory_comes_back_from_its_bytes_and_says_when_it_cannot(cloud):
    heal(cloud)
    cloud.sees(crowd(3), seen(STAYS, EXIST, (6.1, -2.0)), found(-9.0, -9.0), later_s=HOUR_S)
    stored = cloud.store.in_play("signs", TILE).memory.memory
    memory = LayerMemory.decode(stored)
    assert memory.encode() == stored
    said = json.loads(zstandard.ZstdDecompressor().decompress(stored))
    for wrong in ({"format": 9}, {"witnesses": []}, {"features": []}):
        body = zstandard.ZstdCompressor().compress(json.dumps(said | wrong).encode())
        with pytest.raises(MergerError, match=r"format 9|witnesses|cannot be read"):
            LayerMemory.decode(body)
    with pytest.raises(MergerError, match="cannot be read"):
        LayerMemory.decode(stored[:-9])


def test_after_a_rollback_only_what_comes_later_counts(cloud):
    cloud.sees(crowd(4), seen(GONE, ABSENT))
    cloud.sees(["x"], seen(STAYS), later_s=2 * HOUR_S)
    cloud.hears("waits", seen(GONE, ABSENT), base=MAP, later_s=1)
    cloud.keeps()
    cloud.store.rollback("signs", TILE, 1)
    cloud.merges()
    assert cloud.head() == MAP
    assert {row.vehicle for row in cloud.store.in_play("signs", TILE).reports} == {"waits"}
    cloud.sees(["new"], seen(GONE, ABSENT), later_s=1)
    assert GONE not in cloud.ids()
    assert set(cloud.verified()) == {"given", "same"}


def test_verify_tells_a_layer_that_is_not_what_was_reported(cloud):
    heal(cloud)
    cloud.sees(crowd(4, "later"), seen(STAYS, ABSENT), later_s=HOUR_S)
    n = len(cloud.store.history("signs", TILE))
    assert cloud.verified() == ["given", *["same"] * (n - 1)]
    forged = cloud.store.get("signs", TILE, version=1)
    new = "UPDATE tile_version SET body = ?, sha = ? WHERE version = ?"
    cloud.store.transact(lambda c, _now: c.execute(new, (forged.body, forged.sha, n)))
    assert cloud.verified()[-1] == "differs"
    cloud.store.transact(lambda c, _now: c.execute("DELETE FROM report WHERE vehicle = 'car-0'"))
    gone = Verifier(cloud.store, cloud.config).version("signs", TILE, 2)
    assert gone.status == "unknown"
    assert "are gone" in gone.reason


def calls_during(work):
    """How many functions are called: what a merge costs, on every machine and beside every load the same."""
    n = 0

    def count(_frame, event, _argument):
        nonlocal n
        n += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(None)
    return n


def test_the_hundredth_hundred_of_reports_costs_what_the_first_did(cloud):
    """Calls and stored bytes of reports merged one by one at the same places of their windows."""
    said = [seen(GONE, EXIST, (-5.0, 3.1)), seen(STAYS), found(2.0, 2.0), found(-9.0, -9.0)]

    def cost(first):
        calls = []
        for k in range(30):
            cloud.hears(f"car-{first + k}", *said, base=MAP, later_s=60)
            calls.append(calls_during(cloud.merges))
        return float(np.median(calls)), len(cloud.store.in_play("signs", TILE).memory.memory)

    cost(0)  # everything has run once
    early_calls, early_bytes = cost(30)
    for k in range(1000):
        cloud.hears(f"later-{k}", *said, base=MAP, later_s=60)
        if k % 60 == 59:
            cloud.merges()
    late_calls, late_bytes = cost(5000)
    assert late_calls < 1.5 * early_calls
    assert late_bytes < 2 * early_bytes


SPOTS = [(0.0, 0.0), (0.4, 0.1), (-4.8, 3.1), (6.0, -2.0)]


@st.composite
def drives(draw):
    said = [
        seen(one, draw(st.sampled_from([EXIST, ABSENT])), draw(st.sampled_from([None, *SPOTS])), 0.2)
        for one in draw(st.lists(st.sampled_from([GONE, STAYS]), unique=True))
    ]
    said += [found(*spot, sigma_m=0.5) for spot in draw(st.lists(st.sampled_from(SPOTS), max_size=2, unique=True))]
    later_s = draw(st.sampled_from([1.0, 60.0, 2000.0]))
    return draw(st.integers(0, 5)), tuple(said), draw(st.sampled_from([0, WEST, EVERY_CELL])), later_s


@settings(max_examples=15, deadline=None)
@given(st.lists(drives(), min_size=1, max_size=14), st.lists(st.booleans(), min_size=14, max_size=14))
def test_however_merges_are_batched_the_journal_gives_the_same_layer(tmp_path_factory, some, cuts):
    folder = tmp_path_factory.mktemp("layers")
    clouds = [Cloud(folder / f"{name}.sqlite", window_reports=4) for name in ("each", "cut", "end")]
    for k, (vehicle, said, viewed, later_s) in enumerate(some):
        for cloud, merges in zip(clouds, (True, cuts[k], False), strict=True):
            cloud.hears(f"car-{vehicle}", *said, base=MAP, viewed=viewed, later_s=later_s)
            if merges:
                cloud.merges()
    for cloud in clouds:
        cloud.merges()
    shas = {cloud.store.get("signs", TILE).sha for cloud in clouds}
    bodies = {None if (one := cloud.store.in_play("signs", TILE).memory) is None else one.memory for cloud in clouds}
    verified = {status for cloud in clouds for status in cloud.verified()}
    for cloud in clouds:
        cloud.store.close()
    assert len(shas) == 1
    assert len(bodies) == 1
    assert verified <= {"given", "same"}


@settings(max_examples=15, deadline=None)
@given(st.lists(drives(), min_size=2, max_size=10), st.randoms(use_true_random=False))
def test_the_order_of_reports_within_a_window_does_not_matter(tmp_path_factory, some, shuffler):
    folder = tmp_path_factory.mktemp("order")
    order = list(range(len(some)))
    shuffler.shuffle(order)
    got = []
    for name, numbers in (("plain", range(len(some))), ("mixed", order)):
        cloud = Cloud(folder / f"{name}.sqlite")
        for k in numbers:
            vehicle, said, viewed, _ = some[k]
            one = report(k, change(*said, base=MAP, viewed=viewed), vehicle=f"car-{vehicle}")
            cloud.store.put_reports(cloud.inbox.rows(one, START_NS))
            cloud.merges()
        cloud.number = 100
        cloud.sees(["last"], seen(FAR), base=MAP, later_s=2 * HOUR_S)  # folds the window
        stored = cloud.store.in_play("signs", TILE).memory
        got.append((cloud.store.get("signs", TILE).sha, stored.memory))
        cloud.store.close()
    assert got[0] == got[1]


DIES = """
import os, signal, sys
from pathlib import Path
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.work import Worker
from gnd.tile_store.sqlite_store import SqliteStore

store = SqliteStore(sys.argv[1])
publish = store.publish

def dies(publications):
    if sys.argv[2] == "after":
        publish(publications)
    os.kill(os.getpid(), signal.SIGKILL)

store.publish = dies
worker = Worker(store, ShardConfig("victim", Path(sys.argv[1])))
for claim in store.claim("victim", 4, 0.01):
    worker.settle(claim)
"""


@pytest.mark.slow
@pytest.mark.parametrize("when", ["before", "after"])
def test_a_shard_killed_between_journal_and_publication_loses_and_doubles_nothing(tmp_path, when):
    """At each of two merges, of which each closes windows, a process dies with its work in hand, or just done."""
    clouds = [Cloud(tmp_path / f"{name}.sqlite", window_reports=8) for name in ("faulty", "plain")]
    for turn in range(2):
        for cloud in clouds:
            for k in range(12):
                said = seen(GONE, ABSENT if turn % 2 else EXIST, (-5.0, 3.1)), found(2.0 + 0.1 * k, 2.0 + 3 * turn)
                cloud.hears(f"car-{turn}-{k}", *said, base=MAP, later_s=60)
            cloud.keeps()
        victim = [sys.executable, "-c", DIES, str(clouds[0].store.path), when]
        died = subprocess.run(victim, check=False, capture_output=True)
        assert died.returncode == -signal.SIGKILL, died.stderr
        assert clouds[0].store.dirty_count() == (when == "before")
        clouds[0].store.release("victim")
        for cloud in clouds:
            cloud.merges()
    faulty, plain = ([cloud.head(), cloud.memory().encode(), cloud.store.counts()] for cloud in clouds)
    assert faulty == plain
    assert set(clouds[0].verified()) == {"given", "same"}
    assert len(clouds[0].memory().tracks) >= len(MAP) + 2
    for cloud in clouds:
        cloud.store.close()


def test_a_layer_without_a_vehicle_is_computed_from_the_others(cloud):
    cloud.sees(crowd(2), seen(GONE, ABSENT), base=MAP)
    cloud.sees(["liar", "friend"], found(2.0, 2.0), base=MAP, later_s=HOUR_S)
    cloud.sees(["idle"], seen(FAR), later_s=HOUR_S)
    assert len(cloud.ids()) == 3
    config = ShardConfig(store_path=cloud.store.path)
    ((told, content),) = without_vehicle(cloud.store, config, "signs", "liar")
    assert (told.status, told.reports, told.voxels) == ("changes", 1, 1)
    assert {one.feature_id for one in content.features} == {STAYS, FAR}
    cloud.store.put_tiles([content], "rollback", "signs")
    assert cloud.ids() == {STAYS, FAR}
    ((told, content),) = without_vehicle(cloud.store, config, "signs", "liar")
    assert (told.status, content) == ("same", None)


def test_the_command_tells_what_a_layer_remembers(cloud):
    heal(cloud)
    cloud.sees(["one"], found(-9.0, -9.0), later_s=HOUR_S)
    cloud.sees(["two"], seen(STAYS), later_s=HOUR_S)
    arguments = ["memory", str(cloud.store.path), TILE.path, "--layer", "signs", "--json"]
    told = json.loads(CliRunner().invoke(map_group, arguments).output)
    assert (told["features"], told["published"], told["found by one vehicle"]) == (5, 3, 1)
    (gone,) = [one for one in told["each"] if one["feature_id"] == GONE]
    assert (gone["is_published"], gone["votes_for"], gone["votes_against"]) == (False, 0, 6)
