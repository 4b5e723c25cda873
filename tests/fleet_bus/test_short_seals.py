"""Short seals and the keys behind them: encoding, golden bytes, numbers used once, what follows from two halves."""

import hmac as stdlib_hmac
import time
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from hypothesis import given
from hypothesis import strategies as st

from gnd.fleet_bus import remembered
from gnd.fleet_bus.agreed_keys import (
    KEYS_A_MEMBER,
    REPLAY_WINDOW,
    AgreedKey,
    GrantedKeys,
    HeldKeys,
    KeyHalf,
    ReplayWindow,
    under_terse,
)
from gnd.fleet_bus.errors import SealError
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.remembered import FILE, RememberedChains
from gnd.fleet_bus.seal_keys import load_authority, load_signer
from gnd.fleet_bus.seals import Holder, Seal, question_digest
from gnd.fleet_bus.short_seals import LATE, MOST_COUNT, ShortSeal, TerseSeal, is_short, terse_id

KEY, ANSWERED_ON = "gnd/v1/change/ndt/13033/03021/12301", "gnd/v1/tiles/ndt/13033/03021/12301"
PUBLIC = ec.derive_private_key(7, ec.SECP256R1()).public_key()
SHARD = Holder("shard", "s1", "owner", b"shard-id", 4e9, PUBLIC)
VEHICLE = Holder("vehicle", "v1", "owner", b"vehic-id", 4e9, PUBLIC)


GOLDEN_TERSE = {
    "report": "eac8017a610a5db5109a6f",
    "question": "eac8025cbd5c2b",
    "answer": "ef311a42fd7db684",
    "refusal": "b37f51b19778402c40",
    "notice": "eac801da12e44ee30092db",
}


def half(byte: int, *, knows_terse: bool = False) -> KeyHalf:
    secret = X25519PrivateKey.from_private_bytes(bytes([byte]) * 32)
    share = secret.public_key().public_bytes_raw()
    return KeyHalf(secret, share[:-1] + bytes([share[-1] | (0x80 if knows_terse else 0)]))


def both(asks: Holder | None = VEHICLE, knows: tuple[bool, bool] = (False, False)) -> tuple[AgreedKey, AgreedKey]:
    """The same key at the side that asks and at the side that answers, always the same."""
    ours, theirs, digest = half(1, knows_terse=knows[0]), half(2, knows_terse=knows[1]), bytes(32)
    asker = ours.agree(theirs.share, digest, SHARD, asks, is_asker=True)
    return asker, theirs.agree(ours.share, digest, SHARD, asks, is_asker=False)


# ---- encoding


@given(
    what=st.sampled_from(["question", "notice"]),
    mac=st.binary(min_size=8, max_size=8),
    key_id=st.binary(min_size=3, max_size=3),
    count=st.integers(1, MOST_COUNT),
)
def test_numbered_seals_come_back(what, mac: bytes, key_id: bytes, count: int) -> None:
    seal = ShortSeal(what, mac, key_id, count)
    data = seal.encode()
    assert ShortSeal.decode(data) == seal
    assert is_short(data)
    assert len(data) <= 16
    with pytest.raises(SealError):
        Seal.decode(data)


@given(st.one_of(st.binary(max_size=20), st.binary(max_size=19).map(lambda tail: b"\xb1" + tail)))
def test_whatever_is_read_has_one_form(data: bytes) -> None:
    try:
        seal = ShortSeal.decode(data)
    except SealError:
        return
    assert seal.encode() == data


@given(
    data=st.one_of(st.binary(max_size=12), st.binary(max_size=11).map(lambda tail: b"\xc3" + tail)),
    newest=st.integers(0, MOST_COUNT),
)
def test_a_terse_seal_has_one_form_and_is_no_other(data: bytes, newest: int) -> None:
    try:
        seal = TerseSeal.decode(data)
    except SealError:
        return
    assert seal.encode() == data
    assert is_short(data)
    for other in (ShortSeal, Seal):
        with pytest.raises(SealError):
            other.decode(data)
    whole = whole_of(seal, "question", newest)
    if whole is not None:
        assert TerseSeal.decode(whole.encode_terse()) == seal


def whole_of(seal: TerseSeal, what, newest: int) -> ShortSeal | None:
    try:
        return seal.whole(what, seal.terse_id.to_bytes(2, "big") + b"x", newest)
    except SealError:
        assert newest > MOST_COUNT - 256
        return None


