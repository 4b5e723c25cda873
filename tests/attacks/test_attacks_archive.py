"""A mirror of an archive that forges, cuts off, rolls back and never ends: a clear error, and nothing is lost."""

import resource
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path

import archive_mirror as mirrors
import pytest
from archive_mirror import Answer, Mirror, mirror_of
from signing_scene import Authority
from versions_scene import FIRST, LAYER, content

from gnd.deploy.archive_fetch import ArchiveFetcher, FetchedArchive
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.archive import (
    ROOT_NAME,
    ArchiveEntry,
    ArchiveIndex,
    ArchiveRoot,
    Pack,
    certificate_name,
    index_name,
    pack_name,
)
from gnd.schemas.archive_seal import digest_of_index, with_seal
from gnd.schemas.limits import MAX_ARCHIVE_INDEX_BYTES, MAX_ARCHIVE_ROOT_BYTES
from gnd.tile_client import http_reader
from gnd.tile_client.archive import Archive, ArchiveTiles
from gnd.tile_client.archive_check import SeenStates
from gnd.tile_client.checking import VersionCheck
from gnd.tile_client.errors import ArchiveAway, ArchiveError, ArchiveWrong
from gnd.tile_client.http_reader import PATIENT, Patience
from gnd.tile_store import sql_catalogs as catalogs
from gnd.tile_store.objects import FolderObjects
from gnd.tile_store.publishing import publish
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.link.cache import TileCache

TILES = [TileId(FIRST.morton + n) for n in range(4)]
INDEX = index_name(LAYER, FIRST.district)


@dataclass
class ArchiveScene:
    """An archive with two versions of each tile, its hostile mirror, and a client that holds the newer ones."""

    folder: Path
    parts: dict[str, Path]
    old: FolderObjects
    new: FolderObjects
    mirror: Mirror
    client: SqliteStore
    patience: Patience = PATIENT
    seen: SeenStates = field(default_factory=SeenStates)

    def fetch(self, *, is_believing: bool = False, oldest_s: float | None = None) -> FetchedArchive:
        with Archive(self.mirror.url, patience=self.patience) as archive:
            publishers = None if is_believing else Publishers(self.parts["vehicle"], archive.fetch_certificate)
            return ArchiveFetcher(archive, self.client, publishers, self.seen, oldest_s).fetch((), Region(""))

    def serve(self, objects: FolderObjects) -> None:
        self.mirror.folder = Path(objects.location)

    def index(self, objects: FolderObjects) -> ArchiveIndex:
        data = objects.get(INDEX)
        assert data is not None
        return ArchiveIndex.decode(data)

    def put_index(self, objects: FolderObjects, index: ArchiveIndex, signer: str = "operator") -> None:
        """Write an index as somebody would who has that identity, and the root that names it."""
        signing, root = Signing(self.parts[signer]), ArchiveRoot.decode(objects.get(ROOT_NAME) or b"")
        before = self.index(objects).sealed
        assert before is not None
        assert root.sealed is not None
        seal, _ = signing.seal("index", index.encode(), before.seal.archive, before.seal)
        objects.put(INDEX, with_seal("index", index.encode(), seal, MAX_ARCHIVE_INDEX_BYTES))
        digest = digest_of_index(sha256(index.encode()).digest())
        body = ArchiveRoot(root.districts, {LAYER: (digest,)}).encode()
        seal, _ = signing.seal("root", body, root.sealed.seal.archive, root.sealed.seal)
        objects.put(ROOT_NAME, with_seal("root", body, seal, MAX_ARCHIVE_ROOT_BYTES))


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    authority = Authority(tmp_path_factory.mktemp("parts"))
    found = {role: authority.part(role, f"{role}1") for role in ("operator", "vehicle", "tiles")}
    foreign = Authority(tmp_path_factory.mktemp("foreign"))
    return found | {"foreign": foreign.part("operator", "mallory")}


@pytest.fixture
def scene(tmp_path: Path, parts: dict[str, Path]) -> Iterator[ArchiveScene]:
    old, new = FolderObjects(tmp_path / "old"), FolderObjects(tmp_path / "new")
    with SqliteStore(tmp_path / "map.sqlite", signing=Signing(parts["operator"])) as store:
        for objects, seed in ((old, 1), (new, 100)):
            store.put_tiles([content(tile, seed + n) for n, tile in enumerate(TILES)])
            if objects is new:  # the same archive, later
                shutil.copytree(old.location, new.location, dirs_exist_ok=True)
            publish(store, objects, [LAYER], signing=Signing(parts["operator"]))
    with SqliteStore(tmp_path / "client.sqlite") as client, mirror_of(tmp_path / "new") as mirror:
        yield ArchiveScene(tmp_path, parts, old, new, mirror, client)


