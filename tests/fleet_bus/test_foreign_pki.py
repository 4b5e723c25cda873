"""Certificates from a PKI of somebody's own, with an intermediate authority; a command signs the router's list."""

import datetime as dt
import time
from ipaddress import ip_address
from pathlib import Path

import pytest
from click.testing import CliRunner
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from suite_ports import new_port

from gnd.deploy.certs_cli import certs
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusError, IdentityError
from gnd.fleet_bus.gate import SecureRouter
from gnd.fleet_bus.identity.folder import load_identity, problems

TILE = "gnd/v1/tile/ndt/13033/03021/21000/00000"


class Issuer:
    """An authority of the PKI: its key, and its chain up to but without the root."""

    def __init__(self, name: str, above: "Issuer | None" = None) -> None:
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        signer = above or self
        self.certificate = signer.sign(self.name, self.key.public_key(), is_authority=True)
        self.chain = [] if above is None else [self.certificate]

    def sign(
        self, subject: x509.Name, key: ec.EllipticCurvePublicKey, *, is_authority: bool = False, is_router: bool = False
    ) -> x509.Certificate:
        now = dt.datetime.now(dt.UTC)
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(self.name).public_key(key)
        builder = builder.serial_number(x509.random_serial_number())
        builder = builder.not_valid_before(now - dt.timedelta(hours=1)).not_valid_after(now + dt.timedelta(days=1))
        builder = builder.add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
        if not is_authority:
            uses = [ExtendedKeyUsageOID.CLIENT_AUTH] + [ExtendedKeyUsageOID.SERVER_AUTH] * is_router
            builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        if is_router:
            hosts = x509.SubjectAlternativeName([x509.DNSName("localhost"), x509.IPAddress(ip_address("127.0.0.1"))])
            builder = builder.add_extension(hosts, critical=False)
        return builder.sign(self.key, hashes.SHA256())


def pem_of(*certificates: x509.Certificate) -> bytes:
    return b"".join(one.public_bytes(serialization.Encoding.PEM) for one in certificates)


def key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    form = serialization.PrivateFormat.PKCS8
    return key.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption())


@pytest.fixture
def pki(tmp_path: Path) -> Path:
    """Folders `r`, `s`, `v` of a router, a tile server, a vehicle, and `root-key.pem`."""
    root = Issuer("Example Root")
    below = Issuer("Example Vehicles", root)
    (tmp_path / "root-key.pem").write_bytes(key_pem(root.key))
    for folder, common_name in (("r", "router.main"), ("s", "tiles.store"), ("v", "vehicle.v-1")):
        key = ec.generate_private_key(ec.SECP256R1())
        named = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
        own = below.sign(named, key.public_key(), is_router=folder == "r")
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "certificate.pem").write_bytes(pem_of(own, *below.chain))
        (tmp_path / folder / "authority.pem").write_bytes(pem_of(root.certificate))
        (tmp_path / folder / "key.pem").write_bytes(key_pem(key))
    return tmp_path


def sign(pki: Path, *words: str) -> str:
    line = ["members", "--key", str(pki / "root-key.pem"), "--to", str(pki / "r"), *words]
    result = CliRunner().invoke(certs, line, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_members_of_a_foreign_pki_come_in_and_are_cut_off(pki: Path) -> None:
    vehicle = str(pki / "v" / "certificate.pem")
    assert "list 1" in sign(pki, "router.main", "tiles.store", vehicle)
    assert problems(load_identity(pki / "v")) == []
    endpoint = f"tls/127.0.0.1:{new_port()}"
    with (
        SecureRouter((endpoint,), (), pki / "r"),
        open_bus(BusConfig(connect=(endpoint,), identity=pki / "s")) as store,
        open_bus(BusConfig(connect=(endpoint,), identity=pki / "v")) as bus,
    ):
        store.serve("gnd/v1/tile/**", lambda request: request.payload)
        assert bus.request(TILE, b"1", kind="tile", timeout_s=20) == b"1"
        assert "list 2" in sign(pki, "router.main", "tiles.store", "--revoked", "vehicle.v-1")
        is_shut_out, until_s = False, time.monotonic() + 60
        while not is_shut_out and time.monotonic() < until_s:
            try:
                bus.request(TILE, b"2", kind="tile", timeout_s=1)
            except BusError:
                is_shut_out = True
        assert is_shut_out


def test_a_list_is_not_signed_with_another_key_nor_left_empty(pki: Path) -> None:
    sign(pki, "router.main")
    before = (pki / "r" / "members.json").read_bytes()
    with pytest.raises(IdentityError, match="is none of"):
        sign(pki, "driver.main")
    (pki / "root-key.pem").write_bytes(key_pem(Issuer("Somebody").key))
    with pytest.raises(IdentityError, match="the key of none of the 1 authorities"):
        sign(pki, "router.main")
    assert (pki / "r" / "members.json").read_bytes() == before


def test_a_list_without_members_is_refused(pki: Path) -> None:
    with pytest.raises(IdentityError, match="would shut everybody out"):
        sign(pki, "vehicle.v-1", "--revoked", "vehicle.v-1")
