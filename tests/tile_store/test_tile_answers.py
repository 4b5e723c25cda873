"""What the server answers: deltas against any version in the store, "unchanged", "later", codecs that clients read."""

import logging
from pathlib import Path

import apsw
import numpy as np
import pytest
from store_helpers import EAGER, EAST, TILE, tile_of_voxels

from gnd.fleet_bus.errors import Refused
from gnd.gnd_map.codec import (
    CODEC_FLOAT32,
    CODEC_FLOAT32_ZSTD,
    CODEC_STANDARD,
    CODEC_STANDARD_SETS,
    CODEC_STANDARD_SUMS,
    CODEC_STANDARD_ZSTD,
    LATTICES,
    PREFERRED,
    QUICK,
    encode_gaussians,
    snap,
)
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError, WrongHash
from gnd.schemas.tiles import TileRequest, tile_after, tile_of
from gnd.schemas.tiles_batch import HeldVersion, TileAnswer, TilesReply, TilesRequest, tile_of_answer
from gnd.tile_store.answers import TileAnswers, same_lattice
from gnd.tile_store.errors import StoreDamaged
from gnd.tile_store.memory import Memory
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoredTile

DISTRICT = TILE.district
BEFORE_SETS = (4, 3, 2, 7, 6, 5, 1, 0)
"""All codecs of clients that do not read those by sets of tables."""


def street(tile: TileId, seed: int, changed: int = 0, lattice: str | None = "standard") -> Tile:
    """A tile of 300 voxels of ground; `changed` of them differ from those of the same seed without changes."""
    rng = np.random.default_rng(seed)
    ids = np.sort(rng.choice(1500, 300, replace=False)).astype(np.int32)
    mean_m = np.column_stack([rng.uniform(-0.1, 0.1, (300, 2)), np.full(300, -0.2)]).astype(np.float32)
    mean_m[:changed, 2] = 0.3
    cov_m2 = np.tile(np.float32([0.07, 0, 0, 0.07, 0, 0.0004]), (300, 1))
    plain = Gaussians(ids, np.full(300, 90, np.int32), np.full(300, 40, np.int32), mean_m, cov_m2)
    return Tile(tile, 0, plain if lattice is None else snap(plain, LATTICES[lattice]))


@pytest.fixture
def store(tmp_path: Path):
    with SqliteStore(tmp_path / "store.db", EAGER) as opened:
        yield opened


def put(store: SqliteStore, *tiles: Tile) -> list[Tile]:
    """The tiles as the store numbers them."""
    results = store.put_tiles(tiles)
    return [Tile(tile.tile_id, one.version, tile.gaussians) for tile, one in zip(tiles, results, strict=True)]


def held(*tiles: Tile | TileId) -> list[HeldVersion]:
    return [HeldVersion(t) if isinstance(t, TileId) else HeldVersion(t.tile_id, t.version, t.sha) for t in tiles]


def asked(answers: TileAnswers, request: TilesRequest) -> dict[TileId, TileAnswer]:
    """Over the wire and back."""
    reply = TilesReply.decode(answers.many("ndt", DISTRICT, TilesRequest.decode(request.encode())).encode())
    return dict(reply.of_request(request, DISTRICT))


