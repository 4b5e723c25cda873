"""What a kilometre costs over QUIC, TLS and TCP as zenoh has them, by the packets on a loopback of its own.

    unshare -n sh -c 'ip link set lo up; PYTHONPATH=. python tests/studies/security_study/quic_bytes.py'

UDP has no counters of a connection, so packets are read from the interface, which nobody else may use (Linux, root).
These are messages of zenoh alone, without seals, and keep-alives as zenoh sends them by itself.
"""

import json
import socket
import statistics
import struct
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import click
import zenoh

from gnd.deploy.fleet_identities import make_identities
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.rights import access_control
from studies.security_study.kilometre import KILOMETRE, PAUSE_S, KilometreMessage

CLOUD_PORT: Final = 17447
VEHICLE_PORT: Final = 17448
KILOMETRES: Final = 12
IDLE_S: Final = 40.0
SETTLE_S: Final = 5.0
_KEYS: Final = {
    "question": "gnd/v1/tiles/ndt/13033/03021/21000",
    "report": "gnd/v1/change/ndt/13033/03021/21000",
    "telemetry": "gnd/v1/traffic/vehicle-00",
}
_MEMBERS: Final = (
    MemberName("vehicle", "vehicle-00"),
    MemberName("tiles", "store"),
    MemberName("shard", "shard-0"),
    MemberName("router", "router"),
)


class PortMeter:
    """Counts IP bytes from and to a port on the loopback, until the process ends."""

    def __init__(self, port: int) -> None:
        self.total_bytes = 0
        self._port = port
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.ntohs(3))
        self._socket.bind(("lo", 0))
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        while True:
            data, address = self._socket.recvfrom(65_535)
            packet = data[14:]
            is_counted = address[2] == socket.PACKET_OUTGOING and packet[0] >> 4 == 4 and packet[9] in (6, 17)
            head = (packet[0] & 15) * 4
            if is_counted and self._port in struct.unpack("!HH", packet[head : head + 4]):
                self.total_bytes += int(struct.unpack("!H", packet[2:4])[0])

    def since(self, before: int) -> int:
        """Bytes since `total_bytes` was this, once all has passed."""
        time.sleep(2 * PAUSE_S)
        return self.total_bytes - before


def _config(folder: Path, mode: str, connect: list[str], listen: list[str]) -> zenoh.Config:
    key, certificate = str(folder / "key.pem"), str(folder / "certificate.pem")
    tls = {
        "root_ca_certificate": str(folder / "authority.pem"),
        "enable_mtls": True,
        "listen_private_key": key,
        "listen_certificate": certificate,
        "connect_private_key": key,
        "connect_certificate": certificate,
        "verify_name_on_connect": False,
    }
    config = zenoh.Config()
    told: dict[str, Any] = {
        "mode": mode,
        "connect/endpoints": connect,
        "listen/endpoints": listen,
        "scouting/multicast/enabled": False,
        "transport/link/tls": tls,
    }
    for name, value in told.items():
        config.insert_json5(name, json.dumps(value))
    return config


def _answer(query: zenoh.Query) -> None:
    with query:
        asked = b"" if query.payload is None else query.payload.to_bytes()
        query.reply(str(query.key_expr), bytes(int.from_bytes(asked[:2], "big")))
        query.drop()  # type: ignore[no-untyped-call]  # zenoh's stub


def _say(vehicle: zenoh.Session, one: KilometreMessage) -> bool:
    """Whether it was answered, where it is a question."""
    payload, answered = one.down.to_bytes(2, "big") + bytes(one.up - 2), True
    if one.what == "telemetry":
        vehicle.put(_KEYS[one.what], payload)
    else:
        answered = any(reply.ok for reply in vehicle.get(_KEYS[one.what], payload=payload, timeout=10.0))
    time.sleep(PAUSE_S)
    return answered


def _measure(protocol: str, identities: Path) -> dict[str, Any]:
    """Bytes of opening a connection, of a kilometre and of silence; whether who is no member is answered."""
    cloud, own = (f"{protocol}/127.0.0.1:{port}" for port in (CLOUD_PORT, VEHICLE_PORT))
    of_router = _config(identities / "router", "router", [], [cloud, own])
    if protocol != "tcp":  # the rights of a fleet, by the names in certificates
        rights = json.dumps(access_control(_MEMBERS)).replace('["tls"]', json.dumps([protocol]))
        of_router.insert_json5("access_control", rights)
    with ExitStack() as stack:
        stack.enter_context(zenoh.open(of_router))
        for part, key in (("store", "gnd/v1/tiles/**"), ("merger-0", "gnd/v1/change/**")):
            session = stack.enter_context(zenoh.open(_config(identities / part, "client", [cloud], [])))
            session.declare_queryable(key, _answer, complete=True)
        time.sleep(SETTLE_S)
        meter = PortMeter(VEHICLE_PORT)
        vehicle = stack.enter_context(zenoh.open(_config(identities / "vehicle-00", "client", [own], [])))
        time.sleep(SETTLE_S)
        found: dict[str, Any] = {"opening_bytes": meter.since(0)}
        tries = []
        for _ in range(KILOMETRES):
            before = meter.total_bytes
            if not all(_say(vehicle, one) for one in KILOMETRE):
                raise click.ClickException(f"{protocol}: a message was not answered")
            tries.append(meter.since(before))
        before = meter.total_bytes
        time.sleep(IDLE_S)
        found |= {"kilometre_bytes": statistics.median(tries), "kilometre_least_bytes": min(tries)}
        found[f"silent_{IDLE_S:.0f}_s_bytes"] = meter.since(before)
        stranger = stack.enter_context(zenoh.open(_config(identities / "watcher", "client", [cloud], [])))
        found["no_member_is_answered"] = _say(stranger, KILOMETRE[0])
    return found


@click.command(help=__doc__)
@click.argument("protocols", nargs=-1, metavar="[PROTOCOL]…")
def main(protocols: tuple[str, ...]) -> None:
    """Measure each of the protocols: tcp, tls, quic."""
    for protocol in protocols or ("tcp", "tls", "quic"):
        with tempfile.TemporaryDirectory() as folder:
            click.echo(json.dumps({protocol: _measure(protocol, make_identities(Path(folder), 1, 1))}))


if __name__ == "__main__":
    main()
