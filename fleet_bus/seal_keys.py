"""Whom to believe: certificates that the authority has signed, looked up by the short id that seals carry."""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gnd.fleet_bus.errors import ClocksDiffer, IdentityError, SealError
from gnd.fleet_bus.remembered import FILE, RememberedChains
from gnd.fleet_bus.seals import Holder, Signer, certificate_id

if TYPE_CHECKING:
    from cryptography import x509

_LOG = logging.getLogger(__name__)
REMEMBERED: Final = 65_536
LONGEST_CHAIN: Final = 3
"""Certificates between a part and the authority, the part's own included."""
LOOK_AGAIN_S: Final = 1.0
"""The list of revoked certificates is looked for so often."""


class KnownCertificates:
    """Certificates that were shown and are good. Safe in several threads.

    Args:
        authority: certificates that are trusted.
        revoked: file with the authority's list of revoked certificates (PEM); it may come later, and change.
        remembered: certificates of an earlier start.
    """

    def __init__(
        self, authority: Sequence["x509.Certificate"], revoked: Path, remembered: RememberedChains | None = None
    ) -> None:
        self._authority, self._revoked_path, self._remembered = tuple(authority), revoked, remembered
        self._lock = threading.Lock()
        self._known: OrderedDict[bytes, tuple[Holder, frozenset[int]]] = OrderedDict()
        self._revoked: frozenset[int] = frozenset()
        self._list_number, self._looked_s, self._stamp = -1, 0.0, (0, 0)

    def holder(self, certificate_id: bytes) -> Holder | None:
        """Whom a certificate names that was shown before; None = it was not.

        Raises:
            ClocksDiffer: it has ended.
            SealError: it was revoked.
        """
        return self._holder(certificate_id) or self._recall(certificate_id)

    def _holder(self, certificate_id: bytes) -> Holder | None:
        with self._lock:
            found = self._known.get(certificate_id)
            if found is None:
                return None
            self._known.move_to_end(certificate_id)
            self._look_for_list()
            holder, serials = found
            if serials & self._revoked:
                raise SealError(f"the certificate of {holder} was revoked")
        if holder.ends_s < time.time():
            raise ClocksDiffer(f"the certificate of {holder} ended {time.time() - holder.ends_s:.0f} s ago")
        return holder

    def learn(self, chain: bytes) -> Holder:
        """Take a certificate with those between it and the authority.

        Raises:
            ClocksDiffer: it is not valid now.
            SealError: the authority has not signed it, or it was revoked.
        """
        holder, serials = holder_of_chain(chain, self._authority)
        with self._lock:
            self._known[holder.certificate_id] = (holder, serials)
            if len(self._known) > REMEMBERED:
                self._known.popitem(last=False)
        if self._remembered is not None:
            self._remembered.add(holder.certificate_id, chain)
        known = self._holder(holder.certificate_id)
        if known is None:
            raise SealError(f"the certificate of {holder} was forgotten at once: {REMEMBERED} others came meanwhile")
        return known

    def _recall(self, certificate_id: bytes) -> Holder | None:
        """One that an earlier start has learnt, if it is still good; else it is to be shown again."""
        chain = None if self._remembered is None else self._remembered.get(certificate_id)
        if chain is None or self._remembered is None:
            return None
        try:
            return self.learn(chain)
        except SealError:
            self._remembered.drop(certificate_id)
            return None

    def _look_for_list(self) -> None:
        """Read the list again where its file has changed; a list that is older or not the authority's is no list."""
        now_s = time.monotonic()
        if now_s - self._looked_s < LOOK_AGAIN_S:
            return
        self._looked_s = now_s
        try:
            stat = self._revoked_path.stat()
            if (stat.st_mtime_ns, stat.st_size) == self._stamp:
                return
            number, revoked = read_revoked(self._revoked_path.read_bytes(), self._authority)
        except FileNotFoundError:
            return
        except (SealError, OSError) as error:
            _LOG.error("%s: %s", self._revoked_path, error)
            return
        self._stamp = (stat.st_mtime_ns, stat.st_size)
        if number >= self._list_number:
            self._list_number, self._revoked = number, revoked


def certificates_of(chain: bytes) -> list["x509.Certificate"]:
    """The certificates that a seal brings along.

    Raises:
        SealError: they are none, or too many.
    """
    from cryptography import x509
    from cryptography.utils import CryptographyDeprecationWarning

    found: list[x509.Certificate] = []
    while chain:
        size = int.from_bytes(chain[:2], "little")
        if not 0 < size <= len(chain) - 2 or len(found) == LONGEST_CHAIN:
            raise SealError(f"a chain of certificates with {len(chain)} bytes left cannot be read")
        try:
            found.append(x509.load_der_x509_certificate(chain[2 : 2 + size]))
        except (ValueError, x509.InvalidVersion, CryptographyDeprecationWarning) as error:
            raise SealError(f"certificate {len(found) + 1} of a chain cannot be read: {error}") from None
        if found[-1].serial_number <= 0:  # of which the library only warns (RFC 5280, 4.1.2.2)
            raise SealError(f"certificate {len(found)} of a chain has the serial number {found[-1].serial_number}")
        chain = chain[2 + size :]
    if not found:
        raise SealError("a chain without certificates")
    return found


