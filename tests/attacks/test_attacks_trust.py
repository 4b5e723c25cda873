"""Attacks by those who may speak: vehicles that are in the fleet, and say what is not so."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from suite_ports import new_port
from trust_scene import (
    BALL,
    FIRST,
    NOTHING,
    SHARD,
    STREETS,
    WIDE,
    Cloud,
    Street,
    base,
    block,
    change_of,
    corner,
    free,
    guarded_cloud,
    report_of,
    wall,
)

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.verify import Verifier
from gnd.gnd_map.tile import Tile, content_sha
from gnd.gnd_map.tile_id import TileId

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cloud]:
    folder: Path = tmp_path_factory.mktemp("trust")
    with guarded_cloud(folder, new_port()) as found:
        yield found


@pytest.fixture(scope="module")
def adding(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cloud]:
    """A cloud that adds up what vehicles met and did not decide upon."""
    folder: Path = tmp_path_factory.mktemp("adding")
    with guarded_cloud(folder, new_port(), "[merge]\ntogether = true\n") as found:
        yield found


def test_attack_one_report_erases_a_tile(cloud: Cloud) -> None:
    """One vehicle says that everything has gone: it waits for a second witness, and the map stays."""
    street = Street(cloud, 0)
    street.say("bad", street.gone)
    street.settle()
    assert street.shas == street.untouched
    assert street.reasons("bad") == {"share"}


def test_attack_one_report_again_and_again(cloud: Cloud) -> None:
    """Twelve reports of one content under new ids: they are one vote, and who sends them is quarantined for them."""
    street = Street(cloud, 1)
    for number in range(12):
        street.say("bad", street.gone, at_s=60 + number)
    street.settle()
    assert street.shas == street.untouched
    street.say("a", NOTHING, at_s=200)
    street.say("b", NOTHING, at_s=260)
    street.settle()
    street.judge()
    assert street.shas == street.untouched
    assert street.quarantined() == {"bad"}


def test_attack_three_collude_against_five(cloud: Cloud) -> None:
    """Three vehicles delete and invent the same things: five others outvote them, and they are quarantined."""
    street = Street(cloud, 2)
    lie = {tile: {**street.gone[tile], **street.built[tile]} for tile in street.tiles}
    for name in ("x", "y", "z"):
        street.say(name, lie)
    for name in "abcde":
        street.say(name, NOTHING)
    street.settle()
    street.judge()
    assert street.shas == street.untouched
    assert street.quarantined() == {"x", "y", "z"}


def test_attack_one_bad_of_two(cloud: Cloud) -> None:
    """One of two vehicles deletes all that the other sees: nobody knows who is right, so it waits."""
    street = Street(cloud, 3)
    street.say("honest", NOTHING)
    street.say("bad", street.gone)
    street.settle()
    assert street.shas == street.untouched
    assert street.quarantined() == set()


def test_attack_one_bad_of_three(cloud: Cloud) -> None:
    """One of three vehicles invents walls everywhere: nothing of it is published, and it does not count any more."""
    street = Street(cloud, 4)
    street.say("bad", street.built)
    street.say("a", NOTHING)
    street.say("b", NOTHING)
    street.settle()
    street.judge()
    assert street.shas == street.untouched
    assert street.quarantined() == {"bad"}


def test_attack_little_by_little(cloud: Cloud) -> None:
    """A vehicle invents so little in each tile that one would be believed: where another sees nothing, it waits."""
    street = Street(cloud, 5)
    street.say("honest", NOTHING)
    street.say("bad", {tile: dict.fromkeys(free(tile)[:8], BALL) for tile in street.tiles})
    street.settle()
    assert street.shas == street.untouched


def test_attack_the_past_told_as_the_present(cloud: Cloud) -> None:
    """A vehicle says of changed walls that they stand as before: the change is published, and it does not count."""
    street = Street(cloud, 6)
    for name in "abc":
        street.say(name, street.gone)
    street.say("old", NOTHING)
    street.settle()
    assert all(new != old for new, old in zip(street.shas, street.untouched, strict=True))
    assert street.quarantined() == {"old"}


def test_attack_slander(cloud: Cloud) -> None:
    """A vehicle denies all that an honest one reports, to have it quarantined: one accuser is not enough."""
    street = Street(cloud, 7)
    street.say("honest", street.gone)
    for number in range(6):
        street.say("slanderer", NOTHING, at_s=200 + number)
    street.settle()
    assert street.quarantined() == set()
    street.say("b", street.gone)
    street.say("c", street.gone)
    street.settle()
    assert "honest" not in street.quarantined()
    assert all(new != old for new, old in zip(street.shas, street.untouched, strict=True))


def test_attack_a_name_that_marks_another(cloud: Cloud) -> None:
    """A pseudonym with the mark of the quarantined, to push a name into the basis of a version: it is refused."""
    street = Street(cloud, 8)
    with pytest.raises(Exception, match="vehicle"):
        street.report("!honest", street.gone)


def test_attack_the_quarantined_as_a_witness(cloud: Cloud) -> None:
    """Who does not count vouches for the claims of a friend: they stay one vehicle's word, and wait."""
    street = Street(cloud, 9)
    cloud.store.quarantine_vehicle(street.name("bad"), "a test")
    street.say("bad", street.gone)
    street.say("friend", street.gone)
    street.settle()
    assert street.shas == street.untouched
    assert street.reasons("bad") == {"quarantined"}
    assert street.reasons("friend") == {"share"}


