"""Tiles of a district in one query: what is asked and answered survives, is small, and lies are found."""

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from schema_values import EAST, HELD, NEXT, OTHER_SHA, SHA, TILE, gaussians, shas, versions

from gnd.gnd_map.codec import CODEC_STANDARD, CODEC_STANDARD_ZSTD, encode_delta, encode_gaussians, encode_tiles
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue, Malformed, TooLarge, WrongHash, WrongVersion
from gnd.schemas.generated import tiles_reply_pb2, tiles_request_pb2
from gnd.schemas.tiles import CodedDelta, TileReply, blob_of, tile_after, tile_of
from gnd.schemas.tiles_batch import (
    EVERY_CODEC,
    HeldVersion,
    OtherTiles,
    TileAnswer,
    TilesReply,
    TilesRequest,
    digest_of,
    index_of,
    tile_of_answer,
)
from gnd.schemas.updates import TileUpdate, updated
from gnd.schemas.version_signature import VersionSignature

DISTRICT = TILE.district
DELTA = encode_delta(TILE, HELD.gaussians, NEXT.gaussians)
HASH = NEXT.sha[:4]
ALL_TILES = encode_tiles([(k, 1) for k in range(1024)])


def tile_at(index: int) -> TileId:
    return TileId(DISTRICT.first_morton + index)


held_pairs = st.one_of(st.just((0, b"")), st.tuples(st.integers(1, 2**31 - 1), shas))
helds = st.dictionaries(st.integers(0, 1023), held_pairs, min_size=1, max_size=30).map(
    lambda found: [HeldVersion(tile_at(index), *pair) for index, pair in found.items()]
)


@st.composite
def any_signature(draw: Any) -> VersionSignature:
    signer = draw(st.sampled_from([b"signer-1", b"signer-2"]) | st.binary(min_size=8, max_size=8))
    made_s, later_s = (
        draw(st.sampled_from([0, 1_764_000_000, 2**40 - 2**33]) | st.integers(0, 2**39)),
        draw(st.just(0) | st.integers(0, 2**32 - 1)),
    )
    kind = draw(st.sampled_from(["merged", "base", "rollback"]))
    return VersionSignature(signer, kind, made_s, made_s + later_s, draw(st.binary(min_size=64, max_size=64)))


@st.composite
def any_answer(draw: Any) -> TileAnswer:
    status = draw(st.sampled_from(["blob", "delta", "unchanged", "absent", "later", "hash"]))
    if status not in ("blob", "delta"):
        return TileAnswer(status)
    codec = draw(st.integers(0, 2**32 - 1)) if status == "blob" else 0
    body, day = draw(st.binary(max_size=40)), draw(st.sampled_from([0, 1, 9750, 2**16 - 1]))
    return TileAnswer(status, draw(versions), draw(shas)[:4], codec, body, day, draw(st.none() | any_signature()))


@given(helds, st.booleans(), st.integers(1, limits.MAX_TILE_BODY_BYTES), st.none() | st.integers(0, 1023))
def test_any_request_survives(held: list[HeldVersion], with_hashes: bool, max_bytes: int, near: int | None) -> None:
    around = None if near is None else tile_at(near)
    request = TilesRequest.of(held, max_bytes=max_bytes, near=around, with_hashes=with_hashes)
    again = TilesRequest.decode(request.encode())
    assert again == request
    assert again.tiles(DISTRICT) == tuple(sorted(one.tile for one in held))
    assert again.n_held == sum(one.version > 0 for one in held)


@given(st.lists(any_answer(), max_size=40))
@settings(max_examples=60)
def test_any_reply_survives(answers: list[TileAnswer]) -> None:
    reply = TilesReply(tuple(answers))
    assert TilesReply.decode(reply.encode()) == reply


