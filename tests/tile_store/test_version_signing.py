"""Signatures in the store: made with the version, kept with it, asked of whoever publishes there."""

import contextlib
import datetime as dt
import time
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from store_helpers import EAST, TILE, Clock, Maker, begin_trial, tile_of_voxels

from gnd.deploy.map_cli import map_group
from gnd.fleet_bus.errors import IdentityError, NotAnsweredFor
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE, MemberName
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.day import UNKNOWN_DAY, day_of
from gnd.tile_store import releasing
from gnd.tile_store.errors import NotPublished
from gnd.tile_store.location import open_store
from gnd.tile_store.rollback import RollbackTarget, roll_back
from gnd.tile_store.signatures import AnsweredVersion, sign_unsigned, signatures
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.trials import TrialTerms


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    made = Authority.create(tmp_path_factory.mktemp("signing") / "authority", "tests")
    for role, name in (("shard", "s1"), ("operator", "anna"), ("vehicle", "v1"), ("tiles", "t1")):
        made.issue(MemberName(role, name), made.folder.parent / name)
    return made


@pytest.fixture
def folder(authority: Authority) -> Path:
    return authority.folder.parent


def answered(store: SqlStore, folder: Path, **options: bool) -> list[AnsweredVersion]:
    return [
        one
        for layer in store.layers()
        for one in signatures(store, Publishers(folder / "v1"), layer, all_versions=options.get("all_versions", True))
    ]


def test_without_an_identity_nothing_is_signed_and_nothing_asked(maker: Maker) -> None:
    with open_store(maker.location) as store:
        store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
        store.rollback("ndt", TILE, 1)
        stored = store.get("ndt", TILE)
        assert stored is not None
        assert stored.signature is None
        assert store.unsigned() == 2
        store.check_signed(stored)


def test_every_way_to_publish_signs(maker: Maker, folder: Path) -> None:
    with open_store(maker.location, signing=Signing(folder / "anna")) as store:
        store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
        store.put_tiles([tile_of_voxels(TILE, 1, 2)], "rollback")
        store.rollback("ndt", TILE, 1)
        roll_back(store, "ndt", TILE, RollbackTarget(version=2))
        found = answered(store, folder)
        assert {(one.status, one.who) for one in found} == {("good", "operator anna")}
        assert [one.kind for one in found if one.tile == TILE] == ["base", "rollback", "rollback", "rollback"]
        assert store.unsigned() == 0


def test_a_withdrawn_trial_is_followed_by_a_signed_rollback(maker: Maker, folder: Path) -> None:
    with open_store(maker.location, signing=Signing(folder / "s1")) as store:
        for voxels in ((1,), (1, 2)):
            store.put_tiles([tile_of_voxels(TILE, *voxels)])
        terms = TrialTerms(0.5, 3600.0)
        begin_trial(store, TILE, terms)
        (trial,) = store.trials("ndt").values()
        assert releasing.withdraw(store, trial, "shard s1", "vehicles fared badly")
        newest = store.get("ndt", TILE)
        assert newest is not None
        assert (newest.version, newest.kind) == (3, "rollback")
        assert [one.status for one in answered(store, folder)] == ["good"] * 3


def test_a_signed_store_takes_no_version_without_an_identity(maker: Maker, folder: Path) -> None:
    with open_store(maker.location, signing=Signing(folder / "anna")) as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
    with open_store(maker.location) as plain:
        for publish in (
            lambda: plain.put_tiles([tile_of_voxels(TILE, 2)]),
            lambda: plain.rollback("ndt", TILE, 1),
            lambda: plain.put_tiles([tile_of_voxels(EAST, 2), tile_of_voxels(TILE, 1)], surveyed_ns=10**18),
        ):
            with pytest.raises(NotPublished, match="are signed; publish with the identity"):
                publish()
        assert [(head.tile, head.version) for head in plain.heads()] == [(TILE, 1)]


