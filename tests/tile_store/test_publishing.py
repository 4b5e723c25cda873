"""Archives: what is published, what a second publishing writes, what interruptions and pruning leave."""

import os
import time
from collections.abc import Iterable, Iterator
from hashlib import sha256
from pathlib import Path

import pytest
from store_helpers import EAST, FAR, TILE, Maker, begin_trial, of_a_file, tile_of_voxels

from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import MemberName
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.archive import (
    CERTIFICATE_FOLDER,
    PACK_FOLDER,
    ROOT_NAME,
    UNSIGNED,
    ArchiveIndex,
    ArchiveRoot,
    certificate_name,
    index_name,
    pack_name,
)
from gnd.schemas.archive_seal import Sealed, digest_of_index
from gnd.schemas.tiles import TileReply, content_of
from gnd.tile_store.errors import StoreBusy, StoreError, StoreUnavailable
from gnd.tile_store.location import open_store
from gnd.tile_store.objects import FolderObjects, NamedObjects, ObjectSeen
from gnd.tile_store.publishing import LEAST_LIVE, MOST_PACKS, prune, publish
from gnd.tile_store.signatures import sign_unsigned
from gnd.tile_store.signing import Signing
from gnd.tile_store.trials import TrialTerms

TILES = [TileId(TILE.morton + n) for n in range(12)]


@pytest.fixture
def objects(tmp_path: Path) -> FolderObjects:
    return FolderObjects(tmp_path / "archive")


def index_of(objects: NamedObjects, tile: TileId = TILE) -> ArchiveIndex:
    data = objects.get(index_name("ndt", tile.district))
    assert data is not None
    return ArchiveIndex.decode(data)


def published(objects: NamedObjects, tile: TileId) -> TileReply:
    entry = index_of(objects, tile).by_tile[tile]
    data = objects.get(pack_name(entry.pack.sha), entry.start, entry.size)
    assert data is not None
    return TileReply.decode(data)


def names(objects: NamedObjects, prefix: str = "") -> set[str]:
    return {one.name for one in objects.each(prefix)}


def test_all_that_is_published_can_be_read_again(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (TILE, EAST, FAR)])
        done = publish(store, objects, ["ndt"])
        assert (done.districts, done.switched, done.tiles, done.written, done.unsigned) == (2, 2, 3, 3, 3)
        for tile in (TILE, EAST, FAR):
            reply, stored = published(objects, tile), store.get("ndt", tile)
            assert reply.blob is not None
            assert stored is not None
            assert content_of(reply.blob).sha == stored.sha
            assert reply.blob == stored.to_blob()
    root = objects.get(ROOT_NAME)
    assert root is not None
    assert ArchiveRoot.decode(root).districts == {"ndt": tuple(sorted((TILE.district, FAR.district)))}
    for one in objects.each(PACK_FOLDER):  # named by content
        data = objects.get(one.name)
        assert data is not None
        assert one.name == pack_name(sha256(data).digest())


def test_a_second_publishing_writes_only_what_is_new(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (*TILES, FAR)])
        publish(store, objects, ["ndt"])
        before = names(objects)
        nothing = publish(store, objects, ["ndt"])
        assert (nothing.objects, nothing.bytes, nothing.switched) == (0, 0, 0)
        store.put_tiles([tile_of_voxels(TILES[3], 1, 2, 3)])
        one = publish(store, objects, ["ndt"])
        assert (one.switched, one.written, one.objects) == (1, 1, 2)  # a pack of one tile, and its district's index
        new = names(objects) - before
        assert len(new) == 1
        assert one.bytes < 2_000
        reply, stored = published(objects, TILES[3]), store.get("ndt", TILES[3])
        assert reply.blob is not None
        assert stored is not None
        assert (reply.blob.version, reply.blob.sha) == (2, stored.sha)


