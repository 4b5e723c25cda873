"""Settings of a bus session, checked, and their translation for zenoh."""

import ipaddress
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import zenoh

from gnd.fleet_bus.errors import BusConfigError
from gnd.fleet_bus.identity.names import identity_of_environment
from gnd.fleet_bus.links import LinkProfile, load_link

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
PLAIN_VARIABLE: Final = "GND_PLAIN_BEYOND_LOOPBACK"
"""Environment variable: "1" allows endpoints without TLS beyond this machine, where anybody may read and write."""
MAX_MESSAGE_BYTES: Final = 16 * 1024 * 1024
"""Limit of every message, in both directions."""
QUEUE_LIMIT: Final = 4096
"""How many received messages may wait for a handler, before some are refused or dropped."""
MAX_SESSIONS: Final = 10_000
"""How many sessions a router accepts."""
ACCEPT_MS: Final = 5_000
"""A handshake may take so long, ms: a weak mobile link needs one or two seconds."""
READS: Final = ("gnd/v1/tile/**", "gnd/v1/tiles/**", "gnd/v1/catalog/**")
"""Keys of questions that change nothing: whose link is full loses the answer, and asks again."""
QUEUED_BATCHES: Final = 16
"""How many batches a router keeps for each client and each lane (zenoh's most); allocated when needed."""

KIB: Final = 1024
SIZES: Final = {
    "gnd/v1/tile/**": 16 * KIB,
    "gnd/v1/tiles/**": 64 * KIB,
    "gnd/v1/catalog/**": 4 * KIB,
    "gnd/v1/state/**": 16 * KIB,
    "gnd/v1/change/**": 9 * 1024 * KIB,
}
"""Bytes of a question on these keys that a router lets in: more than any of them may have, so that what is refused by
name stays refused by name; a larger one is dropped before it is copied to anybody."""
PUT_SIZES: Final = {
    "gnd/v1/traffic/**": 64 * KIB,
    "gnd/v1/health/**": 64 * KIB,
    "gnd/v1/want/**": 256 * KIB,
    "gnd/v1/update/**": 5 * 1024 * KIB,
}
"""Likewise of messages that are put."""

# Knocking at a router that is down costs some 100 bytes a time.
_LISTEN_AGAIN_MS: Final = 20
_RETRY_MS: Final = 200
_RETRY_MOBILE_MS: Final = 1000
# A client's own queue may be full for as long as its own weak link needs: it drops nothing itself.
_OWN_LINK_WAIT_US: Final = 60_000_000
# At a router somebody else waits meanwhile: who takes nothing for so long loses the connection.
_OTHERS_WAIT_US: Final = 500_000
# What may be dropped waits for room this long, once until the link moves again; a fragment at most twice as long.
_DROP_WAIT_US: Final = 5_000
ROUTER_LEASE_MS: Final = 120_000
"""A router speaks to vehicles on mobile links: its keep-alives cost them as much as their own. A client notices a dead
router by its own keep-alives, which nobody acknowledges, long before this (`WireMeter.transmit_timeout_ms`)."""
_ROUTER_KEEP_ALIVES: Final = 2
FAIL_OVER_MS: Final = 2_000
"""A client with several routers gives a connection up on which nothing is acknowledged for so long."""
_FAIL_OVER_OPEN_MS: Final = 1_500
_FAIL_OVER_OPEN_DELAYS: Final = 40
"""It tries each of its routers so long, or so many times the one-way delay of its link: a handshake with TLS is ten."""


