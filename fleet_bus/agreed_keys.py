"""Keys that two parts agree on: who asks offers half of one with a question, who answers gives the other half.

The halves are X25519 keys, made for this alone and forgotten at once: who steals the key of a certificate later can
read nothing from what was said (forward secrecy). The answer that brings the second half is signed, and bound to the
question with the first half; so is a report's question. From the secret follow, by HKDF-SHA-256 over both halves, the
question and both names, a key for each direction and the 3 bytes that name them.

The highest bit of a half is none of the key (RFC 7748): there a part says that it knows terse seals. Both halves are
part of what is signed or bound, so nobody in between can alter it unseen; a part of an older release leaves it 0.

Whom a key speaks for is asked of the certificates each time it is used: a member that is revoked, or whose certificate
has ended, has no keys either.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from hmac import compare_digest
from typing import TYPE_CHECKING, Final, TypeVar

from gnd.fleet_bus.errors import SealError
from gnd.fleet_bus.seals import Holder
from gnd.fleet_bus.short_seals import (
    BARE_MAC_BYTES,
    KEY_ID_BYTES,
    MAC_BYTES,
    MOST_COUNT,
    ShortSeal,
    ShortWhat,
    TerseSeal,
    check_mac,
    mac_of,
    mac_over,
    terse_id,
)

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

LONGEST_S: Final = 86_400.0
"""After so long another key is agreed on."""
REPLAY_WINDOW: Final = 1024
"""Numbers may come in another order, up to so many late."""
MOST_NAMED: Final = 65_536
"""Keys that a part keeps with members whom it knows ..."""
MOST_UNNAMED: Final = 16_384
"""... and with who has not said its name, which is anybody who asks about the map."""
KEYS_A_MEMBER: Final = 4
MOST_PARTS: Final = 16
"""Parts of the cloud that a part keeps a key with."""
KEYS_REMEMBERED: Final = 256
OFFER_AGAIN_S: Final = 5.0
MOST_ALIKE: Final = 64
"""Keys that one terse seal may name; full tables have 5 in the mean."""
_SECRET_BYTES: Final = 32
_KNOWS_TERSE: Final = 0x80
"""In the last byte of a half."""


class ReplayWindow:
    """Which numbers were used."""

    def __init__(self) -> None:
        self._newest, self._used = 0, 0

    def take(self, count: int) -> bool:
        """Use a number; False when it was used, or is so old that nobody knows."""
        ahead = count - self._newest
        if ahead > 0:
            self._used = (self._used << min(ahead, REPLAY_WINDOW) | 1) & ((1 << REPLAY_WINDOW) - 1)
            self._newest = count
            return True
        if -ahead >= REPLAY_WINDOW or self._used >> -ahead & 1:
            return False
        self._used |= 1 << -ahead
        return True


@dataclass(slots=True, eq=False)
class AgreedKey:
    """A key that this part and another have agreed on. Safe in several threads.

    Attributes:
        key_id: 3 bytes, as seals name it.
        other: who is at the other end; None = somebody who has not said so.
        is_used: the other side has shown that it has the key, too.
        is_terse: both sides know terse seals, and use them.
    """

    key_id: bytes
    other: Holder | None
    _asks: bytes = field(repr=False)
    _tells: bytes = field(repr=False)
    is_used: bool = False
    is_terse: bool = False
    _made_s: float = field(default_factory=time.monotonic)
    _asked: int = 0
    _told: int = 0
    _newest: int = 0
    _windows: dict[int, ReplayWindow] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def is_fresh(self) -> bool:
        """Whether it may be used for what is new."""
        return time.monotonic() - self._made_s < LONGEST_S and max(self._asked, self._told) < MOST_COUNT

    def question(self, key: str, payload: bytes, *, is_bare: bool) -> ShortSeal:
        """The seal of a question; `is_bare`: anybody may ask it."""
        with self._lock:
            self._asked += 1
            blank = ShortSeal("question", b"", self.key_id, self._asked)
        return self._with_mac(blank, self._asks, key, payload, b"", BARE_MAC_BYTES if is_bare else MAC_BYTES)

    def answer(self, key: str, payload: bytes, digest: bytes, *, refusal: bool) -> ShortSeal:
        """The seal of an answer to the question with that digest."""
        blank = ShortSeal("refusal" if refusal else "answer", b"")
        return self._with_mac(blank, self._tells, key, payload, digest, MAC_BYTES)

    def notice(self, key: str, payload: bytes) -> ShortSeal:
        """The seal of a notice to who is at the other end."""
        with self._lock:
            self._told += 1
            blank = ShortSeal("notice", b"", self.key_id, self._told)
        return self._with_mac(blank, self._tells, key, payload, b"", MAC_BYTES)

    def written(self, seal: ShortSeal) -> bytes:
        """A seal under this key as it goes out."""
        return seal.encode_terse() if self.is_terse else seal.encode()

    def answer_seal(self, attachment: bytes) -> ShortSeal:
        """The seal of an answer under this key; raises SealError."""
        if self.is_terse and len(attachment) == MAC_BYTES:
            return ShortSeal("answer", attachment)
        return ShortSeal.decode(attachment)

    def in_full(self, seal: TerseSeal, what: ShortWhat) -> ShortSeal:
        """The seal of a question or a notice in full, if it is under this key; raises SealError."""
        with self._lock:
            newest = self._newest
        return seal.whole(what, self.key_id, newest)

    def has_made(self, seal: ShortSeal, key: str, payload_sha: bytes) -> bool:
        """Whether a question or a notice that has come is under this key; its number is not looked at."""
        secret = self._asks if seal.what == "question" else self._tells
        return compare_digest(mac_over(secret, seal, key, payload_sha, b"", len(seal.mac)), seal.mac)

    def check_question(self, seal: ShortSeal, key: str, payload: bytes, handler: int, *, is_bare: bool) -> None:
        """Whether the other side asks this, for the first time of that handler; raises SealError."""
        check_mac(self._asks, seal, key, payload, b"", BARE_MAC_BYTES if is_bare else MAC_BYTES)
        self.is_used = True
        self._take(seal.count, handler)

    def check_answer(self, seal: ShortSeal, key: str, payload: bytes, digest: bytes) -> None:
        """Whether the other side answers so; raises SealError."""
        check_mac(self._tells, seal, key, payload, digest, MAC_BYTES)

    def check_notice(self, seal: ShortSeal, key: str, payload: bytes) -> None:
        """Whether the other side says so, for the first time; raises SealError."""
        check_mac(self._tells, seal, key, payload, b"", MAC_BYTES)
        self._take(seal.count, 0)

    def _take(self, count: int, handler: int) -> None:
        with self._lock:
            if not self._windows.setdefault(handler, ReplayWindow()).take(count):
                raise SealError(f"number {count} of a short seal was used before: somebody repeats a message")
            self._newest = max(self._newest, count)

    @staticmethod
    def _with_mac(blank: ShortSeal, secret: bytes, key: str, payload: bytes, digest: bytes, size: int) -> ShortSeal:
        return ShortSeal(blank.what, mac_of(secret, blank, key, payload, digest, size), blank.key_id, blank.count)


@dataclass(frozen=True, slots=True)
class KeyHalf:
    """Half of a key: what is kept, and what is shown."""

    secret: "X25519PrivateKey" = field(repr=False)
    share: bytes

    @classmethod
    def make(cls) -> "KeyHalf":
        """A new one."""
        from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

        secret = X25519PrivateKey.generate()
        share = bytearray(secret.public_key().public_bytes_raw())
        share[-1] |= _KNOWS_TERSE
        return cls(secret, bytes(share))

    def agree(
        self, theirs: bytes, question: bytes, answers: Holder, asks: Holder | None, *, is_asker: bool
    ) -> AgreedKey:
        """The key that follows from this half and the other one.

        Args:
            theirs: what the other side has shown.
            question: digest of the question that brought the first half.
            answers: who has answered.
            asks: who has asked, where the question was signed.
            is_asker: whether this side has asked.

        Raises:
            SealError: what the other side has shown is no half of a key.
        """
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PublicKey
        from cryptography.hazmat.primitives.kdf.hkdf import HKDF

        try:
            secret = self.secret.exchange(X25519PublicKey.from_public_bytes(theirs))
        except ValueError as error:
            raise SealError(f"half of a key, {len(theirs)} bytes, cannot be used: {error}") from None
        halves = self.share + theirs if is_asker else theirs + self.share
        names = [_names(answers), _names(asks)]
        bound = b"".join(len(one).to_bytes(4, "little") + one for one in (halves, question, *names))
        size = 2 * _SECRET_BYTES + KEY_ID_BYTES
        made = HKDF(hashes.SHA256(), size, salt=sha256(bound).digest(), info=b"gnd agreed key 1").derive(secret)
        asking, telling, key_id = made[:_SECRET_BYTES], made[_SECRET_BYTES:-KEY_ID_BYTES], made[-KEY_ID_BYTES:]
        is_terse = bool(self.share[-1] & theirs[-1] & _KNOWS_TERSE)
        return AgreedKey(key_id, answers if is_asker else asks, asking, telling, is_terse=is_terse)


def _names(holder: Holder | None) -> bytes:
    return b"" if holder is None else holder.certificate_id + str(holder).encode()


class GrantedKeys:
    """The keys of a part that answers. Safe in several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._named: OrderedDict[bytes, AgreedKey] = OrderedDict()
        self._unnamed: OrderedDict[bytes, AgreedKey] = OrderedDict()
        self._of_name: dict[str, list[bytes]] = {}
        self._of_terse: dict[int, list[bytes]] = {}

    def grant(self, theirs: bytes, question: bytes, own: Holder, asker: Holder | None) -> bytes:
        """Agree on a key with who has asked: the half to send; empty where there is to be none.

        Args: as `KeyHalf.agree`.
        """
        half = KeyHalf.make()
        try:
            agreed = half.agree(theirs, question, own, asker, is_asker=False)
        except SealError:  # the question is answered all the same
            return b""
        with self._lock:
            if agreed.key_id in self._named or agreed.key_id in self._unnamed:  # 3 bytes: once in some hundred, full
                return b""
            self._add(agreed)
        return half.share

    def find(self, key_id: bytes) -> AgreedKey | None:
        """The key of that id."""
        with self._lock:
            for table in (self._named, self._unnamed):
                if key_id in table:
                    table.move_to_end(key_id)
                    return table[key_id]
        return None

    def find_alike(self, number: int) -> list[AgreedKey]:
        """The keys that a terse seal may name, the newest first."""
        with self._lock:
            alike = [self._named.get(one) or self._unnamed[one] for one in self._of_terse.get(number, [])[::-1]]
        return [one for one in alike if one.is_terse]

    def of_name(self, name: str) -> AgreedKey | None:
        """The newest key with that member, if it has used it: else it may be gone there."""
        with self._lock:
            of_name = self._of_name.get(name)
            newest = self._named[of_name[-1]] if of_name else None
        return newest if newest is not None and newest.is_used and newest.is_fresh() else None

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            self._named.clear()
            self._unnamed.clear()
            self._of_name.clear()
            self._of_terse.clear()

    def _add(self, agreed: AgreedKey) -> None:
        self._of_terse.setdefault(terse_id(agreed.key_id), []).append(agreed.key_id)
        if agreed.other is None:
            self._unnamed[agreed.key_id] = agreed
            if len(self._unnamed) > MOST_UNNAMED:
                self._drop(next(iter(self._unnamed)))
        else:
            self._named[agreed.key_id] = agreed
            of_name = self._of_name.setdefault(agreed.other.name, [])
            of_name.append(agreed.key_id)
            if len(of_name) > KEYS_A_MEMBER:
                self._drop(of_name[0])
            if len(self._named) > MOST_NAMED:
                self._drop(next(iter(self._named)))
        alike = self._of_terse[terse_id(agreed.key_id)]
        if len(alike) > MOST_ALIKE:
            self._drop(next((one for one in alike if one in self._unnamed), alike[0]))

    def _drop(self, key_id: bytes) -> None:
        """Forget a key; its holder is asked for a signature."""
        agreed = self._unnamed.pop(key_id, None) or self._named.pop(key_id)
        _remove(self._of_terse, terse_id(key_id), key_id)
        if agreed.other is not None:
            _remove(self._of_name, agreed.other.name, key_id)