def test_a_district_in_many_packs_is_packed_anew(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, *range(1, 40)) for tile in TILES])
        publish(store, objects, ["ndt"])
        repacked = 0
        for n in range(3 * MOST_PACKS):
            store.put_tiles([tile_of_voxels(TILES[n % 10], 1, 2, n + 3)])
            repacked += publish(store, objects, ["ndt"]).repacked
            index = index_of(objects)
            assert len(index.packs) <= MOST_PACKS
            live = sum(entry.size for entry in index.entries)
            # what is written now is whole: the share of what is named cannot fall below that of what stayed
            assert live >= LEAST_LIVE * sum(pack.size_bytes for pack in index.packs) - 2_000
        assert repacked
        assert [entry.tile for entry in index.entries] == TILES


class Killed(Exception):
    """As `kill -9` would: nothing after it is done."""


class KilledObjects:
    """Objects of which the n-th writing never happens."""

    def __init__(self, objects: FolderObjects, at: int) -> None:
        self._objects, self._left, self.location = objects, at, objects.location

    def put(self, name: str, data: bytes, *, changes: bool = False) -> None:
        if self._left == 0:
            raise Killed
        self._left -= 1
        self._objects.put(name, data, changes=changes)

    def put_new(self, name: str, data: bytes) -> bool:
        return self._objects.put_new(name, data)

    def get(self, name: str, start: int = 0, length: int | None = None) -> bytes | None:
        return self._objects.get(name, start, length)

    def each(self, prefix: str) -> Iterator[ObjectSeen]:
        return self._objects.each(prefix)

    def remove(self, names: Iterable[str]) -> None:
        self._objects.remove(names)


@of_a_file
@pytest.mark.parametrize("at", range(7))
def test_readers_see_the_old_or_the_new_district_wherever_publishing_is_interrupted(
    maker: Maker, objects: FolderObjects, at: int
) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (*TILES, FAR)])
        publish(store, objects, ["ndt"])
        store.put_tiles([tile_of_voxels(tile, 1, 2, 3) for tile in (*TILES, FAR)])
        try:
            publish(store, KilledObjects(objects, at), ["ndt"])  # type: ignore[arg-type]
        except Killed:
            assert at < 4
        versions = []
        for tile in (TILE, FAR):
            index = index_of(objects, tile)
            versions.append({published(objects, entry.tile).blob.version for entry in index.entries})  # type: ignore[union-attr]
        assert all(len(one) == 1 for one in versions)  # never a mixture
        publish(store, objects, ["ndt"])
        assert {published(objects, tile).blob.version for tile in (*TILES, FAR)} == {2}  # type: ignore[union-attr]


def age(objects: FolderObjects, seconds: float) -> None:
    then = time.time() - seconds
    for path in Path(objects.location).rglob("*"):
        if path.is_file():
            os.utime(path, (then, then))


def test_pruning_removes_old_packs_that_nothing_names_and_no_others(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (*TILES, FAR)])
        publish(store, objects, ["ndt"])
        for n in range(3):
            store.put_tiles([tile_of_voxels(tile, 1, 2, n + 3) for tile in TILES])
            publish(store, objects, ["ndt"])
        packs = names(objects, PACK_FOLDER)
        assert len(packs) == 5
        assert prune(objects).objects == 0  # all are young: a reader may hold the index before
        age(objects, 7200)
        leftover = Path(objects.location) / "pack" / ".x.1.2.partial"
        leftover.write_bytes(b"half")
        os.utime(leftover, (1, 1))
        pruned = prune(objects)
        assert (pruned.objects, pruned.named) == (3, 2)
        assert not leftover.exists()
        assert {published(objects, tile).blob is not None for tile in (*TILES, FAR)} == {True}


