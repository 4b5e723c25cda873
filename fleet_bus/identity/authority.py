"""The authority of a fleet: a root key, the register of what it has issued, and the lists that follow from it.

There is no intermediate authority: it would only help if a stolen one could be taken back, and zenoh (rustls as it sets
it up) looks at no list of the revoked, so that the roots would have to be replaced all the same. Folders of a PKI with
intermediates are read all the same (`folder.load_identity`).
"""

import datetime as dt
import ipaddress
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, Self

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.identity.folder import AUTHORITY, CERTIFICATE, KEY, MEMBERS, REVOKED, load_key, utc_now
from gnd.fleet_bus.identity.lists import MemberList, replace_file
from gnd.fleet_bus.identity.names import PUBLISHER_ROLES, MemberName

REGISTER: Final = "register.jsonl"
ROOT_DAYS: Final = 3650
VEHICLE_DAYS: Final = 7
SERVER_DAYS: Final = 30
LIST_DAYS: Final = 30
"""A list of the revoked names this as the time until which the next one comes."""
_EARLIER: Final = dt.timedelta(minutes=5)
"""Certificates begin a little before now: clocks of vehicles differ."""


@dataclass(frozen=True, slots=True)
class RegisterEntry:
    """One certificate that was issued.

    Attributes:
        serial: number of the certificate, hex.
        role: of the member.
        name: of the member.
        owner: organisation, "" for none.
        begins: first second, ISO 8601 UTC.
        ends: last second, ISO 8601 UTC.
        revoked: when it was taken back, ISO 8601 UTC; "" = it was not.
        holder: of a pseudonym: whose it is, encrypted (`pseudonyms`).
    """

    serial: str
    role: str
    name: str
    owner: str
    begins: str
    ends: str
    revoked: str = ""
    holder: str = ""

    @property
    def member(self) -> MemberName:
        """Role and name."""
        return MemberName(self.role, self.name)

    def holds(self, now: dt.datetime) -> bool:
        """Whether it has neither ended nor been revoked."""
        return not self.revoked and now <= dt.datetime.fromisoformat(self.ends)

    def shuts_out(self, now: dt.datetime) -> bool:
        """Whether it is revoked, but would still be accepted by who does not know."""
        return bool(self.revoked) and now <= dt.datetime.fromisoformat(self.ends)


