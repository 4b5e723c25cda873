"""What an authority says of its members: who they are (a signed JSON), and which certificates it takes back (a CRL)."""

import base64
import contextlib
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.identity.names import MemberName

MAX_LIST_BYTES: Final = 8 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class MemberList:
    """Who belongs, by the authority.

    Attributes:
        number: a later list has a higher one.
        members: who has a certificate that holds.
        revoked: common names that are shut out until their certificates have ended.
    """

    number: int
    members: frozenset[MemberName]
    revoked: frozenset[str]

    def encode(self, key: ec.EllipticCurvePrivateKey) -> bytes:
        """As JSON with the authority's signature."""
        body = self._body()
        signature = base64.b64encode(key.sign(body, ec.ECDSA(hashes.SHA256()))).decode()
        return json.dumps({"list": body.decode(), "signature": signature}, indent=1).encode() + b"\n"

    def _body(self) -> bytes:
        members = sorted(member.common_name for member in self.members)
        said = {"number": self.number, "members": members, "revoked": sorted(self.revoked)}
        return json.dumps(said, separators=(",", ":")).encode()

    @classmethod
    def decode(cls, data: bytes, authority: Iterable[x509.Certificate]) -> "MemberList":
        """Reads a list that one of these authorities has signed.

        Raises:
            IdentityError: no list, or not signed by them.
        """
        if len(data) > MAX_LIST_BYTES:
            raise IdentityError(f"a list of members of {len(data)} bytes, at most {MAX_LIST_BYTES} are read")
        try:
            outer = json.loads(data)
            body, signature = str(outer["list"]).encode(), base64.b64decode(outer["signature"], validate=True)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise IdentityError(f"no list of members: {error}") from error
        if not any(_is_signed(body, signature, one) for one in authority):
            raise IdentityError("the list of members is not signed by our authority")
        try:
            said = json.loads(body)
            members = frozenset(map(MemberName.parse, said["members"]))
            return cls(int(said["number"]), members, frozenset(map(str, said["revoked"])))
        except (ValueError, KeyError, TypeError) as error:
            raise IdentityError(f"no list of members: {error}") from error


def _is_signed(body: bytes, signature: bytes, certificate: x509.Certificate) -> bool:
    key = certificate.public_key()
    if not isinstance(key, ec.EllipticCurvePublicKey):
        return False
    try:
        key.verify(signature, body, ec.ECDSA(hashes.SHA256()))
    except InvalidSignature:
        return False
    return True


def load_revoked(data: bytes, authority: Sequence[x509.Certificate]) -> x509.CertificateRevocationList:
    """A CRL that one of these authorities has signed; `IdentityError`."""
    if len(data) > MAX_LIST_BYTES:
        raise IdentityError(f"a list of the revoked of {len(data)} bytes, at most {MAX_LIST_BYTES} are read")
    try:
        found = x509.load_pem_x509_crl(data)
    except (ValueError, x509.InvalidVersion) as error:
        raise IdentityError(f"no list of the revoked in PEM: {error}") from error
    for one in authority:
        with contextlib.suppress(TypeError, ValueError):  # a key that signs no CRL
            if found.is_signature_valid(one.public_key()):  # type: ignore[arg-type]  # what is not, raises
                return found
    raise IdentityError("the list of the revoked is not signed by our authority")


def revoked_number(listed: x509.CertificateRevocationList) -> int:
    """The CRL's own number; 0 where it has none."""
    try:
        return listed.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
    except x509.ExtensionNotFound:
        return 0


def replace_file(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Writes a file that readers see whole, the old or the new one."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
