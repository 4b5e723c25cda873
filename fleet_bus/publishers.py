"""Who may publish tile versions, and whether one has: signatures that hold wherever the signed bytes come from.

A seal ends with its message, and its certificate counts while it is valid. A version stays for years: its signature is
judged as of the time at which it was made. What a revoked certificate has signed does not count, whenever that was: who
has the key can write any time beside it.
"""

import logging
import threading
import time
import weakref
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gnd.fleet_bus.errors import BusClosed, BusError, IdentityError, NotAnsweredFor, SealError, SignedAhead
from gnd.fleet_bus.identity.names import PUBLISHER_ROLES
from gnd.fleet_bus.seal_keys import certificates_of, holder_of, is_signed_by, may_sign, read_revoked
from gnd.fleet_bus.sealing import ASK_AGAIN_S, CERTIFICATE_ROOT, MOST_SKEW_S
from gnd.fleet_bus.seals import Holder, certificate_id
from gnd.fleet_bus.seldom import Seldom

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

    from gnd.fleet_bus.bus import Bus

_SELDOM: Final = Seldom(logging.getLogger(__name__))
REMEMBERED: Final = 4096
_LOOK_AGAIN_S: Final = 1.0
_FETCH_S: Final = 5.0
_MOST_IN_VAIN: Final = 16
Fetch = Callable[[bytes], bytes]
"""The chain of a certificate by its id; `BusError` where nobody has it."""


