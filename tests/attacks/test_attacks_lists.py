"""Attacks on which districts a client is told that there are: by a tile server that was broken into, by keys that do
not count (any more), by who shows older states to somebody who was restarted."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from signing_scene import HOUR, NOW, Authority
from versions_scene import FIRST, LAYER, VersionScene, content, raw_signature, version_scene

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.refusals import refusals
from gnd.fleet_bus.seal_keys import load_signer
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, TileId
from gnd.schemas.district_list import DistrictList, DistrictsHead, DistrictsSignature
from gnd.schemas.errors import NotSigned, SchemaError
from gnd.schemas.tiles import Catalog
from gnd.tile_client.archive_check import SeenStates
from gnd.tile_client.checking import SeenInMemory, VersionCheck
from gnd.tile_client.fetching import TileServerClient
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.link.map_age import MapAge, MapAgeTimes

OTHER = TileId(FIRST.morton + TILES_OF_DISTRICT)
HOME, AWAY = FIRST.district, OTHER.district
NUMBERS = tuple(one.first_morton // TILES_OF_DISTRICT for one in (HOME, AWAY))
EVERYWHERE = Region(prefix="")
DAY = 24 * HOUR


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VersionScene]:
    with version_scene(tmp_path_factory.mktemp("lists")) as scene:
        scene.publish("shard", content(FIRST, 1))
        scene.publish("operator", content(OTHER, 2))
        yield scene


@pytest.fixture
def scene(opened: VersionScene) -> VersionScene:
    opened.server.alter_catalog = opened.server.alter_lists = None
    opened.server.beside = lambda _district, said: said
    opened.server.strange = {}
    return opened


def fresh(scene: VersionScene, oldest_s: float | None = None) -> TileServerClient:
    """A client who has seen nothing yet."""
    return TileServerClient(scene.watcher, LAYER, 10.0, oldest_catalog_s=oldest_s)


def true_list(scene: VersionScene) -> DistrictList:
    told = scene.store.district_list(LAYER)
    assert told is not None
    assert told.numbers == NUMBERS
    return told


def signed_by(
    scene: VersionScene,
    folder: Path,
    numbers: tuple[int, ...],
    age_s: float = 0.0,
    number: int = 9,
    layer: str = LAYER,
    region: str = "main",
) -> DistrictList:
    """A list under a signature of any certificate, at any time; its chain is shown to who asks."""
    signer = load_signer(folder)
    scene.server.chains[signer.certificate_id.hex()] = signer.chain
    at = DistrictsSignature(number, round(time.time() - age_s), signer.certificate_id, bytes(64))
    head = DistrictsHead.of(layer, region, numbers)
    return DistrictList(head, replace(at, signature=raw_signature(folder, head.text(at.order, at.signer))), numbers)


def is_refused(
    scene: VersionScene, said: DistrictList | None, why: str, asking: TileServerClient | None = None
) -> None:
    """A client takes nothing that comes with such a list (None: with none), and says why; then the true one again."""
    scene.server.alter_lists = lambda _true: [] if said is None else [said]
    asking = fresh(scene) if asking is None else asking
    before = dict(refusals())
    with pytest.raises(NotSigned, match=why):
        asking.catalog(EVERYWHERE)
    assert refusals() != before, "it is counted"
    scene.server.alter_lists = None
    assert [one.tile for one in asking.catalog(EVERYWHERE)] == [FIRST, OTHER]
    assert asking.refused == {}


# ---- what works


def test_a_fresh_client_takes_what_is_listed(scene: VersionScene) -> None:
    asking = fresh(scene, oldest_s=3600.0)
    assert [one.tile for one in asking.catalog(EVERYWHERE)] == [FIRST, OTHER]
    assert [one.tile for one in asking.catalog(Region(prefix=HOME.path))] == [FIRST]
    assert asking.catalog(Region(prefix="02222")) == []
    with open_bus(BusConfig(connect=(scene.endpoint,), identity=None), name="plain") as plain:
        scene.server.alter_lists = lambda _true: []
        assert len(TileServerClient(plain, LAYER, 10.0).catalog(EVERYWHERE)) == 2


def test_a_list_is_small(scene: VersionScene) -> None:
    """A signature, and about a byte a district where they lie side by side."""
    told = true_list(scene)
    many = tuple(NUMBERS[0] + n for n in range(1000))
    whole = DistrictList(DistrictsHead.of(LAYER, "main", many), told.signature, many)
    assert len(told.encode()) <= 110
    assert len(whole.encode()) <= 1110
    assert len(whole.without_districts.encode()) <= 140


# ---- a tile server that was broken into


def test_attack_district_withheld_from_a_fresh_client(scene: VersionScene) -> None:
    """A whole district is left out of a region's answer, or said to be empty: the signed list names it, so that a
    client who has never seen it is told; the others count."""
    for instead in (None, Catalog()):
        scene.server.beside = lambda _district, _said, instead=instead: instead  # type: ignore[misc]
        asking = fresh(scene)
        assert [one.tile for one in asking.catalog(EVERYWHERE)] == [FIRST]
        assert list(asking.refused) == [AWAY]
        assert "the list of districts names it: withheld" in asking.refused[AWAY]
        with pytest.raises(NotSigned, match="withheld"):
            asking.catalog(Region(prefix=AWAY.path))
    scene.server.beside = lambda _district, said: said
    asking = fresh(scene)
    assert len(asking.catalog(EVERYWHERE)) == 2


def test_attack_district_taken_off_the_list(scene: VersionScene) -> None:
    """A district is taken off the list, and withheld; or others are put on it; the signature is over all of them."""
    told = true_list(scene)
    for numbers in (NUMBERS[:1], (), (*NUMBERS, NUMBERS[1] + 1)):
        is_refused(
            scene, DistrictList(DistrictsHead.of(LAYER, "main", numbers), told.signature, numbers), "does not fit"
        )
    is_refused(scene, told.without_districts, "came without its 2 districts")


def test_attack_no_list_at_all(scene: VersionScene) -> None:
    """The list is withheld: what comes beside it is not used."""
    is_refused(scene, None, "no list of districts names it")
    asking = fresh(scene)
    asking.catalog(EVERYWHERE)
    asking._lists._until_s = 0.0  # type: ignore[union-attr]
    is_refused(scene, None, "that of region main was seen before and did not come", asking)


def test_attack_a_whole_layer_is_withheld(scene: VersionScene, caplog: pytest.LogCaptureFixture) -> None:
    """A layer is withheld with its list from who has never seen it, which looks like a layer that the map does not
    have: it is told and counted, and refused by who wants a state that was signed within so long."""
    before = dict(refusals()).get(("catalog", "no list"), 0)
    scene.server.alter_lists = lambda _true: []
    with caplog.at_level("WARNING"):
        assert TileServerClient(scene.watcher, "walls", 10.0).catalog(EVERYWHERE) == []
    assert "layer walls: none came: the map has nothing of this layer, or all of it is withheld" in caplog.text
    with pytest.raises(NotSigned, match=r"none came.*and one of the last 1\.0 h is wanted"):
        TileServerClient(scene.watcher, "walls", 10.0, oldest_catalog_s=3600.0).catalog(EVERYWHERE)
    assert dict(refusals())["catalog", "no list"] == before + 2


def test_attack_older_list(scene: VersionScene) -> None:
    """A true list of before a district was there: who has seen a newer one refuses it; a fresh client refuses the
    district that is not on it, and who wants one of the last hour refuses an old list."""
    past = scene.authority.part("shard", "past", begins=NOW - 3 * DAY, ends=NOW + DAY)
    old = signed_by(scene, past, NUMBERS[:1], 7200.0, number=1)
    asking = fresh(scene)
    asking.catalog(EVERYWHERE)
    asking._lists._until_s = 0.0  # type: ignore[union-attr]
    is_refused(scene, old, "which was seen before", asking)
    is_refused(scene, old, "signed 2.0 h ago, at most 1.0 h", fresh(scene, 3600.0))
    scene.server.alter_lists = lambda _true: [old]
    asking = fresh(scene)
    assert [one.tile for one in asking.catalog(EVERYWHERE)] == [FIRST]
    assert "no list of districts names it: an older list" in asking.refused[AWAY]


def test_attack_old_list_with_a_new_number_or_time(scene: VersionScene) -> None:
    """Number or time of a list are altered so that it looks new."""
    told = true_list(scene)
    for changes in ({"number": 2**40}, {"signed_s": round(time.time()) + 60}):
        changed = replace(told, signature=replace(told.signature, **changes))  # type: ignore[arg-type]
        is_refused(scene, changed, "does not fit")


def test_attack_list_of_another_layer_or_region(scene: VersionScene) -> None:
    """A list that a publisher has signed of another layer, or of another store's part of the map, under this name."""
    signing = Signing(scene.parts["operator"])
    for layer, region in (("other", "main"), (LAYER, "east")):
        signature, _ = signing.sign_districts(DistrictsHead.of(layer, region, NUMBERS), None)
        is_refused(scene, DistrictList(DistrictsHead.of(LAYER, "main", NUMBERS), signature, NUMBERS), "does not fit")