@given(
    st.dictionaries(st.integers(-40, 40).filter(bool), helds, max_size=3),
    helds,
    st.lists(st.none() | st.lists(any_answer(), max_size=5), max_size=3),
    st.lists(any_answer(), max_size=5),
)
@settings(max_examples=60)
def test_any_request_and_reply_about_several_districts_survives(
    others: dict[int, list[HeldVersion]],
    held: list[HeldVersion],
    told: list[list[TileAnswer] | None],
    answers: list[TileAnswer],
) -> None:
    parts = {}
    for step, of_home in others.items():
        moved = [replace(one, tile=TileId(one.tile.morton + 1024 * step)) for one in of_home]
        parts[moved[0].tile.district] = TilesRequest.of(moved, max_bytes=9)
    alone = TilesRequest.of(held, max_bytes=9)
    request = alone.with_others(DISTRICT, parts)
    again = TilesRequest.decode(request.encode())
    assert again == request
    assert again.by_district(DISTRICT) == {DISTRICT: alone} | parts
    reply = TilesReply(tuple(answers), others=tuple(None if one is None else TilesReply(tuple(one)) for one in told))
    assert TilesReply.decode(reply.encode()) == reply


def test_a_question_about_three_districts_is_shorter_than_three() -> None:
    """Beside the key and all that a question costs on its way."""
    steps = {tile_at(0).district: TilesRequest.of([HeldVersion(tile_at(k)) for k in range(0, 1024, 3)])}
    for step in (1, 2):
        tiles = [HeldVersion(TileId(tile_at(k).morton + 1024 * step)) for k in range(0, 1024, 3)]
        steps[tiles[0].tile.district] = TilesRequest.of(tiles)
    first, *_ = steps.values()
    together = first.with_others(DISTRICT, {one: part for one, part in steps.items() if one != DISTRICT})
    assert len(together.encode()) < sum(len(one.encode()) for one in steps.values())


def test_a_request_for_the_same_tiles_is_the_same_in_whatever_order_they_are_named() -> None:
    held = [HeldVersion(EAST, 2, OTHER_SHA), HeldVersion(TILE, 3, SHA), HeldVersion(tile_at(1023))]
    assert TilesRequest.of(held) == TilesRequest.of(held[::-1])
    assert TilesRequest.of(held).held_digest == digest_of([SHA, OTHER_SHA])


def test_codecs_that_everybody_reads_are_not_spelt_out() -> None:
    asked = TilesRequest.of([HeldVersion(TILE)], codecs=EVERY_CODEC).encode()
    assert len(asked) < len(TilesRequest.of([HeldVersion(TILE)], codecs=(0,)).encode())
    assert TilesRequest.decode(asked).codecs == EVERY_CODEC


def test_a_hundred_unchanged_tiles_cost_less_than_half_a_bit_each() -> None:
    reply = TilesReply((TileAnswer("unchanged"),) * 100).encode()
    assert 8 * len(reply) < 50 + 8 * 2  # two bytes are the major version


def test_a_delta_in_a_reply_costs_little_more_than_itself() -> None:
    alone = len(TilesReply((TileAnswer("unchanged"),)).encode())
    more = TilesReply((TileAnswer("unchanged"), *[TileAnswer("delta", 4, HASH, 0, DELTA)] * 20)).encode()
    assert len(more) - alone <= 20 * (len(DELTA) + 8) + 8


def test_the_day_of_a_survey_costs_four_bytes_whatever_the_number_of_tiles() -> None:
    without, dated = (TilesReply((TileAnswer("delta", 4, HASH, 0, DELTA, day),) * 200).encode() for day in (0, 9750))
    assert len(dated) - len(without) == 4
    assert {answer.day for answer in TilesReply.decode(dated).answers} == {9750}


def test_signatures_cost_64_bytes_each_and_little_more_in_all() -> None:
    signed = VersionSignature(b"signer-1", "base", 1_764_000_000, 1_764_000_000, bytes(64))
    for count in (1, 20, 200):
        bare, full = (
            TilesReply((TileAnswer("delta", 4, HASH, 0, DELTA, 9750, one),) * count).encode() for one in (None, signed)
        )
        assert 64 * count < len(full) - len(bare) <= 64 * count + 31


def test_an_older_reader_passes_over_signatures() -> None:
    """What it does not know it ignores; a reply without them is the same to the byte as before there were any."""
    signed = VersionSignature(b"signer-1", "base", 1_764_000_000, 1_764_000_000, bytes(64))
    bare, full = (TilesReply((TileAnswer("delta", 4, HASH, 0, DELTA, 9750, one),)).encode() for one in (None, signed))
    message = tiles_reply_pb2.TilesReply.FromString(full)
    message.ClearField("signatures")
    assert message.SerializeToString(deterministic=True) == bare
    assert TilesReply.decode(bare).answers[0].signature is None