def test_attack_lies_while_the_shard_dies(cloud: Cloud) -> None:
    """The shard is killed in the middle of lies: who did not count before does not count after, nor does the lie."""
    street = Street(cloud, 10)
    street.say("bad", street.gone)
    street.say("a", NOTHING)
    street.say("b", NOTHING)
    cloud.kill(SHARD)
    cloud.start(SHARD)
    street.settle()
    street.judge()
    assert street.quarantined() == {"bad"}
    assert street.shas == street.untouched


def test_attack_the_word_of_before_the_quarantine(cloud: Cloud) -> None:
    """What a vehicle published while it was believed: it is taken back when it is quarantined, and verified so."""
    street = Street(cloud, 11)
    street.say("bad", {tile: dict.fromkeys(wall(tile)[:8], None) for tile in street.tiles})
    street.settle()
    assert street.shas != street.untouched
    cloud.store.quarantine_vehicle(street.name("bad"), "a test")
    street.settle()
    assert street.shas == street.untouched
    verifier = Verifier(cloud.store, ShardConfig("verifier", cloud.path))
    for tile in street.tiles:
        versions = [verifier.version("ndt", tile, one.version) for one in cloud.store.history("ndt", tile)]
        assert {one.status for one in versions} <= {"same", "given"}, versions


def test_attack_two_that_invent_the_same_against_four(cloud: Cloud) -> None:
    """Two vehicles are each other's witness for a wall that is not there: four who came later take it back."""
    street = Street(cloud, 12)
    street.say("x", street.built)
    street.say("y", street.built)
    street.settle()
    for name in "abcd":
        street.say(name, NOTHING)
    street.settle()
    street.judge()
    assert street.shas == street.untouched
    assert street.quarantined() == {"x", "y"}


def test_attack_three_that_lie_before_anybody_else_comes(cloud: Cloud) -> None:
    """Three vehicles lie together first, and it is published; six honest ones, one by one, bring the map back."""
    street = Street(cloud, 14)
    for name in "xyz":
        street.say(name, {tile: {**street.gone[tile], **street.built[tile]} for tile in street.tiles})
    street.settle()
    assert street.shas != street.untouched
    for name in "abcdef":
        street.say(name, NOTHING)
        street.settle()
    street.judge()
    assert street.shas == street.untouched
    assert street.quarantined() == {"x", "y", "z"}


def test_attack_three_replay_the_past_among_those_who_find_a_change(cloud: Cloud) -> None:
    """Three of ten say of changed walls that they stand as before, the first of them first: the change is published."""
    street = Street(cloud, 15)
    for name in "xabycdzefg":
        street.say(name, NOTHING if name in "xyz" else street.gone)
    street.settle()
    assert all(new != old for new, old in zip(street.shas, street.untouched, strict=True))
    assert street.quarantined() <= {"x", "y", "z"}


