from hypothesis import given
from hypothesis import strategies as st
from merger_world import TILE

from gnd.cloud_merger.ownership import Members, owner_of
from gnd.gnd_map.tile_id import District, TileId

DISTRICTS = [TileId((TILE.morton & ~1023) + k * 1024).district for k in range(400)]
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