def test_signatures_that_are_not_one_each_are_refused() -> None:
    signed = VersionSignature(b"signer-1", "base", 1_764_000_000, 1_764_000_000, bytes(64))
    whole = TilesReply((TileAnswer("delta", 4, HASH, 0, DELTA, 9750, signed),) * 3).encode()

    def changed(change: Any) -> bytes:
        message = tiles_reply_pb2.TilesReply.FromString(whole)
        change(message.signatures)
        return message.SerializeToString()

    def fewer(signatures: Any) -> None:
        signatures.signatures = signatures.signatures[:128]

    def nobody(signatures: Any) -> None:
        signatures.signed_by[:] = [2]

    def cut(signatures: Any) -> None:
        signatures.signers = signatures.signers[:7]

    def early(signatures: Any) -> None:
        signatures.made_s[:] = [-5]

    for change, why in ((fewer, "2 version signatures by 1"), (nobody, "3 version"), (cut, "7 bytes"), (early, "-5 s")):
        with pytest.raises(BadValue, match=why):
            TilesReply.decode(changed(change))


def test_days_that_are_not_one_each_are_refused() -> None:
    message = tiles_reply_pb2.TilesReply.FromString(TilesReply((TileAnswer("delta", 4, HASH, 0, DELTA),) * 3).encode())
    message.days.extend([9750, 9751])
    with pytest.raises(BadValue, match="3 tiles has 2 days"):
        TilesReply.decode(message.SerializeToString())
    message.days[:] = [2**16]
    with pytest.raises(BadValue, match="day 65536 is outside"):
        TilesReply.decode(message.SerializeToString())


# What comes out


@pytest.mark.parametrize("codec_id", [0, CODEC_STANDARD, CODEC_STANDARD_ZSTD])
def test_a_tile_comes_whole_in_any_codec_that_can_express_it(codec_id: int) -> None:
    blob = blob_of(NEXT, codec_id)
    assert tile_of(blob) == NEXT
    answer = TileAnswer("blob", 4, HASH, codec_id, blob.body)
    assert tile_of_answer(TILE, TilesReply.decode(TilesReply((answer,)).encode()).answers[0]) == NEXT


def test_a_delta_gives_the_next_version_wherever_it_comes() -> None:
    reply = TileReply("delta", delta=CodedDelta(TILE, 4, NEXT.sha, DELTA))
    received = TileReply.decode(reply.encode()).delta
    assert received is not None
    assert tile_after(received, HELD) == NEXT
    assert tile_of_answer(TILE, TileAnswer("delta", 4, HASH, 0, DELTA), HELD) == NEXT
    update = TileUpdate(TILE, "ndt", 4, 3, NEXT.sha, HELD.sha, "merged", coded_delta=DELTA, put_voxels=2)
    assert updated(TileUpdate.decode(update.encode()), HELD) == NEXT
    assert updated(TileUpdate.decode(replace(update, day=9750).encode()), HELD).day == 9750
    assert tile_of_answer(TILE, TileAnswer("delta", 4, HASH, 0, DELTA, 9750), HELD).day == 9750


def test_a_delta_against_other_content_is_a_wrong_hash() -> None:
    """One error for all ways to find it out: the client then fetches the tile whole."""
    delta = CodedDelta(TILE, 4, NEXT.sha, DELTA)
    other = Tile(TILE, 2, gaussians([1, 2, 3]))
    with pytest.raises(WrongHash, match="fetch"):
        tile_after(delta, other)
    with pytest.raises(WrongHash, match="fetch"):
        tile_of_answer(TILE, TileAnswer("delta", 4, OTHER_SHA[:4], 0, DELTA), HELD)
    with pytest.raises(WrongHash, match="nothing is held"):
        tile_of_answer(TILE, TileAnswer("delta", 4, HASH, 0, DELTA))
    with pytest.raises(WrongHash, match=f"is not for tile {TILE}"):
        tile_after(CodedDelta(EAST, 4, NEXT.sha, DELTA), HELD)
    for damaged in (b"", DELTA[:-1], bytes([DELTA[0] ^ 64]) + DELTA[1:], DELTA + b"x", DELTA[:-3] + b"abc"):
        with pytest.raises(WrongHash, match="fetch"):
            tile_after(CodedDelta(TILE, 4, NEXT.sha, damaged), HELD)
    with pytest.raises(WrongHash, match="has no delta"):
        updated(TileUpdate(TILE, "ndt", 4, 3, NEXT.sha, HELD.sha, "merged"), HELD)


