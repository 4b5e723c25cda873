import math
from collections import Counter

from hypothesis import assume, given, settings
from hypothesis import strategies as st
from merger_world import GROUND, TILE, tile_of_states

from gnd.cloud_merger import ownership
from gnd.cloud_merger.ownership import ENOUGH_FOR_HASHES, KnownDistricts, Members, largest_share, owner_of, shared_out
from gnd.gnd_map.tile_id import District, TileId
from gnd.tile_store.sqlite_store import SqliteStore

DISTRICTS = [TileId((TILE.morton & ~1023) + k * 1024).district for k in range(400)]
MANY = [TileId((TILE.morton & ~1023) + k * 1024).district for k in range(1000)]
names = st.sets(st.from_regex(r"[a-z0-9]{1,8}", fullmatch=True), min_size=1, max_size=6)


@given(names, st.sampled_from(DISTRICTS))
def test_every_member_computes_the_same_owner_whatever_the_order(members, district):
    assert owner_of(district, sorted(members)) == owner_of(district, sorted(members, reverse=True)) in members


@given(names, st.sampled_from(DISTRICTS), st.data())
def test_when_a_member_goes_only_its_districts_move(members, district, data):
    gone = data.draw(st.sampled_from(sorted(members)))
    before = owner_of(district, members)
    if before != gone:
        assert owner_of(district, members - {gone}) == before


def test_districts_spread_over_the_members():
    owners = [owner_of(district, ["a", "b", "c", "d"]) for district in DISTRICTS]
    assert all(70 <= owners.count(member) <= 130 for member in "abcd")


def test_the_owner_is_the_same_in_every_release():
    members = ["merger-1", "merger-2", "merger-3"]
    owners = [owner_of(District(f"13033/03021/2303{k}"), members) for k in range(4)]
    assert owners == ["merger-2", "merger-1", "merger-1", "merger-1"]


def test_members_come_and_go_but_a_member_never_loses_itself():
    members = Members("a")
    assert members.note("b", alive=True)
    assert not members.note("b", alive=True)
    assert members.living == {"a", "b"}
    mine = [district for district in DISTRICTS if members.is_mine(district)]
    assert 0 < len(mine) < len(DISTRICTS)
    assert not members.note("a", alive=False)  # all tokens go when the own connection is lost
    assert members.note("b", alive=False)
    assert all(members.is_mine(district) for district in DISTRICTS)


SHARES = ["merger-3", "merger-1", "merger-1", "merger-2", "merger-3", "merger-2"]
districts = st.sets(st.sampled_from(MANY), max_size=120)


@settings(deadline=None)
@given(districts, names)
def test_no_member_has_more_than_its_share(some, members):
    owners = shared_out(some, members)
    mean = len(some) / len(members)
    assert owners.keys() == some
    assert set(owners.values()) <= members
    assert max(Counter(owners.values()).values(), default=0) <= max(math.ceil(mean), 1.1 * mean)


@settings(deadline=None)
@given(districts, names)
def test_every_member_shares_out_the_same_whatever_the_order(some, members):
    by_path = sorted(some, key=lambda district: district.path)
    assert shared_out(by_path, sorted(members)) == shared_out(by_path[::-1], sorted(members, reverse=True))


@settings(deadline=None)
@given(districts.filter(bool), names, st.data())
def test_a_district_that_comes_moves_no_more_than_a_district_a_member(some, members, data):
    new = data.draw(st.sampled_from(sorted(some, key=lambda district: district.path)))
    assume(largest_share(len(some) - 1, len(members)) == largest_share(len(some), len(members)))
    before, after = shared_out(some - {new}, members), shared_out(some, members)
    assert sum(before[district] != after[district] for district in before) <= len(members)


def test_of_a_thousand_districts_the_largest_share_is_a_tenth_over_the_mean_and_few_move():
    for n in (2, 4, 8, 16):
        members = [f"shard-{k}" for k in range(n)]
        owners = shared_out(MANY, members)
        assert max(Counter(owners.values()).values()) <= 1.1 * len(MANY) / n
        more, fewer = shared_out(MANY, [*members, "shard-new"]), shared_out(MANY, members[1:])
        joined = sum(owners[district] != more[district] for district in MANY)
        left = sum(owners[district] != fewer[district] for district in MANY)
        assert joined <= 1.3 * len(MANY) / (n + 1)
        assert left <= 1.3 * sum(owner == members[0] for owner in owners.values())


def test_the_districts_of_a_small_map_go_to_different_shards():
    for n in (2, 4):
        owners = shared_out(MANY[:2], [f"merger-{k}" for k in range(n)])
        assert len(set(owners.values())) == 2


def test_the_shares_are_the_same_in_every_release():
    owners = shared_out(DISTRICTS[:6], ["merger-1", "merger-2", "merger-3"])
    assert [owners[district] for district in DISTRICTS[:6]] == SHARES


def test_with_very_many_districts_the_hash_alone_decides(monkeypatch):
    monkeypatch.setattr(ownership, "ENOUGH_FOR_HASHES", 10)
    assert ENOUGH_FOR_HASHES > 10
    members = ["a", "b"]
    assert shared_out(DISTRICTS[:21], members) == {one: owner_of(one, members) for one in DISTRICTS[:21]}


def test_members_of_one_map_agree_and_follow_its_districts(tmp_path, monkeypatch):
    monkeypatch.setattr(ownership, "DISTRICTS_EVERY_S", 0.0)
    with SqliteStore(tmp_path / "map.sqlite") as store:
        shards = [Members(name, KnownDistricts(store)) for name in ("a", "b")]
        for shard in shards:
            shard.note("a", alive=True), shard.note("b", alive=True)
        for known in (1, 2, 8):
            tiles = [TileId(district.first_morton + 5) for district in MANY[:known]]
            store.put_tiles([tile_of_states({0: GROUND}, tile) for tile in tiles])
            mine = [sum(shard.is_mine(district) for district in MANY[:known]) for shard in shards]
            assert sum(mine) == known
            assert max(mine) <= math.ceil(known / 2)
        unknown = MANY[999]
        assert [shard.is_mine(unknown) for shard in shards] == [owner_of(unknown, "ab") == name for name in "ab"]
