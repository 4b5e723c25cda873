"""The bus: sessions, requests, notices, signs of life, traffic ledger, link profiles. Nobody else imports zenoh."""

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import DEFAULT_ENDPOINT, BusConfig
from gnd.fleet_bus.errors import (
    BusClosed,
    BusConfigError,
    BusError,
    LedgerError,
    LinkError,
    MessageTooLarge,
    NoRouter,
    NotMine,
    PortInUse,
    Refused,
    RequestFailed,
    RequestRefused,
)
from gnd.fleet_bus.ledger import KINDS, Ledger, LedgerLine
from gnd.fleet_bus.links import LinkProfile, load_link
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.fleet_bus.router import open_router, run_router
from gnd.fleet_bus.serving import Request
from gnd.fleet_bus.wire import WireBytes

__all__ = [
    "DEFAULT_ENDPOINT",
    "KINDS",
    "Bus",
    "BusClosed",
    "BusConfig",
    "BusConfigError",
    "BusError",
    "Ledger",
    "LedgerError",
    "LedgerLine",
    "LinkError",
    "LinkProfile",
    "MessageTooLarge",
    "NoRouter",
    "NotMine",
    "PortInUse",
    "Refused",
    "Request",
    "RequestFailed",
    "RequestRefused",
    "RetryPolicy",
    "WireBytes",
    "load_link",
    "open_bus",
    "open_router",
    "run_router",
]