def test_pruning_removes_nothing_where_an_index_cannot_be_read(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
        publish(store, objects, ["ndt"])
        store.put_tiles([tile_of_voxels(TILE, 1, 2)])
        publish(store, objects, ["ndt"])
    age(objects, 7200)
    before = names(objects)
    objects.put(index_name("ndt", FAR.district), b"\xff\xff")
    with pytest.raises(StoreError, match="is no index, so nothing is removed"):
        prune(objects)
    assert names(objects, PACK_FOLDER) == {one for one in before if one.startswith(PACK_FOLDER)}


def test_a_damaged_index_is_written_anew(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
        publish(store, objects, ["ndt"])
        good = objects.get(index_name("ndt", TILE.district))
        objects.put(index_name("ndt", TILE.district), b"\x08\x01\xff")
        publish(store, objects, ["ndt"])
        assert objects.get(index_name("ndt", TILE.district)) == good


@of_a_file
def test_a_tile_that_cannot_be_read_stays_as_it_was_published(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
        publish(store, objects, ["ndt"])
        store.put_tiles([tile_of_voxels(TILE, 1, 2), tile_of_voxels(EAST, 1, 2)])
        maker.sql("UPDATE tile_version SET body = x'00' WHERE version = 2 AND tile = ?", EAST.morton)
        done = publish(store, objects, ["ndt"])
        assert list(done.damaged) == [f"ndt {EAST.path}"]
        versions = {tile: published(objects, tile).blob.version for tile in (TILE, EAST)}  # type: ignore[union-attr]
        assert versions == {TILE: 2, EAST: 1}


def test_a_version_on_trial_is_not_published(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        for voxels in ((1,), (1, 2)):
            store.put_tiles([tile_of_voxels(TILE, *voxels)])
        begin_trial(store, TILE, TrialTerms(0.5, 3600.0))
        publish(store, objects, ["ndt"])
        assert index_of(objects).by_tile[TILE].version == 1
        assert publish(store, objects, ["ndt"]).objects == 0


def test_regions_are_whole_districts(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, 1) for tile in (TILE, EAST, FAR)])
        with pytest.raises(StoreError, match="smaller than a district"):
            publish(store, objects, ["ndt"], [TILE.path])
        done = publish(store, objects, ["ndt"], [FAR.district.path])
        assert (done.districts, done.tiles) == (1, 1)
        done = publish(store, objects, ["ndt"], [TILE.district.path, "13033"])
        assert (done.districts, done.tiles) == (1, 2)
        root = objects.get(ROOT_NAME)
        assert root is not None
        assert len(ArchiveRoot.decode(root).districts["ndt"]) == 2  # the one before is still there


def test_one_publishes_at_a_time(maker: Maker, objects: FolderObjects) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
        with objects.locked(), pytest.raises(StoreBusy, match="somebody else publishes there now"):
            publish(store, FolderObjects(Path(objects.location)), ["ndt"])


def test_signatures_are_published_and_new_ones_too(maker: Maker, objects: FolderObjects, tmp_path: Path) -> None:
    authority = Authority.create(tmp_path / "authority", "tests")
    authority.issue(MemberName("operator", "anna"), tmp_path / "anna")
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
        assert publish(store, objects, ["ndt"]).unsigned == 1
        assert index_of(objects).by_tile[TILE].signed == UNSIGNED
    with open_store(maker.location, signing=Signing(tmp_path / "anna")) as store:
        sign_unsigned(store)
        done = publish(store, objects, ["ndt"])
        assert (done.written, done.unsigned) == (1, 0)
        signature = published(objects, TILE).signature
        stored = store.get("ndt", TILE)
        assert stored is not None
        assert signature == stored.signature is not None
        (name,) = names(objects, CERTIFICATE_FOLDER)
        assert signature is not None
        assert objects.get(name) == store.publisher_chain(signature.signer)
        assert publish(store, objects, ["ndt"]).objects == 0


def test_a_folder_that_cannot_be_written_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(StoreUnavailable, match="cannot open"):
        FolderObjects(tmp_path / "missing" / "archive")


@pytest.fixture
def anna(tmp_path: Path) -> Signing:
    authority = Authority.create(tmp_path / "authority", "tests")
    authority.issue(MemberName("operator", "anna"), tmp_path / "anna")
    return Signing(tmp_path / "anna")


def root_of(objects: NamedObjects) -> ArchiveRoot:
    data = objects.get(ROOT_NAME)
    assert data is not None
    return ArchiveRoot.decode(data)


def answers_for(anna: Signing, objects: NamedObjects, sealed: Sealed | None) -> bool:
    assert sealed is not None
    return anna.answers_for(sealed, objects.get(certificate_name(sealed.seal.signer)))


def test_who_publishes_with_an_identity_signs_what_there_is(
    maker: Maker, objects: FolderObjects, anna: Signing
) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (TILE, FAR)])
        assert publish(store, objects, ["ndt"], signing=anna).number == 1
        root = root_of(objects)
        assert answers_for(anna, objects, root.sealed)
        for tile in (TILE, FAR):
            index = index_of(objects, tile)
            assert answers_for(anna, objects, index.sealed)
            assert index.sealed is not None
            assert root.digest("ndt", tile.district) == digest_of_index(index.sealed.body_sha)
        again = publish(store, objects, ["ndt"], signing=anna)
        assert (again.number, again.switched, again.objects) == (2, 0, 1), "the root says that it holds today, too"
        assert root_of(objects).digests == root.digests
        assert root.sealed is not None
        now = root_of(objects).sealed
        assert now is not None
        assert (now.seal.archive, now.seal.order > root.sealed.seal.order) == (root.sealed.seal.archive, True)