@given(newest=st.integers(0, MOST_COUNT - 256), ahead=st.integers(1 - LATE, 256 - LATE))
def test_a_number_is_found_by_its_lowest_byte(newest: int, ahead: int) -> None:
    """As long as it is no more late, or ahead, than one byte tells."""
    count = newest + ahead
    if count < 1:
        return
    sent = ShortSeal("notice", bytes(8), b"abc", count)
    assert TerseSeal.decode(sent.encode_terse()).whole("notice", b"abc", newest) == sent


@pytest.mark.parametrize("count", [0, -1, MOST_COUNT + 1])
def test_a_number_out_of_bounds_is_not_written(count: int) -> None:
    with pytest.raises(SealError, match="expected 1 to"):
        ShortSeal("question", bytes(8), bytes(3), count).encode()


@pytest.mark.parametrize(
    "data", ["b1000000" + "8100" + "00" * 8, "b1000000" + "00" + "00" * 8, "b1000000ffffffff", "b2"]
)
def test_other_forms_are_refused(data: str) -> None:
    with pytest.raises(SealError):
        ShortSeal.decode(bytes.fromhex(data))


def test_golden_bytes() -> None:
    """What is out there already: these bytes are never changed."""
    asker, answers = both()
    question = asker.question(KEY, b"report", is_bare=False)
    digest = question_digest(KEY, b"report", question.head)
    assert question.encode().hex() == "b144a59501c07f20fdd49236c3"
    assert asker.question(ANSWERED_ON, b"which", is_bare=True).encode().hex() == "b144a595027aed6e0f"
    assert answers.answer(KEY, b"true", digest, refusal=False).encode().hex() == "b2300ce66166a73792"
    assert answers.answer(KEY, b"no", digest, refusal=True).encode().hex() == "b3bcd7b205ffe8fcb1"
    assert answers.notice("gnd/v1/want/v1", b"released").encode().hex() == "b444a59501b32a2cd9ff918c5d"
    assert digest.hex() == "10e002edd3bdf0c0ae159e3a6c7a81dd8c2f3e3deda15da68750bda07700183e"


def test_golden_bytes_of_terse_seals() -> None:
    """The same proofs, and less beside them; an answer is its proof alone."""
    asker, answers = both(knows=(True, True))
    question = asker.question(KEY, b"report", is_bare=False)
    digest = question_digest(KEY, b"report", question.head)
    made = {
        "report": asker.written(question),
        "question": asker.written(asker.question(ANSWERED_ON, b"which", is_bare=True)),
        "answer": answers.written(answers.answer(KEY, b"true", digest, refusal=False)),
        "refusal": answers.written(answers.answer(KEY, b"no", digest, refusal=True)),
        "notice": answers.written(answers.notice("gnd/v1/want/v1", b"released")),
    }
    assert {what: data.hex() for what, data in made.items()} == GOLDEN_TERSE
    assert [len(data) for data in made.values()] == [11, 7, 8, 9, 11]
    assert question.encode()[-8:] == made["report"][-8:]


@pytest.mark.parametrize("knows", [(True, False), (False, True), (False, False)])
def test_a_part_of_an_older_release_gets_whole_seals(knows: tuple[bool, bool]) -> None:
    asker, answers = both(knows=knows)
    assert not asker.is_terse
    assert not answers.is_terse
    assert asker.key_id == answers.key_id
    seal = asker.question(KEY, b"report", is_bare=False)
    assert asker.written(seal) == seal.encode()
    answers.check_question(ShortSeal.decode(asker.written(seal)), KEY, b"report", 0, is_bare=False)
    assert KeyHalf.make().share[-1] & 0x80, "an older one leaves it 0, and does not look"


def test_the_mark_in_a_half_changes_the_name_of_the_key_and_not_its_secret() -> None:
    """X25519 ignores the highest bit (RFC 7748); all else that follows is made over the halves as they were sent."""
    ours, theirs = half(1), half(2)
    marked = theirs.share[:-1] + bytes([theirs.share[-1] | 0x80])
    shares = [ours.secret.exchange(X25519PublicKey.from_public_bytes(one)) for one in (theirs.share, marked)]
    assert shares[0] == shares[1]
    assert both()[0].key_id != both(knows=(True, True))[0].key_id