@dataclass(frozen=True, slots=True)
class BusConfig:
    """How a process joins the bus.

    Attributes:
        mode: "client" for everything but the router itself.
        connect: endpoints of routers, tried in order; a client whose router is lost goes to the first that answers.
        listen: endpoints to open (routers only).
        link: profile of the vehicle's link, by name, file or value; "none" paces nothing.
        lease_ms: how long a silent session stays alive, ms; 0 takes the link's own, for a router `ROUTER_LEASE_MS`.
        open_timeout_s: how long `open_bus` tries to reach a router, s.
        patient: whether `open_bus` returns without a router, too, and looks for one as long as it takes: what is
            declared until then is declared when it is found, requests wait for it.
        identity: identity folder (`gnd certs`), which "tls/" endpoints need; by default that of GND_IDENTITY. A client
            with one seals what it says, and demands seals of what it hears.
        rights: access control of a router (`rights.access_control`); empty: none.
        takes_over: of a router: whether another session listens at its endpoints; it listens as soon as that ends.
    """

    mode: Literal["client", "router"] = "client"
    connect: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    listen: tuple[str, ...] = ()
    link: str | LinkProfile = "none"
    lease_ms: int = 0
    open_timeout_s: float = 10.0
    patient: bool = False
    identity: Path | None = field(default_factory=identity_of_environment)
    rights: Mapping[str, Any] = field(default_factory=dict)
    takes_over: bool = False

    def __post_init__(self) -> None:
        if self.mode not in ("client", "router"):
            raise BusConfigError(f"mode must be client or router, got {self.mode!r}")
        if self.mode == "client" and not self.connect:
            raise BusConfigError("a client needs at least one endpoint of a router in `connect`")
        if self.mode == "client" and self.listen:
            raise BusConfigError(f"a client does not listen, got {', '.join(self.listen)}")
        if self.patient and self.mode != "client":
            raise BusConfigError("only a client waits for a router")
        for endpoint in (*self.connect, *self.listen):
            check_endpoint(endpoint)
            check_privacy(endpoint, self.identity)
        if self.rights and self.mode != "router":
            raise BusConfigError("only a router gives rights")
        if self.lease_ms != 0 and self.lease_ms < 100:
            raise BusConfigError(f"lease_ms must be 100 or more (or 0: the link's own), got {self.lease_ms}")

    @property
    def transmit_timeout_ms(self) -> int:
        """A connection ends on which nothing that was sent is acknowledged for so long, ms."""
        lease_ms = self.lease_ms or self.link_profile.lease_ms
        return min(lease_ms, FAIL_OVER_MS) if len(self.connect) > 1 else lease_ms

    @property
    def link_profile(self) -> LinkProfile:
        """The profile that `link` names."""
        return load_link(self.link)


def check_endpoint(endpoint: str) -> None:
    """Refuses what is not "protocol/host:port".

    Raises:
        BusConfigError: with an example of what is meant.
    """
    protocol, slash, address = endpoint.partition("/")
    if protocol == "unixsock-stream" and address:
        return
    host, _, port = address.partition("#")[0].rpartition(":")
    if not (slash and protocol and host and port.isdecimal() and len(port) <= 5 and int(port) < 65_536):
        raise BusConfigError(f"endpoint {endpoint!r} is not like {DEFAULT_ENDPOINT}")


def check_privacy(endpoint: str, identity: Path | None) -> None:
    """Refuses "tls/" without an identity, and anything else beyond this machine.

    Raises:
        BusConfigError: with what to do about it.
    """
    protocol, _, rest = endpoint.partition("/")
    if protocol == "tls":
        if identity is None:
            raise BusConfigError(
                f"{endpoint} needs an identity folder: --identity FOLDER or GND_IDENTITY (`gnd certs`)"
            )
        return
    if protocol == "unixsock-stream" or os.environ.get(PLAIN_VARIABLE) == "1":
        return
    host = rest.partition("#")[0].rpartition(":")[0].strip("[]")
    if not _is_loopback(host):
        raise BusConfigError(
            f"{endpoint} is plain and reaches beyond this machine: whoever gets there could read and forge everything;"
            f" use tls/{rest} with an identity (`gnd certs`), or set {PLAIN_VARIABLE}=1 in a network that you trust"
        )


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def zenoh_config(config: BusConfig) -> zenoh.Config:
    """The zenoh configuration with the rules that protect data and keep the account honest.

    Raises:
        BusConfigError: zenoh did not take a setting.
        LinkError: unknown link profile.
    """
    result = zenoh.Config()
    for key, value in _settings(config, config.link_profile).items():
        try:
            result.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise BusConfigError(f"zenoh refuses {key} = {value!r}: {error}") from error
    assert_rules(result, config)
    return result


def assert_rules(settings: zenoh.Config, config: BusConfig) -> None:
    """Reads back the rules whose breach loses data or hides traffic without any error.

    Raises:
        BusConfigError: naming the rule.
    """
    for key, value in _settings(config, config.link_profile).items():
        got = json.loads(settings.get_json(key))
        if not _same(value, got):
            raise BusConfigError(f"zenoh setting {key} must be {value!r}, but is {got!r}")


def _same(want: Any, got: Any) -> bool:
    if isinstance(want, dict) and isinstance(got, dict):
        return all(_same(value, got.get(key)) for key, value in want.items())
    if isinstance(want, list) and isinstance(got, list):
        return len(want) == len(got) and all(map(_same, want, got))
    return bool(want == got)


def _settings(config: BusConfig, link: LinkProfile) -> dict[str, Any]:
    settings = _session_settings(config, link) | (_router_rules() if config.mode == "router" else {})
    if link.send_buffer_bytes:
        settings["transport/link/tcp/so_sndbuf"] = link.send_buffer_bytes
        settings["transport/link/tls/so_sndbuf"] = link.send_buffer_bytes
    if config.identity is not None:
        settings |= _tls(config.identity)
    if config.rights:
        settings["access_control"] = dict(config.rights)
    if config.takes_over:
        retry = {"period_init_ms": _LISTEN_AGAIN_MS, "period_max_ms": _LISTEN_AGAIN_MS, "period_increase_factor": 1.0}
        settings |= {"listen/exit_on_failure": False, "listen/timeout_ms": -1, "listen/retry": retry}
    return settings | _patience(config)