def test_another_day_of_the_survey_is_signed_anew(maker: Maker, folder: Path) -> None:
    """The day is signed, too, and an import of the same content may change it."""
    surveyed_ns = 1_700_000_000 * 10**9
    with open_store(maker.location, signing=Signing(folder / "anna")) as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
        first = store.get("ndt", TILE)
        (again,) = store.put_tiles([tile_of_voxels(TILE, 1)], surveyed_ns=surveyed_ns)
        second = store.get("ndt", TILE)
        assert first is not None
        assert second is not None
        assert (again.status, first.day, second.day) == ("unchanged", UNKNOWN_DAY, day_of(surveyed_ns))
        assert first.signature != second.signature
        store.check_signed(second)


def test_an_unsigned_map_is_signed_afterwards(maker: Maker, folder: Path) -> None:
    with open_store(maker.location) as store:
        for voxels in ((1,), (1, 2)):
            store.put_tiles([tile_of_voxels(TILE, *voxels)])
    with open_store(maker.location, signing=Signing(folder / "anna")) as store:
        assert sign_unsigned(store) == 2
        assert sign_unsigned(store) == 0
        assert {one.who for one in answered(store, folder)} == {"operator anna"}


def test_signing_later_keeps_when_a_version_was_made(maker: Maker, folder: Path) -> None:
    """Clients order versions by that, so an old version that is signed again does not become a new one."""
    clock = Clock()
    with maker.open(clock=clock) as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
    with open_store(maker.location, signing=Signing(folder / "anna")) as store:
        sign_unsigned(store)
        stored = store.get("ndt", TILE)
        assert stored is not None
        assert stored.signature is not None
        assert stored.signature.made_s == clock.ns // 10**9 < stored.signature.signed_s


def test_what_was_changed_after_it_was_signed_is_named(maker: Maker, folder: Path) -> None:
    with open_store(maker.location, signing=Signing(folder / "s1")) as store:
        store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
        maker.sql("UPDATE tile_version SET signature = ? WHERE tile = ?", bytes(64), TILE.morton)
        maker.sql("UPDATE tile_version SET body = ? WHERE tile = ?", bytes(20), EAST.morton)
        assert {one.tile: one.status for one in answered(store, folder)} == {TILE: "wrong", EAST: "damaged"}
        # a time before the version was made: no signature that can be
        maker.sql("UPDATE tile_version SET signed_s = 5 WHERE tile = ?", TILE.morton)
        assert {one.tile: one.status for one in answered(store, folder)} == {TILE: "unsigned", EAST: "damaged"}


def test_a_renewed_certificate_is_used_from_then_on(maker: Maker, tmp_path: Path, authority: Authority) -> None:
    mine = tmp_path / "renewed"
    authority.issue(MemberName("shard", "renewed"), mine)
    with open_store(maker.location, signing=Signing(mine)) as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
        authority.renew(mine)
        store.put_tiles([tile_of_voxels(TILE, 1, 2)])
        signers = [store.get("ndt", TILE, version) for version in (1, 2)]
        assert len({one.signature.signer for one in signers if one and one.signature}) == 2
        assert {one.status for one in answered(store, authority.folder.parent)} == {"good"}


def test_nobody_publishes_with_a_certificate_that_has_ended(maker: Maker, tmp_path: Path, authority: Authority) -> None:
    """Nobody would believe it; a shard that was not renewed waits, and its reports with it."""
    mine = tmp_path / "ended"
    authority.issue(MemberName("shard", "ended"), mine, days=0.5 / 86_400)
    signing = Signing(mine)
    until_s = time.monotonic() + 20.0
    with open_store(maker.location, signing=signing) as store:

        def publish_until_the_end() -> None:
            while time.monotonic() < until_s:
                store.put_tiles([tile_of_voxels(TILE, *range(1, 2 + len(store.history("ndt", TILE))))])

        with pytest.raises(NotPublished, match=r"has ended \(`gnd certs renew`\)"):
            publish_until_the_end()
        (mine / "certificate.pem").rename(tmp_path / "away.pem")  # unreadable: as before
        with pytest.raises(NotPublished, match="has ended"):
            store.put_tiles([tile_of_voxels(EAST, 1)])
        (tmp_path / "away.pem").rename(mine / "certificate.pem")
        authority.renew(mine)
        store.put_tiles([tile_of_voxels(EAST, 1)])
        assert {one.status for one in answered(store, authority.folder.parent)} == {"good"}


