"""Catalogs in the store: signed with each publication, as they are, by whoever publishes; renewed, looked at, moved."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from store_helpers import EAST, FAR, TILE, Maker, begin_trial, tile_of_voxels

from gnd.cloud_merger.catalog_signer import CatalogSigner
from gnd.cloud_merger.ownership import Members
from gnd.deploy.map_cli import map_group
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.publishers import Publishers
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.catalog_signature import CatalogSignature, CatalogStatement
from gnd.tile_store import releasing
from gnd.tile_store.catalogs import (
    AnsweredCatalog,
    answered_catalogs,
    due_catalogs,
    renew_catalogs,
    sign_unsigned_catalogs,
    sign_whole_catalog,
)
from gnd.tile_store.cli import store as store_command
from gnd.tile_store.copying import district as moving
from gnd.tile_store.errors import NotPublished
from gnd.tile_store.location import open_store
from gnd.tile_store.regions_cli import regions
from gnd.tile_store.signatures import sign_unsigned
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.trials import TrialTerms

HOME = TILE.district
LAST = TileId(HOME.first_morton + 1023)
"""Of another group of the same district."""
TERMS = TrialTerms(0.5, 3600.0)


pytestmark = pytest.mark.parametrize("maker", ["sqlite", "postgres"], indirect=True)


@pytest.fixture
def store(maker: Maker, folder: Path) -> Iterator[SqlStore]:
    with open_store(maker.location, signing=Signing(folder / "s1")) as opened:
        yield opened


def answered(store: SqlStore, folder: Path) -> list[AnsweredCatalog]:
    return list(answered_catalogs(store, Publishers(folder / "v1"), "ndt"))


def signature(store: SqlStore, district: District = HOME) -> CatalogSignature:
    found = store.catalog("ndt", district).signature
    assert found is not None
    return found


def is_as_signed(store: SqlStore, folder: Path, district: District = HOME) -> CatalogSignature:
    """What a client computes from the whole catalog is what was signed step by step."""
    catalog, publishers = store.catalog("ndt", district), Publishers(folder / "v1")
    signed = signature(store, district)
    publishers.learn(store.publisher_chain(signed.signer) or b"")
    text = signed.text(CatalogStatement.of("ndt", district, catalog.entries))
    publishers.check(signed.signer, signed.signed_s, text, signed.signature)
    return signed


def test_without_an_identity_nothing_is_signed(maker: Maker) -> None:
    with open_store(maker.location) as plain:
        plain.put_tiles([tile_of_voxels(TILE, 1)])
        plain.rollback("ndt", TILE, 1)
        catalog = plain.catalog("ndt", HOME)
        assert [(one.tile, one.version) for one in catalog.entries] == [(TILE, 2)]
        assert catalog.signature is None
        with pytest.raises(NotPublished, match="nobody to sign with"):
            sign_whole_catalog(plain, "ndt", HOME)


def test_every_change_of_what_is_released_signs_the_district(store: SqlStore, folder: Path) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(LAST, 1), tile_of_voxels(FAR, 1)])
    first = is_as_signed(store, folder)
    assert (first.number, first.kind) == (2, "published")
    store.put_tiles([tile_of_voxels(TILE, 1)])  # nothing new
    assert signature(store) == first
    store.put_tiles([tile_of_voxels(TILE, 1, 2)])
    begin_trial(store, TILE, TERMS)
    on_trial = is_as_signed(store, folder)
    assert (on_trial.number, store.catalog("ndt", HOME).entries[0].version) == (4, 1)
    (trial,) = store.trials("ndt").values()
    assert releasing.withdraw(store, trial, "s1", "they fared badly")
    withdrawn = is_as_signed(store, folder)
    assert (withdrawn.number, withdrawn.kind, store.catalog("ndt", HOME).entries[0].version) == (5, "rollback", 3)
    store.rollback("ndt", TILE, 2)
    assert (is_as_signed(store, folder).number, signature(store).kind) == (6, "rollback")
    assert is_as_signed(store, folder, FAR.district).number == 1
    assert [(one.status, one.who) for one in answered(store, folder)] == [("good", "shard s1")] * 2
    with open_store(store.location, create=False) as plain:
        for forbidden in (lambda: plain.rollback("ndt", TILE, 1), lambda: plain.put_tiles([tile_of_voxels(EAST, 9)])):
            with pytest.raises(NotPublished, match="--identity FOLDER"):
                forbidden()
    assert signature(store).number == 6


def test_a_trial_is_not_released_without_an_identity(store: SqlStore, folder: Path) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    store.put_tiles([tile_of_voxels(TILE, 1, 2)])
    begin_trial(store, TILE, TERMS)
    (trial,) = store.trials("ndt").values()
    with (
        open_store(store.location, create=False) as plain,
        pytest.raises(NotPublished, match="the catalogs of this store are signed"),
    ):
        releasing.release(plain, trial, "somebody", "because")
    assert releasing.release(store, trial, "s1", "they fared well")
    assert store.catalog("ndt", HOME).entries[0].version == 2
    assert is_as_signed(store, folder).kind == "published"


@pytest.mark.parametrize("seed", range(3))
def test_step_by_step_is_as_all_at_once(store: SqlStore, folder: Path, seed: int) -> None:
    rng, tiles = np.random.default_rng(seed), [TILE, EAST, LAST, FAR]
    for number in range(12):
        tile = tiles[rng.integers(len(tiles))]
        before = {one: store.catalog("ndt", one).signature for one in (HOME, FAR.district)}
        head = store.get("ndt", tile)
        if head is not None and rng.integers(3) == 0:
            store.rollback("ndt", tile, int(rng.integers(1, head.version + 1)))
        else:
            store.put_tiles([tile_of_voxels(tile, 1, 2 + number)])
        had = before[tile.district]
        assert is_as_signed(store, folder, tile.district).number == (had.number if had else 0) + 1
        (other,) = before.keys() - {tile.district}
        assert store.catalog("ndt", other).signature == before[other]


def test_what_was_changed_by_hand_is_not_signed_over(store: SqlStore, maker: Maker, folder: Path) -> None:
    """Publishing goes on there; an operator decides."""
    for voxels in ((1,), (1, 2)):
        store.put_tiles([tile_of_voxels(TILE, *voxels), tile_of_voxels(LAST, *voxels)])
    old = store.get("ndt", TILE, 1)
    assert old is not None
    maker.sql("UPDATE tile_head SET version = 1, epoch = 1 WHERE tile = ?", TILE.morton)
    maker.sql("UPDATE tile_head SET sha = (SELECT sha FROM tile_version AS v WHERE v.tile = ? AND v.version = 1)"
              " WHERE tile = ?", TILE.morton, TILE.morton)  # fmt: skip
    said = signature(store)
    store.put_tiles([tile_of_voxels(EAST, 7)])  # of the same group: nothing is signed
    assert signature(store) == said
    store.put_tiles([tile_of_voxels(LAST, 7)])  # of another group: signed, with that group as it was signed before
    assert signature(store).number == said.number + 1
    (told,) = answered(store, folder)
    assert (told.status, "3 tiles are there" in told.why) == ("wrong", True)
    assert "other versions were signed" in sign_whole_catalog(store, "ndt", HOME)
    assert signer_of(store).work() == 0
    store.transact(lambda c, _now: c.change("forget_catalog_state", {"layer": "ndt", "tile": HOME.first_morton}))
    assert "which is not the newest" in sign_whole_catalog(store, "ndt", HOME), "nor when the state is gone"
    assert signer_of(store).work() == 0
    assert sign_whole_catalog(store, "ndt", HOME, unchecked=True) == ""
    assert is_as_signed(store, folder).kind == "whole"


def signer_of(store: SqlStore, renewed_after_s: float = 3600.0) -> CatalogSigner:
    assert store.signing is not None
    return CatalogSigner(store, Members("s1"), store.signing.publishers, renewed_after_s)


def test_catalogs_are_signed_again_in_time_and_never_back(
    store: SqlStore, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(FAR, 1)])
    before = signature(store)
    assert signer_of(store).work() == 0
    real_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real_ns() - 5 * 10**9)  # a clock that was set back
    assert signer_of(store, -10.0).work() == 3, "two catalogs and the list of districts"
    again = is_as_signed(store, folder)
    assert (again.number, again.kind, again.signed_s) == (before.number + 1, "renewed", before.signed_s)
    assert is_as_signed(store, folder, FAR.district).kind == "renewed"


def test_an_old_store_is_signed_by_the_first_shard(maker: Maker, folder: Path) -> None:
    with open_store(maker.location) as plain:
        plain.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(LAST, 1), tile_of_voxels(FAR, 1)])
    with open_store(maker.location, signing=Signing(folder / "s1")) as store:
        signer = signer_of(store)
        assert signer.work() == 0, "nobody answers for its versions"
        assert signer.work() == 0, "it is not looked at again at once"
        assert {one.status for one in answered(store, folder)} == {"unsigned"}
        store.put_tiles([tile_of_voxels(EAST, 1)])
        assert store.catalog("ndt", HOME).signature is None, "one version of a district is not all"
        assert all("is not signed" in why or "not signed" in why for why in sign_unsigned_catalogs(store).values())
        sign_unsigned(store)
        assert signer_of(store).work() == 3, "two catalogs and the list of districts"
        assert (is_as_signed(store, folder).kind, signature(store).number) == ("whole", 1)
        store.put_tiles([tile_of_voxels(EAST, 1, 2)])
        assert (is_as_signed(store, folder).kind, signature(store).number) == ("published", 2)


def test_of_a_revoked_shard_nothing_is_built_upon(
    maker: Maker, authority: Authority, folder: Path, tmp_path: Path
) -> None:
    gone = MemberName("shard", f"gone-{'pg' if '://' in str(maker.location) else 'file'}")  # a name is used once
    authority.issue(gone, tmp_path / "gone")
    for part, tile in ((folder / "s1", TILE), (tmp_path / "gone", LAST)):
        with open_store(maker.location, signing=Signing(part)) as store:
            store.put_tiles([tile_of_voxels(tile, 1)])
    authority.revoke(gone)
    authority.copy_lists([folder / one for one in ("s1", "s2", "anna", "v1")])
    with open_store(maker.location, signing=Signing(folder / "s1")) as store:
        assert [one.status for one in answered(store, folder)] == ["revoked"]
        assert renew_catalogs(store, "ndt", [HOME]) == []
        publishers = Publishers(folder / "s1")
        (due,) = due_catalogs(store, publishers, lambda _district: True)
        assert (due.whole, due.renewed) == ((HOME,), ())
        assert "was revoked" in sign_whole_catalog(store, "ndt", HOME)
        store.put_tiles([tile_of_voxels(TILE, 1, 2)])
        assert store.catalog("ndt", HOME).signature is None
        done = run(folder, "sign", maker.location, "--unchecked")
        assert done.exit_code == 0, done.output
        assert (is_as_signed(store, folder).kind, answered(store, folder)[0].who) == ("whole", "operator anna")


def run(folder: Path, *words: object):  # type: ignore[no-untyped-def]
    return CliRunner().invoke(map_group, [*map(str, words), "--identity", str(folder / "anna")])


def test_verify_tells_of_catalogs(store: SqlStore, maker: Maker, folder: Path) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(FAR, 1)])
    good = run(folder, "verify", maker.location, "--signatures")
    assert (good.exit_code, "catalogs, good" in good.output) == (0, True), (good.output, good.exception)
    flipped = bytes(64)
    maker.sql("UPDATE catalog_state SET signature = ? WHERE tile = ?", flipped, HOME.first_morton)
    bad = run(folder, "verify", maker.location, "--signatures")
    assert bad.exit_code == 1
    assert f"catalog of district {HOME} wrong: the signature of shard s1 does not fit" in bad.output
    tile_alone = run(folder, "verify", maker.location, "--signatures", "--region", TILE.path)
    assert tile_alone.exit_code == 0, "a region that is smaller than a district has no catalog"
    assert run(folder, "sign", maker.location).exit_code == 0
    assert run(folder, "verify", maker.location, "--signatures").exit_code == 0


@pytest.mark.parametrize("way", ["copy", "move"])
def test_catalogs_go_with_what_they_name(
    store: SqlStore, folder: Path, way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(moving, "NOTICED_S", 0.0)
    store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(LAST, 1), tile_of_voxels(FAR, 1)])
    said, other = signature(store), f"sqlite:{tmp_path}/other.db"
    if way == "copy":
        done = CliRunner().invoke(store_command, ["copy", store.location, other])
    else:
        CliRunner().invoke(regions, ["create", other, "east"])
        done = CliRunner().invoke(regions, ["move", HOME.path, "--from", store.location, "--to", other])
    assert done.exit_code == 0, done.output
    with open_store(other, create=False, signing=Signing(folder / "s2")) as there:
        assert signature(there) == said
        assert is_as_signed(there, folder) == said
        there.put_tiles([tile_of_voxels(TILE, 1, 2)])
        assert is_as_signed(there, folder).number == said.number + 1
    if way == "move":
        assert store.catalog("ndt", HOME).signature is None
        assert is_as_signed(store, folder, FAR.district).number == 1


def test_a_state_that_nobody_can_have_made_is_none(store: SqlStore, maker: Maker, folder: Path) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    maker.sql("UPDATE catalog_state SET number = ? WHERE tile = ?", 2**60, HOME.first_morton)
    assert store.catalog("ndt", HOME).signature is None
    assert sign_whole_catalog(store, "ndt", HOME) == ""
    assert is_as_signed(store, folder) == replace(signature(store), number=1)
