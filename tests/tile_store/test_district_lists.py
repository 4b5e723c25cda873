"""Lists of districts in the store: signed when a district appears, alone; looked at, renewed, copied and moved."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from store_helpers import FAR, TILE, Maker, tile_of_voxels

from gnd.cloud_merger.catalog_signer import CatalogSigner
from gnd.cloud_merger.ownership import Members
from gnd.deploy.map_cli import map_group
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE, MemberName
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, TileId
from gnd.schemas.district_list import DistrictList
from gnd.tile_store.cli import store as store_command
from gnd.tile_store.copying import district as moving
from gnd.tile_store.district_lists import answered_list, due_lists, sign_list
from gnd.tile_store.errors import NotPublished
from gnd.tile_store.location import open_store
from gnd.tile_store.regions_cli import regions
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore

pytestmark = pytest.mark.parametrize("maker", ["sqlite", "postgres"], indirect=True)
HOME, AWAY = (one.district.first_morton // TILES_OF_DISTRICT for one in (TILE, FAR))


@pytest.fixture
def store(maker: Maker, folder: Path) -> Iterator[SqlStore]:
    with open_store(maker.location, signing=Signing(folder / "s1")) as opened:
        yield opened


def listed(store: SqlStore, folder: Path) -> DistrictList:
    """What is signed, as a client checks it."""
    told, publishers = store.district_list("ndt"), Publishers(folder / "v1")
    assert told is not None
    signed = told.signature
    publishers.learn(store.publisher_chain(signed.signer) or b"")
    publishers.check(signed.signer, signed.signed_s, told.text, signed.signature)
    assert DistrictList.decode(told.encode()) == told
    return told


def status(store: SqlStore, folder: Path) -> str:
    return answered_list(store, Publishers(folder / "v1"), "ndt").status


def signer_of(store: SqlStore, renewed_after_s: float = 3600.0) -> CatalogSigner:
    assert store.signing is not None
    return CatalogSigner(store, Members("s1"), store.signing.publishers, renewed_after_s)


def test_a_list_changes_when_a_district_appears(store: SqlStore, folder: Path) -> None:
    """And not when a version is published: no shard waits for another one there. Without an identity there is none."""
    store.put_tiles([tile_of_voxels(TILE, 1)])
    assert (listed(store, folder).numbers, listed(store, folder).signature.number) == ((HOME,), 1)
    store.put_tiles([tile_of_voxels(TILE, 1, 2), tile_of_voxels(TileId(TILE.morton + 1), 1)])
    assert listed(store, folder).signature.number == 1
    store.put_tiles([tile_of_voxels(FAR, 1)])
    store.rollback("ndt", TILE, 1)
    assert (listed(store, folder).numbers, listed(store, folder).signature.number) == (tuple(sorted((HOME, AWAY))), 2)
    assert signer_of(store).work() == 0
    assert signer_of(store, -10.0).work() == 3, "two catalogs and the list are signed again"
    assert (listed(store, folder).signature.number, status(store, folder)) == (3, "good")
    with open_store(store.location, create=False) as plain, pytest.raises(NotPublished, match="--identity FOLDER"):
        sign_list(plain, "ndt")


def test_districts_that_appear_at_once_are_all_in_the_list(store: SqlStore, folder: Path) -> None:
    """Shards with sessions of their own publish the first tiles of eight districts at the same time."""
    begin = threading.Barrier(4)

    def publish(part: int) -> None:
        with open_store(store.location, create=False, signing=Signing(folder / f"s{1 + part % 2}")) as own:
            begin.wait()
            for n in (part, part + 4):
                own.put_tiles([tile_of_voxels(TileId(TILE.morton + n * TILES_OF_DISTRICT), 1)])

    threads = [threading.Thread(target=publish, args=(part,)) for part in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    told = listed(store, folder)
    assert told.numbers == tuple(HOME + n for n in range(8))
    assert told.signature.number == 8, "none was lost, none signed twice"


def test_what_was_changed_by_hand_is_not_signed_over(store: SqlStore, maker: Maker, folder: Path) -> None:
    """A district that has gone, one that nobody has published, a list that nobody can have made: an operator decides,
    and publishing goes on."""
    store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(FAR, 1)])
    said = listed(store, folder)
    for table in ("tile_head", "catalog_state"):
        maker.sql(f"DELETE FROM {table} WHERE tile / 1024 = ?", AWAY)
    assert status(store, folder) == "wrong"
    assert "1 districts that were signed have gone" in sign_list(store, "ndt")
    assert signer_of(store, -10.0).work() == 1, "the catalog of the district that is there"
    assert listed(store, folder) == said
    store.put_tiles([tile_of_voxels(TileId(TILE.morton + TILES_OF_DISTRICT), 1)])
    assert set(listed(store, folder).numbers or ()) == {HOME, AWAY, HOME + 1}
    run = CliRunner()
    env = {IDENTITY_VARIABLE: str(folder / "anna")}
    bad = run.invoke(map_group, ["verify", str(maker.location), "--signatures"], env=env)
    assert bad.exit_code == 1
    assert "list of districts wrong: 1 districts that it names have no tiles" in bad.output
    assert run.invoke(map_group, ["sign", str(maker.location)], env=env).exit_code == 1
    assert run.invoke(map_group, ["sign", str(maker.location), "--unchecked"], env=env).exit_code == 0
    assert run.invoke(map_group, ["verify", str(maker.location), "--signatures"], env=env).exit_code == 0
    assert listed(store, folder).numbers == (HOME, HOME + 1)
    number = listed(store, folder).signature.number
    maker.sql("UPDATE district_list SET number = ? WHERE layer = 'ndt'", 2**60)
    assert store.district_list("ndt") is None
    store.put_tiles([tile_of_voxels(TileId(TILE.morton + 2 * TILES_OF_DISTRICT), 1)])
    assert due_lists(store, Publishers(folder / "v1")) == ["ndt"]
    assert signer_of(store).work() >= 1
    assert set(listed(store, folder).numbers or ()) == {HOME, HOME + 1, HOME + 2}
    assert listed(store, folder).signature.number < number


def test_a_list_of_a_revoked_shard_is_made_anew(
    maker: Maker, authority: Authority, folder: Path, tmp_path: Path
) -> None:
    """Its districts are left out until an operator has looked; the others' do not wait for that."""
    gone = MemberName("shard", f"gone-{'pg' if '://' in str(maker.location) else 'file'}")  # a name is used once
    authority.issue(gone, tmp_path / "gone")
    for part, tile in ((folder / "s1", TILE), (tmp_path / "gone", FAR)):
        with open_store(maker.location, signing=Signing(part)) as store:
            store.put_tiles([tile_of_voxels(tile, 1)])
    authority.revoke(gone)
    authority.copy_lists([folder / one for one in ("s1", "s2", "anna", "v1")])
    with open_store(maker.location, signing=Signing(folder / "s1")) as store:
        assert status(store, folder) == "revoked"
        assert due_lists(store, Publishers(folder / "s1")) == ["ndt"]
        assert "was revoked" in sign_list(store, "ndt")
        said = listed(store, folder)
        assert said.numbers == (HOME,)
        assert "was revoked" in sign_list(store, "ndt")
        assert listed(store, folder) == said, "it is not signed again while nothing has changed"
        env = {IDENTITY_VARIABLE: str(folder / "anna")}
        assert CliRunner().invoke(map_group, ["sign", str(maker.location), "--unchecked"], env=env).exit_code == 0
        assert (listed(store, folder).numbers, status(store, folder)) == (tuple(sorted((HOME, AWAY))), "good")


