"""Attacks on the map's versions: by a tile server that was broken into, by who can write the store's file, by a
publisher that was shut out."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import apsw
import numpy as np
import pytest
import zenoh
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from signing_scene import HOUR, NOW, Authority
from versions_scene import FIRST, LAYER, VersionScene, content, version_scene, whole, with_signature

from gnd.cloud_merger.announce import Announcer
from gnd.cloud_merger.ownership import Members
from gnd.cloud_merger.stored import Bases
from gnd.deploy.map_cli import map_group
from gnd.deploy.watch import TileWatch, WatchEvent
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import RequestFailed
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.fleet_bus.refusals import refusals
from gnd.fleet_bus.rights import REVOKED_KEY
from gnd.gnd_map.content import encode_content
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import keys
from gnd.schemas.errors import NotSigned
from gnd.schemas.keys import update_keys
from gnd.schemas.tiles import Catalog, CatalogEntry
from gnd.schemas.tiles_batch import TileAnswer
from gnd.schemas.updates import TileUpdate
from gnd.tile_client.checking import SeenInMemory, SeenVersion, VersionCheck
from gnd.tile_client.fetching import TileServerClient
from gnd.tile_client.following import NewVersion, RegionFollower
from gnd.tile_store import releasing
from gnd.tile_store import sql_catalogs as catalogs
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.connection import SqlConnection
from gnd.tile_store.errors import NotPublished, StoreDamaged
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.trials import TrialTerms
from gnd.tile_store.values import StoredTile
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.errors import CacheError
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher
from gnd.vehicle_agent.link.updates import Updates

DAY = 24 * HOUR


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[VersionScene]:
    with version_scene(tmp_path_factory.mktemp("versions")) as scene:
        yield scene


@pytest.fixture
def scene(opened: VersionScene) -> VersionScene:
    opened.server.alter = opened.server.alter_catalog = None
    return opened


def stored(scene: VersionScene, tile: TileId, version: int | None = None) -> StoredTile:
    found = scene.store.get(LAYER, tile, version)
    assert found is not None
    return found


def begin_trial(store: SqliteStore, tile: TileId, terms: TrialTerms) -> None:
    """Version 2 of a tile goes on trial, as when it is published."""

    def work(c: SqlConnection, now: int) -> None:
        with catalogs.changing(c, store.signing, LAYER, tile):
            trials.begin(c, LAYER, tile, (1, 2), terms, now)

    store.transact(work)


def until(what: str, condition: Callable[[], object], for_s: float = 20.0) -> None:
    end_s = time.monotonic() + for_s
    while not condition():
        assert time.monotonic() < end_s, what
        time.sleep(0.02)


# ---- what works


def test_versions_of_an_operator_and_of_a_shard_are_taken(scene: VersionScene) -> None:
    tile = scene.tile(1)
    client = scene.client("works")
    assert client.version(tile) == 1
    scene.publish("shard", content(tile, 2))
    outcome = client.ask(tile)
    assert {one.status for one in outcome.fetched} <= {"delta", "blob"}
    assert client.cache.head(tile)[0] == 2
    assert client.check is not None
    assert client.check.counts == {"good": 2}
    assert client.ask(tile).fetched[0].status == "unchanged"


def test_a_rollback_is_a_new_version_that_is_signed_as_one(scene: VersionScene) -> None:
    tile = scene.tile(1, 2)
    client = scene.client("rollback")
    assert client.version(tile) == 2
    with SqliteStore(scene.path, create=False, signing=Signing(scene.parts["operator"])) as store:
        back = store.rollback(LAYER, tile, 1)
    assert (back.version, back.signature.kind if back.signature else None) == (3, "rollback")
    assert client.version(tile) == 3
    assert client.cache.head(tile)[1] == stored(scene, tile, 1).sha


def test_a_client_without_identity_reads_signed_versions(scene: VersionScene) -> None:
    tile = scene.tile(1)
    with open_bus(BusConfig(connect=(scene.endpoint,), identity=None), name="plain") as plain:
        (found,) = TileServerClient(plain, LAYER, 10.0).fetch([tile])
    assert found.sha == stored(scene, tile).sha


def test_versions_stay_good_when_the_certificate_of_their_signer_has_ended(scene: VersionScene) -> None:
    tile = scene.tile(1, 2)
    with (
        SqliteStore(scene.path, create=False, signing=Signing(scene.parts["operator"])) as store,
        apsw.Connection(str(scene.path)) as file,
    ):
        past = scene.authority.part("shard", "past", begins=NOW - 3 * DAY, ends=NOW - DAY)
        at = stored(scene, tile)
        made_ns = int((NOW - 2 * DAY).timestamp()) * 10**9
        at = replace(at, created_ns=made_ns)
        signature = scene.signed_by(past, at.statement)
        chain = scene.server.chains[signature.signer.hex()]
        file.execute("INSERT INTO publisher VALUES (?, ?, 0)", (signature.signer, chain))
        row = (made_ns, signature.signer, signature.signed_s, signature.signature, tile.morton)
        file.execute(
            "UPDATE tile_version SET created_ns = ?, signer = ?, signed_s = ?, signature = ?"
            " WHERE tile = ? AND version = 2",
            row,
        )
        store.check_signed(stored(scene, tile))
    assert scene.client("ended").version(tile) == 2


def test_a_store_that_was_built_anew_counts_from_one_and_is_taken(scene: VersionScene) -> None:
    """Its versions were made later, which is what counts."""
    tile = scene.tile(1, 2, 3)
    client = scene.client("anew")
    assert client.version(tile) == 3
    new = content(tile, 4)
    at = replace(stored(scene, tile).statement, version=1, sha=new.sha, made_s=round(time.time()) + 5)
    signature = scene.signed_by(scene.parts["operator"], at)
    scene.server.alter = lambda _tile, _answer: whole(new, 1, signature)
    assert client.version(tile) == 1


def test_vehicles_on_trial_and_all_others_take_their_versions(scene: VersionScene) -> None:
    """Both are signed; who has the newer one keeps it whatever its ticket is by then, and nobody is refused."""
    tile = scene.tile(1, 2)
    with SqliteStore(scene.path, create=False, signing=Signing(scene.parts["shard"])) as store:
        begin_trial(store, tile, TrialTerms(0.5, 3600.0))
        trial = store.trials(LAYER)[tile]
        first, other = (
            next(number for number in range(1, 1000) if trial.is_among_first(number) == is_first)
            for is_first in (True, False)
        )
        on_trial, usual = scene.client("on-trial", first), scene.client("usual", other)
        assert (on_trial.version(tile), usual.version(tile)) == (2, 1)
        with_another_ticket = scene.client("on-trial", other)
        assert with_another_ticket.ask(tile).fetched[0].status == "unchanged"
        releasing.withdraw(store, trial, "s1", "vehicles fared badly")
    assert with_another_ticket.version(tile) == 3
    assert usual.ask(tile).fetched[0].status == "unchanged"  # the content that it has
    assert on_trial.cache.head(tile)[1] == usual.cache.head(tile)[1] == stored(scene, tile, 1).sha


def test_a_cache_that_cannot_remember_stops_no_drive(scene: VersionScene) -> None:
    class FullDisk(SeenInMemory):
        def note(self, tile: TileId, seen: SeenVersion) -> None:
            raise CacheError(f"{tile}: disk full")

    tile = scene.tile(1)
    check = VersionCheck.on_the_bus(scene.vehicle, LAYER, FullDisk())
    found = stored(scene, tile)
    assert check is not None
    check.check(found.decode(), found.signature)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 4)), max_size=12))
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_was_seen_only_grows_in_memory_and_on_disk(
    tmp_path_factory: pytest.TempPathFactory, told: list[tuple[int, int]]
) -> None:
    """Both remember the same: the latest time, and the highest number of that time."""
    disk: TileCache[Tile] = TileCache(tmp_path_factory.mktemp("seen") / "cache.sqlite", LAYER)
    memory = SeenInMemory()
    for made_s, version in told:
        for one in (disk, memory):
            one.note(FIRST, SeenVersion(made_s + 1, version))
    newest = max(told, default=(-1, 0))
    assert disk.seen(FIRST) == memory.seen(FIRST) == SeenVersion(newest[0] + 1, newest[1])
    disk.close()


# ---- a tile server that was broken into


def test_attack_altered_content(scene: VersionScene) -> None:
    """A broken-into tile server sends another wall, with its right hash and the old signature; no client takes it."""
    tile = scene.tile(1)
    other = content(tile, 99)
    scene.server.alter = lambda _tile, answer: whole(other, answer.version, answer.signature)
    client = scene.client("altered")
    client.refuses(tile, "does not fit")
    with pytest.raises(RequestFailed, match="does not fit"):
        list(TileServerClient(scene.watcher, LAYER, 10.0).fetch([tile]))
    scene.server.alter = None
    assert client.version(tile) == 1


def test_attack_altered_delta(scene: VersionScene) -> None:
    """It sends a difference that leads elsewhere; what comes out has no signature, and the held tile stays."""
    tile = scene.tile(1)
    client = scene.client("delta")
    assert client.version(tile) == 1
    scene.publish("shard", content(tile, 1, count=41))
    elsewhere = content(tile, 1, count=39)
    from gnd.gnd_map.content import encode_content_delta

    def lie(_tile: TileId, answer: TileAnswer) -> TileAnswer:
        body = encode_content_delta(stored(scene, tile, 1).decode(), elsewhere)
        return TileAnswer("delta", 2, elsewhere.sha[:4], 0, body, answer.day, answer.signature)

    scene.server.alter = lie
    client.refuses(tile, "does not fit")


def test_attack_older_version_after_a_newer_one(scene: VersionScene) -> None:
    """It answers with the version before, well signed; who has seen the newer one refuses, also after a restart and
    without the tile itself."""
    tile = scene.tile(1, 2)
    client = scene.client("older")
    assert client.version(tile) == 2
    old = stored(scene, tile, 1)
    scene.server.alter = lambda tile, _answer: whole(old.decode_gaussians(), 1, old.signature)
    client.refuses(tile, "older than version 2")
    client.cache.drop(tile)
    client.cache.close()
    again = scene.client("older")
    again.refuses(tile, "older than version 2")
    scene.server.alter = None
    assert again.version(tile) == 2


def test_attack_older_version_to_a_process_without_a_cache(scene: VersionScene) -> None:
    """A program of the API has seen version 2 and asks anew; version 1 is refused as long as it runs."""
    tile = scene.tile(1, 2)
    asking = TileServerClient(scene.watcher, LAYER, 10.0)
    assert [one.version for one in asking.fetch([tile])] == [2]
    old = stored(scene, tile, 1)
    scene.server.alter = lambda tile, _answer: whole(old.decode_gaussians(), 1, old.signature)
    with pytest.raises(RequestFailed, match="older than version 2"):
        list(asking.fetch([tile]))


def test_attack_older_version_after_the_notice_of_a_newer_one(scene: VersionScene) -> None:
    """A shard's notice has told of version 2, and the tile server goes on with version 1; it is refused."""
    tile = scene.tile(1)
    client, parameters = scene.client("noticed"), DownloadParameters()
    assert client.version(tile) == 1
    old = stored(scene, tile, 1)
    scene.publish("shard", content(tile, 2))
    new = stored(scene, tile, 2)
    scene.server.alter = lambda tile, _answer: whole(old.decode_gaussians(), 1, old.signature)
    fetcher: TileFetcher[Tile] = TileFetcher(scene.vehicle, client.cache, parameters)
    updates: Updates[Tile] = Updates(scene.vehicle, client.cache, fetcher, lambda _tile: None)
    try:
        updates.follow([tile])
        notice = TileUpdate(tile, LAYER, 2, 1, new.sha, old.sha, "base", made_s=new.created_ns // 10**9, put_count=1)
        with open_bus(BusConfig(connect=(scene.endpoint,), identity=scene.parts["shard"]), name="s1") as shard:
            from gnd.schemas.keys import update_key

            publisher = shard.advanced_publisher(update_key(LAYER, tile))

            def noticed() -> bool:
                publisher.put(notice.encode(), tile=tile)
                time.sleep(0.05)
                updates.apply()
                return updates.counts["received"] > 0

            until("the notice is heard", noticed)
    finally:
        fetcher.close()
        updates.close()
    client.cache.drop(tile)
    client.refuses(tile, "older than version 2")


def test_attack_version_of_another_tile(scene: VersionScene) -> None:
    """It answers with a neighbour's content and signature, or the neighbour's signature alone; both are refused."""
    tile, neighbour = scene.tile(1), scene.tile(2)
    other = stored(scene, neighbour)
    same = Tile(tile, 1, other.decode_gaussians().gaussians)
    scene.server.alter = lambda _tile, _answer: whole(same, 1, other.signature)
    scene.client("another").refuses(tile, "does not fit")
    scene.server.alter = lambda _tile, answer: replace(answer, signature=other.signature)
    scene.client("another").refuses(tile, "does not fit")


def test_attack_versions_swapped_between_districts_of_one_question(scene: VersionScene) -> None:
    """It answers for two districts at once, and gives each the other's version, an altered or an older one."""
    here = scene.tile(1, 2)
    there = TileId(here.morton + 1024)
    for part, seed in (("operator", 3), ("shard", 4)):
        scene.publish(part, content(there, seed))
    client, both = scene.client("two districts"), [here, there]

    def said(tile: TileId, of: TileId, version: int) -> TileAnswer:
        found = stored(scene, of, version)
        return whole(content(tile, {here: 1, there: 3}[of] + version - 1), version, found.signature)

    others = {here: there, there: here}
    for alter in (
        lambda tile, _: said(tile, others[tile], 2),
        lambda tile, answer: replace(answer, signature=stored(scene, others[tile]).signature),
        lambda tile, answer: replace(answer, signature=None),
    ):
        scene.server.alter = alter
        outcome = client.exchange.ask(both, (), 1_000_000)
        assert outcome.wrong.keys() == set(both)
        assert (outcome.fetched, outcome.unanswered) == ([], [])
        assert [client.cache.head(tile) for tile in both] == [(0, b"")] * 2
    scene.server.alter = None
    assert {one.tile_id for one in client.exchange.ask(both, (), 1_000_000).fetched} == set(both)
    scene.server.alter = lambda tile, _: said(tile, tile, 1)
    outcome = client.exchange.ask(both, both, 1_000_000)
    assert all("older than version 2" in outcome.wrong[tile] for tile in both)
    assert [client.cache.head(tile)[0] for tile in both] == [2, 2]


def test_attack_signature_of_who_signs_no_versions(scene: VersionScene) -> None:
    """It lets a vehicle, itself, and a shard of a foreign authority sign; their certificates are shown, and refused."""
    tile = scene.tile(1)
    wall = content(tile, 99)
    foreign = Authority(scene.folder / "foreign").part("shard", "s1")
    client = scene.client("signers")
    for folder in (scene.parts["vehicle"], scene.parts["tiles"], foreign):
        at = stored(scene, tile)
        signature = scene.signed_by(folder, replace(at.statement, sha=wall.sha, version=2))
        scene.server.alter = lambda _tile, _answer, of=signature: whole(wall, 2, of)  # type: ignore[misc]
        client.refuses(tile, "is not of our authority" if folder is foreign else "signs no versions")


def test_attack_certificate_under_another_name(scene: VersionScene) -> None:
    """It signs with a key of its own and shows the shard's certificate under that id; ids are hashes, so none fits."""
    tile = scene.tile(1)
    wall = content(tile, 99)
    foreign = Authority(scene.folder / "renamed").part("shard", "s1")
    signature = scene.signed_by(foreign, replace(stored(scene, tile).statement, sha=wall.sha))
    scene.client("warm").ask(tile)
    known = stored(scene, tile).signature
    assert known is not None
    chain = scene.store.publisher_chain(known.signer)
    assert chain is not None
    scene.server.chains[signature.signer.hex()] = chain
    scene.server.alter = lambda _tile, _answer: whole(wall, 1, signature)
    scene.client("renamed").refuses(tile, "asked for the certificate")


def test_attack_signature_moved_elsewhere(scene: VersionScene) -> None:
    """It keeps the signature and changes version, kind, day, or one of the times; each is part of what is signed."""
    tile = scene.tile(1, 2)
    client = scene.client("moved")
    lies: list[Callable[[TileAnswer], TileAnswer]] = [
        lambda answer: replace(answer, version=answer.version + 1),
        lambda answer: with_signature(answer, kind="merged"),
        lambda answer: with_signature(answer, kind="rollback"),
        lambda answer: replace(answer, day=answer.day + 1),
        lambda answer: with_signature(answer, made_s=answer.signature.made_s - 1 if answer.signature else 0),
        lambda answer: with_signature(answer, signed_s=answer.signature.signed_s + 1 if answer.signature else 0),
    ]
    for lie in lies:
        scene.server.alter = lambda _tile, answer, of=lie: of(answer)  # type: ignore[misc]
        client.refuses(tile, "does not fit")


def test_attack_signature_moved_to_another_layer(scene: VersionScene) -> None:
    """It serves a version of one layer in another; the layer's name is signed, too."""
    tile = scene.tile(1)
    with SqliteStore(scene.path, create=False, signing=Signing(scene.parts["operator"])) as store:
        store.put_tiles([content(tile, 1)], layer="ndt_winter")
        winter = store.get("ndt_winter", tile)
    assert winter is not None
    assert winter.sha == stored(scene, tile).sha
    scene.server.alter = lambda _tile, answer: replace(answer, signature=winter.signature)
    scene.client("layer").refuses(tile, "does not fit")


def test_attack_stripped_signature(scene: VersionScene) -> None:
    """It leaves the signature out, as if nobody signed in this fleet; a client with an identity demands one."""
    tile = scene.tile(1)
    scene.server.alter = lambda _tile, answer: replace(answer, signature=None)
    client = scene.client("stripped")
    client.refuses(tile, "nobody has signed it")
    assert client.check is not None
    assert client.check.counts["unsigned"] == 1


def test_attack_broken_signatures(scene: VersionScene) -> None:
    """It flips bits of r and s, swaps them, sends zeros and ones; none is a signature."""
    tile = scene.tile(1)
    signed = stored(scene, tile).signature
    assert signed is not None
    rng, client = np.random.default_rng(7), scene.client("bits")
    forged = [bytes(64), b"\xff" * 64, signed.signature[32:] + signed.signature[:32]]
    for _ in range(8):
        bits = np.unpackbits(np.frombuffer(signed.signature, np.uint8))
        bits[rng.integers(512)] ^= 1
        forged.append(np.packbits(bits).tobytes())
    for one in forged:
        scene.server.alter = lambda _tile, answer, of=one: with_signature(answer, signature=of)  # type: ignore[misc]
        client.refuses(tile, "does not fit")


def test_attack_version_of_four_thousand_million(scene: VersionScene) -> None:
    """It names version 4,000,000,000, so that the next true one would look old; without a signature over that number
    it is refused, and the next true version is taken."""
    tile = scene.tile(1)
    client = scene.client("jump")
    assert client.version(tile) == 1
    wall = content(tile, 99)
    signed = stored(scene, tile).signature
    scene.server.alter = lambda _tile, _answer: whole(wall, 4_000_000_000, signed)
    client.refuses(tile, "does not fit")
    scene.server.alter = None
    scene.publish("shard", content(tile, 2))
    assert client.version(tile) == 2


def test_attack_catalog_that_lies(scene: VersionScene) -> None:
    """Its catalog names version 4,000,000,000 of a tile; a watcher refuses all of it, and does not miss the next true
    version for it. A version that a catalog names is still fetched before it is reported."""
    tile, region = scene.tile(1), Region(prefix=FIRST.district.path)
    asking = TileServerClient(scene.watcher, LAYER, 10.0)
    follower = RegionFollower(scene.watcher, {LAYER: asking}, region, 0.0)
    try:
        follower.begin()
        assert (LAYER, tile) not in follower.known
        scene.server.alter_catalog = lambda said: replace(
            said,
            entries=tuple(replace(one, version=4_000_000_000) if one.tile == tile else one for one in said.entries),
        )
        with pytest.raises(NotSigned, match="does not fit"):
            follower.next(0.0)
        events: list[WatchEvent] = []
        watch = TileWatch(scene.watcher, region, events.append)
        assert not watch._is_proven(NewVersion(LAYER, tile, 4_000_000_000, None), follower)
        scene.server.alter_catalog = None
        scene.publish("shard", content(tile, 2))
        (true,) = [one for one in follower.next(0.0) if one.tile == tile]
        assert true.version == 2
        assert watch._is_proven(true, follower)
    finally:
        follower.close()


def test_attack_catalog_that_goes_back(scene: VersionScene, caplog: pytest.LogCaptureFixture) -> None:
    """Its catalog is a true one of before; who has seen a newer one refuses it by name, and who has only fetched the
    tile, or heard the shard's notice of it, notices and counts it."""
    tile, heard = scene.tile(1), scene.tile(2)
    region, asking = Region(prefix=FIRST.district.path), TileServerClient(scene.watcher, LAYER, 10.0)
    old = scene.store.catalog(LAYER, FIRST.district)
    scene.publish("shard", content(tile, 4))
    new_tile = scene.tile(3)
    assert len(list(asking.fetch([tile, new_tile]))) == 2
    new = stored(scene, heard)
    made_s = new.created_ns // 10**9 + 1
    asking.note_announced(TileUpdate(heard, LAYER, 2, 1, bytes(32), new.sha, "base", made_s=made_s, put_count=1))
    before = refusals()
    scene.server.alter_catalog = lambda _said: old
    with caplog.at_level("WARNING"):
        asking.catalog(region)
    assert asking.behind == {tile: 1, heard: 1, new_tile: None}
    assert "goes back behind what was seen of 3 tiles" in caplog.text
    scene.server.alter_catalog = None
    assert asking.catalog(region)[-1].tile == new_tile
    assert asking.behind == {heard: 1}, "the notice's version has not come"
    scene.server.alter_catalog = lambda _said: old
    with pytest.raises(NotSigned, match=r"number \d+ was signed \d+ s before number \d+, which was seen before"):
        asking.catalog(region)
    assert list(asking.refused) == [FIRST.district]
    for reason, n in (("older", 4), ("left out", 1)):  # two tiles, one of them twice, and a catalog are older
        assert refusals()["catalog", reason] - before.get(("catalog", reason), 0) == n
    on_trial = TileServerClient(scene.watcher, LAYER, 10.0, newest=True)
    list(on_trial.fetch([tile]))
    on_trial.catalog(region)
    assert on_trial.behind == {}, "a catalog names what is released"


def test_attack_catalog_of_a_router(scene: VersionScene) -> None:
    """Somebody without a tile server's certificate answers for the catalog, also with one that was true before."""
    tile = scene.tile(1)
    kept: list[tuple[str, bytes, bytes]] = []
    with zenoh.open(zenoh_config(BusConfig(connect=(scene.endpoint,)))) as stranger:
        for reply in stranger.get(f"gnd/v1/catalog/{LAYER}/**", payload=b""):
            assert reply.ok is not None
            seal = b"" if reply.ok.attachment is None else reply.ok.attachment.to_bytes()
            kept.append((str(reply.ok.key_expr), reply.ok.payload.to_bytes(), seal))
        assert kept
        forged = Catalog((CatalogEntry(tile, 77, bytes(32)),)).encode()
        said = [*kept, (keys.catalog_key(LAYER, tile.district), forged, b"")]

        def answer(query: zenoh.Query) -> None:
            with query:
                for key, payload, seal in said:
                    query.reply(key, payload, attachment=seal or None)

        queryable = stranger.declare_queryable("gnd/v1/catalog/**", answer)
        try:
            time.sleep(0.5)
            scene.publish("shard", content(tile, 2))
            asking = TileServerClient(scene.watcher, LAYER, 10.0)
            found = {one.tile: one.version for one in asking.catalog(Region(prefix=""))}
            assert found[tile] == 2
        finally:
            queryable.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub


def test_attack_version_from_the_future(scene: VersionScene) -> None:
    """A publisher's key signs for tomorrow, so that all true versions would look old; a client refuses the future."""
    tile = scene.tile(1)
    at = replace(stored(scene, tile).statement, made_s=round(time.time()) + 1800)
    signature = scene.signed_by(scene.parts["shard"], at)
    scene.server.alter = lambda _tile, answer: replace(answer, signature=signature)
    scene.client("future").refuses(tile, "check the clocks")


def test_attack_signature_after_the_certificate_had_ended(scene: VersionScene) -> None:
    """Somebody has found the key of a shard whose certificate ended yesterday, and signs today; the time is judged."""
    tile = scene.tile(1)
    past = scene.authority.part("shard", "found", begins=NOW - 3 * DAY, ends=NOW - DAY)
    wall = content(tile, 99)
    signature = scene.signed_by(past, replace(stored(scene, tile).statement, sha=wall.sha))
    scene.server.alter = lambda _tile, _answer: whole(wall, 1, signature)
    scene.client("late").refuses(tile, "did not hold when it was signed")


# ---- who can write the store's file


def edited(scene: VersionScene, tile: TileId, tile_content: Tile) -> None:
    """The head's body and hash are exchanged, as by somebody with the file."""
    codec_id, body = encode_content(tile_content)
    version = stored(scene, tile).version
    with apsw.Connection(str(scene.path)) as file:
        file.execute(
            "UPDATE tile_version SET sha = ?, codec_id = ?, body = ?, size_bytes = ? WHERE tile = ? AND version = ?",
            (tile_content.sha, codec_id, body, len(body), tile.morton, version),
        )
        file.execute("UPDATE tile_head SET sha = ? WHERE tile = ?", (tile_content.sha, tile.morton))


def test_attack_edited_store(scene: VersionScene) -> None:
    """Somebody exchanges body and hash in the store's file; clients refuse the tile, a shard builds nothing on it, and
    `gnd map verify --signatures` names it."""
    tile = scene.tile(1)
    edited(scene, tile, content(tile, 99))
    scene.client("edited").refuses(tile, "does not fit")
    with SqliteStore(scene.path, create=False, signing=Signing(scene.parts["shard"])) as shard:
        with pytest.raises(StoreDamaged, match="does not fit"):
            shard.rollback(LAYER, tile, 1)
        with pytest.raises(StoreDamaged, match="does not fit"):
            shard.check_signed(stored(scene, tile))
    told = run(scene, "verify", "--signatures", "--region", tile.path)
    assert told.exit_code == 1
    assert f"{tile.path} version 1 wrong: the signature of operator o1 does not fit" in told.output
    resigned = run(scene, "sign", "--region", tile.path)
    assert resigned.exit_code == 1, resigned.output
    assert "does not fit" in resigned.output


def test_attack_edited_store_is_announced(scene: VersionScene) -> None:
    """Somebody writes a version and its notice into the file, for a shard to seal; the shard announces what is signed,
    and nothing else."""
    tile = scene.tile(1, 2)
    edited(scene, tile, content(tile, 99))
    other = scene.tile(3, 4)
    heard: list[TileUpdate] = []
    folder = scene.parts["shard"]
    with (
        SqliteStore(scene.path, create=False, signing=Signing(folder)) as store,
        open_bus(BusConfig(connect=(scene.endpoint,), identity=folder), name="s1") as shard,
        scene.vehicle.subscribe(
            update_keys(LAYER, ""), lambda _key, payload: heard.append(TileUpdate.decode(payload)), history=True
        ),
    ):
        announcer = Announcer(store, shard, Members("s1"), Bases(store))
        until("all are announced", lambda: announcer.announce(1000) == 0 and not store.notices())
        until("the good one is heard", lambda: other in {one.tile for one in heard})
    assert tile not in {one.tile for one in heard}


def test_attack_publication_without_identity(scene: VersionScene) -> None:
    """A program without an identity publishes into a signed store; nothing is written, and it says what to do."""
    tile = scene.tile(1)
    with SqliteStore(scene.path, create=False) as plain, pytest.raises(NotPublished, match="--identity FOLDER"):
        plain.put_tiles([content(tile, 2)])
    assert stored(scene, tile).version == 1


# ---- a publisher that was shut out


def test_attack_revoked_shard(scene: VersionScene) -> None:
    """A shard was broken into and is revoked; within a second of hearing of it nothing counts that it has signed, at
    whatever time it claims, until an operator has signed what he vouches for."""
    gone = scene.authority.part("shard", "gone")
    scene.parts["gone"] = gone
    tile = scene.tile(1)
    scene.publish("gone", content(tile, 2))
    client = scene.client("revoked")
    assert client.version(tile) == 2
    scene.authority.revoke(gone, scene.parts["operator"])
    follow_revoked(scene.vehicle)
    listed_as = (scene.parts["operator"] / "revoked.pem").read_bytes()

    def is_heard() -> bool:
        scene.watcher.publish(REVOKED_KEY, listed_as, kind="control")
        time.sleep(0.05)
        return (scene.parts["vehicle"] / "revoked.pem").exists()

    until("the list is heard", is_heard)

    def is_refused() -> bool:
        client.cache.drop(tile)
        return "was revoked" in client.ask(tile).wrong.get(tile, "")

    until("it is refused", is_refused)
    back_dated = scene.signed_by(gone, replace(stored(scene, tile).statement, made_s=int(NOW.timestamp()) - 1800))
    scene.server.alter = lambda _tile, answer: replace(answer, signature=back_dated)
    client.refuses(tile, "was revoked")
    scene.server.alter = None
    listed = run(scene, "verify", "--signatures", "--region", tile.path)
    assert (listed.exit_code, "revoked" in listed.output) == (1, True)
    assert run(scene, "sign", "--region", tile.path).exit_code == 1  # a base cannot be computed anew
    signed = run(scene, "sign", "--region", tile.path, "--unchecked")
    assert signed.exit_code == 0, signed.output
    assert client.version(tile) == 2
    good = run(scene, "verify", "--signatures", "--region", tile.path)
    assert (good.exit_code, "operator o1" in good.output) == (0, True), good.output


def run(scene: VersionScene, command: str, *options: str):  # type: ignore[no-untyped-def]
    """`gnd map COMMAND STORE` as the operator."""
    arguments = [command, str(scene.path), "--identity", str(scene.parts["operator"]), *options]
    from unittest.mock import patch

    with patch.dict("os.environ"):
        return CliRunner().invoke(map_group, arguments)