class PublisherKey:
    """Signs versions with the key of an identity folder; a renewed certificate is taken as soon as it lies there.

    Safe in several threads.

    Args:
        folder: of a shard or an operator.

    Raises:
        IdentityError: the folder cannot be read, or its role signs no versions.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, threading.Lock()
        self._stamp, self._signer = self._stamp_now(), self._load()

    def sign(self, text_for: Callable[[bytes], bytes], signed_s: int) -> tuple[bytes, bytes, bytes]:
        """Sign what `text_for(id of the certificate)` gives.

        Returns:
            Id of the certificate (8 bytes), signature (r and s, 32 bytes each), and the certificates: the own one and
            those that lead to the authority (DER, 2 bytes of length before each).

        Raises:
            IdentityError: the certificate does not hold at `signed_s` (POSIX seconds): nobody would believe it.
        """
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric import ec, utils

        own = self._current()
        if not own.begins_s <= signed_s <= own.ends_s:
            late = "has ended (`gnd certs renew`)" if signed_s > own.ends_s else "has not begun: is the clock wrong?"
            raise IdentityError(f"the certificate in {self._folder} {late}")
        r, s = utils.decode_dss_signature(own.key.sign(text_for(own.signer), ec.ECDSA(hashes.SHA256())))
        return own.signer, r.to_bytes(32, "big") + s.to_bytes(32, "big"), own.chain

    def _current(self) -> "_OwnKey":
        with self._lock:
            try:
                stamp = self._stamp_now()
                if stamp != self._stamp:
                    self._stamp, self._signer = stamp, self._load()
            except IdentityError as error:  # what was there goes on, until it ends
                _SELDOM.warning("%s", error)
            return self._signer

    def _stamp_now(self) -> tuple[int, int]:
        try:
            stat = (self._folder / "certificate.pem").stat()
        except OSError as error:
            raise IdentityError(f"identity {self._folder}: {error.strerror}") from error
        return stat.st_mtime_ns, stat.st_size

    def _load(self) -> "_OwnKey":
        from cryptography.hazmat.primitives.serialization import Encoding

        from gnd.fleet_bus.identity.folder import load_identity

        identity = load_identity(self._folder)
        if identity.role not in PUBLISHER_ROLES:
            raise IdentityError(
                f"{identity.member.common_name} in {self._folder} signs no versions: a"
                f" {' or an '.join(PUBLISHER_ROLES)} does"
            )
        ders = [one.public_bytes(Encoding.DER) for one in identity.chain]
        chain = b"".join(len(der).to_bytes(2, "little") + der for der in ders)
        begins_s, ends_s = identity.begins.timestamp(), identity.ends.timestamp()
        return _OwnKey(identity.key, chain, certificate_id(ders[0]), begins_s, ends_s)


@dataclass(frozen=True, slots=True)
class _OwnKey:
    """A key to sign with, and its certificate."""

    key: "EllipticCurvePrivateKey"
    chain: bytes
    signer: bytes
    begins_s: float
    ends_s: float


@dataclass(frozen=True, slots=True)
class _Known:
    """A certificate that comes from the authority: whom it names, when it held, what revokes it."""

    holder: Holder
    begins_s: float
    ends_s: float
    serials: frozenset[int]


class Publishers:
    """Whose signature under a version counts. Safe in several threads.

    Args:
        folder: an identity folder; its `authority.pem` is believed, its `revoked.pem` may come later and change.
        fetch: where certificates come from that nobody has shown.

    Raises:
        IdentityError: there is no authority.
    """

    def __init__(self, folder: Path, fetch: Fetch | None = None) -> None:
        from cryptography import x509

        try:
            self._authority = tuple(x509.load_pem_x509_certificates((folder / "authority.pem").read_bytes()))
        except (OSError, ValueError) as error:
            raise IdentityError(f"identity {folder}: {error}") from None
        self._revoked = RevokedSerials(folder / "revoked.pem", self._authority)
        self._fetch, self._lock, self._fetching = fetch, threading.Lock(), threading.Lock()
        self._known: OrderedDict[bytes, _Known] = OrderedDict()
        self._in_vain: dict[bytes, float] = {}

    @classmethod
    def on_the_bus(cls, bus: "Bus") -> "Publishers | None":
        """Whom a session's authority names; None for a session without an identity, which believes what it hears."""
        folder = bus.config.identity
        if folder is None:
            return None
        with _SHARED_LOCK:
            if bus not in _SHARED:
                _SHARED[bus] = cls(folder, _asking(weakref.ref(bus)))
            return _SHARED[bus]

    def check(self, signer: bytes, signed_s: int, text: bytes, signature: bytes) -> Holder:
        """Who has signed a text.

        Args:
            signer: id of the certificate, 8 bytes.
            signed_s: when it is said to have been signed, POSIX seconds; part of the text.
            text: what is signed.
            signature: r and s, 32 bytes each.

        Raises:
            NotAnsweredFor: nobody who may.
        """
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.asymmetric import ec, utils

        known = self._certificate(signer)
        self._check_when(known, signed_s)
        r, s = int.from_bytes(signature[:32], "big"), int.from_bytes(signature[32:], "big")
        try:
            known.holder.public_key.verify(utils.encode_dss_signature(r, s), text, ec.ECDSA(hashes.SHA256()))
        except InvalidSignature:
            raise NotAnsweredFor("wrong", f"the signature of {known.holder} does not fit") from None
        return known.holder

    def knows(self, signer: bytes) -> bool:
        """Whether the certificate of this id was shown."""
        return self._shown(signer) is not None

    def is_revoked(self, signer: bytes) -> bool:
        """Whether the certificate of this id was shown, and is on the list of the revoked."""
        known = self._shown(signer)
        return known is not None and bool(known.serials & self._revoked.serials())

    def learn(self, chain: bytes) -> bytes:
        """Take a certificate with those between it and the authority, whether it still holds or not; its id.

        Raises:
            SealError: the authority has not signed it, or it is no publisher's.
        """
        try:
            return self._learn(chain)
        except SealError:
            raise
        except Exception as error:  # the library has many names for bytes that are no certificate
            raise NotAnsweredFor("foreign", f"no certificate: {type(error).__name__}: {str(error)[:200]}") from error

    def _learn(self, chain: bytes) -> bytes:
        certificates = certificates_of(chain)
        holder = holder_of(certificates[0])
        links = pairwise(certificates)
        if not all(map(may_sign, certificates[1:])) or not all(is_signed_by(one, by) for one, by in links):
            raise NotAnsweredFor("foreign", f"the certificates of {holder} are no chain")
        if not any(is_signed_by(certificates[-1], by) for by in self._authority):
            raise NotAnsweredFor("foreign", f"the certificate of {holder} is not of our authority")
        if holder.role not in PUBLISHER_ROLES:
            raise NotAnsweredFor("foreign", f"{holder} signs no versions: a {' or an '.join(PUBLISHER_ROLES)} does")
        begins_s = max(one.not_valid_before_utc.timestamp() for one in certificates)
        ends_s = min(one.not_valid_after_utc.timestamp() for one in certificates)
        serials = frozenset(one.serial_number for one in certificates)
        with self._lock:
            self._known[holder.certificate_id] = _Known(holder, begins_s, ends_s, serials)
            if len(self._known) > REMEMBERED:
                self._known.popitem(last=False)
        return holder.certificate_id

    def _check_when(self, known: _Known, signed_s: int) -> None:
        if known.serials & self._revoked.serials():
            raise NotAnsweredFor(
                "revoked", f"the certificate of {known.holder} was revoked: nothing that it signed counts"
            )
        if not known.begins_s <= signed_s <= known.ends_s:
            raise NotAnsweredFor("expired", f"the certificate of {known.holder} did not hold when it was signed")
        ahead_s = signed_s - time.time()
        if ahead_s > MOST_SKEW_S:
            raise SignedAhead("expired", f"{known.holder} signed it {ahead_s:.0f} s from now: check the clocks")

    def _certificate(self, signer: bytes) -> _Known:
        """That of an id; one that nobody has shown is asked for, once at a time."""
        known = self._shown(signer)
        if known is not None:
            return known
        with self._fetching:
            known = self._shown(signer)  # another thread may have asked meanwhile
            if known is not None:
                return known
            now_s = time.monotonic()
            self._in_vain = {one: until_s for one, until_s in self._in_vain.items() if until_s > now_s}
            if self._fetch is None or signer in self._in_vain or len(self._in_vain) >= _MOST_IN_VAIN:
                raise NotAnsweredFor("unknown", f"the certificate {signer.hex()} is not known")
            self._in_vain[signer] = now_s + ASK_AGAIN_S
            known = self._fetched(signer, self._fetch)
            del self._in_vain[signer]
            return known

    def _fetched(self, signer: bytes, fetch: Fetch) -> _Known:
        try:
            chain = fetch(signer)
        except BusError as error:
            raise NotAnsweredFor("unknown", f"the certificate {signer.hex()} is not known: {error}") from error
        shown = self.learn(chain)
        known = self._shown(signer)
        if known is None:
            raise NotAnsweredFor("unknown", f"asked for the certificate {signer.hex()}, got {shown.hex()}")
        return known

    def _shown(self, signer: bytes) -> _Known | None:
        with self._lock:
            known = self._known.get(signer)
            if known is not None:
                self._known.move_to_end(signer)
            return known