@pytest.mark.parametrize("way", ["copy", "move"])
def test_lists_go_with_their_store(
    store: SqlStore, folder: Path, way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy goes on counting. Of a district that moves both lists tell: who is kept from one hears of the other."""
    monkeypatch.setattr(moving, "NOTICED_S", 0.0)
    store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(FAR, 1)])
    said, other = listed(store, folder), f"sqlite:{tmp_path}/other.db"
    if way == "copy":
        done = CliRunner().invoke(store_command, ["copy", store.location, other])
    else:
        CliRunner().invoke(regions, ["create", other, "east"])
        done = CliRunner().invoke(regions, ["move", TILE.district.path, "--from", store.location, "--to", other])
    assert done.exit_code == 0, done.output
    with open_store(other, create=False, signing=Signing(folder / "s2")) as there:
        if way == "copy":
            assert listed(there, folder) == said
            there.put_tiles([tile_of_voxels(TileId(TILE.morton + TILES_OF_DISTRICT), 1)])
            assert listed(there, folder).signature.number == said.signature.number + 1
            return
        assert there.district_list("ndt") is None
        assert signer_of(there).work() == 1
        assert (listed(there, folder).head.region, listed(there, folder).numbers) == ("east", (HOME,))
        assert status(there, folder) == "good"
    assert signer_of(store, -10.0).work() == 2, "the catalog that is still here, and the list"
    assert (listed(store, folder).numbers, status(store, folder)) == (said.numbers, "good")