def test_the_mirror_itself_is_good(scene: ArchiveScene) -> None:
    done = scene.fetch()
    assert (done.fetched, done.wrong) == (4, {})


def test_an_older_state_takes_nothing_away(scene: ArchiveScene) -> None:
    scene.fetch()
    before = scene.client.heads()
    scene.serve(scene.old)
    scene.seen = SeenStates()  # what was seen of the archive is lost; the tiles are not
    done = scene.fetch()
    assert len(done.wrong) == 4
    assert all("version 1 is offered, version 2 is here" in why for why in done.wrong.values())
    assert scene.client.heads() == before
    assert scene.fetch(is_believing=True).wrong.keys() == done.wrong.keys()  # so far also without an authority


def test_an_old_version_under_a_new_number_is_refused(scene: ArchiveScene) -> None:
    """The index names version 3; what lies there is the old content, rightly signed as version 1."""
    scene.fetch()
    before = scene.client.heads()
    index = scene.index(scene.old)
    entries = tuple(ArchiveEntry(e.tile, 3, e.hash, e.signed, e.pack, e.start, e.size) for e in index.entries)
    scene.put_index(scene.old, ArchiveIndex(LAYER, index.district, entries))
    scene.serve(scene.old)
    scene.seen = SeenStates()
    assert all("another tile or version lies there" in why for why in scene.fetch().wrong.values())
    assert scene.client.heads() == before


def forged(scene: ArchiveScene, signer: str | None) -> FetchedArchive:
    """An archive of another world, version 3, its tiles signed by who may not, or by nobody; index and root are signed
    by an operator who was deceived.
    """
    objects = FolderObjects(scene.folder / "forged")
    signing = None if signer is None else Signing(scene.parts[signer])
    with SqliteStore(scene.folder / "forged.sqlite", signing=signing) as store:
        for seed in (1, 2, 3):
            store.put_tiles([content(tile, 1000 + seed) for tile in TILES])
        if signer is not None:  # an operator's own look: the catalog is not that of a publisher
            done = publish(store, objects, [LAYER], signing=Signing(scene.parts["operator"]))
            assert (done.written, list(done.damaged)) == (0, [f"{LAYER} {FIRST.district.path}"])
            store.transact(lambda c, _now: catalogs.forget(c, LAYER, FIRST.district))
        publish(store, objects, [LAYER], signing=Signing(scene.parts["operator"]))
    scene.serve(objects)
    return scene.fetch()


@pytest.mark.parametrize(
    ("signer", "why"), [("foreign", "not of our authority"), (None, "nobody has signed it")], ids=["foreign", "nobody"]
)
def test_another_world_is_refused(scene: ArchiveScene, signer: str | None, why: str) -> None:
    scene.fetch()
    before = scene.client.heads()
    done = forged(scene, signer)
    assert len(done.wrong) == 4
    assert why in next(iter(done.wrong.values()))
    assert scene.client.heads() == before


def test_a_good_signature_over_other_content_is_refused(scene: ArchiveScene) -> None:
    """The pack holds, under the signature of one tile, what lies in another one; the index is made to fit."""
    index = scene.index(scene.new)
    first, second = index.entries[:2]
    entries = (
        ArchiveEntry(first.tile, 2, second.hash, second.signed, second.pack, second.start, second.size),
        *index.entries[1:],
    )
    scene.put_index(scene.new, ArchiveIndex(LAYER, index.district, entries))
    done = scene.fetch()
    assert list(done.wrong) == [f"{LAYER} {first.tile.path}"]
    assert "another tile or version lies there" in done.wrong[f"{LAYER} {first.tile.path}"]
    assert done.fetched == 3


def test_flipped_bits_are_found_also_without_an_authority(scene: ArchiveScene) -> None:
    scene.mirror.wrong["pack/"] = mirrors.flipped
    done = scene.fetch(is_believing=True)
    assert done.fetched + len(done.wrong) == 4
    assert len(done.wrong) >= 3
    scene.mirror.wrong.clear()
    assert scene.fetch(is_believing=True).wrong == {}
    assert len(scene.client.heads()) == 4


