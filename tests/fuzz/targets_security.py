"""Targets: seals, certificates, lists of an authority, and what vehicles tell of versions on trial."""

import datetime as dt
import json
import warnings
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.utils import CryptographyDeprecationWarning
from cryptography.x509.oid import NameOID
from fuzz_mutators import bytes_mutated, message_mutated, text_mutated
from fuzz_target import FuzzTarget

from gnd.fleet_bus.errors import NotAnsweredFor, SealError
from gnd.fleet_bus.identity.lists import MemberList, load_revoked
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.publishers import Publishers
from gnd.fleet_bus.remembered import read_chains
from gnd.fleet_bus.seal_keys import certificates_of, holder_of, holder_of_chain, read_revoked
from gnd.fleet_bus.seals import Seal
from gnd.fleet_bus.short_seals import ShortSeal, TerseSeal
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.archive_seal import SealNumber
from gnd.schemas.generated import health_report_pb2
from gnd.schemas.health import HealthReport, TileHealth
from gnd.tile_client.archive_check import bytes_of_seen, read_seen

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


def _seen() -> list[bytes]:
    states = {"catalog/ndt/7": SealNumber(1_700_000_000, 3), "list/ndt/": SealNumber(1, 2**48 - 1)}
    before = {name: [one.signed_s, one.number] for name, one in states.items()}  # releases before wrote no checksum
    return [bytes_of_seen(states), bytes_of_seen({}), json.dumps(before).encode()]


def _seen_mutated(data: bytes, rng: Random) -> bytes:
    """Half of the time with the checksum of what it says now, where it is still an object of states."""
    changed = text_mutated(data, rng)
    with suppress(ValueError, TypeError, KeyError, RecursionError):
        if rng.randrange(2):
            told = json.loads(changed)
            told["sha256"] = sha256(json.dumps(told["states"], sort_keys=True).encode()).hexdigest()
            return json.dumps(told).encode()
    return changed


def _chain() -> bytes:
    der = _authority()[0].public_bytes(Encoding.DER)
    return len(der).to_bytes(2, "little") + der


def _holders(data: bytes) -> object:
    with warnings.catch_warnings():  # about serial numbers that later releases of the library refuse
        warnings.simplefilter("ignore", CryptographyDeprecationWarning)
        certificates = certificates_of(data)
        with suppress(SealError):  # most are not signed; what they say is read all the same
            holder_of_chain(data, [_authority()[0]])
    return [holder_of(one) for one in certificates]


@cache
def _publishers() -> Publishers:
    with TemporaryDirectory() as folder:
        (Path(folder) / "authority.pem").write_bytes(_authority()[0].public_bytes(Encoding.PEM))
        return Publishers(Path(folder))


def _publisher(data: bytes) -> object:
    with suppress(NotAnsweredFor):  # read, and of a vehicle
        return _publishers().learn(data)
    return None


def _lists(data: bytes) -> object:
    load_revoked(data, [_authority()[0]])
    return read_revoked(data, [_authority()[0]])


def _seals() -> list[bytes]:
    seals = (
        Seal("question", bytes(8), 1, bytes(64), bytes(8), chain=b"\x01\x00x"),
        Seal("answer", bytes(8), 0, bytes(64)),
        Seal("number", b"", 0, b"", bytes(8), count_wanted=True),
        Seal("question", bytes(8), 1, bytes(64), bytes(8), chain=b"\x01\x00x", share=bytes(32)),
        Seal("answer", bytes(8), 0, bytes(64), share=bytes(32)),
    )
    return [seal.encode() for seal in seals]


def _short_seals() -> list[bytes]:
    seals = (
        ShortSeal("question", bytes(4), bytes(3), 1),
        ShortSeal("question", bytes(8), bytes(3), 1 << 27),
        ShortSeal("answer", bytes(8)),
        ShortSeal("refusal", bytes(8)),
        ShortSeal("notice", bytes(8), bytes(3), 300),
    )
    return [seal.encode() for seal in seals]


def _terse_seals() -> list[bytes]:
    return [TerseSeal(7, 200, bytes(4)).encode(), TerseSeal((1 << 14) - 1, 0, bytes(8)).encode()]


def _known() -> list[bytes]:
    chain = _chain()
    return [2 * (len(chain).to_bytes(2, "little") + chain), b""]


TARGETS = (
    FuzzTarget(
        "seal", ("fleet_bus/seals.py:Seal.decode",), "seals (attachments)", Seal.decode, _seals, bytes_mutated
    ),
    FuzzTarget(
        "short-seal",
        ("fleet_bus/short_seals.py:ShortSeal.decode",),
        "short seals (attachments)",
        lambda data: ShortSeal.decode(data).encode(),
        _short_seals,
        bytes_mutated,
    ),
    FuzzTarget(
        "terse-seal",
        ("fleet_bus/short_seals.py:TerseSeal.decode",),
        "terse seals (attachments)",
        lambda data: TerseSeal.decode(data).whole("question", b"key", 1000).encode(),
        _terse_seals,
        bytes_mutated,
    ),
    FuzzTarget(
        "seen-states",
        ("tile_client/archive_check.py:read_seen",),
        "which catalogs, lists and archives were seen (JSON)",
        read_seen,
        _seen,
        _seen_mutated,
    ),
    FuzzTarget(
        "known-certificates",
        ("fleet_bus/remembered.py:read_chains",),
        "certificates of others, kept over a start",
        read_chains,
        _known,
        bytes_mutated,
    ),
    FuzzTarget(
        "certificate-chain", (), "certificates of a seal (DER)", _holders, lambda: [_chain()], bytes_mutated
    ),
    FuzzTarget(
        "publisher-chain", (), "certificates of a publisher (DER)", _publisher, lambda: [_chain()], bytes_mutated
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