def test_attack_a_known_liar_where_nobody_looks(cloud: Cloud) -> None:
    """Who is contradicted in three tiles says little in one that no other vehicle sees: it waits there, too."""
    street = Street(cloud, 16)
    lonely = street.tiles[3]
    little = {lonely: dict.fromkeys(wall(lonely)[:4] + wall(lonely)[WIDE : WIDE + 4], None)}
    street.say("bad", little, tiles=[lonely])
    street.settle()
    assert street.shas != street.untouched  # it is believed: nobody knows it
    street.say("bad", {**street.gone, **street.built, **little})
    street.say("honest", NOTHING, tiles=street.tiles[:3])
    street.settle()
    assert street.shas == street.untouched
    assert "contradicted" in street.reasons("bad")
    street.say("second", little, tiles=[lonely])
    street.settle()
    assert street.shas[3] != street.untouched[3]


def test_attack_a_little_in_very_many_tiles(cloud: Cloud) -> None:
    """A vehicle deletes as much alone as one is believed in a tile, in more and more tiles: on one day no more than
    2,000 voxels, else all of it waits; another vehicle that sees it lets it through.
    """
    tiles = [TileId(FIRST + 4 * STREETS + k) for k in range(7)]
    cloud.store.put_tiles([Tile(one, 1, block(one)) for one in tiles])
    untouched = {one: content_sha(one, block(one)) for one in tiles}

    def is_changed() -> set[bool]:
        heads = [(one, cloud.store.get("ndt", one)) for one in tiles]
        return {head is not None and head.sha != untouched[one] for one, head in heads}

    def say(number: int, vehicle: str, some: list[TileId]) -> None:
        told = [change_of(block(one), block(one).voxel_id, dict.fromkeys(corner(one)), tile=one) for one in some]
        ack = cloud.send(report_of(90_000 + number, *told, vehicle=vehicle))
        assert ack.status in ("stored", "duplicate"), ack
        Street(cloud, 0).settle()

    say(1, "patient", tiles[:5])
    assert is_changed() == {True, False}
    say(2, "patient", tiles[5:])
    assert is_changed() == {False}
    assert {one.reason for one in cloud.store.waiting_changes() if one.vehicle == "patient"} == {"day"}
    (word,) = [one for one in cloud.store.lone_words() if one.vehicle == "patient"]
    assert word.why.startswith(f"{7 * len(corner(tiles[0]))} voxels changed alone on a day")
    say(3, "second", tiles)
    assert is_changed() == {True}


def test_attack_everywhere_at_once(cloud: Cloud) -> None:
    """A vehicle reports of places that it cannot have reached, earlier, later and at the same time: refused."""
    street = Street(cloud, 17)
    far = [TileId.from_indices(street.tiles[0].lon_index + 900 * k, street.tiles[0].lat_index) for k in range(1, 4)]
    cloud.store.put_tiles([Tile(one, 1, base(one)) for one in far])
    street.say("ghost", street.gone, at_s=1000)
    street.settle()  # reports that are judged at the same time may be judged in any order, and the first one counts
    refused = [
        street.say("ghost", {one: dict.fromkeys(wall(one)[:8], None)}, at_s=1000 + late_s, tiles=[one])
        for one, late_s in zip(far, (-60, 0, 300), strict=True)
    ]
    street.settle()
    assert [cloud.store.by_sha("ndt", one, content_sha(one, base(one))) is not None for one in far] == [True] * 3
    assert all(not cloud.store.first_parts("ndt", one.report_id, [one.tiles[0].tile]) for one in refused)
    states = cloud.store.upload_statuses(street.name("ghost"), [one.report_id for one in refused])
    assert {one.state for one in states} == {"quarantined"}
    assert all("more than 70 m/s" in one.reason for one in states)
    (told,) = [one for one in cloud.store.impossible_places() if one.vehicle == street.name("ghost")]
    assert told.times == 3
    assert street.reasons("ghost") == {"share"}  # the first is kept, and waits as one word