def test_attack_a_whole_store_is_withheld(scene: VersionScene, caplog: pytest.LogCaptureFixture) -> None:
    """A map of two stores: the list of the one is withheld with all of its districts. Who has seen it is told; and the
    other one's list goes on naming the districts that have moved away from it."""
    east = signed_by(scene, scene.parts["shard"], NUMBERS[1:], region="east")
    asking = fresh(scene)
    scene.server.alter_lists = lambda true: [true, east]
    assert len(asking.catalog(EVERYWHERE)) == 2
    scene.server.alter_lists = lambda true: [true]
    scene.server.beside = lambda _district, _said: None
    asking._lists._until_s = 0.0  # type: ignore[union-attr]
    with caplog.at_level("WARNING"):
        asking.catalog(EVERYWHERE)
    assert "that of region east was seen before and did not come" in caplog.text
    assert list(asking.refused) == [AWAY]


def test_attack_list_that_is_nonsense(scene: VersionScene) -> None:
    """Bytes cut off, districts twice, out of range, a head with districts; refused as no list."""
    good = true_list(scene).encode()
    for wrong in (good[:-1], good + b"\x22\x01\x00", good + b"\x22\x05\xff\xff\xff\xff\x0f", good + b"\x32\x01\x00"):
        scene.server.alter_lists = lambda true, wrong=wrong: [_Raw(true, wrong)]  # type: ignore[misc]
        with pytest.raises(SchemaError):
            fresh(scene).catalog(EVERYWHERE)