def test_a_whole_tile_that_is_another_or_in_no_codec_is_refused() -> None:
    body = encode_gaussians(NEXT.gaussians)
    with pytest.raises(WrongHash, match="content has sha"):
        tile_of_answer(EAST, TileAnswer("blob", 4, HASH, 0, body))
    with pytest.raises(BadValue, match="codec 99 is unknown"):
        tile_of_answer(TILE, TileAnswer("blob", 4, HASH, 99, body))
    with pytest.raises(BadValue, match="answer 'later' about tile"):
        tile_of_answer(TILE, TileAnswer("later"))
    forged = (10**9).to_bytes(4, "little") + bytes(36)  # forty bytes that claim 10^9 voxels
    for codec_id in EVERY_CODEC:
        with pytest.raises(BadValue):
            tile_of_answer(TILE, TileAnswer("blob", 4, HASH, codec_id, forged))
        with pytest.raises(WrongHash):
            tile_of_answer(TILE, TileAnswer("delta", 4, HASH, 0, bytes([codec_id]) + forged), HELD)


# Requests and replies that cannot be


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"wanted": ()}, "for no tiles"),
        ({"wanted": ((5, 0), (5, 0))}, "ascending in 0 .. 1023, once each"),
        ({"wanted": ((6, 0), (5, 0))}, "ascending in 0 .. 1023"),
        ({"wanted": ((1024, 0),)}, "ascending in 0 .. 1023"),
        ({"wanted": ((-1, 0),)}, "ascending in 0 .. 1023"),
        ({"wanted": ((0, 2**31),)}, r"held version 2147483648 of tile 0 is outside 0 \.\. 2147483647"),
        ({"wanted": ((0, 3),)}, "1 tiles held, a digest of 0 bytes and 0 hashes"),
        ({"held_digest": bytes(8)}, "0 tiles held, a digest of 8 bytes"),
        ({"wanted": ((0, 3),), "held_digest": bytes(7)}, "a digest of 7 bytes"),
        ({"wanted": ((0, 3), (1, 1)), "held_hashes": (bytes(8),)}, "2 tiles held, .* and 1 hashes"),
        ({"wanted": ((0, 3),), "held_hashes": (bytes(9),)}, "1 hashes: a digest of 8 bytes, or a hash of so many"),
        (
            {"wanted": ((0, 3),), "held_hashes": (bytes(8),), "held_digest": bytes(8)},
            "a digest of 8 bytes and 1 hashes",
        ),
        ({"max_bytes": 0}, r"for 0 bytes: 1 \.\. 4194304"),
        ({"max_bytes": 2**31}, "for 2147483648 bytes"),
        ({"near": 1024}, "near tile 1024: a district has 0 .. 1023"),
        ({"codecs": ()}, "at least one"),
    ],
)
def test_a_request_that_cannot_be_is_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(BadValue, match=message):
        TilesRequest(**({"wanted": ((0, 0),)} | fields))


def test_a_request_for_two_districts_is_refused() -> None:
    with pytest.raises(BadValue, match="tiles of 2 districts: one only"):
        TilesRequest.of([HeldVersion(TILE), HeldVersion(TileId(TILE.morton + 1024))])
    with pytest.raises(BadValue, match="once each"):
        TilesRequest.of([HeldVersion(TILE), HeldVersion(TILE)])


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ((OtherTiles(1, ((0, 0),)), OtherTiles(1, ((1, 0),))), "some of them twice"),
        (tuple(OtherTiles(n, ((0, 0),)) for n in range(1, 5)), "4 other districts, the limit is 3"),
    ],
)
def test_other_districts_that_cannot_be_are_refused(others: tuple[OtherTiles, ...], message: str) -> None:
    with pytest.raises((BadValue, TooLarge), match=message):
        TilesRequest(((0, 0),), others=others)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"step": 0}, "for another district, 0 from the key's"),
        ({"step": 2**29}, "for another district, 536870912 from the key's"),
        ({"wanted": ()}, "for no tiles"),
        ({"wanted": ((0, 1),)}, "1 tiles held of another district and a digest of 0 bytes"),
        ({"held_digest": bytes(8)}, "0 tiles held of another district and a digest of 8 bytes"),
    ],
)
def test_tiles_of_another_district_that_cannot_be_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(BadValue, match=message):
        OtherTiles(**({"step": 1, "wanted": ((0, 0),)} | fields))