def test_an_index_of_another_district_is_refused(scene: ArchiveScene) -> None:
    index = scene.index(scene.new)
    elsewhere = TileId(FIRST.morton + 1024).district
    moved = ArchiveIndex(LAYER, elsewhere, ()).encode()
    scene.mirror.wrong["index/"] = mirrors.instead(moved)
    with pytest.raises(ArchiveWrong, match="is that of"):
        scene.fetch()
    assert index.entries


def test_a_pack_that_is_not_there_is_an_error(scene: ArchiveScene) -> None:
    gone = Pack(sha256(b"gone").digest(), 1000)
    index = scene.index(scene.new)
    entries = tuple(ArchiveEntry(e.tile, 2, e.hash, e.signed, gone, 0, 500) for e in index.entries)
    scene.put_index(scene.new, ArchiveIndex(LAYER, index.district, entries))
    with pytest.raises(ArchiveAway, match=f"{pack_name(gone.sha)}: not there, though an index names it"):
        scene.fetch()


@pytest.fixture
def hurried(scene: ArchiveScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same rules with shorter times."""
    scene.patience = Patience(2, 0.3)
    monkeypatch.setattr(http_reader, "LEAST_RATE", 1e9)
    monkeypatch.setattr(http_reader, "FIRST_PAUSE_S", 0.01)


WAYS = {
    "cut off": (mirrors.cut_off, ArchiveAway, "IncompleteRead|cut off"),
    "told too long": (mirrors.told_too_long, ArchiveWrong, "at most .* can be right"),
    "endless": (mirrors.endless, ArchiveWrong, "more than the .* bytes that can be right"),
    "dripping": (mirrors.dripping, ArchiveAway, "not done within"),
    "dripping head": (mirrors.dripping_head, ArchiveAway, "not done within"),
    "endless head": (mirrors.endless_head, ArchiveAway, "more than 100 headers"),
    "encoded": (mirrors.encoded, ArchiveWrong, "comes encoded"),
    "moved": (mirrors.moved, ArchiveWrong, r"moved \(302\); nothing is followed"),
    "broken": (mirrors.broken, ArchiveAway, "the server says 503"),
    "nonsense": (mirrors.nonsense, ArchiveAway, "BadStatusLine|SSH-2.0"),
}


@pytest.mark.parametrize("where", ["archive.gnd", "index/", "pack/"])
@pytest.mark.parametrize("way", WAYS)
def test_wrong_answers_are_clear_errors_within_bounds(scene: ArchiveScene, hurried: None, way: str, where: str) -> None:
    answer, kind, why = WAYS[way]
    scene.mirror.wrong[where] = answer
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(kind, match=why) as caught:
        scene.fetch()
    assert f"{scene.mirror.url}/{where}" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB
    assert scene.client.heads() == []
    scene.mirror.wrong.clear()
    assert scene.fetch().fetched == 4  # and it works again as soon as the mirror does


@pytest.mark.parametrize("answer", [mirrors.shorter, mirrors.a_page], ids=["shorter", "a page"])
@pytest.mark.parametrize("where", ["archive.gnd", "index/", "pack/"])
def test_other_bytes_are_clear_errors(scene: ArchiveScene, hurried: None, answer: Answer, where: str) -> None:
    scene.mirror.wrong[where] = answer
    with pytest.raises(ArchiveError):
        scene.fetch()
    assert scene.client.heads() == []


def test_another_range_than_asked_for_is_refused(scene: ArchiveScene, hurried: None) -> None:
    scene.mirror.wrong["pack/"] = mirrors.other_range
    with pytest.raises(ArchiveWrong, match=r"asked for bytes 0-\d+/\d+, got 'bytes 0-9/"):
        scene.fetch()


def test_a_server_without_ranges_will_do(scene: ArchiveScene) -> None:
    scene.mirror.wrong["pack/"] = lambda handler, data: handler.whole(data)
    assert scene.fetch().fetched == 4


def test_what_came_before_it_failed_is_kept(scene: ArchiveScene, hurried: None) -> None:
    """The second pack never comes; the first one is in the store."""
    with SqliteStore(scene.folder / "map.sqlite", signing=Signing(scene.parts["operator"])) as store:
        store.put_tiles([content(TILES[0], 500)])
        publish(store, scene.new, [LAYER], signing=Signing(scene.parts["operator"]))
    packs = sorted(scene.index(scene.new).packs, key=lambda pack: pack.sha)
    assert len(packs) == 2
    scene.mirror.wrong[pack_name(packs[1].sha)] = mirrors.broken
    with pytest.raises(ArchiveAway):
        scene.fetch()
    kept = len(scene.client.heads())
    assert 0 < kept < 4
    scene.mirror.wrong.clear()
    done = scene.fetch()
    assert (done.unchanged, done.fetched) == (kept, 4 - kept)


def test_attack_a_mirror_goes_back_to_an_older_state(scene: ArchiveScene, tmp_path: Path) -> None:
    """A mirror goes back to an older state of the archive; who has seen the newer one refuses it by name, also after a
    new start, before a tile is looked at.
    """
    kept = tmp_path / "archives_seen.json"
    scene.seen = SeenStates(kept)
    scene.fetch()
    before = scene.client.heads()
    scene.serve(scene.old)
    scene.seen = SeenStates(kept)
    with pytest.raises(ArchiveWrong, match=r"archive\.gnd: an older state: number 1, signed .* number 2"):
        scene.fetch()
    assert scene.client.heads() == before
    assert scene.fetch(is_believing=True).wrong, "without an authority the numbers of the tiles are all there is"


def test_attack_an_old_index_under_the_root_of_now(scene: ArchiveScene) -> None:
    """A mirror keeps one district at an older state under the root of now; the root names another index."""
    old = scene.old.get(INDEX)
    assert old is not None
    time.sleep(1.1)
    with SqliteStore(scene.folder / "map.sqlite", signing=Signing(scene.parts["operator"])) as store:
        publish(store, scene.new, [LAYER], signing=Signing(scene.parts["operator"]))
    scene.mirror.wrong["index/"] = mirrors.instead(old)
    with pytest.raises(ArchiveWrong, match=r"not the index that the archive's root names, and signed \d+ s before"):
        scene.fetch()
    assert scene.client.heads() == []


def test_a_publisher_at_work_is_no_attack(scene: ArchiveScene) -> None:
    """Indexes are written before the root: one that is newer than the root is taken."""
    root = scene.old.get(ROOT_NAME)
    assert root is not None
    scene.mirror.wrong["archive.gnd"] = mirrors.instead(root)
    assert scene.fetch().fetched == 4


def test_attack_an_index_is_withheld(scene: ArchiveScene) -> None:
    """A mirror says that a district's index is not there; the root names it, so this is told."""
    scene.mirror.wrong["index/"] = lambda handler, _data: handler.whole(b"", status=404)
    with pytest.raises(ArchiveAway, match=r"not there, though the root names it: withheld"):
        scene.fetch()


@pytest.mark.parametrize("where", ["archive.gnd", "index/"])
@pytest.mark.parametrize("what", ["left out", "unsigned", "more behind", "more between", "seal cut", "bit", "number"])
def test_attack_altered_by_the_mirror(scene: ArchiveScene, where: str, what: str) -> None:
    """A mirror leaves tiles or districts out, takes the seal off, adds bytes to it, or alters its number."""
    name = ROOT_NAME if where == "archive.gnd" else INDEX
    data = scene.new.get(name)
    assert data is not None
    kind = ArchiveRoot if name == ROOT_NAME else ArchiveIndex
    one = kind.decode(data)
    assert one.sealed is not None
    body, seal = one.encode(), one.sealed.seal
    part, limit = one.sealed.part, MAX_ARCHIVE_ROOT_BYTES
    empty = (ArchiveRoot() if isinstance(one, ArchiveRoot) else replace(one, entries=one.entries[:-1])).encode()
    altered = {
        "left out": with_seal(part, empty, seal, limit),
        "unsigned": body,
        "more behind": data + b"\x0a\x00",
        "more between": body + b"\x0a\x00" + data[len(body) :],
        "seal cut": data[:-1],
        "bit": bytes([*data[:-30], data[-30] ^ 1, *data[-29:]]),
        "number": with_seal(part, body, replace(seal, number=seal.number + 7, signed_s=seal.signed_s + 1), limit),
    }[what]
    scene.mirror.wrong[where] = mirrors.instead(altered)
    why = {"unsigned": "nobody has signed it", "seal cut": "truncated", "bit": "does not fit|signed|archive seal|known"}
    with pytest.raises(ArchiveError, match=why.get(what, "does not fit|are not signed")):
        scene.fetch()
    assert scene.client.heads() == []


def test_attack_the_seal_of_an_index_under_a_root(scene: ArchiveScene) -> None:
    """A true seal over the same bytes, made for an index, is put under the root; a seal says what it is of."""
    root = ArchiveRoot.decode(scene.new.get(ROOT_NAME) or b"")
    assert root.sealed is not None
    seal, _ = Signing(scene.parts["operator"]).seal("index", root.encode(), root.sealed.seal.archive, root.sealed.seal)
    forged_root = with_seal("root", root.encode(), seal, MAX_ARCHIVE_ROOT_BYTES)
    scene.mirror.wrong["archive.gnd"] = mirrors.instead(forged_root)
    with pytest.raises(ArchiveWrong, match="does not fit"):
        scene.fetch()


def test_attack_a_publisher_of_another_authority_signs_the_archive(scene: ArchiveScene) -> None:
    """A mirror signs all of the archive as an operator of an authority of its own, and shows that certificate."""
    scene.put_index(scene.new, scene.index(scene.new), "foreign")
    chain = Signing(scene.parts["foreign"]).seal("root", b"x", bytes(8), None)
    scene.new.put(certificate_name(chain[0].signer), chain[1])
    with pytest.raises(ArchiveWrong, match="not of our authority"):
        scene.fetch()


def test_attack_a_revoked_publisher_signs_the_archive(scene: ArchiveScene, tmp_path: Path) -> None:
    """The operator who has signed the archive is revoked: no part of it counts any more."""
    authority = Authority(tmp_path / "own")
    operator, vehicle = authority.part("operator", "o"), authority.part("vehicle", "v")
    objects = FolderObjects(tmp_path / "own-archive")
    with SqliteStore(tmp_path / "own.sqlite", signing=Signing(operator)) as store:
        store.put_tiles([content(tile, 7) for tile in TILES])
        publish(store, objects, [LAYER], signing=Signing(operator))
    scene.serve(objects)
    scene.parts = scene.parts | {"vehicle": vehicle}
    assert scene.fetch().fetched == 4
    authority.revoke(operator, vehicle)
    with pytest.raises(ArchiveWrong, match=r"archive\.gnd: the certificate of operator o was revoked"):
        scene.fetch()


def test_an_old_mirror_is_named_to_who_asks_for_a_new_one(scene: ArchiveScene) -> None:
    """A new client has seen nothing; when the archive was signed is told all the same."""
    done = scene.fetch(oldest_s=3600.0)
    assert (done.fetched, done.number, done.signed_by) == (4, 2, "operator operator1")
    assert time.time() - done.signed_s < 600
    time.sleep(1.1)
    with pytest.raises(ArchiveWrong, match=r"signed 0\.0 h ago, at most 0\.0 h are wanted: an old mirror"):
        scene.fetch(oldest_s=0.5)


@pytest.mark.parametrize("what", ["good", "unsigned", "older"])
def test_a_vehicle_takes_no_tiles_by_an_index_that_nobody_answers_for(scene: ArchiveScene, what: str) -> None:
    """It leaves the archive alone, and asks the bus for all."""
    cache: TileCache[Tile] = TileCache(scene.folder / "cache.sqlite", LAYER)
    kept = scene.folder / "seen.json"

    def bring(tiles: list[TileId]) -> tuple[int, bool]:
        with Archive(scene.mirror.url) as archive:
            check = VersionCheck(Publishers(scene.parts["vehicle"]), LAYER, cache)
            vehicle = ArchiveTiles(archive, cache, check, SeenStates(kept))
            return vehicle.bring(tiles), vehicle.is_left_alone

    assert bring(TILES[:1]) == (1, False)
    if what == "unsigned":
        scene.mirror.wrong["index/"] = mirrors.instead(scene.index(scene.new).encode())
    elif what == "older":
        scene.serve(scene.old)
    assert bring(TILES[1:]) == ((3, False) if what == "good" else (0, True))
    cache.close()


@pytest.mark.parametrize("data", [b"", b"[]", b'{"a": 1}', b'{"a": [1]}', b"\xff", b"[" * 100_000])
def test_a_memory_of_archives_that_is_none_stops_nobody(scene: ArchiveScene, data: bytes) -> None:
    kept = scene.folder / "seen.json"
    kept.write_bytes(data)
    scene.seen = SeenStates(kept)
    assert scene.fetch().fetched == 4
    again = SeenStates(kept)
    assert again.newest(next(iter(again.names("")))).number >= 1
    assert (kept.with_name("seen.json.damaged")).read_bytes() == data


def test_a_folder_that_cannot_be_written_stops_nobody(scene: ArchiveScene) -> None:
    scene.seen = SeenStates(scene.folder / "not-there" / "seen.json")
    assert scene.fetch().fetched == 4