class _Raw(DistrictList):
    """Bytes that are said to be a list."""

    def __init__(self, true: DistrictList, data: bytes) -> None:
        super().__init__(true.head, true.signature, true.numbers)
        object.__setattr__(self, "data", data)

    def encode(self) -> bytes:
        return bytes(self.data)  # type: ignore[attr-defined]


def test_attack_district_that_nobody_listed(scene: VersionScene, tmp_path: Path) -> None:
    """A district with a catalog that a publisher has signed, of another map of the same authority, is put among ours:
    no list names it."""
    with SqliteStore(tmp_path / "other.sqlite", signing=Signing(scene.parts["operator"])) as store:
        strange = TileId(OTHER.morton + 5 * TILES_OF_DISTRICT)
        store.put_tiles([content(strange, 4)])
        theirs = store.catalog(LAYER, strange.district)
    scene.server.strange = {strange.district: theirs}
    asking = fresh(scene)
    assert [one.tile for one in asking.catalog(EVERYWHERE)] == [FIRST, OTHER]
    assert "no list of districts names it" in asking.refused[strange.district]


# ---- keys that do not count


def test_attack_list_signed_by_who_may_not(scene: VersionScene, tmp_path: Path) -> None:
    """A list without a district, signed with the tile server's own key, a vehicle's, one of another authority, or with
    one that had ended."""
    foreign = Authority(tmp_path, "authority").part("operator", "mallory")
    ended = scene.authority.part("shard", "ended-lists", begins=NOW - 3 * DAY, ends=NOW - DAY)
    for folder, why in (
        (scene.parts["tiles"], "signs no versions"),
        (scene.parts["vehicle"], "signs no versions"),
        (foreign, "not of our authority"),
        (ended, "did not hold when it was signed"),
    ):
        is_refused(scene, signed_by(scene, folder, NUMBERS[:1]), why)
    told = true_list(scene)
    is_refused(scene, replace(told, signature=replace(told.signature, signer=bytes(8))), "is not known")