_SHARED_LOCK: Final = threading.Lock()
_SHARED: "Final[weakref.WeakKeyDictionary[Bus, Publishers]]" = weakref.WeakKeyDictionary()
"""Those of each session: its layers ask for a certificate once together."""


def _asking(bus_of: "Callable[[], Bus | None]") -> Fetch:
    """Asks on a bus, as long as it is there."""

    def fetch(signer: bytes) -> bytes:
        bus = bus_of()
        if bus is None:
            raise BusClosed("the bus is gone")
        return bus.request(f"{CERTIFICATE_ROOT}/{signer.hex()}", b"", kind="control", timeout_s=_FETCH_S)

    return fetch


class RevokedSerials:
    """The serial numbers on an authority's list of the revoked; the file is read again where it has changed."""

    def __init__(self, path: Path, authority: "Sequence[x509.Certificate]") -> None:
        self._path, self._authority, self._lock = path, authority, threading.Lock()
        self._looked_s, self._stamp = 0.0, (0, 0)
        self._number, self._serials = -1, frozenset[int]()

    def serials(self) -> frozenset[int]:
        """Those of the list with the highest number that was seen; a list that is not the authority's is no list."""
        with self._lock:
            now_s = time.monotonic()
            if now_s - self._looked_s >= _LOOK_AGAIN_S or not self._looked_s:
                self._looked_s = now_s
                self._read()
            return self._serials

    def _read(self) -> None:
        try:
            stat = self._path.stat()
            if (stat.st_mtime_ns, stat.st_size) == self._stamp:
                return
            number, serials = read_revoked(self._path.read_bytes(), self._authority)
        except (OSError, SealError):  # whoever checks seals has said so
            return
        self._stamp = (stat.st_mtime_ns, stat.st_size)
        if number >= self._number:
            self._number, self._serials = number, serials
