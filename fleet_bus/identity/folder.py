"""An identity folder: certificate.pem, key.pem, authority.pem, and where known revoked.pem and members.json."""

import datetime as dt
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.identity.names import MemberName

CERTIFICATE: Final = "certificate.pem"
KEY: Final = "key.pem"
AUTHORITY: Final = "authority.pem"
REVOKED: Final = "revoked.pem"
MEMBERS: Final = "members.json"
_SOON: Final = 1 / 4
"""A certificate with less than this share of its time left should have been renewed."""


@dataclass(frozen=True, slots=True)
class MemberIdentity:
    """What an identity folder holds; it has been checked.

    Attributes:
        folder: where it was read.
        member: role and name.
        owner: organisation (O) of the certificate, "" where it names none.
        chain: own certificate, then those of issuers below the authority.
        key: private key, ECDSA P-256.
        authority: trusted roots.
    """

    folder: Path
    member: MemberName
    owner: str
    chain: tuple[x509.Certificate, ...]
    key: ec.EllipticCurvePrivateKey
    authority: tuple[x509.Certificate, ...]

    @property
    def role(self) -> str:
        """Role of the member."""
        return self.member.role

    @property
    def name(self) -> str:
        """The id used in the protocol."""
        return self.member.name

    @property
    def certificate(self) -> x509.Certificate:
        """The member's own certificate."""
        return self.chain[0]

    @property
    def begins(self) -> dt.datetime:
        """When the certificate begins, UTC."""
        return self.certificate.not_valid_before_utc

    @property
    def ends(self) -> dt.datetime:
        """When the certificate ends, UTC."""
        return self.certificate.not_valid_after_utc

    def left_s(self, now: dt.datetime | None = None) -> float:
        """How long the certificate holds, s; below 0 = it has ended."""
        return (self.ends - (now or utc_now())).total_seconds()

    def ends_soon(self, now: dt.datetime | None = None) -> bool:
        """Whether it should have been renewed by now."""
        return self.left_s(now) < _SOON * (self.ends - self.begins).total_seconds()

    def file(self, name: str) -> str:
        """Path of one of the folder's files."""
        return str(self.folder / name)


def utc_now() -> dt.datetime:
    """The time by this machine's clock."""
    return dt.datetime.now(dt.UTC)


def load_identity(folder: Path) -> MemberIdentity:
    """Reads and checks an identity folder. Validity in time is not checked here: `problems` does.

    Raises:
        IdentityError: a file is missing or is no PEM, the key is of another certificate, the name is none of ours, or
            the certificate does not come from the authority.
    """
    chain = certificates_in(folder / CERTIFICATE)
    authority = certificates_in(folder / AUTHORITY)
    key = load_key(folder / KEY)
    own = chain[0]
    if not same_key(own, key):
        raise IdentityError(f"{folder / KEY} is the key of another certificate than {folder / CERTIFICATE}")
    member = member_of(own)
    _check_chain(folder, chain, authority)
    return MemberIdentity(folder, member, _attribute(own, NameOID.ORGANIZATION_NAME), chain, key, authority)


def problems(identity: MemberIdentity, now: dt.datetime | None = None) -> list[str]:
    """What keeps an identity from being accepted right now, a sentence each; empty = nothing."""
    now, found = now or utc_now(), []
    name = f"certificate {identity.member.common_name} in {identity.folder}"
    if now < identity.begins:
        found.append(
            f"{name} is not yet valid: it begins {identity.begins:%Y-%m-%d %H:%M:%S} UTC and this machine's clock"
            f" says {now:%Y-%m-%d %H:%M:%S}: is the clock wrong?"
        )
    if now > identity.ends:
        found.append(
            f"{name} has expired {identity.ends:%Y-%m-%d %H:%M:%S} UTC (the clock says {now:%Y-%m-%d %H:%M:%S}):"
            " `gnd certs renew`"
        )
    if is_revoked(identity):
        found.append(f"{name} was revoked by its authority")
    return found


def is_revoked(identity: MemberIdentity) -> bool:
    """Whether the list of the revoked beside the certificate names it; False where there is no list."""
    path = identity.folder / REVOKED
    if not path.exists():
        return False
    from gnd.fleet_bus.identity.lists import load_revoked

    listed = load_revoked(path.read_bytes(), identity.authority)
    return listed.get_revoked_certificate_by_serial_number(identity.certificate.serial_number) is not None


def member_of(certificate: x509.Certificate) -> MemberName:
    """The member that a certificate names; `IdentityError`."""
    return MemberName.parse(_attribute(certificate, NameOID.COMMON_NAME))


def load_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """A private key of the curve P-256 without a password; `IdentityError`."""
    try:
        key = serialization.load_pem_private_key(_read(path), password=None)
    except (ValueError, TypeError) as error:
        raise IdentityError(f"{path} is no private key in PEM: {error}") from error
    if not (isinstance(key, ec.EllipticCurvePrivateKey) and isinstance(key.curve, ec.SECP256R1)):
        raise IdentityError(f"{path} is no ECDSA key of the curve P-256")
    return key


def same_key(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> bool:
    """Whether a private key is that of a certificate."""
    return _public_bytes(certificate.public_key()) == _public_bytes(key.public_key())


def is_issued_by(certificate: x509.Certificate, issuer: x509.Certificate) -> bool:
    """Whether `issuer` is an authority and has signed `certificate`."""
    try:
        certificate.verify_directly_issued_by(issuer)
        return issuer.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    except (ValueError, TypeError, InvalidSignature, x509.ExtensionNotFound):
        return False


def _check_chain(folder: Path, chain: tuple[x509.Certificate, ...], roots: tuple[x509.Certificate, ...]) -> None:
    for one, issuer in itertools.pairwise(chain):
        if not is_issued_by(one, issuer):
            raise IdentityError(f"{folder / CERTIFICATE}: {_of(one)} was not issued by {_of(issuer)}, which follows it")
    if not any(is_issued_by(chain[-1], root) for root in roots):
        raise IdentityError(
            f"{folder / CERTIFICATE}: {_of(chain[-1])} does not come from the authority in {folder / AUTHORITY}"
            f" ({', '.join(map(_of, roots))})"
        )


def _of(certificate: x509.Certificate) -> str:
    return certificate.subject.rfc4514_string() or "a certificate without a name"


def _attribute(certificate: x509.Certificate, which: x509.ObjectIdentifier) -> str:
    found = certificate.subject.get_attributes_for_oid(which)
    return str(found[0].value) if found else ""


def _public_bytes(key: object) -> bytes:
    encoding, form = serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    return key.public_bytes(encoding, form)  # type: ignore[attr-defined,no-any-return]  # every public key has it


def certificates_in(path: Path) -> tuple[x509.Certificate, ...]:
    """The certificates of a file in PEM, at least one; `IdentityError`."""
    try:
        return tuple(x509.load_pem_x509_certificates(_read(path)))
    except ValueError as error:
        raise IdentityError(f"{path} holds no certificate in PEM: {error}") from error


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise IdentityError(f"cannot read {path}: {error.strerror}") from error