def test_attack_list_of_a_revoked_shard(scene: VersionScene) -> None:
    """A shard was broken into and has signed a list without a district; it is revoked, and within a second nothing
    counts that it has signed, back-dated or not."""
    gone = scene.authority.part("shard", "gone-lists")
    scene.server.beside = lambda _district, _said: None
    less = signed_by(scene, gone, NUMBERS[:1], number=1000)
    scene.server.alter_lists = lambda _true: [less]
    asking = fresh(scene)
    assert (len(asking.catalog(EVERYWHERE)), asking.refused) == (1, {}), "until somebody knows, it is a publisher"
    scene.authority.revoke(gone, *scene.parts.values())
    end_s, why = time.monotonic() + 10.0, ""
    while "was revoked" not in why:
        assert time.monotonic() < end_s, "the list of the revoked is not read"
        time.sleep(0.1)
        try:
            fresh(scene).catalog(EVERYWHERE)
        except NotSigned as error:
            why = str(error)
    scene.server.beside = lambda _district, said: said
    is_refused(scene, signed_by(scene, gone, NUMBERS[:1], 1800.0), "was revoked")


# ---- a map that is frozen


def until(what: Callable[[], bool], why: str) -> None:
    end_s = time.monotonic() + 20.0
    while not what():
        assert time.monotonic() < end_s, why
        time.sleep(0.02)


