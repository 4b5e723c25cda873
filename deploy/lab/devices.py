"""The commands that make a vehicle's link: a pair of interfaces, a rate on each, and netem where it is used.

A link that is carried by a relay is a pair of TUN interfaces; all others are veth pairs that the kernel joins itself.
Each side limits what it sends: the vehicle's the rate up, the cloud's the rate down.
"""

import math
from typing import Final

from gnd.deploy.lab.groups import LabLink
from gnd.fleet_bus.links import SEGMENT_BYTES, LinkProfile

HEADER_BYTES: Final = 52
"""IPv4 and TCP with time stamps."""
MTU_BYTES: Final = SEGMENT_BYTES + HEADER_BYTES
QUEUE_S: Final = 0.2
"""What may wait for a link, as time at its rate: an assumption; cellular queues are deep."""
MIN_QUEUE_BYTES: Final = 64 * MTU_BYTES
QUEUE_PACKETS: Final = 4000

Command = tuple[str, ...]


def link_commands(link: LabLink, *, relayed: bool) -> list[Command]:
    """Return the commands that make one vehicle's link, in order."""
    return [*(_tun_pair(link) if relayed else _veth_pair(link)), *_both_sides(link, relayed=relayed)]


def _tun_pair(link: LabLink) -> list[Command]:
    return [
        ("ip", "-n", namespace, "tuntap", "add", "dev", device, "mode", "tun")
        for namespace, device in _sides(link)
    ]  # fmt: skip


def _veth_pair(link: LabLink) -> list[Command]:
    vehicle, cloud = link.vehicle_device, link.cloud_device
    make = (
        "ip", "-n", link.cloud_namespace, "link", "add", cloud, "type", "veth",
        "peer", "name", vehicle, "netns", link.vehicle_namespace,
    )  # fmt: skip
    # One packet of the counters is one packet of the link: no segments joined for the way.
    return [make, *(("ip", "-n", ns, "link", "set", device, "gso_max_segs", "1") for ns, device in _sides(link))]


def _sides(link: LabLink) -> tuple[tuple[str, str], tuple[str, str]]:
    return (link.vehicle_namespace, link.vehicle_device), (link.cloud_namespace, link.cloud_device)


def _both_sides(link: LabLink, *, relayed: bool) -> list[Command]:
    addresses = (link.vehicle_address, link.cloud_address)
    rates = (link.profile.up_bit_s, link.profile.down_bit_s)
    commands: list[Command] = []
    for (namespace, device), own, peer, rate in zip(_sides(link), addresses, addresses[::-1], rates, strict=True):
        ip = ("ip", "-n", namespace)
        commands += [
            (*ip, "addr", "add", own, "peer", peer, "dev", device),
            (*ip, "link", "set", device, "mtu", str(MTU_BYTES), "txqueuelen", str(QUEUE_PACKETS), "up"),
            *_disciplines(namespace, device, rate, link.profile, netem=not relayed),
        ]
    return commands


def _disciplines(namespace: str, device: str, rate_bit_s: float, link: LinkProfile, *, netem: bool) -> list[Command]:
    add = ("tc", "-n", namespace, "qdisc", "add", "dev", device)
    limited, carried = math.isfinite(rate_bit_s), netem and (link.delay_ms > 0 or link.loss > 0)
    commands: list[Command] = []
    if limited:
        commands.append((*add, "root", "handle", "1:", *tbf_words(rate_bit_s, link.burst_bytes)))
    if carried:
        parent = ("parent", "1:1") if limited else ("root",)
        commands.append((*add, *parent, "handle", "10:", *netem_words(link)))
    return commands


def tbf_words(rate_bit_s: float, burst_bytes: int) -> Command:
    """Return the token bucket of one direction as words of `tc`."""
    queue_bytes = max(MIN_QUEUE_BYTES, round(rate_bit_s / 8 * QUEUE_S))
    burst = max(burst_bytes, 2 * MTU_BYTES)  # a bucket smaller than a packet would pass nothing
    return ("tbf", "rate", f"{round(rate_bit_s)}bit", "burst", f"{burst}b", "limit", f"{queue_bytes + burst}b")


def netem_words(link: LinkProfile) -> Command:
    """Return delay, jitter and loss of a profile as words of `tc`."""
    jitter = (f"{round(link.jitter_ms * 1000)}us",) if link.jitter_ms else ()
    loss = ("loss", "random", f"{link.loss * 100:.6f}%") if link.loss else ()
    return ("netem", "limit", str(QUEUE_PACKETS), "delay", f"{round(link.delay_ms * 1000)}us", *jitter, *loss)
