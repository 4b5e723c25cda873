"""Seals of archives: what is signed, byte by byte, and that nothing else passes as it."""

from hashlib import sha256

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.gnd_map.tile_id import TileId
from gnd.schemas.archive import ArchiveIndex, ArchiveRoot
from gnd.schemas.archive_seal import ArchiveSeal, SealNumber, sealed_text, with_seal
from gnd.schemas.errors import BadValue, SchemaError, TooLarge
from gnd.schemas.generated import archive_index_pb2
from gnd.schemas.limits import MAX_ARCHIVE_INDEX_BYTES as LIMIT

DISTRICT = TileId(497353963154).district
BODY = ArchiveIndex("ndt", DISTRICT).encode()
SEAL = ArchiveSeal(bytes(range(8)), 300, 1_795_780_247, bytes(range(8, 16)), bytes(range(64)))
SEALED = with_seal("index", BODY, SEAL, LIMIT)


def test_what_is_signed_is_this() -> None:
    """Written out by hand, so that no release signs anything else."""
    sealed = ArchiveIndex.decode(SEALED).sealed
    assert sealed is not None
    expected = b"gnd archive 1" + b"\x01" + sha256(BODY).digest() + bytes(range(8))
    expected += (300).to_bytes(8, "little") + (1_795_780_247).to_bytes(8, "little") + bytes(range(8, 16))
    assert sealed.text == expected
    assert sealed.seal == SEAL
    assert sealed.text != sealed_text("root", sealed.body_sha, SEAL.archive, SEAL.order, SEAL.signer)


def test_who_knows_no_seals_reads_the_same() -> None:
    """The seal is one field behind all others."""
    message = archive_index_pb2.ArchiveIndex.FromString(SEALED)
    message.ClearField("seal")
    assert message.SerializeToString(deterministic=True) == BODY
    assert ArchiveIndex.decode(SEALED) == ArchiveIndex.decode(BODY)
    assert ArchiveIndex.decode(BODY).sealed is None
    assert 95 <= len(SEALED) - len(BODY) <= 105


@given(st.integers(0, len(SEALED) - 1), st.integers(1, 255))
def test_another_byte_is_another_text_or_none(at: int, change: int) -> None:
    """Whatever is altered: what must have been signed differs, or there is no seal, or it is no file of an archive."""
    altered = bytearray(SEALED)
    altered[at] ^= change
    before = ArchiveIndex.decode(SEALED).sealed
    try:
        sealed = ArchiveIndex.decode(bytes(altered)).sealed
    except SchemaError:
        return
    assert sealed is None or before is None or (sealed.text, sealed.seal) != (before.text, before.seal)


@pytest.mark.parametrize("size", range(len(BODY), len(SEALED)))
def test_a_seal_that_is_cut_off_is_none(size: int) -> None:
    try:
        assert ArchiveIndex.decode(SEALED[:size]).sealed is None
    except SchemaError:
        assert size > len(BODY)


@pytest.mark.parametrize("data", [SEALED + b"\x12\x00", BODY + b"\x12\x00" + SEALED[len(BODY) :], SEALED + SEALED])
def test_what_lies_behind_or_between_is_not_taken_for_signed(data: bytes) -> None:
    with pytest.raises(BadValue, match="are not signed, nor a seal"):
        ArchiveIndex.decode(data)


@pytest.mark.parametrize(
    "wrong",
    [
        {"number": 0},
        {"number": 2**48},
        {"signed_s": -1},
        {"signed_s": 2**41},
        {"archive": b"x"},
        {"signer": b""},
        {"signature": bytes(63)},
    ],
)
def test_a_seal_is_within_bounds(wrong: dict[str, object]) -> None:
    told = {name: getattr(SEAL, name) for name in ("archive", "number", "signed_s", "signer", "signature")}
    with pytest.raises(BadValue, match=r"archive seal|outside"):
        ArchiveSeal(**told | wrong)  # type: ignore[arg-type]


def test_times_decide_before_numbers() -> None:
    assert SealNumber(10, 1) < SealNumber(10, 2) < SealNumber(11, 1)
    assert SealNumber() < SEAL.order


def test_a_file_that_readers_would_refuse_is_not_written() -> None:
    with pytest.raises(TooLarge):
        with_seal("index", BODY, SEAL, len(SEALED) - 1)


def test_a_root_names_the_state_of_each_index() -> None:
    root = ArchiveRoot({"ndt": (DISTRICT,), "signs": (DISTRICT,)}, {"ndt": (b"a" * 16,), "signs": (b"b" * 16,)})
    assert ArchiveRoot.decode(root.encode()) == root
    assert (root.digest("ndt", DISTRICT), root.digest("signs", DISTRICT)) == (b"a" * 16, b"b" * 16)
    assert root.digest("poles", DISTRICT) == b""
    assert root.digest("ndt", TileId(0).district) == b""
    with pytest.raises(BadValue, match="1 digests of 2 indexes"):
        ArchiveRoot(root.districts, {"ndt": (b"a" * 16,)})
