"""What a tile remembers over its windows: what is settled stays, a world that changes is followed, and all of it can be
computed anew."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import (
    BALL,
    GROUND,
    GROUND_AGAIN,
    POLE,
    TILE,
    VOXEL_BY_VOXEL,
    WALL,
    WALL_AGAIN,
    change_of,
    gaussians_of,
    report_of,
)

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.memory import CLAIMS_OF_VEHICLE, CLAIMS_OF_VOXEL, TileMemory
from gnd.cloud_merger.merge import MergeParameters
from gnd.cloud_merger.stored import decode_state
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import split
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

BASE = {0: GROUND, 1: WALL, 2: POLE}
EVERYTHING = [0, 1, 2, 3, 4, 5]
HOUR_NS = 3600 * 1_000_000_000
START_NS = 1_800_000_000_000_000_000


class Cloud:
    """A store and a worker; vehicles come by, each with the newest version unless another is named."""

    def __init__(self, path, together=False, base=BASE, **store):
        merge = MergeParameters(together=together)
        self.config = ShardConfig(store_path=path, confirmation=VOXEL_BY_VOXEL, merge=merge)
        self.now_ns = START_NS
        self.store = SqliteStore(path, StoreConfig(merge_delay_s=0.0, **store), now_ns=lambda: self.now_ns)
        self.store.put_tiles([Tile(TILE, 1, gaussians_of(base))])
        self.number = 0

    def head(self):
        return self.store.get("ndt", TILE).decode_gaussians().gaussians

    def ids(self):
        return self.head().voxel_id.tolist()

    def hears(
        self,
        vehicle,
        changed=None,
        observed=EVERYTHING,
        base=None,
        later_s=60.0,
        withheld=(),
        unsure=None,
        sensor="VLP-16",
    ):
        """One report: these voxels changed against the version, it is unsure of some, the others are as in it."""
        self.now_ns += round(later_s * 1e9)
        self.number += 1
        base = self.head() if base is None else base
        change = change_of(base, sorted({*observed, *(changed or {})}), changed or {}, withheld=withheld)
        change = replace(change, unsure=gaussians_of(unsure or {}, 10, 10))
        times = {"first_ns": self.now_ns - 10**9, "last_ns": self.now_ns}
        report = replace(report_of(self.number, change, vehicle=vehicle), sensor_model=sensor, **times)
        ((tile, body),) = split(report)
        (row,) = rows_of(report, self.now_ns, together=self.config.merge.together)
        assert (row.tile, row.body) == (tile, body)
        self.store.put_reports([row])
        return report

    def merges(self):
        worker = Worker(self.store, self.config)
        published = 0
        while claims := self.store.claim("one", 4, 30.0):
            published += sum(one.status == "published" for one in self.store.publish(worker.merge(claims)))
        return published

    def sees(self, vehicles, changed=None, **how):
        """Several vehicles report the same, each merged before the next."""
        for vehicle in vehicles:
            self.hears(vehicle, changed, **how)
            self.merges()

    def state(self):
        journal = self.store.in_play("ndt", TILE)
        return None if journal.memory is None else decode_state(TILE, journal.memory)

    def verified(self):
        return [one.status for one in Verifier(self.store, self.config).history("ndt", TILE)]


@pytest.fixture
def cloud(tmp_path):
    made = Cloud(tmp_path / "map.sqlite")
    yield made
    made.store.close()


@pytest.fixture
def adding(tmp_path):
    """A cloud that adds up what vehicles met."""
    made = Cloud(tmp_path / "map.sqlite", together=True)
    yield made
    made.store.close()


def crowd(n, name="car"):
    return [f"{name}-{k}" for k in range(n)]


def test_what_is_healed_stays_healed_when_later_passes_see_other_voxels(cloud):
    cloud.sees(crowd(8), {3: BALL, 1: None}, base=gaussians_of(BASE))
    assert cloud.ids() == [0, 2, 3]
    for k in range(300):
        cloud.sees([f"later-{k}"], observed=[0, 4] if k % 2 else [2, 5], later_s=200)
    assert cloud.ids() == [0, 2, 3]
    assert set(cloud.verified()) == {"given", "same"}


def test_passes_with_a_stale_map_that_see_other_voxels_do_not_bring_the_base_back(cloud):
    cloud.sees(crowd(8), {3: BALL}, base=gaussians_of(BASE))
    for k in range(100):
        cloud.sees([f"later-{k}"], observed=[0, 2, 4], base=gaussians_of(BASE), later_s=100)
    assert cloud.ids() == [0, 1, 2, 3]


def test_a_settled_voxel_does_not_change_on_one_vehicles_word_nor_on_its_repetition(cloud):
    cloud.sees(crowd(4), later_s=3600)
    for _ in range(20):
        cloud.sees(["liar"], {3: BALL, 1: None}, later_s=300)
    assert cloud.ids() == [0, 1, 2]
    for _ in range(20):
        cloud.sees(["liar"], {3: BALL, 1: None}, later_s=3600)
    assert cloud.ids() == [0, 1, 2]


def test_a_vehicle_that_talks_closes_no_window(tmp_path, monkeypatch):
    monkeypatch.setattr("gnd.tile_store.sql_journal.WINDOW_VEHICLES", 3)
    cloud = Cloud(tmp_path / "map.sqlite")
    cloud.sees(["a", "b", "c"], later_s=1)
    cloud.sees(["a"] * 20, later_s=1)
    assert cloud.store.windows()[0].window == 1
    cloud.sees(["d"], later_s=1)
    assert cloud.store.windows()[0].window == 2
    cloud.store.close()


def test_a_flood_of_reports_in_many_windows_is_one_vote(tmp_path):
    cloud = Cloud(tmp_path / "map.sqlite", window_reports=2)
    cloud.sees(crowd(2), later_s=1)
    for _ in range(30):
        cloud.sees(["liar"], {3: BALL}, later_s=1)
    assert cloud.ids() == [0, 1, 2]
    state = cloud.state()
    assert len(state.memory.claims) <= CLAIMS_OF_VEHICLE
    cloud.store.close()


def test_vehicles_that_each_saw_too_little_decide_together_over_many_windows(cloud):
    cloud.sees(crowd(3, "before"), later_s=4000)  # settled: two votes for the base
    for k, vehicle in enumerate(crowd(6)):
        cloud.sees([vehicle], {3: BALL}, observed=[3], later_s=4000)
        if k < 2:
            assert cloud.ids() == [0, 1, 2]
    assert cloud.ids() == [0, 1, 2, 3]


def test_what_several_met_is_published_remembered_and_computed_anew(adding):
    """The voxel of which each is unsure is new for all of them; later windows confirm it, and every version is what the
    journal gives.
    """
    adding.sees(["one"], observed=[0, 1, 2], unsure={3: WALL})
    assert adding.ids() == [0, 1, 2]
    adding.sees(["two"], observed=[0, 1, 2], unsure={3: WALL}, base=gaussians_of(BASE))
    assert adding.ids() == [0, 1, 2, 3]
    for k in range(40):
        adding.sees([f"later-{k}"], observed=[0, 1, 2, 3], later_s=400)
    assert adding.ids() == [0, 1, 2, 3]
    known = adding.state().memory.voxels
    assert known["observers"][known["voxel_id"] == 3] > 2
    assert set(adding.verified()) == {"given", "same"}


def test_what_two_met_against_a_settled_voxel_is_remembered_until_enough_have_met_it(adding):
    """Many found nothing there, window for window; then a thing comes that each vehicle meets too seldom."""
    adding.sees(crowd(12), observed=EVERYTHING, later_s=400)
    assert adding.ids() == [0, 1, 2]
    needed = 0
    while adding.ids() == [0, 1, 2] and needed < 40:
        needed += 2
        adding.sees([f"a-{needed}", f"b-{needed}"], observed=[0, 1, 2], unsure={3: WALL}, later_s=60)
        adding.now_ns += HOUR_NS
    assert 4 <= needed <= 12
    assert set(adding.verified()) == {"given", "same"}


def test_each_confirmation_takes_a_claim_away(cloud):
    cloud.sees(crowd(3, "before"), later_s=4000)
    for k in range(12):  # one of three sees it, and errs
        cloud.sees([f"errs-{k}"], {3: BALL}, later_s=4000)
        cloud.sees([f"right-{k}", f"also-{k}"], later_s=10)
    assert cloud.ids() == [0, 1, 2]
    assert len(cloud.state().memory.claims) <= 1


def test_a_world_that_changes_twice_and_back_is_followed(cloud):
    here = [0, 1, 2]
    for turn, there in enumerate(([0, 1, 2, 3], here, [0, 1, 2, 3], here)):
        gone = {3: BALL} if 3 in there else {3: None}
        cloud.sees(crowd(8, f"turn-{turn}"), gone, observed=[3], base=cloud.head(), later_s=200)
        cloud.sees(crowd(3, f"then-{turn}"), later_s=4000)
        assert cloud.ids() == there, turn
    assert set(cloud.verified()) == {"given", "same"}


def test_a_lonely_vehicle_is_believed_on_its_second_drive(cloud):
    claims = {3: BALL, 4: POLE, 5: WALL, 1: None}
    cloud.config = replace(cloud.config, confirmation=replace(VOXEL_BY_VOXEL, few_voxels=0, few_share=0.0))
    cloud.sees(["only"], claims)
    cloud.sees(["only"], claims, later_s=60)
    assert cloud.ids() == [0, 1, 2]
    assert cloud.store.waiting_changes()[0].voxels == 4
    cloud.sees(["only"], claims, later_s=3600)
    assert cloud.ids() == [0, 2, 3, 4, 5]
    assert cloud.store.waiting_changes() == []


def test_what_waits_for_a_second_witness_waits_over_windows(cloud):
    cloud.config = replace(cloud.config, confirmation=replace(VOXEL_BY_VOXEL, few_voxels=0, few_share=0.0))
    claims = {3: BALL, 4: POLE}
    cloud.sees(["one"], claims)
    for k in range(3):
        cloud.sees([f"elsewhere-{k}"], observed=[0], later_s=4000)
    assert cloud.ids() == [0, 1, 2]
    cloud.sees(["two"], claims, later_s=4000)
    assert cloud.ids() == [0, 1, 2, 3, 4]


def test_support_grows_with_who_confirmed_and_fades_with_age(cloud):
    cloud.sees(crowd(8), later_s=10)
    cloud.sees(["next"], later_s=4000)
    memory, head = cloud.state().memory, cloud.head()
    day = int(memory.voxels["day"].max())

    def weight(age_days=0, observers=8):
        voxels = memory.voxels.copy()
        voxels["observers"] = observers
        rows = replace(memory, voxels=voxels).support_rows(np.array([1], np.int32), head, day + age_days)
        return rows["weight"].sum()

    assert [weight(observers=n) for n in (0, 1, 2, 4, 7, 99, 200)] == [0.0, 1.0, 1.5, 2.0, 3.0, 5.0, 6.0]
    assert weight(90) == pytest.approx(1.5)
    assert weight(900) < 0.01


def test_the_memory_of_a_voxel_is_bounded(cloud):
    cloud.sees(crowd(4), later_s=3600)
    for k in range(30):
        cloud.hears(f"a-{k}", {3: (0.4, 0.0, 0.1 * (k % 3), 0.02, 0.1, 0.1)}, later_s=3600)
        cloud.hears(f"b-{k}", {3: (-0.4, 0.0, -0.1 * (k % 4), 0.1, 0.02, 0.1)}, later_s=1)
        cloud.merges()
    assert len(cloud.state().memory.claims) <= CLAIMS_OF_VOXEL


def test_a_memory_comes_back_from_its_bytes(cloud):
    cloud.sees(crowd(3), later_s=10)
    cloud.sees(["x"], {3: BALL}, later_s=4000)
    cloud.sees(["y"], observed=[0], later_s=4000)
    memory = cloud.state().memory
    again = TileMemory.decode(memory.encode())
    assert (again.voxels == memory.voxels).all()
    assert again.claims.tobytes() == memory.claims.tobytes()
    assert (again.witnesses, dict(again.voters)) == (memory.witnesses, dict(memory.voters))
    assert len(memory.claims) == 1


def test_quiet_reports_about_the_newest_version_cost_no_merge(cloud):
    cloud.sees(crowd(2), {3: BALL}, later_s=1)
    for k in range(20):
        cloud.hears(f"quiet-{k}", later_s=1)
        assert cloud.store.dirty_count() == 0
    cloud.hears("an-hour-later", later_s=3600)
    assert cloud.store.dirty_count() == 1  # the window is full: it is folded
    assert cloud.merges() == 0
    assert len(cloud.store.in_play("ndt", TILE).reports) == 1


def test_a_shard_that_was_away_folds_many_windows_in_steps(cloud):
    cloud.sees(crowd(3), {3: BALL}, base=gaussians_of(BASE), later_s=1)
    for k in range(40):
        cloud.hears(f"one-{k}", {4: POLE}, base=gaussians_of(BASE | {3: BALL}), later_s=4000)
    cloud.merges()
    assert cloud.store.dirty_count() == 0
    assert len(cloud.store.in_play("ndt", TILE).reports) == 1
    assert cloud.ids() == [0, 1, 2, 3, 4]
    assert set(cloud.verified()) == {"given", "same"}


def test_after_a_rollback_only_what_comes_later_counts(cloud):
    cloud.sees(crowd(4), {3: BALL}, base=gaussians_of(BASE), later_s=1)
    cloud.sees(["x"], later_s=4000)
    cloud.hears("waits", {4: POLE}, observed=[4], later_s=1)
    cloud.store.rollback("ndt", TILE, 1)
    cloud.merges()
    assert 3 not in cloud.ids()
    assert {row.vehicle for row in cloud.store.in_play("ndt", TILE).reports} == {"waits"}
    cloud.sees(crowd(2, "new"), {5: WALL}, later_s=1)
    assert 5 in cloud.ids()
    assert set(cloud.verified()) == {"given", "same"}


def test_verify_tells_a_map_that_is_not_what_was_reported(cloud):
    cloud.sees(crowd(3), {3: BALL}, base=gaussians_of(BASE), later_s=1)
    verifier = Verifier(cloud.store, cloud.config)
    assert verifier.version("ndt", TILE, 2).status == "same"
    forged = cloud.store.get("ndt", TILE, version=1)
    new = "UPDATE tile_version SET body = ?, sha = ?, codec_id = ? WHERE version = 2"
    cloud.store.transact(lambda c, _now: c.execute(new, (forged.body, forged.sha, forged.codec_id)))
    assert verifier.version("ndt", TILE, 2).status == "differs"
    cloud.store.transact(lambda c, _now: c.execute("DELETE FROM report WHERE vehicle = 'car-0'"))
    gone = verifier.version("ndt", TILE, 2)
    assert gone.status == "unknown"
    assert "1 reports that it rests on are gone, first" in gone.reason


# Of a version that the store does not hold. No report claims it: a merge that published exactly this content would make
# the version known, and how reports are merged afterwards would depend on when that was.
LOST = (0.1, -0.1, 0.1, 0.1, 0.1, 0.1)
STATES = [None, GROUND, GROUND_AGAIN, WALL, WALL_AGAIN, POLE, BALL]


@settings(max_examples=20, deadline=None)
@given(
    drives=st.lists(
        st.tuples(
            st.integers(0, 5),
            st.dictionaries(st.integers(0, 5), st.sampled_from(STATES), max_size=3),
            st.sampled_from([1.0, 60.0, 2000.0]),
            st.booleans(),
        ),
        min_size=1,
        max_size=14,
    ),
    cuts=st.lists(st.booleans(), min_size=14, max_size=14),
)
def test_however_merges_are_batched_the_journal_gives_the_same_map(tmp_path_factory, drives, cuts):
    folder = tmp_path_factory.mktemp("windows")
    clouds = [Cloud(folder / f"{name}.sqlite", window_reports=4) for name in ("each", "cut", "end")]
    for k, (vehicle, changed, later_s, is_stale) in enumerate(drives):
        base = gaussians_of(BASE if is_stale else BASE | {5: LOST})
        for cloud, merges in zip(clouds, (True, cuts[k], False), strict=True):
            known = {v: s for v, s in changed.items() if s is not None or v in base.voxel_id}
            cloud.hears(f"car-{vehicle}", known, base=base, later_s=later_s)
            if merges:
                cloud.merges()
    for cloud in clouds:
        cloud.merges()
    shas = {cloud.store.get("ndt", TILE).sha for cloud in clouds}
    verified = [status for cloud in clouds for status in cloud.verified()]
    for cloud in clouds:
        cloud.store.close()
    assert len(shas) == 1
    assert set(verified) <= {"given", "same", "unknown"}
