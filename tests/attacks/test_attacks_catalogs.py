"""Attacks on what a client is told that there is: by a tile server that was broken into, by who can write the store's
file, by keys that do not count (any more)."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import apsw
import pytest
from signing_scene import HOUR, NOW, Authority
from suite_ports import new_port
from versions_scene import FIRST, LAYER, VersionScene, content, raw_signature, version_scene

from gnd.client import Client
from gnd.deploy.watch import TileWatch, WatchEvent
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.publishers import Publishers
from gnd.fleet_bus.refusals import refusals
from gnd.fleet_bus.router import open_router
from gnd.fleet_bus.seal_keys import load_signer
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.catalog_signature import CatalogSignature, CatalogStatement
from gnd.schemas.errors import NotSigned, SchemaError
from gnd.schemas.tiles import Catalog
from gnd.tile_client.catalog_check import CatalogCheck
from gnd.tile_client.fetching import TileServerClient
from gnd.tile_client.following import NewVersion, RegionFollower
from gnd.tile_store.catalogs import answered_catalogs, sign_whole_catalog
from gnd.tile_store.server import TileServer
from gnd.tile_store.signatures import sign_unsigned
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore

HOME = FIRST.district
EVERYWHERE = Region(prefix="")
DAY = 24 * HOUR


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VersionScene]:
    with version_scene(tmp_path_factory.mktemp("catalogs")) as scene:
        for seed in (1, 2, 3):
            scene.tile(seed, seed + 10)  # two versions each
        yield scene


@pytest.fixture
def scene(opened: VersionScene) -> VersionScene:
    opened.server.alter = opened.server.alter_catalog = None
    return opened


def fresh(scene: VersionScene, oldest_s: float | None = None) -> TileServerClient:
    """A client who has seen nothing yet."""
    return TileServerClient(scene.watcher, LAYER, 10.0, oldest_catalog_s=oldest_s)


def true_catalog(scene: VersionScene) -> Catalog:
    return scene.store.catalog(LAYER, HOME)


def signed_by(scene: VersionScene, folder: Path, said: Catalog, age_s: float = 0.0, number: int = 0) -> Catalog:
    """The same catalog under a signature of any certificate, at any time; its chain is shown to who asks."""
    signer, true = load_signer(folder), said.signature
    assert true is not None
    scene.server.chains[signer.certificate_id.hex()] = signer.chain
    at = CatalogSignature(
        number or true.number, round(time.time() - age_s), true.kind, signer.certificate_id, bytes(64)
    )
    text = at.text(CatalogStatement.of(LAYER, HOME, said.entries))
    return replace(said, signature=replace(at, signature=raw_signature(folder, text)))


def is_refused(scene: VersionScene, said: Catalog, why: str, asking: TileServerClient | None = None) -> None:
    """A fresh client takes nothing of a catalog, and says why."""
    scene.server.alter_catalog = lambda _true: said
    asking = fresh(scene) if asking is None else asking
    with pytest.raises(NotSigned, match=why):
        asking.catalog(EVERYWHERE)
    assert list(asking.refused) == [HOME]
    scene.server.alter_catalog = None
    assert [one.tile for one in asking.catalog(EVERYWHERE)] == [one.tile for one in true_catalog(scene).entries]
    assert asking.refused == {}


# ---- what works


def test_a_fresh_client_takes_the_catalog_and_its_successors(scene: VersionScene) -> None:
    asking = fresh(scene, oldest_s=3600.0)
    before = asking.catalog(EVERYWHERE)
    tile = scene.tile(7)
    assert [one.tile for one in asking.catalog(EVERYWHERE)] == [*(one.tile for one in before), tile]
    assert Catalog.decode(true_catalog(scene).encode()) == true_catalog(scene)


def test_a_client_without_identity_reads_catalogs_of_any_kind(scene: VersionScene) -> None:
    scene.server.alter_catalog = lambda said: replace(said, signature=None)
    with open_bus(BusConfig(connect=(scene.endpoint,), identity=None), name="plain") as plain:
        assert len(TileServerClient(plain, LAYER, 10.0).catalog(EVERYWHERE)) == len(true_catalog(scene).entries)


def test_the_signature_weighs_less_than_three_entries(scene: VersionScene) -> None:
    said = true_catalog(scene)
    more = len(said.encode()) - len(replace(said, signature=None).encode())
    assert 80 <= more <= 100
    assert len(replace(said, entries=said.entries[:2], signature=None).encode()) > 80


# ---- a tile server that was broken into


def test_attack_tile_withheld_from_a_fresh_client(scene: VersionScene) -> None:
    """A tile is left out of the catalog for a client that has never seen it; the signature is over all of them."""
    said = true_catalog(scene)
    for left in (said.entries[1:], said.entries[:-1], (*said.entries[:1], *said.entries[2:]), ()):
        is_refused(scene, replace(said, entries=left), "does not fit")


def test_attack_older_version_named_to_a_fresh_client(scene: VersionScene) -> None:
    """The catalog names the version before, which a publisher has signed, too; or an invented one."""
    said, before = true_catalog(scene), refusals()
    first = said.entries[0]
    old = scene.store.get(LAYER, first.tile, 1)
    assert old is not None
    for entry in (replace(first, version=1, sha=old.sha), replace(first, sha=old.sha), replace(first, version=999)):
        is_refused(scene, replace(said, entries=(entry, *said.entries[1:])), "does not fit")
    assert refusals()["catalog", "wrong"] - before.get(("catalog", "wrong"), 0) == 3


def test_attack_old_catalog_for_a_fresh_client(scene: VersionScene, caplog: pytest.LogCaptureFixture) -> None:
    """A true catalog of two hours, or two days, ago: who wants one of the last hour refuses it; who has no bound is
    told of the age of more than a day, and who has seen a newer one refuses any older one."""
    said, past = true_catalog(scene), scene.authority.part("shard", "past", begins=NOW - 3 * DAY, ends=NOW + DAY)
    is_refused(scene, signed_by(scene, past, said, 7200.0), "signed 2.0 h ago, at most 1.0 h", fresh(scene, 3600.0))
    old = signed_by(scene, past, said, 2 * 86_400.0)
    asking = fresh(scene)
    scene.server.alter_catalog = lambda _true: old
    with caplog.at_level("WARNING"):
        assert asking.catalog(EVERYWHERE)
    assert "was signed 48.0 h ago: newer ones are withheld" in caplog.text
    scene.server.alter_catalog = None
    asking.catalog(EVERYWHERE)
    is_refused(scene, old, "which was seen before", asking)


def test_attack_old_catalog_with_a_new_number_or_time(scene: VersionScene) -> None:
    """The number, the time or the kind of an old catalog is altered so that it looks new."""
    said = true_catalog(scene)
    assert said.signature is not None
    for changes in ({"number": 2**40}, {"signed_s": round(time.time()) + 60}, {"kind": "renewed"}):
        is_refused(scene, replace(said, signature=replace(said.signature, **changes)), "does not fit")  # type: ignore[arg-type]


def test_attack_catalog_of_another_district(scene: VersionScene, tmp_path: Path) -> None:
    """The signed catalog of another district, or its signature alone, under this district's key."""
    other = TileId(FIRST.morton + 1024)
    with own_store(scene, tmp_path / "other.sqlite", "operator") as store:
        store.put_tiles([content(other, 5)])
        there = store.catalog(LAYER, other.district)
    is_refused(scene, there, f"is not in district {HOME}")
    is_refused(scene, replace(true_catalog(scene), signature=there.signature), "does not fit")
    is_refused(scene, replace(there, entries=()), "does not fit")


