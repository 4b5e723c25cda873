"""Targets: seals, certificates, lists of an authority, and what vehicles tell of versions on trial."""

import datetime as dt
from functools import cache

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID
from fuzz_mutators import bytes_mutated, message_mutated, text_mutated
from fuzz_target import FuzzTarget

from gnd.fleet_bus.identity.lists import MemberList, load_revoked
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.seal_keys import certificates_of, holder_of, read_revoked
from gnd.fleet_bus.seals import Seal
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.generated import health_report_pb2
from gnd.schemas.health import HealthReport, TileHealth

_NOW = dt.datetime(2026, 11, 23, tzinfo=dt.UTC)
_TILE = TileId(497353963154)


@cache
def _authority() -> tuple[x509.Certificate, bytes, ec.EllipticCurvePrivateKey]:
    """A certificate that is its own authority, its list of revoked ones, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "vehicle.v-17")])
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(17).not_valid_before(_NOW).not_valid_after(_NOW + dt.timedelta(days=9999))
    certificate = builder.sign(key, hashes.SHA256())
    revoked = x509.CertificateRevocationListBuilder().issuer_name(name).last_update(_NOW)
    revoked = revoked.next_update(_NOW + dt.timedelta(days=1)).add_extension(x509.CRLNumber(1), critical=False)
    return certificate, revoked.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM), key


def _chain() -> bytes:
    der = _authority()[0].public_bytes(Encoding.DER)
    return len(der).to_bytes(2, "little") + der


def _holders(data: bytes) -> object:
    return [holder_of(one) for one in certificates_of(data)]


def _lists(data: bytes) -> object:
    load_revoked(data, [_authority()[0]])
    return read_revoked(data, [_authority()[0]])


def _seals() -> list[bytes]:
    seals = (
        Seal("question", bytes(8), 1, bytes(64), bytes(8), chain=b"\x01\x00x"),
        Seal("answer", bytes(8), 0, bytes(64)),
        Seal("number", b"", 0, b"", bytes(8), count_wanted=True),
    )
    return [seal.encode() for seal in seals]


TARGETS = (
    FuzzTarget(
        "seal", ("fleet_bus/seals.py:Seal.decode",), "seals (attachments)", Seal.decode, _seals, bytes_mutated
    ),
    FuzzTarget(
        "certificate-chain", (), "certificates of a seal (DER)", _holders, lambda: [_chain()], bytes_mutated
    ),
    FuzzTarget(
        "revoked",
        ("fleet_bus/seal_keys.py:read_revoked", "fleet_bus/identity/lists.py:load_revoked"),
        "lists of revoked certificates (PEM)",
        _lists,
        lambda: [_authority()[1]],
        bytes_mutated,
    ),
    FuzzTarget(
        "members",
        ("fleet_bus/identity/lists.py:MemberList.decode",),
        "signed lists of members (JSON)",
        lambda data: MemberList.decode(data, [_authority()[0]]),
        lambda: [MemberList(1, frozenset([MemberName("vehicle", "v-17")]), frozenset()).encode(_authority()[2])],
        text_mutated,
    ),
    FuzzTarget(
        "member-name",
        ("fleet_bus/identity/names.py:MemberName.parse",),
        "common names of certificates",
        lambda data: MemberName.parse(data.decode("utf-8", "replace")),
        lambda: [b"vehicle.v-17", b"shard.shard-0"],
        text_mutated,
    ),
    FuzzTarget(
        "HealthReport",
        ("schemas/health.py:HealthReport.decode",),
        "gnd.v1.HealthReport (protobuf)",
        HealthReport.decode,
        lambda: [HealthReport("ndt", _TILE.district, 1_700_000_000 * 10**9, (TileHealth(_TILE, 3, scans=5),)).encode()],
        message_mutated(health_report_pb2.HealthReport),
    ),
)  # fmt: skip