def test_attack_map_frozen_for_a_vehicle(scene: VersionScene, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Everything that a vehicle hears is two days old, or nobody answers it: it drives on, and says in its log and its
    telemetry for how long nobody has confirmed its map, also after a new start. What is younger than it has seen ends
    that; what is older, or signed by who may not, does not."""
    past = scene.authority.part("shard", "frozen", begins=NOW - 3 * DAY, ends=NOW + DAY)
    old, told = signed_by(scene, past, NUMBERS, 2 * 86_400.0, number=3), true_list(scene)
    check = VersionCheck.on_the_bus(scene.vehicle, LAYER, SeenInMemory())
    assert check is not None
    path, times = tmp_path / "seen.json", MapAgeTimes(again_s=0.05, look_s=0.05)

    def vehicle() -> MapAge:
        return MapAge(scene.vehicle, LAYER, check.publishers, SeenStates(path), times)

    scene.server.alter_lists = lambda _true: [old]
    with caplog.at_level("WARNING"), closing(vehicle()) as age:
        assert age.stale_h == 0, "it has just begun to look"
        until(lambda: age.stale_h == 48, "an old list is not told of")
        until(lambda: "the map is stale: its publishers have confirmed it 48.0 h ago" in caplog.text, "no word")
        scene.server.alter_lists = lambda _true: [signed_by(scene, scene.parts["tiles"], NUMBERS)]
        until(lambda: "signs no versions" in caplog.text, "it is not asked again")
        assert age.stale_h == 48
    scene.server.alter_lists = lambda _true: []
    with closing(vehicle()) as age:
        assert age.stale_h == 48, "known from before the start"
        scene.server.alter_lists = None
        until(lambda: age.stale_h == 0, "a fresh list does not end it")
        asked = len(scene.server.asked)
        time.sleep(0.3)
        assert len(scene.server.asked) == asked, "it is not asked again while that is young"
    with closing(vehicle()) as age:
        time.sleep(0.3)
        assert (len(scene.server.asked), age.stale_h) == (asked, 0), "nor after a new start"
        assert abs(time.time() - told.signature.signed_s - age.age_s) <= 1.0


def test_a_vehicle_asks_for_a_head_alone(scene: VersionScene, tmp_path: Path) -> None:
    """And no more often than every six hours."""
    check = VersionCheck.on_the_bus(scene.vehicle, LAYER, SeenInMemory())
    assert check is not None
    before = len(scene.server.asked)
    with closing(MapAge(scene.vehicle, LAYER, check.publishers, SeenStates(tmp_path / "seen.json"))):
        until(lambda: len(scene.server.asked) > before, "it does not ask")
    assert scene.server.asked[before:] == [b"\x01"]


# ---- after a restart

PROGRAM = """
import sys, time, gnd
with gnd.connect(sys.argv[1], timeout_s=20.0) as client:
    try:
        found = [one.version for one in client.catalog()]
        print("took", *found, "refused", *client.refused().values(), flush=True)
    except gnd.GndError as error:
        print("refused", error, flush=True)
    time.sleep(60.0)
"""


def program(scene: VersionScene, identity: Path) -> str:
    """What a program of the API says of the map; it is killed (kill -9) as soon as it has said it."""
    command = [sys.executable, "-c", PROGRAM, scene.endpoint]
    env = os.environ | {"GND_IDENTITY": str(identity)}
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        said = running.stdout.readline()
        running.kill()
    return said


@pytest.mark.slow
def test_attack_older_states_after_a_restart(scene: VersionScene, tmp_path: Path) -> None:
    """A program is killed (kill -9) and started again; then an older catalog, or list, is shown to it, which a
    publisher has signed: it knows from its disk that it has seen newer ones. Where somebody damages that file, it is
    laid aside, and said to count as nothing seen."""
    identity = tmp_path / "program"
    shutil.copytree(scene.parts["watcher"], identity)
    old_catalog, old_list = scene.store.catalog(LAYER, HOME), true_list(scene)
    scene.publish("shard", content(FIRST, 7))
    newer = signed_by(scene, scene.parts["shard"], NUMBERS, number=50)
    scene.server.alter_lists = lambda _true: [newer]
    assert program(scene, identity).startswith("took 2 1 refused")
    scene.server.alter_catalog = lambda _true: old_catalog
    assert "which was seen before" in program(scene, identity), "an older catalog of a district"
    scene.server.alter_catalog, scene.server.alter_lists = None, lambda _true: [old_list]
    said = program(scene, identity)
    assert said.startswith("refused list of districts"), said
    assert "which was seen before" in said
    kept = identity / "catalogs_seen.json"
    data = kept.read_bytes()
    kept.write_bytes(data.replace(b"50]", b"10]"))
    assert program(scene, identity).startswith("took 2 1"), "nothing counts as seen, and the map is read"
    assert (identity / "catalogs_seen.json.damaged").read_bytes() == data.replace(b"50]", b"10]")
    assert "which was seen before" not in program(scene, identity)


WRITER = """
import itertools, sys
from pathlib import Path
from gnd.schemas.archive_seal import SealNumber
from gnd.tile_client.archive_check import SeenStates
seen = SeenStates(Path(sys.argv[1]))
for n in itertools.count(seen.newest("one").number + 1):
    seen.note("one", SealNumber(1_795_000_000, n))
    seen.note(f"other {n % 50}", SealNumber(1_795_000_000, n))
    print(n, flush=True)
"""


@pytest.mark.slow
def test_what_was_seen_survives_kill_9_at_any_time(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, last = tmp_path / "seen.json", 0
    for wait_s in (0.0, 0.003, 0.011, 0.05):
        with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE) as running:
            assert running.stdout is not None
            said = [int(running.stdout.readline()) for _ in range(20)]
            time.sleep(wait_s)
            running.kill()
            said += map(int, running.stdout.read().split())
        assert said[0] > last, "it has gone on from what was seen"
        last = said[-1]
        assert SeenStates(path).newest("one").number >= last
    assert caplog.text == ""
