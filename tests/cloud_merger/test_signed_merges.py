"""Merges in a signed store: signed by the shard, built on signed bases alone, and signed again only where the reports
give the same."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import apsw
import pytest
from click.testing import CliRunner
from merger_world import BALL, GROUND, POLE, TILE, VOXEL_BY_VOXEL, WALL, change_of, gaussians_of, report_of

from gnd.cloud_merger import work
from gnd.cloud_merger.config import MAX_ATTEMPTS, ShardConfig
from gnd.cloud_merger.work import Worker
from gnd.deploy.map_cli import map_group
from gnd.fleet_bus import publishers
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE, MemberName
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.content import encode_content
from gnd.gnd_map.tile import Tile
from gnd.schemas.changes import split
from gnd.tile_store.errors import ClocksApart
from gnd.tile_store.signatures import AnsweredVersion, signatures
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import Publication, ReportRow, StoreConfig

BASE = {0: GROUND, 1: WALL, 2: POLE}


@dataclass
class Place:
    """A map that an operator has signed, and the identities of an operator, a shard and a vehicle."""

    path: Path
    folder: Path
    authority: Authority
    reports: int = 0

    @contextmanager
    def opened(self, part: str) -> Iterator[SqliteStore]:
        with SqliteStore(self.path, StoreConfig(merge_delay_s=0.0), signing=Signing(self.folder / part)) as store:
            yield store

    def hears(self, store: SqliteStore) -> None:
        """Two vehicles tell of a ball."""
        for vehicle in ("a", "b"):
            self.reports += 1
            change = change_of(gaussians_of(BASE), [0, 1, 2, 3, 4], {3: BALL})
            now_ns = time.time_ns()
            report = report_of(self.reports, change, vehicle=vehicle)
            report = replace(report, first_ns=now_ns - 10**9, last_ns=now_ns)
            ((tile, body),) = split(report)
            row = ReportRow(report.report_id, "ndt", tile, vehicle, now_ns, body, change.base_sha)
            store.put_reports([row])

    def merge(self, store: SqliteStore) -> list[Publication]:
        worker = Worker(store, ShardConfig(store_path=self.path, confirmation=VOXEL_BY_VOXEL))
        return worker.merge(store.claim("s", 4, 30.0))

    def answered(self) -> list[AnsweredVersion]:
        with SqliteStore(self.path) as store:
            return list(signatures(store, Publishers(self.folder / "v"), "ndt", all_versions=True))

    def run(self, *words: str) -> tuple[int, str]:
        arguments = [words[0], str(self.path), *words[1:], "--identity", str(self.folder / "o")]
        result = CliRunner().invoke(map_group, arguments)
        return result.exit_code, " ".join((result.output + str(result.exception or "")).split())

    def revoke(self, name: str) -> None:
        self.authority.revoke(MemberName("shard", name))
        self.authority.copy_lists([self.folder / one for one in ("o", "v")])


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    monkeypatch.setenv(IDENTITY_VARIABLE, "")
    authority = Authority.create(tmp_path / "authority", "tests")
    for role, name in (("operator", "o"), ("shard", "s"), ("vehicle", "v")):
        authority.issue(MemberName(role, name), tmp_path / name)
    made = Place(tmp_path / "map.sqlite", tmp_path, authority)
    with made.opened("o") as store:
        store.put_tiles([Tile(TILE, 1, gaussians_of(BASE))])
    return made


def test_a_shard_signs_what_it_merges(place: Place) -> None:
    with place.opened("s") as store:
        place.hears(store)
        assert [one.status for one in store.publish(place.merge(store))] == ["published"]
    assert [(one.kind, one.who) for one in place.answered()] == [("base", "operator o"), ("merged", "shard s")]
    code, said = place.run("verify")
    assert (code, "same │ 1" in said) == (0, True), said


def test_nothing_is_built_on_a_base_that_somebody_has_exchanged(place: Place) -> None:
    wall = Tile(TILE, 1, gaussians_of({0: GROUND, 1: BALL, 2: POLE}))
    codec_id, body = encode_content(wall)
    with place.opened("s") as store:
        place.hears(store)
        with apsw.Connection(str(place.path)) as file:
            file.execute("UPDATE tile_version SET sha = ?, codec_id = ?, body = ?", (wall.sha, codec_id, body))
            file.execute("UPDATE tile_head SET sha = ?", (wall.sha,))
        assert place.merge(store) == []
        assert [head.version for head in store.heads()] == [1]
        assert store.dirty_count() == 1  # it is tried again, then set aside
    assert [one.status for one in place.answered()] == ["wrong"]


def test_a_shard_whose_clock_is_late_waits_for_it(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its clock the base was signed too far in the future: no tile is set aside for that."""
    monkeypatch.setattr(work, "RETRY_S", 0.0)
    with place.opened("s") as store:
        place.hears(store)
        monkeypatch.setattr(publishers, "MOST_SKEW_S", -3600.0)
        with pytest.raises(ClocksApart, match=r"operator o signed it -?\d+ s from now: check the clocks"):
            store.check_signed(store.get("ndt", TILE))
        for _ in range(2 * MAX_ATTEMPTS):
            assert place.merge(store) == []
        assert store.tiles_set_aside() == []
        monkeypatch.setattr(publishers, "MOST_SKEW_S", 600.0)
        assert [one.status for one in store.publish(place.merge(store))] == ["published"]


def test_what_a_revoked_shard_has_merged_is_signed_again(place: Place) -> None:
    """Its reports give the same bits, so an operator can vouch for it."""
    with place.opened("s") as store:
        place.hears(store)
        store.publish(place.merge(store))
    place.revoke("s")
    assert [one.status for one in place.answered()] == ["good", "revoked"]
    code, said = place.run("sign")
    assert (code, "signed │ 1" in said) == (0, True), said
    assert {one.who for one in place.answered()} == {"operator o"}


def test_what_a_revoked_shard_has_made_up_is_not_signed_again(place: Place) -> None:
    """It had published something else than its reports give, under its own good signature."""
    with place.opened("s") as store:
        place.hears(store)
        (publication,) = place.merge(store)
        made_up = Tile(TILE, 2, gaussians_of({0: GROUND, 2: POLE}))
        assert [one.status for one in store.publish([replace(publication, tile=made_up)])] == ["published"]
    place.revoke("s")
    code, said = place.run("sign")
    assert (code, "the journal gives" in said) == (1, True), said
    assert [one.status for one in place.answered()] == ["good", "revoked"]
    code, said = place.run("rollback", TILE.path, "--to", "1")
    assert code == 0, said
    assert [one.status for one in place.answered()] == ["good", "revoked", "good"]