def test_attack_catalog_of_another_layer(scene: VersionScene) -> None:
    """The same tiles were signed in another layer; the signature says of which layer it is."""
    signing = Signing(scene.parts["operator"])
    said = true_catalog(scene)
    signature, _ = signing.sign_catalog(CatalogStatement.of("other", HOME, said.entries), "published", None)
    is_refused(scene, replace(said, signature=signature), "does not fit")


def test_attack_catalog_without_a_signature(scene: VersionScene) -> None:
    """The signature is taken off, and tiles with it; or the district is said to be empty to who has seen it."""
    said = true_catalog(scene)
    is_refused(scene, Catalog(said.entries[1:]), "nobody has signed it")
    asking = fresh(scene)
    asking.catalog(EVERYWHERE)
    is_refused(scene, Catalog(), "nobody has signed it", asking)


def test_attack_catalog_that_is_nonsense(scene: VersionScene) -> None:
    """Signatures with other lengths, numbers out of range, an unknown kind; refused as no catalog."""
    good = true_catalog(scene).encode()
    for wrong in (good[:-1], good + b"\x1a\x02\x08\x00", good + b"\x1a\x02\x18\x09", good + b"\x1a\x03\x2a\x01\x00"):
        scene.server.alter_catalog = lambda _true, wrong=wrong: _Raw(wrong)  # type: ignore[misc]
        with pytest.raises(SchemaError, match=r"[Cc]atalog"):
            fresh(scene).catalog(EVERYWHERE)