def test_keys_of_the_same_terse_name_are_told_apart() -> None:
    granted, askers = GrantedKeys(), []
    for number in range(300):
        ours, digest = KeyHalf.make(), number.to_bytes(32, "big")
        share = granted.grant(ours.share, digest, SHARD, replace(VEHICLE, name=f"w{number}"))
        if share:  # names have three bytes: one of some hundred runs has two keys of the same, and grants no second
            askers.append(ours.agree(share, digest, SHARD, replace(VEHICLE, name=f"w{number}"), is_asker=True))
    assert len(askers) >= 298
    one, other = askers[7], askers[8]
    granted._of_terse[terse_id(one.key_id)] = [one.key_id, other.key_id]  # as if their names began alike
    seal = one.question(KEY, b"report", is_bare=False)
    alike = granted.find_alike(terse_id(one.key_id))
    assert len(alike) == 2
    found = under_terse(alike, TerseSeal.decode(one.written(seal)), "question", KEY, b"report")
    assert found.key_id == one.key_id
    with pytest.raises(SealError, match="not known here"):
        under_terse(alike, TerseSeal.decode(one.written(seal)), "question", KEY, b"other")
    with pytest.raises(SealError, match="not known here"):
        under_terse([], TerseSeal.decode(one.written(seal)), "question", KEY, b"report")


def test_a_second_implementation_finds_the_same() -> None:
    """By the standard library alone: X25519 aside, HKDF (RFC 5869) and HMAC as docs/protocol.md describes them."""

    def parts(*values: bytes) -> bytes:
        return b"".join(len(one).to_bytes(4, "little") + one for one in values)

    def hmac(key: bytes, data: bytes) -> bytes:
        return stdlib_hmac.new(key, data, "sha256").digest()

    ours, theirs = half(1), half(2)
    secret = ours.secret.exchange(X25519PublicKey.from_public_bytes(theirs.share))
    names = (b"shard-id" + b"shard s1", b"vehic-id" + b"vehicle v1")
    pseudo = hmac(sha256(parts(ours.share + theirs.share, bytes(32), *names)).digest(), secret)
    made = block = b""
    for number in (1, 2, 3):
        block = hmac(pseudo, block + b"gnd agreed key 1" + bytes([number]))
        made += block
    asker, _ = both()
    assert asker.key_id == made[64:67]
    seal = asker.question(KEY, b"report", is_bare=False)
    text = parts(b"gnd short seal 1", b"\xb1" + made[64:67] + b"\x01", KEY.encode(), b"") + sha256(b"report").digest()
    assert seal.mac == hmac(made[:32], text)[:8]


def test_a_share_is_part_of_what_is_signed() -> None:
    plain = Seal("answer", bytes(8), 0, bytes(64))
    shared = replace(plain, share=bytes(32))
    assert Seal.decode(shared.encode()) == shared
    assert len(shared.encode()) == len(plain.encode()) + 32
    assert shared.signed_text(KEY, b"", b"") != plain.signed_text(KEY, b"", b"")
    assert question_digest("k", b"b", b"a") != question_digest("k", b"", b"ab") != question_digest("ka", b"b", b"")


# ---- keys


def test_both_sides_have_the_same_key_and_each_direction_its_own() -> None:
    asker, answers = both()
    assert asker.key_id == answers.key_id
    seal = asker.question(KEY, b"report", is_bare=False)
    answers.check_question(seal, KEY, b"report", 0, is_bare=False)
    digest = question_digest(KEY, b"report", seal.head)
    asker.check_answer(answers.answer(KEY, b"true", digest, refusal=False), KEY, b"true", digest)
    asker.check_notice(answers.notice(KEY, b"x"), KEY, b"x")
    with pytest.raises(SealError, match="does not fit"):  # what this side says is nothing that it may hear
        asker.check_answer(asker.question(KEY, b"true", is_bare=False), KEY, b"true", digest)


def test_another_question_name_or_half_gives_another_key() -> None:
    ours, theirs = half(1), half(2)
    made = {
        ours.agree(theirs.share, digest, answers, asks, is_asker=True).key_id
        for digest in (bytes(32), b"\1" * 32)
        for answers in (SHARD, replace(SHARD, name="s2"), replace(SHARD, certificate_id=b"another!"))
        for asks in (VEHICLE, None)
    }
    made.add(ours.agree(half(3).share, bytes(32), SHARD, VEHICLE, is_asker=True).key_id)
    assert len(made) == 13


@pytest.mark.parametrize("theirs", [bytes(32), b"\1" + bytes(31), b"short", bytes(33)])
def test_no_half_of_a_key(theirs: bytes) -> None:
    with pytest.raises(SealError, match="cannot be used"):
        half(1).agree(theirs, bytes(32), SHARD, None, is_asker=True)


@given(st.lists(st.integers(1, 3 * REPLAY_WINDOW), max_size=200))
def test_each_number_counts_once(counts: list[int]) -> None:
    """As a set does it, but for numbers that are too old."""
    window, used, newest = ReplayWindow(), set(), 0
    for count in counts:
        expected = count not in used and count > newest - REPLAY_WINDOW
        assert window.take(count) is expected
        used.add(count)
        newest = max(newest, count)


