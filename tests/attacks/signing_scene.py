"""An authority with parts of a fleet, as folders that the parts read; made with `cryptography` alone."""

import datetime as dt
from dataclasses import dataclass, field
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

NOW = dt.datetime.now(dt.UTC)  # of the import: a whole suite may run for an hour before a test uses it
HOUR = dt.timedelta(hours=1)


@dataclass
class Authority:
    """Signs certificates into folders."""

    folder: Path
    name: str = "authority"
    key: ec.EllipticCurvePrivateKey = field(default_factory=lambda: ec.generate_private_key(ec.SECP256R1()))
    revoked: list[int] = field(default_factory=list)
    lists: int = 0

    def __post_init__(self) -> None:
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, self.name)])
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(subject).public_key(self.key.public_key())
        builder = builder.serial_number(x509.random_serial_number()).not_valid_before(NOW - HOUR)
        builder = builder.not_valid_after(NOW + 24 * HOUR)
        self.certificate = builder.add_extension(x509.BasicConstraints(ca=True, path_length=1), critical=True).sign(
            self.key, hashes.SHA256()
        )

    def part(
        self,
        role: str,
        name: str,
        *,
        begins: dt.datetime = NOW - HOUR,
        ends: dt.datetime = NOW + 24 * HOUR,
        folder: str = "",
    ) -> Path:
        """An identity folder."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name(
            [
                x509.NameAttribute(NameOID.COMMON_NAME, f"{role}.{name}"),
                x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role),
                x509.NameAttribute(NameOID.ORGANIZATION_NAME, "owner"),
            ]
        )
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(self.certificate.subject)
        builder = builder.public_key(key.public_key()).serial_number(x509.random_serial_number())
        builder = builder.not_valid_before(begins).not_valid_after(ends)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        certificate = builder.sign(self.key, hashes.SHA256())
        made = self.folder / (folder or f"{role}.{name}")
        made.mkdir(parents=True)
        (made / "certificate.pem").write_bytes(certificate.public_bytes(Encoding.PEM))
        (made / "key.pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
        (made / "authority.pem").write_bytes(self.certificate.public_bytes(Encoding.PEM))
        return made

    def revoke(self, part: Path, *told: Path) -> None:
        """Put a part's certificate on the list, and the list into folders."""
        self.revoked.append(x509.load_pem_x509_certificate((part / "certificate.pem").read_bytes()).serial_number)
        self.lists += 1
        builder = x509.CertificateRevocationListBuilder().issuer_name(self.certificate.subject)
        builder = builder.last_update(NOW).next_update(NOW + 24 * HOUR)
        builder = builder.add_extension(x509.CRLNumber(self.lists), critical=False)
        for serial in self.revoked:
            one = x509.RevokedCertificateBuilder().serial_number(serial).revocation_date(NOW).build()
            builder = builder.add_revoked_certificate(one)
        pem = builder.sign(self.key, hashes.SHA256()).public_bytes(Encoding.PEM)
        for folder in told:
            (folder / "revoked.pem").write_bytes(pem)