class _Raw(Catalog):
    """Bytes that are said to be a catalog."""

    def __init__(self, data: bytes) -> None:
        object.__setattr__(self, "data", data)

    def encode(self) -> bytes:
        return bytes(self.data)  # type: ignore[attr-defined]


def test_attack_watcher_and_api_of_a_lying_catalog(scene: VersionScene) -> None:
    """A watcher and a program of the API hear nothing of what a catalog invents, and go on with the true one."""
    tile = scene.tile(8)
    asking = fresh(scene)
    follower = RegionFollower(scene.watcher, {LAYER: asking}, EVERYWHERE, 0.0)
    lie = lambda said: replace(said, entries=(*said.entries[:-1], replace(said.entries[-1], version=77)))  # noqa: E731
    with Client(scene.watcher, 10.0, oldest_catalog_s=3600.0) as client:
        try:
            follower.begin()
            scene.server.alter_catalog = lie
            with pytest.raises(NotSigned):
                follower.next(0.0)
            with pytest.raises(NotSigned):
                client.catalog()
            events: list[WatchEvent] = []
            watch = TileWatch(scene.watcher, EVERYWHERE, events.append)
            assert not watch._is_proven(NewVersion(LAYER, tile, 77, None), follower)
            scene.server.alter_catalog = None
            scene.publish("shard", content(tile, 9))
            assert [one.version for one in follower.next(0.0) if one.tile == tile] == [2]
            assert client.catalog()[-1].version == 2
        finally:
            follower.close()
            client._bus = open_bus(BusConfig(connect=(scene.endpoint,), identity=scene.parts["watcher"]), name="w2")


# ---- keys that do not count


def test_attack_catalog_signed_by_who_may_not(scene: VersionScene, tmp_path: Path) -> None:
    """A catalog without a tile, signed with the tile server's own key, a vehicle's, or one of another authority."""
    said = true_catalog(scene)
    less = replace(said, entries=said.entries[1:])
    foreign = Authority(tmp_path, "authority").part("operator", "mallory")
    for folder, why in ((scene.parts["tiles"], "signs no versions"), (foreign, "not of our authority")):
        is_refused(scene, signed_by(scene, folder, less), why)
    is_refused(scene, signed_by(scene, scene.parts["vehicle"], less), "signs no versions")
    unknown = replace(less, signature=replace(said.signature, signer=bytes(8)))  # type: ignore[type-var]
    is_refused(scene, unknown, "is not known")


def test_attack_catalog_signed_with_a_key_that_had_ended(scene: VersionScene) -> None:
    """The key of a shard whose certificate ended yesterday signs today; it is judged as of the time of signing."""
    ended = scene.authority.part("shard", "ended", begins=NOW - 3 * DAY, ends=NOW - DAY)
    is_refused(scene, signed_by(scene, ended, true_catalog(scene)), "did not hold when it was signed")


def test_attack_catalog_signed_with_a_key_rotated_away(scene: VersionScene, tmp_path: Path) -> None:
    """While one root takes the place of another both count; when the old one is no longer pinned, what its shards have
    signed does not."""
    new = Authority(tmp_path / "new", "authority of next year")
    folder = new.part("vehicle", "v9")
    both = (folder / "authority.pem").read_bytes() + (scene.parts["vehicle"] / "authority.pem").read_bytes()
    said = true_catalog(scene)
    chain = load_signer(scene.parts["shard"]).chain
    catalog = signed_by(scene, scene.parts["shard"], said)

    def check() -> None:
        CatalogCheck(Publishers(folder, lambda _signer: chain), LAYER).check(LAYER, HOME, catalog)

    with pytest.raises(NotSigned, match="not of our authority"):
        check()
    (folder / "authority.pem").write_bytes(both)
    check()


def test_attack_catalog_of_a_revoked_shard(scene: VersionScene) -> None:
    """A shard was broken into and has signed a catalog without a tile; it is revoked, and within a second nothing
    counts that it has signed, back-dated or not."""
    gone, said = scene.authority.part("shard", "gone-catalogs"), true_catalog(scene)
    less = signed_by(scene, gone, replace(said, entries=said.entries[1:]), number=1000)
    scene.server.alter_catalog = lambda _true: less
    assert len(fresh(scene).catalog(EVERYWHERE)) == len(said.entries) - 1, "until somebody knows, it is a publisher"
    scene.authority.revoke(gone, *scene.parts.values())

    def why() -> str:
        try:
            fresh(scene).catalog(EVERYWHERE)
        except NotSigned as error:
            return str(error)
        return "taken"

    end_s = time.monotonic() + 10.0
    while "was revoked" not in why():
        assert time.monotonic() < end_s, "the list is not read"
        time.sleep(0.1)
    is_refused(scene, signed_by(scene, gone, replace(said, entries=said.entries[1:]), 1800.0), "was revoked")