class Authority:
    """An authority in a folder: root key and certificate, register, lists. One process at a time may change it."""

    def __init__(self, folder: Path) -> None:
        """Opens one that `create` has made; `IdentityError` where there is none."""
        self.folder = folder
        self._key = load_key(folder / KEY)
        try:
            self.certificate = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
        except (OSError, ValueError) as error:
            raise IdentityError(f"{folder}: no authority ({error}); `gnd certs init` makes one") from error
        self._entries = {entry.serial: entry for entry in _read_register(folder / REGISTER)}

    @property
    def key(self) -> ec.EllipticCurvePrivateKey:
        """Private key of the root."""
        return self._key

    @classmethod
    def create(cls, folder: Path, name: str) -> Self:
        """Makes a root that holds ten years; `IdentityError` where there is one already."""
        if (folder / KEY).exists():
            raise IdentityError(f"{folder} holds an authority already; its members would be lost with its key")
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        key, now = ec.generate_private_key(ec.SECP256R1()), utc_now()
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        builder = _builder(subject, subject, key.public_key(), now - _EARLIER, now + dt.timedelta(days=ROOT_DAYS))
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        builder = builder.add_extension(_usage(ca=True), critical=True)
        certificate = builder.sign(key, hashes.SHA256())
        replace_file(folder / AUTHORITY, certificate.public_bytes(serialization.Encoding.PEM))
        replace_file(folder / KEY, _key_bytes(key), 0o600)
        authority = cls(folder)
        authority._write_lists()
        return authority

    def entries(self) -> tuple[RegisterEntry, ...]:
        """What was issued, oldest first."""
        return tuple(self._entries.values())

    def issue(
        self,
        member: MemberName,
        out: Path,
        *,
        owner: str = "",
        hosts: Sequence[str] = (),
        days: float = 0.0,
        begins: dt.datetime | None = None,
        ends: dt.datetime | None = None,
        holder: str = "",
    ) -> RegisterEntry:
        """Makes a key and a certificate for a member, and writes its identity folder.

        Args:
            member: role and name.
            out: the folder; what is in it of an earlier certificate of the member is replaced.
            owner: organisation.
            hosts: names and addresses under which a router is reached.
            days: how long it holds; 0 = `VEHICLE_DAYS` for a vehicle, else `SERVER_DAYS`.
            begins: first moment; None = five minutes ago.
            ends: last moment, instead of `days`.
            holder: of a pseudonym, as the register keeps it.

        Raises:
            IdentityError: the name is shut out, because a certificate of it was revoked and has not ended; or `out`
                belongs to another member.
        """
        now = utc_now()
        self._check_name(member, out, now)
        days = days or (VEHICLE_DAYS if member.role == "vehicle" else SERVER_DAYS)
        key, begins = ec.generate_private_key(ec.SECP256R1()), begins or now - _EARLIER
        certificate = self._certificate(member, owner, hosts, key, begins, ends or now + dt.timedelta(days=days))
        entry = RegisterEntry(
            f"{certificate.serial_number:x}",
            member.role,
            member.name,
            owner,
            certificate.not_valid_before_utc.isoformat(),
            certificate.not_valid_after_utc.isoformat(),
            holder=holder,
        )
        self._record(entry)  # before it can be used
        out.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._write_folder(out, key, certificate)
        return entry

    def renew(self, folder: Path, days: float = 0.0) -> RegisterEntry:
        """Replaces certificate and key of an identity folder by new ones of the same member, owner and hosts."""
        from gnd.fleet_bus.identity.folder import load_identity

        old = load_identity(folder)
        serial = f"{old.certificate.serial_number:x}"
        if serial not in self._entries:
            raise IdentityError(
                f"{folder}: {old.member.common_name} ({serial}) is not in the register of {self.folder}"
            )
        hosts = [host for host in _hosts_of(old.certificate) if host not in ("localhost", "127.0.0.1", "::1")]
        return self.issue(old.member, folder, owner=old.owner, hosts=hosts, days=days)

    def revoke(self, member: MemberName) -> list[RegisterEntry]:
        """Takes back every certificate of a member that still holds; the lists say so at once.

        Raises:
            IdentityError: it has none.
        """
        now = utc_now()
        found = [entry for entry in self._entries.values() if entry.member == member and entry.holds(now)]
        if not found:
            raise IdentityError(f"{member.common_name} has no certificate that holds in {self.folder / REGISTER}")
        taken = [replace(entry, revoked=now.isoformat()) for entry in found]
        self._record(*taken)
        return taken

    def copy_lists(self, folders: Iterable[Path]) -> None:
        """Puts the lists of members and of the revoked into identity folders."""
        for folder in folders:
            for name in (MEMBERS, REVOKED):
                replace_file(folder / name, (self.folder / name).read_bytes())

    def lists(self) -> tuple[bytes, bytes]:
        """The lists as they are published: members, revoked."""
        return (self.folder / MEMBERS).read_bytes(), (self.folder / REVOKED).read_bytes()

    def _check_name(self, member: MemberName, out: Path, now: dt.datetime) -> None:
        for entry in self._entries.values():
            if entry.member == member and entry.shuts_out(now):
                raise IdentityError(
                    f"{member.common_name} is shut out until {entry.ends}: a revoked certificate of this name has not"
                    " ended, and routers know members by name; issue under another name"
                )
        if (out / CERTIFICATE).exists():
            from gnd.fleet_bus.identity.folder import member_of

            there = member_of(x509.load_pem_x509_certificate((out / CERTIFICATE).read_bytes()))
            if there != member:
                raise IdentityError(f"{out} is the identity of {there.common_name}, not of {member.common_name}")

    def _certificate(
        self,
        member: MemberName,
        owner: str,
        hosts: Sequence[str],
        key: ec.EllipticCurvePrivateKey,
        begins: dt.datetime,
        ends: dt.datetime,
    ) -> x509.Certificate:
        named = [(NameOID.COMMON_NAME, member.common_name), (NameOID.ORGANIZATIONAL_UNIT_NAME, member.role)]
        named += [(NameOID.ORGANIZATION_NAME, owner)] if owner else []
        subject = x509.Name([x509.NameAttribute(which, text) for which, text in named])
        builder = _builder(subject, self.certificate.subject, key.public_key(), begins, ends)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(_usage(ca=False), critical=True)
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if member.role == "router":  # only routers are connected to: no other certificate passes for one
            uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
            names = [_general_name(host) for host in ("localhost", "127.0.0.1", "::1", *hosts)]
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        return builder.sign(self._key, hashes.SHA256())

    def _write_folder(self, out: Path, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> None:
        # The certificate comes last: who waits for a new one sees it change when its key is there.
        replace_file(out / AUTHORITY, (self.folder / AUTHORITY).read_bytes())
        self.copy_lists((out,))
        replace_file(out / KEY, _key_bytes(key), 0o600)
        replace_file(out / CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM))

    def _record(self, *entries: RegisterEntry) -> None:
        """Appends to the register; of each certificate the last line counts."""
        lines = "".join(json.dumps(asdict(entry)) + "\n" for entry in entries).encode()
        descriptor = os.open(self.folder / REGISTER, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        with os.fdopen(descriptor, "ab") as file:
            file.write(lines)
            file.flush()
            os.fsync(file.fileno())
        self._entries |= {entry.serial: entry for entry in entries}
        self._write_lists()

    def _write_lists(self) -> None:
        now, number = utc_now(), self._last_number() + 1
        shut = [entry for entry in self._entries.values() if entry.shuts_out(now)]
        # what a publisher has signed stays: so does, when its certificate has ended, that it was taken back
        gone = [
            one for one in self._entries.values() if one.revoked and one.role in PUBLISHER_ROLES and one not in shut
        ]
        names = frozenset(entry.member.common_name for entry in shut)
        holding = (entry.member for entry in self._entries.values() if entry.holds(now))
        members = frozenset(member for member in holding if member.common_name not in names)
        replace_file(self.folder / REVOKED, self._revoked_list([*shut, *gone], number, now))
        replace_file(self.folder / MEMBERS, MemberList(number, members, names).encode(self._key))

    def _last_number(self) -> int:
        path = self.folder / MEMBERS
        return MemberList.decode(path.read_bytes(), (self.certificate,)).number if path.exists() else 0

    def _revoked_list(self, shut: Sequence[RegisterEntry], number: int, now: dt.datetime) -> bytes:
        builder = x509.CertificateRevocationListBuilder().issuer_name(self.certificate.subject)
        builder = builder.last_update(now).next_update(now + dt.timedelta(days=LIST_DAYS))
        builder = builder.add_extension(x509.CRLNumber(number), critical=False)
        for entry in shut:
            one = x509.RevokedCertificateBuilder().serial_number(int(entry.serial, 16))
            builder = builder.add_revoked_certificate(
                one.revocation_date(dt.datetime.fromisoformat(entry.revoked)).build()
            )
        return builder.sign(self._key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def _read_register(path: Path) -> list[RegisterEntry]:
    if not path.exists():
        return []
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if whole != data:  # cut off by a crash while it was written: its certificate was never handed out
        os.truncate(path, len(whole))
    found = []
    for number, line in enumerate(whole.splitlines(), start=1):
        try:
            found.append(RegisterEntry(**json.loads(line)))
        except (ValueError, TypeError) as error:
            raise IdentityError(f"{path}, line {number} is no entry: {error}") from error
    return found


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    begins: dt.datetime,
    ends: dt.datetime,
) -> x509.CertificateBuilder:
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
    return builder.serial_number(x509.random_serial_number()).not_valid_before(begins).not_valid_after(ends)


def _usage(*, ca: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not ca,
        key_cert_sign=ca,
        crl_sign=ca,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _hosts_of(certificate: x509.Certificate) -> list[str]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    return [str(name.value) for name in names]


def _key_bytes(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
