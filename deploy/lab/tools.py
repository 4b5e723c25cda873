"""What a lab needs from the machine, refused clearly where it is missing."""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.lab.namespaces import add_namespace, remove_namespace, run_tool
from gnd.fleet_bus.links import LinkProfile

TUN_DEVICE: Final = Path("/dev/net/tun")
TOOLS: Final = ("ip", "tc", "ss")


@dataclass(frozen=True, slots=True)
class Offer:
    """What the kernel offers.

    Attributes:
        tbf: whether it can limit the rate of an interface.
        netem: whether it can delay and lose packets by itself.
        tun: whether a process can carry packets instead.
    """

    tbf: bool
    netem: bool
    tun: bool


def needs_carrying(link: LinkProfile) -> bool:
    """Tell whether a link asks for more than a rate."""
    return link.delay_ms > 0 or link.loss > 0


def check_rights() -> None:
    """Refuse to go on without root or without the tools of iproute2.

    Raises:
        LabError: naming what is missing and what to do.
    """
    if os.geteuid() != 0:
        raise LabError(f"network namespaces need root, this is user {os.geteuid()}: run it with sudo")
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        raise LabError(f"{' and '.join(missing)} missing: install iproute2")


def kernel_offer(name: str) -> Offer:
    """Try out which queueing disciplines the kernel knows.

    Args:
        name: a namespace to make for it, and to remove again.

    Raises:
        LabError: no namespace can be made.
    """
    add_namespace(name)
    try:
        tbf = _knows(name, "tbf", "rate", "1mbit", "burst", "4kb", "limit", "64kb")
        netem = _knows(name, "netem", "delay", "1ms")
    finally:
        remove_namespace(name)
    return Offer(tbf, netem, TUN_DEVICE.is_char_device())


def _knows(namespace: str, *discipline: str) -> bool:
    try:
        run_tool("tc", "-n", namespace, "qdisc", "replace", "dev", "lo", "root", *discipline)
    except LabError:
        return False
    return True


def check_offer(offer: Offer, links: tuple[LinkProfile, ...]) -> None:
    """Refuse links that this kernel cannot shape.

    Raises:
        LabError: naming the missing module.
    """
    if not offer.tbf:
        raise LabError("this kernel has no tbf, so no rate can be limited: load the module sch_tbf")
    if not (offer.netem or offer.tun) and any(map(needs_carrying, links)):
        raise LabError(
            f"delay and loss need the module sch_netem, or {TUN_DEVICE} for a relay: this kernel has neither"
        )