# ---- who can write the store's file


@contextmanager
def own_store(scene: VersionScene, path: Path, name: str) -> Iterator[SqliteStore]:
    with SqliteStore(path, signing=Signing(scene.parts[name])) as store:
        yield store


def test_attack_head_set_back_in_the_store(scene: VersionScene, tmp_path: Path) -> None:
    """Somebody sets a tile back to its older version, which is rightly signed, and takes the newer one away; the next
    publication signs nothing over that, nor does who signs again in time, and clients refuse the catalog."""
    path, tiles = tmp_path / "own.sqlite", [TileId(FIRST.morton + n) for n in range(3)]
    with own_store(scene, path, "operator") as store:
        for seed in (1, 2):
            store.put_tiles([content(tile, seed) for tile in tiles])
        old = store.get(LAYER, tiles[0], 1)
        assert old is not None
        with apsw.Connection(str(path)) as file:
            file.execute("DELETE FROM tile_version WHERE tile = ? AND version = 2", (tiles[0].morton,))
            file.execute("UPDATE tile_head SET version = 1, sha = ? WHERE tile = ?", (old.sha, tiles[0].morton))
        store.put_tiles([content(tiles[1], 3)])
        check = CatalogCheck(Publishers(scene.parts["vehicle"], store.publisher_chain), LAYER)  # type: ignore[arg-type]
        with pytest.raises(NotSigned, match="does not fit"):
            check.check(LAYER, HOME, store.catalog(LAYER, HOME))
        publishers = Publishers(scene.parts["operator"])
        assert [one.status for one in answered_catalogs(store, publishers, LAYER)] == ["wrong"]
        assert "other versions were signed" in sign_whole_catalog(store, LAYER, HOME)


# ---- real processes


@pytest.mark.slow
def test_attack_shard_killed_while_a_catalog_is_due(scene: VersionScene, tmp_path: Path) -> None:
    """A map from before signatures of catalogs: clients refuse its catalog until a shard with a key has signed it. One
    that is killed (kill -9) as it starts is no hindrance: the next one signs, and a real tile server hands it out."""
    path, endpoint = tmp_path / "old.sqlite", f"tcp/127.0.0.1:{new_port()}"
    tiles = [TileId(FIRST.morton + 40 * n) for n in range(4)]
    with SqliteStore(path) as plain:
        plain.put_tiles([content(tile, 1) for tile in tiles])
    with own_store(scene, path, "operator") as store:
        sign_unsigned(store)
        assert store.catalog(LAYER, HOME).signature is None
    with (
        open_router([endpoint]),
        open_bus(BusConfig(connect=(endpoint,), identity=scene.parts["tiles"]), name="t") as tiles_bus,
        open_bus(BusConfig(connect=(endpoint,), identity=scene.parts["watcher"]), name="w") as watcher,
        SqliteStore(path, create=False) as store,
        TileServer(store, tiles_bus),
    ):
        with pytest.raises(NotSigned, match="nobody has signed it"):
            TileServerClient(watcher, LAYER, 10.0).catalog(EVERYWHERE)
        killed = shard(scene, path, endpoint, "k1")
        time.sleep(1.0)
        killed.kill()
        killed.wait()
        running = shard(scene, path, endpoint, "k2")
        try:
            end_s = time.monotonic() + 120.0
            while store.district_list(LAYER) is None:  # it comes after the catalog
                assert time.monotonic() < end_s, "no shard has signed the catalog and the list of districts"
                time.sleep(0.1)
            asking = TileServerClient(watcher, LAYER, 10.0, oldest_catalog_s=3600.0)
            assert [one.tile for one in asking.catalog(EVERYWHERE)] == tiles
            assert store.catalog(LAYER, HOME).signature.kind == "whole"  # type: ignore[union-attr]
        finally:
            running.terminate()
            running.wait(30.0)


def shard(scene: VersionScene, path: Path, endpoint: str, name: str) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "gnd.deploy.cli", "merger", "--store", str(path), "--id", name]
    command += ["--connect", endpoint, "--identity", str(scene.parts["shard"])]
    return subprocess.Popen(command, env=os.environ | {"GND_IDENTITY": ""}, stderr=subprocess.DEVNULL)