def test_a_district_outside_the_world_is_refused() -> None:
    request = TilesRequest(((0, 0),), others=(OtherTiles(-(2**29) + 1, ((0, 0),)),))
    with pytest.raises(BadValue, match="for the district -536870911 from"):
        request.by_district(DISTRICT)
    hashes = TilesRequest(((0, 3),), held_hashes=(bytes(8),))
    with pytest.raises(BadValue, match="with the hashes of what is held of another district"):
        TilesRequest(((0, 0),)).with_others(DISTRICT, {tile_at(0).district: hashes})


def request_bytes(**fields: Any) -> bytes:
    plain = {"major": 1, "wanted": encode_tiles([(0, 3)]), "held_digest": bytes(8)}
    return tiles_request_pb2.TilesRequest(**(plain | fields)).SerializeToString()


@pytest.mark.parametrize(
    ("fields", "error", "message"),
    [
        ({"wanted": b""}, BadValue, "TilesRequest"),
        ({"wanted": b"\xff" * 40}, BadValue, "TilesRequest"),
        (
            {"wanted": encode_tiles([(k, 1) for k in range(1024)]), "held_hashes": bytes(8188)},
            BadValue,
            "of 8188 bytes",
        ),
        ({"held_digest": b"", "held_hashes": bytes(12)}, BadValue, "hashes of 12 bytes, not a multiple of 8"),
        ({"codecs": range(17)}, TooLarge, "has 17 codecs, the limit is 16"),
        ({"max_bytes": 2**32 - 1}, BadValue, "for 4294967295 bytes"),
        ({"near": 4000}, BadValue, "near tile 4000"),
        ({"held_hashes": bytes(25_000)}, TooLarge, "exceeds the limit of 24576 bytes"),
    ],
)
def test_hostile_request_bytes_are_refused_by_name(
    fields: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        TilesRequest.decode(request_bytes(**fields))
    assert TilesRequest.decode(request_bytes()).n_held == 1


def reply_bytes(**fields: Any) -> bytes:
    plain = {"major": 1, "runs": [8 + 1], "versions": [4], "hashes": HASH, "codecs": [0], "bodies": [b"body"]}
    return tiles_reply_pb2.TilesReply(**(plain | fields)).SerializeToString()


@pytest.mark.parametrize(
    ("fields", "error", "message"),
    [
        ({"runs": [8 * 10**8 + 3]}, TooLarge, "has 100000000 tiles, the limit is 1024"),
        ({"runs": [8 + 3] * 1025}, TooLarge, "has 1025 runs, the limit is 1024"),
        ({"runs": [1]}, BadValue, "with an empty run"),
        ({"runs": [8]}, BadValue, "answer status 0 is unknown"),
        ({"runs": [15]}, BadValue, "answer status 7 is unknown"),
        (
            {"runs": [16 + 1]},
            BadValue,
            "brings 2 tiles, 2 of them whole, has 1 versions, 1 hashes, 1 bodies",
        ),
        ({"runs": [8 + 2]}, BadValue, "brings 1 tiles, 0 of them whole, has .* 1 codecs"),
        ({"runs": []}, BadValue, "brings 0 tiles"),
        ({"versions": [0]}, BadValue, "tile version 0 is outside 1"),
        ({"hashes": HASH[:3]}, BadValue, "hashes of 3 bytes, not a multiple of 4"),
        ({"bodies": [b"", b""]}, BadValue, "2 bodies"),
        ({"bodies": [bytes(limits.MAX_TILE_BODY_BYTES + 1)]}, TooLarge, "has 4194305 bytes, the limit is 4194304"),
        ({"bodies": [b""] * 6000}, TooLarge, "has more than 5184 fields"),
    ],
)
def test_hostile_reply_bytes_are_refused(fields: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        TilesReply.decode(reply_bytes(**fields))
    assert TilesReply.decode(reply_bytes()).answers == (TileAnswer("blob", 4, HASH, 0, b"body"),)


def test_replies_about_other_districts_that_cannot_be_are_refused() -> None:
    request = TilesRequest(((0, 0),), others=(OtherTiles(1, ((0, 0),)), OtherTiles(2, ((0, 0),))))
    absent = TilesReply((TileAnswer("absent"),))
    assert list(absent.by_district(request, DISTRICT)) == [DISTRICT], "an older server"
    assert len(replace(absent, others=(None, absent)).by_district(request, DISTRICT)) == 2
    with pytest.raises(BadValue, match="about 1 other districts, asked for 2"):
        replace(absent, others=(absent,)).by_district(request, DISTRICT)
    with pytest.raises(BadValue, match="itself about others"):
        replace(absent, others=(replace(absent, others=(None,)),))
    deep = absent.encode()
    for _ in range(100):  # as deep as it may be: refused before what is below is read
        deep = reply_bytes(others=[deep])
    for others, error, message in (
        ([deep], BadValue, "itself about others"),
        ([b"\xff"], Malformed, "truncated"),
        ([reply_bytes(major=2)], WrongVersion, "major version 2"),
        ([b""] * 4, TooLarge, "4 other districts, the limit is 3"),
        ([reply_bytes(bodies=[b""] * 6000)], TooLarge, "more than 5184 fields"),
    ):
        with pytest.raises(error, match=message):
            TilesReply.decode(reply_bytes(others=others))


def test_a_truncated_reply_is_malformed() -> None:
    with pytest.raises(Malformed, match="truncated"):
        TilesReply.decode(reply_bytes()[:-1])


@pytest.mark.parametrize(
    "fields",
    [
        {"status": "blob", "version": 4, "sha": HASH[:3]},
        {"status": "delta", "version": 4, "sha": HASH, "codec_id": 3},
        {"status": "later", "body": b"body"},
        {"status": "unchanged", "version": 4},
    ],
)
def test_an_answer_that_cannot_be_is_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(BadValue, match=f"answer '{fields['status']}' with version"):
        TileAnswer(**fields)


def test_a_reply_about_other_tiles_than_asked_for_is_refused() -> None:
    request = TilesRequest.of([HeldVersion(TILE, 3, HELD.sha), HeldVersion(EAST)])
    unchanged, absent = TileAnswer("unchanged"), TileAnswer("absent")
    assert TilesReply((unchanged, absent)).of_request(request, DISTRICT) == [(TILE, unchanged), (EAST, absent)]
    with pytest.raises(BadValue, match="about 3 tiles, asked for 2"):
        TilesReply((unchanged, absent, absent)).of_request(request, DISTRICT)
    for status in ("unchanged", "hash"):
        with pytest.raises(BadValue, match=f"says '{status}' of tile {index_of(EAST)}, of which nothing is held"):
            TilesReply((unchanged, TileAnswer(status))).of_request(request, DISTRICT)  # type: ignore[arg-type]


def test_a_reply_with_a_delta_or_blob_too_many_is_refused() -> None:
    with pytest.raises(BadValue, match="TileReply 'delta' without a delta"):
        TileReply("delta")
    with pytest.raises(BadValue, match="TileReply 'unchanged' with a delta"):
        TileReply("unchanged", delta=CodedDelta(TILE, 4, NEXT.sha, DELTA))
    plain = TileUpdate(TILE, "ndt", 4, 3, NEXT.sha, HELD.sha, "merged", coded_delta=DELTA, put_voxels=2)
    with pytest.raises(BadValue, match="puts 7 and removes 0 voxels by 0 coded bytes"):
        TileUpdate(TILE, "ndt", 4, 3, NEXT.sha, HELD.sha, "merged", put_voxels=7)
    assert (plain.voxels, plain.has_delta) == ((2, 0), True)
