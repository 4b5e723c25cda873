"""What attacks on identity and rights share: an authority, a router process with rights, and sessions of members."""

import datetime as dt
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from suite_ports import new_port

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.gate import FRESH_LOOKS, LOOK_S
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import MemberName

START_S = 30.0
MEMBERS = (
    MemberName("vehicle", "a"),
    MemberName("vehicle", "b"),
    MemberName("shard", "shard-0"),
    MemberName("tiles", "store"),
    MemberName("operator", "ops"),
    MemberName("router", "main"),
    MemberName("router", "witness"),
)


@dataclass
class Scene:
    """A router process with an authority beside it."""

    root: Path
    authority: Authority
    endpoint: str
    router: "subprocess.Popen[str]"

    def folder(self, common_name: str) -> Path:
        """The identity folder of a member."""
        return self.root / common_name

    def config(self, folder: Path | str, **changes: Any) -> BusConfig:
        """The settings of a client with an identity."""
        where = self.folder(folder) if isinstance(folder, str) else folder
        return BusConfig(**{"connect": (self.endpoint,), "identity": where, "open_timeout_s": 2.0} | changes)

    def bus(self, folder: Path | str, **changes: Any) -> Bus:
        """A bus of a member."""
        return open_bus(self.config(folder, **changes), name=str(folder))

    @contextmanager
    def session(self, folder: Path | str) -> Iterator[zenoh.Session]:
        """A bare zenoh session of a member: it may try whatever zenoh can."""
        with zenoh.open(zenoh_config(self.config(folder))) as session:
            yield session

    def issue(self, common_name: str, **options: Any) -> Path:
        """Another member, of whom the router hears."""
        folder = self.folder(common_name)
        self.authority.issue(MemberName.parse(common_name), folder, **options)
        self.tell_router()
        return folder

    def tell_router(self) -> None:
        """Puts the lists into the router's folder."""
        self.authority.copy_lists([self.folder("router.main")])


@contextmanager
def scene(root: Path) -> Iterator[Scene]:
    """A router with rights and an identity for each of `MEMBERS`."""
    authority = Authority.create(root / "authority", "attacked fleet")
    for member in MEMBERS:
        authority.issue(member, root / member.common_name)
    authority.copy_lists([root / "router.main"])
    endpoint = f"tls/127.0.0.1:{new_port()}"
    with router_process(root / "router.main", endpoint) as process:
        yield Scene(root, authority, endpoint, process)


@contextmanager
def router_process(identity: Path, endpoint: str, *connect: str) -> Iterator["subprocess.Popen[str]"]:
    """`gnd router` with an identity, listening, linked with those at `connect`."""
    command = [sys.executable, "-m", "gnd.deploy.cli", "router", "--listen", endpoint, "--identity", str(identity)]
    command += [word for other in connect for word in ("--connect", other)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    try:
        assert process.stdout is not None
        assert "listens" in process.stdout.readline()
        yield process
    finally:
        process.terminate()
        process.wait(20)
        if process.stdout is not None:
            process.stdout.close()


def be_settled() -> None:
    """Waits until who is connected stays so when rights change; who has only just come, comes again."""
    time.sleep((FRESH_LOOKS + 2) * LOOK_S)


def until(condition: Callable[[], bool], timeout_s: float = START_S) -> bool:
    """Waits for something; whether it came."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.02)
    return True


def forged_folder(
    folder: Path,
    common_name: str,
    authority: Path,
    *,
    issuer: tuple[x509.Certificate, ec.EllipticCurvePrivateKey] | None = None,
    days: tuple[float, float] = (-1.0, 1.0),
    server: bool = False,
) -> Path:
    """An identity folder as an attacker would make it: self-signed, or signed by whatever key it has."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
    now = dt.datetime.now(dt.UTC)
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name if issuer is None else issuer[0].subject)
    builder = builder.public_key(key.public_key()).serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(now + dt.timedelta(days=days[0]))
    builder = builder.not_valid_after(now + dt.timedelta(days=days[1]))
    if server:
        builder = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
    certificate = builder.sign(key if issuer is None else issuer[1], hashes.SHA256())
    chain = [certificate] if issuer is None else [certificate, issuer[0]]
    folder.mkdir(parents=True, exist_ok=True)
    pem = serialization.Encoding.PEM
    (folder / "certificate.pem").write_bytes(b"".join(one.public_bytes(pem) for one in chain))
    (folder / "key.pem").write_bytes(
        key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    (folder / "authority.pem").write_bytes(authority.read_bytes())
    return folder


class Wiretap:
    """A listener between a client and the router: passes all on, and keeps a copy."""

    def __init__(self, endpoint: str) -> None:
        self._to = ("127.0.0.1", int(endpoint.rpartition(":")[2]))
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tls/127.0.0.1:{self._server.getsockname()[1]}"
        self.heard = bytearray()
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Listens no more."""
        self._server.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            router = socket.create_connection(self._to)
            for source, sink in ((client, router), (router, client)):
                threading.Thread(target=self._pass, args=(source, sink), daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65_536):
                self.heard += data
                sink.sendall(data)
        except OSError:
            pass
        finally:
            source.close()
            sink.close()