def test_no_attack_a_long_drive_and_reports_that_are_late(cloud: Cloud) -> None:
    """No attack: a vehicle drives on at 50 m/s, and its reports come in any order: all of them are taken."""
    street = Street(cloud, 18)
    first = street.tiles[0]
    road = [TileId.from_indices(first.lon_index + 300 * k, first.lat_index + 40) for k in range(6)]
    cloud.store.put_tiles([Tile(one, 1, base(one)) for one in road])
    metres = 300 * 30.2
    sent = [
        street.say("lorry", NOTHING, at_s=round(2000 + k * metres / 50.0), tiles=[road[k]]) for k in (3, 0, 5, 1, 4, 2)
    ]
    street.settle()
    states = cloud.store.upload_statuses(street.name("lorry"), [one.report_id for one in sent])
    assert {one.state for one in states} == {"released"}
    assert street.name("lorry") not in {one.vehicle for one in cloud.store.impossible_places()}


def test_attack_a_gang_that_is_known(cloud: Cloud) -> None:
    """Four that said the same false things in two tiles delete a wall before two others come: they have one vote."""
    street = Street(cloud, 19)
    known, last = street.tiles[:2], street.tiles[3]
    lie = {tile: {**dict.fromkeys(wall(tile)[:20], None), **dict.fromkeys(free(tile)[:20], BALL)} for tile in known}
    for name in "wxyz":
        street.say(name, lie, tiles=known)
    for name in "abcdef":
        street.say(name, NOTHING, tiles=known)
    street.say("judge", {tile: {free(tile)[40]: BALL} for tile in known}, tiles=known)
    street.settle()
    assert street.quarantined() == set()  # two tiles are too few
    for name in "wxyz":
        street.say(name, street.gone, tiles=[last])
    street.settle()
    assert street.shas[3] == street.untouched[3]
    assert street.reasons("w")  # it waits
    for name in "gh":
        street.say(name, NOTHING, tiles=[last])
    street.settle()
    assert street.shas[3] == street.untouched[3]
    verifier = Verifier(cloud.store, ShardConfig("verifier", cloud.path))
    for tile in street.tiles:
        versions = [verifier.version("ndt", tile, one.version) for one in cloud.store.history("ndt", tile)]
        assert {one.status for one in versions} <= {"same", "given"}, versions


@pytest.mark.parametrize(("number", "colluders"), [(20, "xy"), (21, "xyz")])
def test_attack_counters_of_colluders(cloud: Cloud, number: int, colluders: str) -> None:
    """Two, and three, vehicles tell the cloud that they met as much as may be told in voxels where nothing is: unless
    it is told to add that up, nothing is published, nothing waits, and every version verifies.
    """
    street = Street(cloud, number)
    for _ in range(2):
        for vehicle in colluders:
            street.say(vehicle, NOTHING, unsure=street.built, cells=19)
    street.judge()
    assert street.new() == [0] * 4
    assert {reason for vehicle in colluders for reason in street.reasons(vehicle)} == set()
    assert street.statuses() <= {"same", "given"}


@pytest.mark.parametrize(("number", "colluders"), [(0, "xy"), (1, "xyz")])
def test_attack_counters_of_colluders_where_they_are_added_up(adding: Cloud, number: int, colluders: str) -> None:
    """The same where the cloud adds it up: two or three together are one witness, so they change what one vehicle is
    believed, eight voxels of a tile, and of a tile in which they tell of more nothing. When others have seen nothing in
    three tiles, it is held against each of them: they change nothing any more, not even where nobody else looks.
    """
    street = Street(adding, number)
    lonely = street.tiles[3]
    told = street.built | {lonely: dict.fromkeys(free(lonely)[:4] + free(lonely)[WIDE : WIDE + 4], BALL)}
    for vehicle in colluders:
        street.say(vehicle, NOTHING, unsure=told, cells=10)
    street.settle()
    assert street.new() == [0, 0, 0, 8]
    assert street.reasons("x") == {"share"}
    for vehicle in "abcd"[: len(colluders)]:
        street.say(vehicle, NOTHING, tiles=street.tiles[:3])
    street.settle()
    street.say("last", {tile: {wall(tile)[0]: None} for tile in street.tiles[:3]}, tiles=street.tiles[:3])
    street.settle()
    assert street.new() == [0] * 4
    assert street.not_believed_alone() == dict.fromkeys(colluders, "others deny 144 of 144 claims")
    assert "contradicted" in street.reasons("x")
    assert street.statuses() <= {"same", "given"}


