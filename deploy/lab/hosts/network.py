"""The network between the hosts: a cable each to a namespace in the middle that forwards, and what it may not forward.

What is cut is dropped in the middle, without word to anybody, as by a network that fails. A host's own end stays up.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from gnd.deploy.lab.devices import MTU_BYTES, Command
from gnd.deploy.lab.groups import LabLink
from gnd.deploy.lab.hosts.plan import HostsPlan, LabHost
from gnd.deploy.lab.namespaces import add_namespace, inside, run_all, run_batch, run_tool

RULE_PRIORITY: Final = "100"
_FORWARD: Final = "/proc/sys/net/ipv4/ip_forward"


@dataclass(frozen=True, slots=True)
class LabEnd:
    """What is at one cable of the middle: a host or a vehicle.

    Attributes:
        device: interface in the middle.
        address: at the other end.
    """

    device: str
    address: str

    @classmethod
    def of_host(cls, host: LabHost) -> "LabEnd":
        """Of a host."""
        return cls(host.device, host.address)

    @classmethod
    def of_link(cls, link: LabLink) -> "LabEnd":
        """Of a vehicle's link."""
        return cls(link.cloud_device, link.vehicle_address)


def build_network(plan: HostsPlan, links: Iterable[LabLink], middle: str) -> None:
    """Make the hosts' namespaces and cables, and let vehicles reach all hosts; their links must be there.

    Raises:
        LabError: the kernel refuses.
    """
    with inside(middle), open(_FORWARD, "w", encoding="ascii") as file:  # noqa: PTH123  (of this thread's namespace)
        file.write("1")
    for host in plan.hosts:
        add_namespace(host.namespace)
        run_all(_cable(host, middle))
    for link in links:
        route = ("route", "add", "default", "via", link.cloud_address, "dev", link.vehicle_device)
        run_tool("ip", "-n", link.vehicle_namespace, *route)


def _cable(host: LabHost, middle: str) -> list[Command]:
    own, outside = ("ip", "-n", host.namespace), ("ip", "-n", middle)
    up = ("mtu", str(MTU_BYTES), "up")
    return [
        (*outside, "link", "add", host.device, "type", "veth", "peer", "name", "eth0", "netns", host.namespace),
        (*outside, "addr", "add", f"{host.gateway}/30", "dev", host.device),
        (*outside, "link", "set", host.device, *up),
        (*own, "addr", "add", f"{host.address}/30", "dev", "eth0"),
        (*own, "link", "set", "eth0", *up),
        (*own, "route", "add", "default", "via", host.gateway),
    ]


def lose_between(middle: str, sources: Iterable[LabEnd], targets: Iterable[LabEnd]) -> Callable[[], None]:
    """Drop what any of the sources sends to any of the targets; the other way is not touched.

    Returns:
        What undoes it.
    """
    targets = tuple(targets)
    words = [
        ("iif", source.device, "to", f"{target.address}/32", "blackhole", "priority", RULE_PRIORITY)
        for source in sources
        for target in targets
    ]
    run_batch(middle, [("rule", "add", *rule) for rule in words])
    return lambda: run_batch(middle, [("rule", "del", *rule) for rule in words])
