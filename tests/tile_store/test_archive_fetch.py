"""A store from an archive on a real web server: nothing but HTTP between them."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result
from store_helpers import FAR, TILE, tile_of_voxels
from web_fixtures import ServedFolder

from gnd.deploy.archive_fetch import ArchiveFetcher, FetchedArchive
from gnd.deploy.map_cli import map_group
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE, MemberName
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.region import Region, parse_region
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_client.archive import Archive, ArchiveTiles
from gnd.tile_client.checking import VersionCheck
from gnd.tile_client.errors import ArchiveAway, ArchiveError, ArchiveWrong
from gnd.tile_client.http_reader import HttpReader
from gnd.tile_store.catalogs import answered_catalogs
from gnd.tile_store.district_lists import answered_list
from gnd.tile_store.errors import StoreError
from gnd.tile_store.objects import FolderObjects
from gnd.tile_store.publishing import prune, publish
from gnd.tile_store.signatures import signatures
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.link.cache import TileCache

TILES = [TileId(TILE.morton + n) for n in range(30)]


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = Authority.create(tmp_path_factory.mktemp("parts") / "authority", "tests")
    for role, name in (("operator", "anna"), ("vehicle", "v1")):
        made.issue(MemberName(role, name), made.folder.parent / name)
    return made.folder.parent


@pytest.fixture
def store(tmp_path: Path, parts: Path) -> Iterator[SqliteStore]:
    with SqliteStore(tmp_path / "map.sqlite", signing=Signing(parts / "anna")) as opened:
        opened.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (*TILES, FAR)])
        yield opened


def fetched(served: ServedFolder, into: SqliteStore, parts: Path | None) -> FetchedArchive:
    with Archive(served.url) as archive:
        publishers = None if parts is None else Publishers(parts / "v1", archive.fetch_certificate)
        return ArchiveFetcher(archive, into, publishers).fetch((), Region(""))


def test_a_mirror_has_what_was_published_with_its_signatures(
    served: ServedFolder, store: SqliteStore, parts: Path, tmp_path: Path
) -> None:
    store.rollback("ndt", FAR, 1)
    publish(store, FolderObjects(served.folder), ["ndt"], signing=Signing(parts / "anna"))
    with SqliteStore(tmp_path / "mirror.sqlite") as mirror:
        done = fetched(served, mirror, parts)
        assert (done.tiles, done.fetched, done.unsigned, done.wrong) == (31, 31, 0, {})
        assert mirror.heads() == store.heads()
        answered = list(signatures(mirror, Publishers(parts / "v1"), "ndt"))
        assert {(one.status, one.who) for one in answered} == {("good", "operator anna")}
        assert {one.kind for one in answered if one.tile == FAR} == {"rollback"}
        # a tile server over the mirror sends what the first one would
        for tile in (TILE, FAR):
            ours, theirs = mirror.get("ndt", tile), store.get("ndt", tile)
            assert ours is not None
            assert theirs is not None
            assert (ours.to_blob(), ours.signature) == (theirs.to_blob(), theirs.signature)
            assert mirror.catalog("ndt", tile.district) == store.catalog("ndt", tile.district)
        assert {one.status for one in answered_catalogs(mirror, Publishers(parts / "v1"), "ndt")} == {"good"}
        assert mirror.district_list("ndt") == store.district_list("ndt") is not None
        assert answered_list(mirror, Publishers(parts / "v1"), "ndt").status == "good"


def test_a_mirror_is_brought_up_to_date_with_few_requests(
    served: ServedFolder, store: SqliteStore, parts: Path, tmp_path: Path
) -> None:
    objects = FolderObjects(served.folder)
    publish(store, objects, ["ndt"], signing=Signing(parts / "anna"))
    with SqliteStore(tmp_path / "mirror.sqlite") as mirror:
        before = served.server.requests()
        fetched(served, mirror, parts)
        # root, two indexes, a pack each, the certificate when a version is checked and to be kept
        assert served.server.requests() - before <= 7
        before = served.server.requests()
        assert fetched(served, mirror, parts).fetched == 0
        assert served.server.requests() - before == 4  # root, indexes, and the certificate of who has signed them
        store.put_tiles([tile_of_voxels(TILES[5], 1, 2, 3)])
        publish(store, objects, ["ndt"], signing=Signing(parts / "anna"))
        done = fetched(served, mirror, parts)
        assert (done.fetched, done.unchanged, done.wrong) == (1, 30, {})
        assert mirror.heads() == store.heads()
        assert mirror.catalog("ndt", TILE.district) == store.catalog("ndt", TILE.district)
        assert [line.version for line in mirror.history("ndt", TILES[5])] == [1, 2]


def test_only_the_tiles_of_a_region_are_read(
    served: ServedFolder, store: SqliteStore, parts: Path, tmp_path: Path
) -> None:
    publish(store, FolderObjects(served.folder), ["ndt"], signing=Signing(parts / "anna"))
    ledger = Ledger()
    with SqliteStore(tmp_path / "mirror.sqlite") as mirror, Archive(served.url, ledger) as archive:
        fetcher = ArchiveFetcher(archive, mirror, Publishers(parts / "v1", archive.fetch_certificate))
        fetcher.fetch(("ndt",), parse_region(str(TILES[3].morton)))
        assert [head.tile for head in mirror.heads()] == [TILES[3]]
        fetcher.fetch(("ndt",), Region(FAR.district.path))
        assert [head.tile for head in mirror.heads()] == [FAR, TILES[3]]
        signed = [mirror.catalog("ndt", tile.district).signature for tile in (FAR, TILES[3])]
        assert [one is not None for one in signed] == [True, False], "of a part of a district nobody has signed a list"
        stored = [mirror.get("ndt", tile) for tile in (FAR, TILES[3])]
        told = {path: n for path, (_, n) in ledger.by_tile().items()}
        assert told.keys() == {FAR.path, TILES[3].path}
        assert all(one is not None and told[one.tile.path] > len(one.body) for one in stored)
        assert {line.kind for line in ledger.totals()} == {"tile", "catalog", "control"}


def test_a_pack_that_was_pruned_meanwhile_is_found_through_the_newer_index(
    served: ServedFolder, store: SqliteStore, parts: Path, tmp_path: Path
) -> None:
    objects = FolderObjects(served.folder)
    publish(store, objects, ["ndt"], [TILE.district.path], signing=Signing(parts / "anna"))
    with Archive(served.url) as archive:
        old = archive.index("ndt", TILE.district)
    assert old is not None
    assert old.entries[0].version == 1
    store.put_tiles([tile_of_voxels(tile, 1, 2, 3) for tile in TILES])
    publish(store, objects, ["ndt"], [TILE.district.path], signing=Signing(parts / "anna"))

    class Late(Archive):
        """Has read the index a moment before."""

        asked = 0

        def index(self, layer: str, district: object, kept_s: float = 0.0) -> object:  # type: ignore[override]
            self.asked += 1
            return old if self.asked == 1 else super().index(layer, district, kept_s)  # type: ignore[arg-type]

    assert prune(objects, older_than_s=-1.0).objects == 1
    with SqliteStore(tmp_path / "mirror.sqlite") as mirror, Late(served.url) as late:
        done = ArchiveFetcher(late, mirror, Publishers(parts / "v1", late.fetch_certificate)).fetch((), Region(""))
        assert late.asked == 2
        assert (done.fetched, done.wrong) == (30, {})


def test_readers_see_whole_districts_while_they_are_published(
    served: ServedFolder, store: SqliteStore, parts: Path
) -> None:
    objects, stop, wrong, seen = FolderObjects(served.folder), threading.Event(), list[str](), set[int]()
    publish(store, objects, ["ndt"], signing=Signing(parts / "anna"))

    def read() -> None:
        with Archive(served.url) as archive:
            while not stop.is_set():
                index = archive.index("ndt", TILE.district)
                assert index is not None
                versions = {entry.version for entry in index.entries}
                came = list(archive.tiles("ndt", index.entries))
                seen.update(versions)
                if len(versions) != 1 or any(isinstance(one, tuple) for one in came):
                    wrong.append(f"{versions} {came[:1]}")

    reader = threading.Thread(target=read)
    reader.start()
    for n in range(200):
        store.put_tiles([tile_of_voxels(tile, 1, 2, n + 3) for tile in TILES])
        publish(store, objects, ["ndt"], signing=Signing(parts / "anna"))
        if len(seen) > 3:
            break
    stop.set()
    reader.join(60)
    assert wrong == []
    assert len(seen) > 3


def test_the_commands(
    served: ServedFolder, store: SqliteStore, parts: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(command: click.Group, arguments: list[str]) -> Result:
        monkeypatch.setenv(IDENTITY_VARIABLE, "")  # --identity sets it for the process
        return CliRunner().invoke(command, arguments)

    publishing = ["publish", str(store.path), "-o", str(served.folder), "--json"]
    assert json.loads(run(map_group, publishing).stdout)["number"] == 0
    mirror, identity = tmp_path / "mirror.sqlite", str(parts / "v1")
    fetch = ["fetch", served.url, "-o", str(mirror), "--json"]
    told = run(map_group, [*fetch, "--identity", identity])
    assert told.exit_code != 0
    assert "archive.gnd: nobody has signed it" in str(told.exception)
    told = run(map_group, [*publishing, "--prune", "--identity", str(parts / "anna")])
    assert told.exit_code == 0, told.output
    found = json.loads(told.stdout)
    assert (found["tiles"], found["written"], found["number"]) == (31, 0, 1)
    told = run(map_group, publishing)
    assert told.exit_code != 0
    assert "the archive is signed; publish with the identity of a shard or an operator" in str(told.exception)
    told = run(map_group, [*publishing, "--identity", identity])
    assert told.exit_code != 0
    assert "vehicle.v1" in str(told.exception)
    told = run(map_group, [*fetch, "--not-older-than", "1"])
    assert "--not-older-than needs --identity" in told.output
    told = run(map_group, [*fetch, "--identity", identity, "--tiles", TILE.path])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout)["fetched"] == 1
    told = run(map_group, [*fetch, "--identity", identity, "--not-older-than", "1"])
    assert json.loads(told.stdout)["fetched"] == 30
    assert json.loads(told.stdout)["signed_by"] == "operator anna"
    assert (parts / "v1" / "archives_seen.json").exists()
    told = run(map_group, ["verify", str(mirror), "--signatures", "--identity", identity, "--json"])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout)["signed_by"] == {"operator anna": 31}


def test_without_an_identity_nobody_looks_at_signatures_and_none_are_kept(
    served: ServedFolder, store: SqliteStore, parts: Path, tmp_path: Path
) -> None:
    publish(store, FolderObjects(served.folder), ["ndt"], signing=Signing(parts / "anna"))
    with SqliteStore(tmp_path / "mirror.sqlite") as mirror:
        done = fetched(served, mirror, None)
        assert (done.fetched, done.unsigned) == (31, 31)
        assert mirror.heads() == store.heads()
        assert mirror.unsigned() == 31


def test_a_store_with_reports_is_no_mirror(
    served: ServedFolder, store: SqliteStore, parts: Path, tmp_path: Path
) -> None:
    from store_helpers import report

    publish(store, FolderObjects(served.folder), ["ndt"], signing=Signing(parts / "anna"))
    with SqliteStore(tmp_path / "own.sqlite") as own:
        own.put_reports([report(1)])
        with pytest.raises(StoreError, match="is no mirror"):
            fetched(served, own, None)


def test_a_vehicle_is_filled_from_the_archive(
    served: ServedFolder, store: SqliteStore, parts: Path, tmp_path: Path
) -> None:
    publish(store, FolderObjects(served.folder), ["ndt"], signing=Signing(parts / "anna"))
    cache: TileCache[Tile] = TileCache(tmp_path / "cache.sqlite", "ndt")
    check = VersionCheck(Publishers(parts / "v1"), "ndt", cache)  # the certificate comes from the archive, too
    with Archive(served.url) as archive:
        tiles: ArchiveTiles[Tile] = ArchiveTiles(archive, cache, check)
        assert tiles.bring(TILES[:10]) == 10
        assert check.counts == {"good": 10}
        assert tiles.bring(TILES[:12]) == 2
        assert tiles.bring([TileId(TILE.morton + 500)]) == 0  # the map has none
        assert len(cache) == 12
        served.server.end()
        assert tiles.bring(TILES) == 0  # it fails for the caller never ...
        assert tiles.is_left_alone
        assert tiles.bring(TILES) == 0  # ... and the archive is left alone for some seconds
        assert len(cache) == 12
    cache.close()


def test_a_server_that_is_not_there_is_a_clear_error(free_port: int) -> None:
    with pytest.raises(ArchiveAway, match=f"http://127.0.0.1:{free_port}/archive.gnd: Connection refused"):
        Archive(f"http://127.0.0.1:{free_port}").root()


def test_a_folder_without_an_archive_is_a_clear_error(served: ServedFolder) -> None:
    with Archive(served.url) as archive, pytest.raises(ArchiveWrong, match=r"no archive of `gnd map publish`"):
        archive.root()


@pytest.mark.parametrize(
    "url",
    [
        "ftp://host/x", "http://anna:secret@host/x", "https://anna@host", "http://host/x?key=secret", "http:///x",
        "http://host:99x/", "http://host/a b", "http://host/\r\nX: y", "http://host/#secret", "host/x", "",
    ],
)  # fmt: skip
def test_urls_with_credentials_are_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(ArchiveError, match=r"^an archive is given as") as caught:
        HttpReader(url)
    assert "secret" not in str(caught.value)
    assert "anna" not in str(caught.value)