def _tls(identity: Path) -> dict[str, Any]:
    """TLS of both sides; zenoh reads the files anew for each connection that it opens."""
    certificate, key = str(identity / "certificate.pem"), str(identity / "key.pem")
    tls = {
        "root_ca_certificate": str(identity / "authority.pem"),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "connect_certificate": certificate,
        "connect_private_key": key,
        "listen_certificate": certificate,
        "listen_private_key": key,
    }
    return {f"transport/link/tls/{name}": value for name, value in tls.items()}


def _patience(config: BusConfig) -> dict[str, Any]:
    """How long a full queue is waited for: by a client as long as its own link needs, by a router hardly at all."""
    is_router = config.mode == "router"
    drop_us = _DROP_WAIT_US if is_router else _OWN_LINK_WAIT_US
    control = "transport/link/tx/queue/congestion_control"
    return {
        f"{control}/drop/wait_before_drop": drop_us,
        f"{control}/drop/max_wait_before_drop_fragments": drop_us,
        # Then the session is closed, and later puts would vanish.
        f"{control}/block/wait_before_close": _OTHERS_WAIT_US if is_router else _OWN_LINK_WAIT_US,
    }


def _router_rules() -> dict[str, Any]:
    """Whoever does not read loses its own messages, then its own connection, and nobody waits for it.

    Answers have the congestion control of their question as it left the router; the end of the answers always blocks,
    and where its lane is known to be full, zenoh closes that connection at once.
    """
    lanes = ("data_high", "data", "data_low")
    return {
        "transport/link/tx/queue/size": dict.fromkeys(lanes, QUEUED_BATCHES),
        "qos/network": [
            _rule("notices", ["put", "delete"], ["**"], {"congestion_control": "drop", "priority": "data_low"}),
            _rule("reads", ["query"], list(READS), {"congestion_control": "drop"}),
        ],
        "low_pass_filter": [
            *(_size("query", key, size) for key, size in SIZES.items()),
            *(_size("put", key, size) for key, size in PUT_SIZES.items()),
        ],
    }


def _size(message: str, key: str, size: int) -> dict[str, Any]:
    name = f"{message} {key}"
    return {"id": name, "messages": [message], "key_exprs": [key], "flows": ["ingress"], "size_limit": size}


def _rule(name: str, messages: list[str], keys: list[str], overwrite: dict[str, str]) -> dict[str, Any]:
    return {"id": name, "messages": messages, "key_exprs": keys, "flows": ["ingress"], "overwrite": overwrite}


def _open_timeout_ms(config: BusConfig, link: LinkProfile) -> int:
    """How long one attempt to connect may take; with several routers the next is to have its turn soon."""
    longest_ms = 10_000.0
    if config.mode == "client" and len(config.connect) > 1:
        longest_ms = min(longest_ms, max(_FAIL_OVER_OPEN_MS, _FAIL_OVER_OPEN_DELAYS * link.delay_ms))
    return round(max(100.0, min(longest_ms, 1000 * config.open_timeout_s)))


def _session_settings(config: BusConfig, link: LinkProfile) -> dict[str, Any]:
    is_router = config.mode == "router"
    return {
        "mode": config.mode,
        "connect/endpoints": list(config.connect),
        # Endpoints come back by themselves after a lost connection.
        "connect/retry": {
            "period_init_ms": 50,
            "period_max_ms": _RETRY_MS if math.isinf(link.up_bit_s) else _RETRY_MOBILE_MS,
            "period_increase_factor": 1.5,
        },
        "listen/endpoints": list(config.listen),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # A router would wait half a second for others to be found, though nobody scouts.
        "scouting/delay": 0,
        # On by default; would carry messages past the socket and past the traffic account.
        "transport/shared_memory/enabled": False,
        "transport/unicast/max_sessions": MAX_SESSIONS,
        "transport/unicast/accept_pending": 1000,
        "transport/unicast/accept_timeout": ACCEPT_MS,
        "transport/unicast/open_timeout": _open_timeout_ms(config, link),
        # Has no fragmentation.
        "transport/unicast/lowlatency": False,
        "transport/link/tx/lease": config.lease_ms or (ROUTER_LEASE_MS if is_router else link.lease_ms),
        "transport/link/tx/keep_alive": _ROUTER_KEEP_ALIVES if is_router else link.keep_alives,
        "transport/link/tx/batch_size": link.batch_bytes,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
    }