def holder_of_chain(chain: bytes, authority: Sequence["x509.Certificate"]) -> tuple[Holder, frozenset[int]]:
    """Whom a chain of certificates names, and their serial numbers.

    Raises:
        ClocksDiffer: it is not valid now.
        SealError: it cannot be read, the authority has not signed it, or it names no part of a fleet.
    """
    from cryptography import x509
    from cryptography.exceptions import UnsupportedAlgorithm

    broken = ValueError, TypeError, UnsupportedAlgorithm, x509.DuplicateExtension, x509.UnsupportedGeneralNameType
    certificates = certificates_of(chain)
    try:  # the parts of a certificate are read when they are asked for
        _check_chain(certificates, authority)
        return holder_of(certificates[0]), frozenset(one.serial_number for one in certificates)
    except broken as error:
        raise SealError(f"a certificate of a chain cannot be read: {error}") from None


def holder_of(certificate: "x509.Certificate") -> Holder:
    """Whom a certificate names: its common name is `<role>.<name>`.

    Raises:
        SealError: it names no part of a fleet, or its key is none on P-256.
    """
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import Encoding
    from cryptography.x509.oid import NameOID

    def said(oid: "x509.ObjectIdentifier") -> str:
        values = [str(attribute.value) for attribute in certificate.subject.get_attributes_for_oid(oid)]
        return values[0] if len(values) == 1 else ""

    try:  # its parts are read when they are asked for
        common, owner = said(NameOID.COMMON_NAME), said(NameOID.ORGANIZATION_NAME)
    except (ValueError, TypeError) as error:
        raise SealError(f"the name in a certificate cannot be read: {error}") from None
    role, _, name = common.partition(".")
    try:
        key = certificate.public_key()
    except (ValueError, UnsupportedAlgorithm) as error:
        raise SealError(f"the key of certificate {common[:80]!r} cannot be read: {error}") from None
    if not role or not name or not isinstance(key, ec.EllipticCurvePublicKey):
        raise SealError(f"certificate {common[:80]!r} names no part of a fleet")
    if not isinstance(key.curve, ec.SECP256R1):
        raise SealError(f"the key of certificate {common[:80]!r} is on {key.curve.name}, not on P-256")
    return Holder(
        role=role,
        name=name,
        owner=owner,
        certificate_id=certificate_id(certificate.public_bytes(Encoding.DER)),
        ends_s=certificate.not_valid_after_utc.timestamp(),
        public_key=key,
    )


def _check_chain(chain: Sequence["x509.Certificate"], authority: Sequence["x509.Certificate"]) -> None:
    """Each is signed by the next, the last by the authority; all are valid now, all but the first may sign."""
    now_s = time.time()
    for position, one in enumerate(chain):
        begins_s, ends_s = one.not_valid_before_utc.timestamp(), one.not_valid_after_utc.timestamp()
        if not begins_s <= now_s <= ends_s:
            late = "has ended" if now_s > ends_s else "is not valid yet: check the clocks"
            raise ClocksDiffer(f"a certificate of {one.subject.rfc4514_string()[:120]} {late}")
        if (position > 0) != may_sign(one):
            raise SealError(f"{one.subject.rfc4514_string()[:120]} has another place in the chain")
    links = pairwise(chain)
    last = chain[-1]
    if not all(is_signed_by(one, by) for one, by in links) or not any(is_signed_by(last, by) for by in authority):
        raise SealError(f"the certificate of {chain[0].subject.rfc4514_string()[:120]} is not of our authority")


def may_sign(certificate: "x509.Certificate") -> bool:
    """Whether a certificate is of an authority."""
    from cryptography import x509

    try:
        return certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    except (x509.ExtensionNotFound, ValueError):
        return False


def is_signed_by(certificate: "x509.Certificate", by: "x509.Certificate") -> bool:
    """Whether `by` has signed a certificate."""
    from cryptography.exceptions import InvalidSignature

    try:
        certificate.verify_directly_issued_by(by)
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def read_revoked(pem: bytes, authority: Sequence["x509.Certificate"]) -> tuple[int, frozenset[int]]:
    """Number and serial numbers of a list of revoked certificates.

    Raises:
        SealError: it cannot be read, or the authority has not signed it.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.types import CertificateIssuerPublicKeyTypes

    try:
        revoked = x509.load_pem_x509_crl(pem)
        keys: list[CertificateIssuerPublicKeyTypes] = [one.public_key() for one in authority]  # type: ignore[misc]
        if not any(revoked.is_signature_valid(key) for key in keys):
            raise SealError("a list of revoked certificates that our authority has not signed")
        number = revoked.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
    except x509.ExtensionNotFound:
        number = 0
    except (ValueError, TypeError) as error:
        raise SealError(f"no list of revoked certificates: {error}") from None
    return number, frozenset(one.serial_number for one in revoked)


def load_signer(folder: Path) -> Signer:
    """The signer of an identity folder: `certificate.pem` and `key.pem`.

    Raises:
        IdentityError: a file is missing or cannot be read, or the key is not the certificate's.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key

    try:
        chain = x509.load_pem_x509_certificates((folder / "certificate.pem").read_bytes())
        key = load_pem_private_key((folder / "key.pem").read_bytes(), password=None)
    except (OSError, ValueError, TypeError) as error:
        raise IdentityError(f"identity {folder}: {error}") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != chain[0].public_key():
        raise IdentityError(f"identity {folder}: key.pem is the key of another certificate")
    return Signer(key, tuple(one.public_bytes(Encoding.DER) for one in chain))


def load_authority(folder: Path) -> KnownCertificates:
    """Whom an identity folder trusts: `authority.pem`, and `revoked.pem` where it is there.

    Raises:
        IdentityError: the file is missing or cannot be read.
    """
    from cryptography import x509

    try:
        authority = x509.load_pem_x509_certificates((folder / "authority.pem").read_bytes())
        return KnownCertificates(authority, folder / "revoked.pem", RememberedChains(folder / FILE))
    except (OSError, ValueError) as error:
        raise IdentityError(f"identity {folder}: {error}") from None