def damage(store: SqliteStore, version: int) -> None:
    """Flip a bit of a body, as a failing disk would."""
    with apsw.Connection(str(store.path)) as connection:
        body = bytearray(connection.execute("SELECT body FROM tile_version WHERE version = ?", (version,)).get)
        body[len(body) // 2] ^= 0x10
        connection.execute("UPDATE tile_version SET body = ? WHERE version = ?", (bytes(body), version))


# One tile


@pytest.mark.parametrize("lattice", ["archive", "standard", "compact"])
def test_who_holds_any_older_version_gets_a_delta_that_gives_the_newest(store: SqliteStore, lattice: str) -> None:
    versions = [put(store, street(TILE, 1, changed, lattice))[0] for changed in (0, 4, 8)]
    newest, answers = versions[-1], TileAnswers(store)
    for old in versions[:2]:
        reply = answers.one(store.get("ndt", TILE), TileRequest(old.version, old.sha))
        assert reply.delta is not None
        assert tile_after(reply.delta, old) == newest
        assert len(reply.delta.body) < len(store.get("ndt", TILE).body) / 4
    assert answers.one(store.get("ndt", TILE), TileRequest(3, newest.sha)).status == "unchanged"


def test_a_client_that_does_not_read_sets_of_tables_gets_the_older_codec_and_deltas(store: SqliteStore) -> None:
    versions = [put(store, street(TILE, 1, changed))[0] for changed in (0, 4)]
    answers, head = TileAnswers(store), store.get("ndt", TILE)
    assert head.codec_id == CODEC_STANDARD_SETS
    whole = answers.one(head, TileRequest(codecs=BEFORE_SETS)).blob
    assert whole is not None
    assert (whole.codec_id, tile_of(whole)) == (CODEC_STANDARD, versions[1])
    reply = answers.one(head, TileRequest(1, versions[0].sha, codecs=BEFORE_SETS))
    assert reply.delta is not None
    assert tile_after(reply.delta, versions[0]) == versions[1]
    assert reply.delta == answers.one(head, TileRequest(1, versions[0].sha)).delta


def test_a_version_that_has_gone_or_never_was_here_gets_the_whole_tile(store: SqliteStore) -> None:
    versions = [put(store, street(TILE, 1, changed))[0] for changed in (0, 4, 8)]
    store.gc(1)
    answers, head = TileAnswers(store), store.get("ndt", TILE)
    for request in (TileRequest(), TileRequest(1, versions[0].sha), TileRequest(3, bytes(32))):
        reply = answers.one(head, request)
        assert reply.blob is not None
        assert tile_of(reply.blob) == versions[-1]


def test_who_cannot_read_deltas_gets_the_whole_tile(store: SqliteStore) -> None:
    old, _ = put(store, street(TILE, 1))[0], put(store, street(TILE, 1, 4))
    answers, head = TileAnswers(store), store.get("ndt", TILE)
    for request in (
        TileRequest(1, old.sha, deltas=False),
        TileRequest(1, old.sha, codecs=(CODEC_FLOAT32,)),  # it does not know lattices
        TileRequest(1, old.sha, codecs=(CODEC_STANDARD_ZSTD,)),  # nor the range coder
    ):
        assert answers.one(head, request).status == "blob"


@pytest.mark.parametrize(
    "codec_id",
    [CODEC_FLOAT32, CODEC_FLOAT32_ZSTD, CODEC_STANDARD_ZSTD, CODEC_STANDARD, CODEC_STANDARD_SETS, CODEC_STANDARD_SUMS],
)
def test_a_client_that_reads_few_codecs_gets_the_tile_in_one_of_them(store: SqliteStore, codec_id: int) -> None:
    (tile,) = put(store, street(TILE, 1))
    head = store.get("ndt", TILE)
    assert head.codec_id == CODEC_STANDARD_SETS
    reply = TileAnswers(store).one(head, TileRequest(codecs=(99, codec_id)))
    assert reply.blob is not None
    assert (reply.blob.codec_id, tile_of(reply.blob)) == (codec_id, tile)


def test_the_first_codec_that_fits_is_taken_in_the_clients_order(store: SqliteStore) -> None:
    put(store, street(TILE, 1), street(EAST, 2, lattice=None))
    answers = TileAnswers(store)

    def codec_of(tile: TileId, *codecs: int) -> int:
        reply = answers.one(store.get("ndt", tile), TileRequest(codecs=codecs))
        assert reply.blob is not None
        return reply.blob.codec_id

    assert codec_of(TILE, *PREFERRED) == CODEC_STANDARD_SETS
    assert codec_of(TILE, *BEFORE_SETS) == CODEC_STANDARD
    assert codec_of(TILE, *QUICK) == CODEC_STANDARD_SUMS
    assert not {11, 12, 13} & {codec_of(TILE, *PREFERRED), codec_of(TILE, *BEFORE_SETS)}
    assert codec_of(TILE, CODEC_FLOAT32, CODEC_STANDARD) == CODEC_FLOAT32
    assert codec_of(TILE, 2, 4, 7, CODEC_STANDARD_ZSTD, 0) == CODEC_STANDARD_ZSTD
    assert codec_of(EAST, *PREFERRED) == CODEC_FLOAT32_ZSTD
    with pytest.raises(Refused, match=rf"comes in codec {CODEC_STANDARD_SETS}, asked for \(2, 4\)"):
        codec_of(TILE, 2, 4)


def test_an_old_store_with_plain_columns_is_served_to_old_clients_and_new(store: SqliteStore) -> None:
    old, new = put(store, street(TILE, 1, lattice=None))[0], put(store, street(TILE, 1, 5, lattice=None))[0]
    with apsw.Connection(str(store.path)) as connection:
        for tile in (old, new):
            row = (encode_gaussians(tile.gaussians), tile.version)
            connection.execute("UPDATE tile_version SET codec_id = 0, body = ? WHERE version = ?", row)
    answers, head = TileAnswers(store), store.get("ndt", TILE)
    plain = answers.one(head, TileRequest(codecs=(CODEC_FLOAT32,))).blob
    assert plain is not None
    assert plain.body == head.body
    small = answers.one(head, TileRequest()).blob
    assert small is not None
    assert tile_of(small) == new
    assert len(small.body) < len(head.body)
    assert answers.one(head, TileRequest(1, old.sha)).blob == small
    assert answers.one(head, TileRequest(2, new.sha)).status == "unchanged"


def test_a_tile_too_large_for_a_message_in_the_clients_codec_is_refused(
    store: SqliteStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(store, street(TILE, 1))
    monkeypatch.setattr("gnd.tile_store.answers.MAX_TILE_BODY_BYTES", 10_000)
    answers, head = TileAnswers(store), store.get("ndt", TILE)
    with pytest.raises(Refused, match=r"has 14404 bytes in codec 0, a message holds 10000; it comes in codec 9"):
        answers.one(head, TileRequest(codecs=(CODEC_FLOAT32,)))
    assert answers.one(head, TileRequest()).blob is not None


def test_a_delta_as_large_as_the_tile_is_not_sent(store: SqliteStore) -> None:
    (old,) = put(store, street(TILE, 1))
    (new,) = put(store, tile_of_voxels(TILE, 3))
    reply = TileAnswers(store).one(store.get("ndt", TILE), TileRequest(1, old.sha))
    assert reply.blob is not None
    assert tile_of(reply.blob) == new


def test_a_damaged_base_gives_the_whole_tile(store: SqliteStore, caplog: pytest.LogCaptureFixture) -> None:
    old, new = put(store, street(TILE, 1))[0], put(store, street(TILE, 1, 4))[0]
    damage(store, 1)
    with caplog.at_level(logging.ERROR):
        reply = TileAnswers(store).one(store.get("ndt", TILE), TileRequest(1, old.sha))
    assert reply.blob is not None
    assert tile_of(reply.blob) == new
    assert "no delta from version 1 to 2" in caplog.text


def test_a_damaged_body_is_not_sent_whether_it_was_sent_before_or_not(store: SqliteStore) -> None:
    put(store, street(TILE, 1))
    fresh, knowing = TileAnswers(store), TileAnswers(store)
    assert knowing.one(store.get("ndt", TILE), TileRequest()).blob is not None
    damage(store, 1)
    for answers in (fresh, knowing):
        with pytest.raises(StoreDamaged, match="version 1: damaged"):
            answers.one(store.get("ndt", TILE), TileRequest())
    damage(store, 1)  # the same bit again: it is whole
    for answers in (fresh, knowing):
        assert answers.one(store.get("ndt", TILE), TileRequest()).blob is not None


def test_a_body_as_it_was_encoded_is_sent_without_decoding_it(
    store: SqliteStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tile,) = put(store, street(TILE, 1))
    monkeypatch.setattr(StoredTile, "decode", lambda _: pytest.fail("decoded"))
    reply = TileAnswers(store).one(store.get("ndt", TILE), TileRequest())
    assert reply.blob is not None
    assert tile_of(reply.blob) == tile


def altered(store: SqliteStore, command: str) -> TileAnswers:
    with apsw.Connection(str(store.path)) as connection:
        connection.execute(command)
    return TileAnswers(store)


@pytest.mark.parametrize("check", ["NULL", "zeroblob(16)"])
def test_a_body_without_its_check_is_decoded_and_sent_if_it_is_whole(store: SqliteStore, check: str) -> None:
    """Of a version from before there were checks; and where the check itself was damaged."""
    (tile,) = put(store, street(TILE, 1))
    answers = altered(store, f"UPDATE tile_version SET body_check = {check}")
    reply = answers.one(store.get("ndt", TILE), TileRequest())
    assert reply.blob is not None
    assert tile_of(reply.blob) == tile
    damage(store, 1)
    with pytest.raises(StoreDamaged, match="version 1: damaged"):
        TileAnswers(store).one(store.get("ndt", TILE), TileRequest())


def test_a_body_of_another_content_is_not_sent_not_even_with_its_check(store: SqliteStore) -> None:
    put(store, street(TILE, 1))
    put(store, street(TILE, 2))
    answers = altered(
        store,
        "UPDATE tile_version SET (body, body_check) = (SELECT body, body_check FROM tile_version WHERE version = 1)"
        " WHERE version = 2",
    )
    with pytest.raises(StoreDamaged, match="version 2: damaged"):
        answers.one(store.get("ndt", TILE), TileRequest())


def test_a_damaged_body_that_is_published_again_stays_damaged(store: SqliteStore) -> None:
    put(store, street(TILE, 1))
    put(store, street(TILE, 2))
    damage(store, 1)
    assert store.rollback("ndt", TILE, 1).version == 3
    with pytest.raises(StoreDamaged, match="version 3: damaged"):
        TileAnswers(store).one(store.get("ndt", TILE), TileRequest())


# Several tiles


def tiles_of_district(n: int) -> list[TileId]:
    return [TileId(DISTRICT.first_morton + 5 * k) for k in range(n)]


def test_a_batch_tells_what_each_tile_is(store: SqliteStore) -> None:
    same, moved, fresh, absent = tiles_of_district(4)
    kept, old = put(store, street(same, 1), street(moved, 2))
    new = put(store, street(moved, 2, 6), street(fresh, 3))
    found = asked(TileAnswers(store), TilesRequest.of(held(kept, old, fresh, absent)))
    assert [found[tile].status for tile in (same, moved, fresh, absent)] == ["unchanged", "delta", "blob", "absent"]
    assert tile_of_answer(moved, found[moved], old) == new[0]
    assert tile_of_answer(fresh, found[fresh]) == new[1]


def test_a_rollback_to_what_the_client_holds_is_unchanged(store: SqliteStore) -> None:
    (old,) = put(store, street(TILE, 1))
    put(store, street(TILE, 1, 6))
    store.rollback("ndt", TILE, 1)
    for with_hashes in (False, True):
        request = TilesRequest.of(held(old), with_hashes=with_hashes)
        assert asked(TileAnswers(store), request) == {TILE: TileAnswer("unchanged")}


def test_who_holds_what_the_store_does_not_know_is_asked_for_hashes_and_gets_what_it_needs(store: SqliteStore) -> None:
    """Version numbers alone could lie: the store was built anew, or has let old versions go."""
    a, b, c, d = tiles_of_district(4)
    kept, old, foreign = put(store, street(a, 1), street(b, 2), street(c, 3))
    new = put(store, street(b, 2, 6))[0]
    foreign = Tile(c, 1, street(c, 33).gaussians)
    wanted = held(kept, old, foreign, d)
    answers = TileAnswers(store)
    first = asked(answers, TilesRequest.of(wanted))
    assert [first[tile].status for tile in (a, b, c, d)] == ["hash", "hash", "hash", "absent"]
    again = asked(answers, TilesRequest.of(wanted, with_hashes=True))
    assert [again[tile].status for tile in (a, b, c, d)] == ["unchanged", "delta", "blob", "absent"]
    assert tile_of_answer(b, again[b], old) == new
    with pytest.raises(WrongHash):
        tile_of_answer(b, again[b], kept)
    store.gc(1)  # the version number is no longer known; the epochs of all tiles are their heads
    assert asked(answers, TilesRequest.of(held(old)))[b].status == "hash"
    assert asked(answers, TilesRequest.of(held(old), with_hashes=True))[b].status == "blob"


def test_a_version_is_found_by_its_hash_whatever_its_number(store: SqliteStore) -> None:
    (old,), (new,) = put(store, street(TILE, 1)), put(store, street(TILE, 1, 6))
    renumbered = Tile(TILE, 77, old.gaussians)
    found = asked(TileAnswers(store), TilesRequest.of(held(renumbered), with_hashes=True))[TILE]
    assert tile_of_answer(TILE, found, renumbered) == new


def test_what_does_not_fit_comes_later_and_the_nearest_comes_first(store: SqliteStore) -> None:
    tiles = tiles_of_district(12)
    made = put(store, *(street(tile, k) for k, tile in enumerate(tiles)))
    size = len(store.get("ndt", tiles[0]).body)
    near, answers = tiles[7], TileAnswers(store)
    wanted: list[Tile | TileId] = [*tiles]
    rounds: list[set[TileId]] = []
    while any(isinstance(one, TileId) for one in wanted):
        request = TilesRequest.of(held(*wanted), max_bytes=round(3.5 * size), near=near)
        found = asked(answers, request)
        assert sum(len(answer.body) for answer in found.values()) <= 3.5 * size
        rounds.append({tile for tile, answer in found.items() if answer.status == "blob"})
        wanted = [made[k] if found[tile].status in ("blob", "unchanged") else tile for k, tile in enumerate(tiles)]
    assert near in rounds[0]
    assert set().union(*rounds) == set(tiles)
    assert sum(map(len, rounds)) == len(tiles), "a tile came twice"
    gap = [abs(t.lon_index - near.lon_index) ** 2 + abs(t.lat_index - near.lat_index) ** 2 for t in tiles]
    order = sorted(range(12), key=lambda k: (gap[k], k))
    assert rounds[0] == {tiles[k] for k in order[: len(rounds[0])]}


def test_the_first_body_always_fits(store: SqliteStore) -> None:
    a, b = tiles_of_district(2)
    put(store, street(a, 1), street(b, 2))
    found = asked(TileAnswers(store), TilesRequest.of(held(a, b), max_bytes=1))
    assert [found[tile].status for tile in (a, b)] == ["blob", "later"]


def test_unchanged_tiles_are_told_without_reading_bodies(store: SqliteStore, monkeypatch: pytest.MonkeyPatch) -> None:
    made = put(store, *(street(tile, k) for k, tile in enumerate(tiles_of_district(20))))
    monkeypatch.setattr(store, "get", lambda *_: pytest.fail("a body was read"))
    found = asked(TileAnswers(store), TilesRequest.of(held(*made)))
    assert {answer.status for answer in found.values()} == {"unchanged"}


def test_one_damaged_body_does_not_keep_the_others(store: SqliteStore, caplog: pytest.LogCaptureFixture) -> None:
    a, b = tiles_of_district(2)
    put(store, street(a, 1))
    put(store, street(a, 1, 4))
    damage(store, 2)
    put(store, street(b, 2))
    with caplog.at_level(logging.ERROR):
        found = asked(TileAnswers(store), TilesRequest.of(held(a, b), codecs=(CODEC_FLOAT32,)))
    assert [found[tile].status for tile in (a, b)] == ["later", "blob"]
    assert f"tile {a} cannot be sent: " in caplog.text
    with caplog.at_level(logging.CRITICAL), pytest.raises(SchemaError, match=f"tile {a} version 2"):
        asked(TileAnswers(store), TilesRequest.of(held(a), codecs=(CODEC_FLOAT32,)))


# What is remembered


def test_equal_questions_are_worked_out_once(store: SqliteStore, monkeypatch: pytest.MonkeyPatch) -> None:
    old, _ = put(store, street(TILE, 1))[0], put(store, street(TILE, 1, 4))
    answers = TileAnswers(store)
    requests = [TilesRequest.of(held(old)), TilesRequest.of(held(TILE), codecs=(CODEC_FLOAT32,))]
    first = [asked(answers, request) for request in requests]
    monkeypatch.setattr("gnd.tile_store.answers.encode_content_delta", lambda *_: pytest.fail("worked out again"))
    monkeypatch.setattr(StoredTile, "decode", lambda *_: pytest.fail("decoded again"))
    assert [asked(answers, request) for request in requests] == first


def test_memory_forgets_what_was_least_lately_used() -> None:
    memory: Memory[bytes] = Memory(10, len)
    made: list[str] = []

    def ask(key: str, size: int) -> bytes:
        def make() -> bytes:
            made.append(key)
            return bytes(size)

        return memory.get(key, make)

    for key, size in (("a", 4), ("b", 4), ("a", 4), ("c", 4), ("a", 4), ("b", 4)):
        assert len(ask(key, size)) == size
    assert made == ["a", "b", "c", "b"]
    assert (len(memory), memory.bytes) == (2, 8)
    ask("huge", 11)
    assert (len(memory), memory.bytes) == (0, 0)
    with pytest.raises(ZeroDivisionError):
        memory.get("fails", lambda: bytes(1 // 0))
    assert len(memory) == 0


def test_lattices_of_codecs() -> None:
    assert same_lattice(CODEC_STANDARD, CODEC_STANDARD_ZSTD)
    assert same_lattice(CODEC_FLOAT32, CODEC_FLOAT32_ZSTD)
    assert not same_lattice(CODEC_STANDARD, CODEC_FLOAT32)