def test_attack_counters_that_make_an_honest_vehicle_wrong(adding: Cloud) -> None:
    """A liar tells of the voxels in which an honest vehicle met something that moved on, so that both have voted for
    them, and six others have seen nothing there: the map stays, and nobody is quarantined for what it did not claim.
    """
    street = Street(adding, 2)
    street.say("honest", NOTHING, unsure=street.built, cells=10)
    street.say("liar", NOTHING, unsure=street.built, cells=19)
    for vehicle in "abcdef":
        street.say(vehicle, NOTHING)
    street.settle()
    street.judge()
    assert street.shas == street.untouched
    assert street.quarantined() == set()


def test_attack_one_drive_under_two_names(cloud: Cloud) -> None:
    """A vehicle sends what it has measured on one drive under two names, right away and an hour later, and a third
    one: all of it is one vehicle's word, and waits, in the tile that is sent later, too. Another vehicle's own
    measurement of the same walls is a second word.
    """
    street = Street(cloud, 22)
    first, later = street.tiles[:3], street.tiles[3:]
    for vehicle, at_s in (("one", 60), ("two", 70), ("three", 3700)):
        street.say(vehicle, street.built, at_s=at_s, tiles=first, as_measured=True)
        street.settle()
        assert street.new() == [0] * 4
    assert {one.vehicle for one in cloud.store.waiting_changes() if one.vehicle.endswith("-22")} == {street.name("one")}
    for vehicle in ("two", "three"):
        street.say(vehicle, street.built, at_s=3800, tiles=later, as_measured=vehicle == "two")
    street.settle()
    assert street.new() == [0] * 4
    street.say("honest", street.built, at_s=3900)
    street.settle()
    assert street.new() == [48] * 4
    assert street.quarantined() == set()
    assert street.statuses() <= {"same", "given"}


def test_attack_large_counters(adding: Cloud) -> None:
    """One vehicle tells again and again that it met as much as may be told in empty voxels, another met a little there
    by chance: nobody counts for more than all others together, so nothing is published. Nor is it where another met
    much and two saw nothing. Where nobody saw it empty, two that met much publish what one witness may.
    """
    street = Street(adding, 3)
    for _ in range(9):
        street.say("bad", NOTHING, unsure=street.built, cells=19)
    street.say("chance", NOTHING, unsure=street.built, cells=5)
    street.settle()
    assert street.shas == street.untouched
    street.say("a", NOTHING)
    street.say("b", NOTHING)
    street.say("moved", NOTHING, unsure=street.built, cells=10)
    street.settle()
    assert street.shas == street.untouched
    assert street.quarantined() == set()
    true = Street(adding, 4)
    few = {tile: dict.fromkeys(free(tile)[:4] + free(tile)[WIDE : WIDE + 4], BALL) for tile in true.tiles}
    for vehicle in ("one", "two"):
        true.say(vehicle, NOTHING, unsure=few, cells=10)
    true.settle()
    assert true.new() == [8] * 4
    assert true.statuses() == {"same", "given"}


def test_road_works_quarantine_nobody(cloud: Cloud) -> None:
    """No attack: four honest vehicles find that every wall has gone, after two saw them standing."""
    street = Street(cloud, 13)
    for name in "ab":
        street.say(name, NOTHING)
    for name in "cdef":
        street.say(name, street.gone)
    street.settle()
    assert street.quarantined() == set()
    assert all(new != old for new, old in zip(street.shas, street.untouched, strict=True))