_PlaceT = TypeVar("_PlaceT")


def _remove(table: dict[_PlaceT, list[bytes]], place: _PlaceT, key_id: bytes) -> None:
    table[place].remove(key_id)
    if not table[place]:
        del table[place]


def under_terse(alike: Sequence[AgreedKey], seal: TerseSeal, what: ShortWhat, key: str, payload: bytes) -> AgreedKey:
    """Which of the keys that a terse seal may name it is under; of a single one that is still to be checked.

    Raises:
        SealError: none of them.
    """
    if len(alike) == 1:
        return alike[0]
    payload_sha = sha256(payload).digest() if alike else b""
    for one in alike:
        if one.has_made(one.in_full(seal, what), key, payload_sha):
            return one
    raise SealError(f"the terse seal of a {what} under a key that is not known here")


class HeldKeys:
    """The keys of a part that asks. Safe in several threads.

    Several parts may answer in a role, each with a key of its own: a question goes with the key of who has answered on
    its key expression before, or of the only part in that role.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of_part: OrderedDict[bytes, AgreedKey] = OrderedDict()
        self._part_of: OrderedDict[str, bytes] = OrderedDict()
        self._offered_s: dict[str, float] = {}

    def to_use(self, key: str, role: str) -> AgreedKey | None:
        """The key for a question to that role."""
        with self._lock:
            found = self._of_part.get(self._part_of.get(key, b""))
            if found is None and key not in self._part_of:
                in_role = [one for one in self._of_part.values() if one.other is not None and one.other.role == role]
                found = in_role[0] if len(in_role) == 1 else None
        return found if found is not None and found.is_fresh() else None

    def may_offer(self, role: str) -> bool:
        """Whether to offer half of a key now: questions that are asked at the same time need one."""
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._offered_s.get(role, -OFFER_AGAIN_S) < OFFER_AGAIN_S:
                return False
            self._offered_s[role] = now_s
        return True

    def offer_ended(self, role: str) -> None:
        """The question with the offer to that role has got its answers."""
        with self._lock:
            self._offered_s.pop(role, None)

    def add(self, key: str, agreed: AgreedKey) -> None:
        """Keep the key that was agreed on with who has answered on `key`."""
        assert agreed.other is not None
        with self._lock:
            self._of_part[agreed.other.certificate_id] = agreed
            if len(self._of_part) > MOST_PARTS:
                self._of_part.popitem(last=False)
        self.answered(key, agreed.other)

    def answered(self, key: str, part: Holder) -> None:
        """Note who has answered on a key expression."""
        with self._lock:
            self._part_of[key] = part.certificate_id
            self._part_of.move_to_end(key)
            if len(self._part_of) > KEYS_REMEMBERED:
                self._part_of.popitem(last=False)

    def find(self, key_id: bytes) -> AgreedKey | None:
        """The key of that id."""
        with self._lock:
            return next((one for one in self._of_part.values() if one.key_id == key_id), None)

    def find_alike(self, number: int) -> list[AgreedKey]:
        """The keys that a terse seal may name."""
        with self._lock:
            return [one for one in self._of_part.values() if one.is_terse and terse_id(one.key_id) == number]

    def forget(self, key: str, agreed: AgreedKey) -> None:
        """The other side does not have it, or is somebody else. One that was only tried on `key` may be somebody's all
        the same, who seals notices with it.
        """
        with self._lock:
            if self._part_of.pop(key, None) is None:
                return
            if agreed.other is not None and self._of_part.get(agreed.other.certificate_id) is agreed:
                del self._of_part[agreed.other.certificate_id]

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            self._of_part.clear()
            self._part_of.clear()
            self._offered_s.clear()