def test_a_revoked_publisher_stays_revoked_when_its_certificate_has_ended(maker: Maker, tmp_path: Path) -> None:
    """The list goes on naming it: what it has signed is still there."""
    authority = Authority.create(tmp_path / "authority", "tests")
    authority.issue(MemberName("vehicle", "v1"), tmp_path / "v1")
    open_store(maker.location).close()  # or making its schema would take what the certificate has
    for lasts_s in (1, 4, 16):  # the shortest in which this machine publishes now
        name = f"gone{lasts_s}"
        authority.issue(MemberName("shard", name), tmp_path / name, days=lasts_s / 86_400)
        with open_store(maker.location, signing=Signing(tmp_path / name)) as store, contextlib.suppress(NotPublished):
            store.put_tiles([tile_of_voxels(TILE, 1)])
            break
    (entry,) = (one for one in authority.entries() if one.name == name)
    authority._record(replace(entry, revoked="2026-01-01T00:00:00+00:00"))
    authority.copy_lists([tmp_path / "v1"])
    time.sleep(max(0.0, dt.datetime.fromisoformat(entry.ends).timestamp() - time.time()))
    with open_store(maker.location) as store:
        assert [one.status for one in answered(store, tmp_path)] == ["revoked"]


@pytest.mark.parametrize("name", ["v1", "t1"])
def test_who_signs_no_versions_is_told_so(folder: Path, name: str) -> None:
    with pytest.raises(IdentityError, match="signs no versions: a shard or an operator does"):
        Signing(folder / name)


def test_a_foreign_authority_answers_for_nothing(maker: Maker, tmp_path: Path, folder: Path) -> None:
    other = Authority.create(tmp_path / "other", "others")
    other.issue(MemberName("shard", "s1"), tmp_path / "s1")
    with open_store(maker.location, signing=Signing(tmp_path / "s1")) as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
        chain = store.publisher_chain(store.get("ndt", TILE).signature.signer)  # type: ignore[union-attr]
        assert [one.status for one in answered(store, folder)] == ["foreign"]
    assert chain is not None
    with pytest.raises(NotAnsweredFor, match="not of our authority"):
        Publishers(folder / "v1").learn(chain)


def test_commands_say_who_answers_and_sign_the_rest(
    maker: Maker, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_store(maker.location) as store:
        store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
        store.put_tiles([tile_of_voxels(TILE, 2)])
    monkeypatch.delenv(IDENTITY_VARIABLE, raising=False)

    def run(*words: str) -> tuple[int, str]:
        monkeypatch.delenv(IDENTITY_VARIABLE, raising=False)
        result = CliRunner().invoke(map_group, [words[0], str(maker.location), *words[1:]])
        return result.exit_code, result.output + str(result.exception or "")

    code, said = run("verify", "--signatures")
    assert (code, "--identity FOLDER" in said) == (1, True)
    code, said = run("verify", "--signatures", "--identity", str(folder / "v1"), "--json")
    assert (code, '"unsigned": 2' in said) == (1, True), said
    code, said = run("sign")
    assert (code, "nobody to sign with" in said) == (1, True), said
    code, said = run("sign", "--identity", str(folder / "v1"))
    assert (code, "signs no versions" in said) == (1, True), said
    code, said = run("sign", "--identity", str(folder / "anna"), "--dry-run", "--json")
    assert (code, '"signed": 3' in said) == (0, True), said
    code, said = run("sign", "--identity", str(folder / "anna"), "--json")
    assert (code, '"signed": 3' in said) == (0, True), said
    code, said = run("verify", "--signatures", "--all-versions", "--identity", str(folder / "v1"))
    assert (code, "signed by operator anna" in said, "3" in said) == (0, True, True), said
    code, said = run("rollback", TILE.path, "--to", "1")
    assert (code, "publish with the identity" in said) == (1, True), said
    code, said = run("rollback", TILE.path, "--to", "1", "--identity", str(folder / "anna"))
    assert (code, "gets the older content" in said) == (0, True), said