def test_an_archive_is_signed_later_and_stays_so(maker: Maker, objects: FolderObjects, anna: Signing) -> None:
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (TILE, FAR)])
        publish(store, objects, ["ndt"])
        packs = names(objects, PACK_FOLDER)
        part = publish(store, objects, ["ndt"], [TILE.district.path], signing=anna)
        assert (part.switched, part.written) == (1, 0)
        assert root_of(objects).districts == {"ndt": (TILE.district,)}, "nobody answers for the other one yet"
        publish(store, objects, ["ndt"], signing=anna)
        assert len(root_of(objects).districts["ndt"]) == 2
        assert names(objects, PACK_FOLDER) == packs
        before = {name: objects.get(name) for name in names(objects)}
        with pytest.raises(StoreError, match="the archive is signed; publish with the identity"):
            publish(store, objects, ["ndt"])
        assert {name: objects.get(name) for name in names(objects)} == before


def test_what_somebody_else_has_put_into_the_archive_is_signed_by_nobody(
    maker: Maker, objects: FolderObjects, anna: Signing
) -> None:
    """An index that was altered, or a root: what the store says is published anew."""
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (TILE, FAR)])
        publish(store, objects, ["ndt"], signing=anna)
        good, name = index_of(objects), index_name("ndt", TILE.district)
        objects.put(name, ArchiveIndex("ndt", TILE.district).encode())
        objects.put(ROOT_NAME, ArchiveRoot({"ndt": (TILE.district,)}, {"ndt": (bytes(16),)}).encode())
        done = publish(store, objects, ["ndt"], signing=anna)
        assert done.switched == 1
        assert {e.tile: e.version for e in index_of(objects).entries} == {e.tile: e.version for e in good.entries}
        root = root_of(objects)
        assert answers_for(anna, objects, root.sealed)
        for tile in (TILE, FAR):
            sealed = index_of(objects, tile).sealed
            assert sealed is not None
            assert root.digest("ndt", tile.district) == digest_of_index(sealed.body_sha)


def test_who_is_interrupted_leaves_an_archive_that_is_signed(
    maker: Maker, objects: FolderObjects, anna: Signing
) -> None:
    """Each object is whole and signed at any time; an index may be newer than the root."""
    with maker.open() as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (TILE, FAR)])
        publish(store, objects, ["ndt"], signing=anna)
        store.put_tiles([tile_of_voxels(tile, 1, 2, 3) for tile in (TILE, FAR)])
        for at in (0, 1, 2, 2):  # before the first pack, its index, the second pack, the root
            with pytest.raises(Killed):
                publish(store, KilledObjects(objects, at), ["ndt"], signing=anna)  # type: ignore[arg-type]
            parts = root_of(objects).sealed, *(index_of(objects, tile).sealed for tile in (TILE, FAR))
            assert all(answers_for(anna, objects, one) for one in parts)
        publish(store, objects, ["ndt"], signing=anna)
        assert {index_of(objects, tile).by_tile[tile].version for tile in (TILE, FAR)} == {2}
