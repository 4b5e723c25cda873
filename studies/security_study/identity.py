"""What certificates cost and how fast they act: connecting, sessions a second, bytes, revocation, new members."""

import concurrent.futures
import json
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from gnd.deploy.fleet_identities import make_identities
from gnd.deploy.ports import claim_port
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusError
from gnd.fleet_bus.gate import SecureRouter
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.folder import MEMBERS
from gnd.fleet_bus.identity.lists import MemberList, replace_file
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.links import load_link
from studies.security_study.delay_relay import DelayRelay
from studies.security_study.kilometre import kilometres, router
from studies.security_study.light_clients import Opening, cpu_of_s, open_sessions, record_opening

CONNECTS: Final = 20
SESSIONS: Final = 300
LIGHT_ROUNDS: Final = 5
THREADS: Final = 8
EXCHANGES: Final = 200
PAYLOAD: Final = bytes(200)
"""Of a question and of its answer: about what a steady vehicle sends in a message."""
ROUNDS: Final = 3
KILOMETRES: Final = 3
TILE: Final = "gnd/v1/tile/ndt/13033/03021/21000/00000"


@click.command()
@click.option("--members", "members", default="10,1000", show_default=True, help="Fleet sizes for the router's rights.")
@click.option("--json", "to", type=click.Path(path_type=Path), help="Write the figures into this file.")
def identity(members: str, to: Path | None) -> None:
    """What identity costs: time to connect on 3G, sessions a second, bytes; how fast revocation and new members act."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        identities = make_identities(root, 1, 3)
        found: dict[str, Any] = {"load_at_start": os.getloadavg()[0]}
        found |= _costs(identities)
        found["acts"] = [_acts(root / f"of-{n}", int(n)) for n in members.split(",")]
    text = json.dumps(found, indent=2)
    click.echo(text)
    if to is not None:
        to.write_text(text + "\n", encoding="utf-8")


def _costs(identities: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    with router("tcp", identities) as (port, _):
        opening = record_opening(port)
    for protocol in ("tcp", "tls"):
        with router(protocol, identities) as (port, process):
            endpoint = f"{protocol}/127.0.0.1:{port}"
            config = BusConfig(connect=(endpoint,), identity=identities / "vehicle-00")
            with DelayRelay(port, load_link("3g")) as relay:
                slow = BusConfig(connect=(f"{protocol}/127.0.0.1:{relay.port}",), identity=identities / "vehicle-00")
                took_s = [_connect_s(slow) for _ in range(CONNECTS)]
            found[protocol] = {
                "connect_3g_median_s": float(np.median(took_s)),
                "connect_3g_max_s": max(took_s),
            }
            tls = identities / "vehicle-00" if protocol == "tls" else None
            found[protocol]["light_clients"] = _light_sessions(opening, port, tls, process)
            found[protocol]["zenoh_clients"] = _sessions(config, process)
            for drive in ("first_drive", "next_drive"):  # the next one knows the certificates
                found[protocol][drive] = kilometres(endpoint, identities if tls else None, KILOMETRES)
            found[protocol] |= _bytes(config, BusConfig(connect=(endpoint,), identity=identities / "store"))
    return found


def _connect_s(config: BusConfig) -> float:
    began_s = time.perf_counter()
    with open_bus(config):
        return time.perf_counter() - began_s


def _light_sessions(opening: Opening, port: int, identity: Path | None, router: int) -> dict[str, float]:
    """Sessions a second that one router opens for clients that cost next to nothing, by the clock.

    Both ends share the machine with whatever else runs there: the slowest of the rounds stands beside the median, and
    the processor time of router and clients, which does not depend on others.
    """
    before_s, rounds = cpu_of_s(router), [open_sessions(opening, port, identity, SESSIONS) for _ in range(LIGHT_ROUNDS)]
    router_s, per_s = cpu_of_s(router) - before_s, [one.sessions / one.clock_s for one in rounds]
    sessions = sum(one.sessions for one in rounds)
    return {
        "sessions_per_s_median": float(np.median(per_s)),
        "sessions_per_s_slowest": min(per_s),
        "sessions_per_router_cpu_s": sessions / max(router_s, 0.01),
        "client_cpu_ms_a_session": 1e3 * sum(one.clients_cpu_s for one in rounds) / sessions,
    }


def _sessions(config: BusConfig, router: int) -> dict[str, float]:
    """Sessions opened by threads of this process and kept until all are open.

    Here a client is a whole zenoh session in Python, which costs several times what the router's side does: by the
    clock this measures the clients.
    """
    began_s, before_s, own_s = time.perf_counter(), cpu_of_s(router), time.process_time()
    with concurrent.futures.ThreadPoolExecutor(THREADS) as pool:
        opened: list[Bus] = list(pool.map(lambda _n: open_bus(config), range(SESSIONS)))
    took_s, cpu_s, own_s = time.perf_counter() - began_s, cpu_of_s(router) - before_s, time.process_time() - own_s
    with concurrent.futures.ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(Bus.close, opened))
    return {
        "sessions_per_s": SESSIONS / took_s,
        "sessions_per_router_cpu_s": SESSIONS / max(cpu_s, 0.01),
        "client_cpu_ms_a_session": 1e3 * own_s / SESSIONS,
    }


def _bytes(asking: BusConfig, answering: BusConfig) -> dict[str, float]:
    """IP bytes of a new connection, and of one question with its answer."""
    with open_bus(answering) as store, open_bus(asking) as vehicle:
        store.serve("gnd/v1/tile/**", lambda _request: PAYLOAD)
        vehicle.request(TILE, PAYLOAD, kind="tile", timeout_s=20)
        time.sleep(0.5)
        before = vehicle.wire()
        for _ in range(EXCHANGES):
            vehicle.request(TILE, PAYLOAD, kind="tile", timeout_s=20)
        time.sleep(0.5)
        after = vehicle.wire()
    return {
        "opening_bytes": float(after.up_opening + after.down_opening),
        "exchange_bytes": (after.up + after.down - before.up - before.down) / EXCHANGES,
    }


def _acts(root: Path, members: int) -> dict[str, float]:
    """How fast a router with so many members shuts one out and lets one in, over its folder."""
    authority, folder = Authority.create(root / "authority", "study"), root / "router"
    extra = frozenset(MemberName("vehicle", f"v-{n}") for n in range(members))
    for member in (MemberName("router", "r"), MemberName("tiles", "store")):
        authority.issue(member, root / member.name)
    endpoint = f"tls/127.0.0.1:{claim_port(0)}"
    (root / "r").rename(folder)
    shut_s, in_s = [], []
    _publish(authority, folder, extra)
    began_s, before_mb = time.perf_counter(), _memory_mb()
    with SecureRouter((endpoint,), (), folder), open_bus(_client(endpoint, root / "store")) as store:
        open_s = time.perf_counter() - began_s
        opened_mb = _memory_mb() - before_mb
        connect_ms = 1e3 * float(np.median([_connect_s(_client(endpoint, root / "store")) for _ in range(CONNECTS)]))
        store.serve("gnd/v1/tile/**", lambda _request: PAYLOAD)
        for n in range(ROUNDS):
            name = MemberName("vehicle", f"new-{n}")
            authority.issue(name, root / name.name)
            began_s = time.perf_counter()
            _publish(authority, folder, extra)
            with open_bus(_client(endpoint, root / name.name)) as vehicle:
                vehicle.request(TILE, b"", kind="tile", timeout_s=60)
                in_s.append(time.perf_counter() - began_s)
                authority.revoke(name)
                began_s = time.perf_counter()
                _publish(authority, folder, extra)
                shut_s.append(_last_answer_s(vehicle, began_s))
    return {
        "members": float(members),
        "router_opens_s": open_s,
        "router_opens_mb": opened_mb,
        "connect_median_ms": connect_ms,
        "let_in_max_s": max(in_s),
        "last_answer_after_revoking_max_s": max(shut_s),
    }


def _memory_mb() -> float:
    """Resident memory of this process, MB (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def _client(endpoint: str, folder: Path) -> BusConfig:
    return BusConfig(connect=(endpoint,), identity=folder)


def _publish(authority: Authority, folder: Path, extra: frozenset[MemberName]) -> None:
    """The lists of an authority that has so many more members (whose certificates are not made for this)."""
    listed = MemberList.decode(authority.lists()[0], (authority.certificate,))
    data = replace(listed, members=listed.members | extra).encode(authority._key)
    replace_file(folder / MEMBERS, data)


def _last_answer_s(vehicle: Bus, began_s: float) -> float:
    """When the last question of a revoked vehicle was answered, s after it was revoked; it asks for 6 s more."""
    last_s = began_s
    while time.perf_counter() - last_s < 6.0:
        try:
            vehicle.request(TILE, b"", kind="tile", timeout_s=0.2)
            last_s = time.perf_counter()
        except BusError:
            continue
    return last_s - began_s