def test_numbers_end() -> None:
    asker, _ = both()
    assert asker.is_fresh()
    asker._asked = MOST_COUNT
    assert not asker.is_fresh()
    with pytest.raises(SealError):
        asker.question(KEY, b"", is_bare=False)


def test_an_old_key_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    asker, _ = both()
    later_s = time.monotonic() + 86_401
    monkeypatch.setattr(time, "monotonic", lambda: later_s)
    assert not asker.is_fresh()


def test_several_parts_in_a_role() -> None:
    held, second = HeldKeys(), replace(SHARD, name="s2", certificate_id=b"shard-2!")
    one = half(1).agree(half(2).share, bytes(32), SHARD, VEHICLE, is_asker=True)
    two = half(1).agree(half(3).share, bytes(32), second, VEHICLE, is_asker=True)
    held.add("a", one)
    assert held.to_use("b", "shard") is one  # the only one: most likely it answers there, too
    assert held.to_use("b", "tiles") is None
    held.forget("b", one)  # it was another that answered there: that of "a" still seals its notices with this key
    assert held.find(one.key_id) is one
    assert held.to_use("a", "shard") is one
    held.answered("b", second)
    assert held.to_use("b", "shard") is None
    held.add("b", two)
    assert held.to_use("a", "shard") is one
    assert held.to_use("b", "shard") is two
    assert held.to_use("c", "shard") is None  # nobody knows which
    held.forget("a", one)
    assert held.to_use("a", "shard") is two
    assert held.find(two.key_id) is two
    assert held.find(one.key_id) is None


def test_granted_keys_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gnd.fleet_bus.agreed_keys.MOST_UNNAMED", 5)
    monkeypatch.setattr("gnd.fleet_bus.agreed_keys.MOST_NAMED", 6)
    granted = GrantedKeys()
    for _ in range(10):
        assert granted.grant(KeyHalf.make().share, bytes(32), SHARD, None)
        assert granted.grant(KeyHalf.make().share, bytes(32), SHARD, VEHICLE)
    assert len(granted._unnamed) == 5
    assert len(granted._named) == KEYS_A_MEMBER
    for number in range(8):
        assert granted.grant(KeyHalf.make().share, bytes(32), SHARD, replace(VEHICLE, name=f"w{number}"))
    assert len(granted._named) == 6
    assert set(granted._of_name) == {f"w{number}" for number in range(2, 8)}
    assert sum(map(len, granted._of_terse.values())) == 6 + 5
    assert granted.of_name("w7") is None  # it has not used its key yet
    assert granted.grant(bytes(32), bytes(32), SHARD, None) == b""


# ---- certificates of others


def test_certificates_are_kept_over_a_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    authority = Authority.create(tmp_path / "authority", "test")
    for name in (MemberName("vehicle", "v1"), MemberName("tiles", "t1"), MemberName("tiles", "t2")):
        authority.issue(name, tmp_path / name.name)
    signers = [load_signer(tmp_path / name) for name in ("t1", "t2")]
    known = load_authority(tmp_path / "v1")
    assert known.holder(signers[0].certificate_id) is None
    for signer in signers:
        known.learn(signer.chain)
    again = load_authority(tmp_path / "v1")
    found = again.holder(signers[0].certificate_id)
    assert found is not None
    assert str(found) == "tiles t1"
    file = tmp_path / "v1" / FILE
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])  # the machine went down while it was written
    cut = RememberedChains(file)
    assert cut.get(signers[0].certificate_id) == signers[0].chain
    assert cut.get(signers[1].certificate_id) is None
    first_bytes = 2 + len(signers[0].chain)
    assert file.read_bytes() == whole[:first_bytes]
    monkeypatch.setattr(remembered, "MOST_BYTES", len(whole) - 1)
    file.write_bytes(whole)
    assert RememberedChains(file).get(signers[1].certificate_id) == signers[1].chain  # the newest stay
    later_s = time.time() + 400 * 86_400
    monkeypatch.setattr(time, "time", lambda: later_s)
    RememberedChains(file)
    assert file.read_bytes() == b""  # what has ended is not kept


def test_a_folder_that_cannot_be_written(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    chains = RememberedChains(tmp_path / "not there" / FILE)
    with caplog.at_level("INFO"):
        chains.add(b"one", b"chain")
        chains.add(b"two", b"chain")
    assert chains.get(b"one") == b"chain"
    assert [record.levelname for record in caplog.records] == ["INFO"]
