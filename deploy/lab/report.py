"""The account of a fleet in a lab: what each link was asked for, what it carried, and whether two counts agree.

Compared are, per vehicle and direction, bytes of whole IP packets: the *ledger's* wire bytes, which the agent takes
from TCP_INFO of its own sockets (payload with repetitions, plus 40 or 52 bytes of IP and TCP headers a segment), and
the *interface's* bytes, which the kernel counts at the vehicle's end of the link (a veth's Ethernet headers taken off).
They differ by what TCP_INFO does not tell: options of SYN and SACK segments, payload that arrived twice (one segment is
1.4 kB, which is much in a small download), and the last segments of a connection after the agent has read its count.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from gnd.deploy.lab.counters import Drops, InterfaceCounts, read_counts, read_drops
from gnd.deploy.lab.groups import Group, LabLink
from gnd.deploy.lab.lab import Lab
from gnd.deploy.lab.relay import LineCount
from gnd.deploy.lab.sampler import LinkSeen
from gnd.fleet_bus.ledger_file import AgentLedger

TOLERANCE: Final = 0.05
"""Ledger and interface must agree within this share of the interface's bytes."""


@dataclass(frozen=True, slots=True)
class LinkCounted:
    """The counts of one vehicle's link at the end of a run.

    Attributes:
        link: which.
        counts: of the vehicle's interface.
        up_drops: of the queue on the vehicle's side.
        down_drops: of the queue on the cloud's side.
    """

    link: LabLink
    counts: InterfaceCounts
    up_drops: Drops
    down_drops: Drops


def count_links(lab: Lab) -> tuple[LinkCounted, ...]:
    """Read all counters of a lab; do it before the lab is removed."""
    return tuple(
        LinkCounted(
            link,
            read_counts(link),
            read_drops(link.vehicle_namespace, link.vehicle_device),
            read_drops(link.cloud_namespace, link.cloud_device),
        )
        for link in lab.links
    )


@dataclass(frozen=True, slots=True)
class DirectionAccount:
    """One direction of the links of one group.

    Attributes:
        rate_bit_s: what each link may carry; infinite without limit.
        peak_bit_s: the highest mean over one second that a link of the group carried.
        packets: at the vehicles' interfaces.
        interface_bytes: at the vehicles' interfaces, IP bytes.
        ledger_bytes: on the wire according to the vehicles' ledgers, IP bytes.
        difference: (ledger - interface) / interface; 0 where nothing was sent.
        worst_difference: the same of the vehicle for which it is largest.
        lost: packets lost on purpose.
        loss: share of the packets that were lost on purpose.
        overflowed: packets dropped because the queue before the rate limit was full.
        resent: share of the payload bytes that TCP sent again, as far as seen; None when never seen.
        delay_ms: mean one-way delay that the relay gave, ms; None where no relay carries the links.
        delay_max_ms: the longest, ms.
    """

    rate_bit_s: float
    peak_bit_s: float
    packets: int
    interface_bytes: int
    ledger_bytes: int
    difference: float
    worst_difference: float
    lost: int
    loss: float
    overflowed: int
    resent: float | None
    delay_ms: float | None
    delay_max_ms: float | None

    @property
    def agrees(self) -> bool:
        """Whether the ledgers of the group and the interfaces of its namespace agree within `TOLERANCE`."""
        return abs(self.difference) <= TOLERANCE


@dataclass(frozen=True, slots=True)
class GroupAccount:
    """The links of one group.

    Attributes:
        group: its name.
        profile: name of the link profile.
        vehicles: how many.
        carried_by: "relay", or "kernel" where nothing or netem delays.
        wanted_delay_ms: one-way delay of the profile, ms.
        wanted_jitter_ms: jitter of the profile, ms.
        wanted_loss: share of packets that the profile loses.
        round_trip_ms: median of the round trips that the vehicles' TCP measured, ms; None when never seen.
        shortest_ms: the shortest round trip, ms.
        up: from the vehicles.
        down: to the vehicles.
    """

    group: str
    profile: str
    vehicles: int
    carried_by: str
    wanted_delay_ms: float
    wanted_jitter_ms: float
    wanted_loss: float
    round_trip_ms: float | None
    shortest_ms: float | None
    up: DirectionAccount
    down: DirectionAccount


@dataclass(frozen=True, slots=True)
class Evidence:
    """Everything that a run in a lab left to be accounted for.

    Attributes:
        counted: the kernel's counts, by number of the vehicle.
        seen: what was watched, by number of the vehicle.
        relays: what the relays did, by device.
        ledgers: the vehicles' own accounts, by number of the vehicle; a vehicle that left none is missing.
    """

    counted: tuple[LinkCounted, ...]
    seen: dict[int, LinkSeen]
    relays: dict[str, LineCount]
    ledgers: dict[int, AgentLedger]


def account(lab: Lab, evidence: Evidence) -> tuple[GroupAccount, ...]:
    """Return the account of each group of a lab."""
    return tuple(_group_account(lab, group, evidence) for group in lab.groups)


def _group_account(lab: Lab, group: Group, evidence: Evidence) -> GroupAccount:
    seen = [evidence.seen[number] for number in group.vehicles]
    medians = [median for one in seen if (median := one.median_ms()) is not None]
    shortest_ms = min(one.shortest_ms for one in seen)
    return GroupAccount(
        group=group.name,
        profile=group.link.name,
        vehicles=group.count,
        carried_by="relay" if lab.links[group.first] in lab.relayed else "kernel",
        wanted_delay_ms=group.link.delay_ms,
        wanted_jitter_ms=group.link.jitter_ms,
        wanted_loss=group.link.loss,
        round_trip_ms=sum(medians) / len(medians) if medians else None,
        shortest_ms=shortest_ms if medians else None,
        up=_direction(lab, group, evidence, "up"),
        down=_direction(lab, group, evidence, "down"),
    )


def _direction(lab: Lab, group: Group, evidence: Evidence, direction: str) -> DirectionAccount:
    up = direction == "up"
    counted = [evidence.counted[number] for number in group.vehicles]
    drops = [one.up_drops if up else one.down_drops for one in counted]
    relay = _relay_total(lab.links_of(group), evidence.relays, up=up)
    pairs = [_ledger_and_interface(one, evidence.ledgers, up=up) for one in counted]
    packets = sum(one.counts.up_packets if up else one.counts.down_packets for one in counted)
    lost = relay.lost + sum(drop.netem for drop in drops)
    # What the vehicle sends is counted before the losses, what it receives after them.
    offered = packets if up else packets + lost
    shares = [s for number in group.vehicles if (s := evidence.seen[number].resent_share(direction)) is not None]
    return DirectionAccount(
        rate_bit_s=group.link.rate_byte_s(direction) * 8,
        peak_bit_s=max(evidence.seen[number].peak_bit_s[direction] for number in group.vehicles),
        packets=packets,
        interface_bytes=sum(interface for _, interface in pairs),
        ledger_bytes=sum(ledger for ledger, _ in pairs),
        difference=_difference(sum(ledger for ledger, _ in pairs), sum(interface for _, interface in pairs)),
        worst_difference=max((_difference(*pair) for pair in pairs), key=abs),
        lost=lost,
        loss=lost / offered if offered else 0.0,
        overflowed=sum(drop.queue for drop in drops),
        resent=max(shares, default=None),
        delay_ms=relay.delay_sum_s / relay.packets * 1000 if relay.packets else None,
        delay_max_ms=relay.delay_max_s * 1000 if relay.packets else None,
    )


def _relay_total(links: tuple[LabLink, ...], relays: dict[str, LineCount], *, up: bool) -> LineCount:
    devices = [link.vehicle_device if up else link.cloud_device for link in links]
    return sum((relays[device] for device in devices if device in relays), LineCount())


def _ledger_and_interface(counted: LinkCounted, ledgers: dict[int, AgentLedger], *, up: bool) -> tuple[int, int]:
    ledger = ledgers.get(counted.link.number)
    interface = counted.counts.up_bytes if up else counted.counts.down_bytes
    if ledger is None:
        return 0, interface
    return (ledger.wire_up if up else ledger.wire_down), interface


def _difference(ledger: int, interface: int) -> float:
    return (ledger - interface) / interface if interface else 0.0


def as_json(lab: str, groups: tuple[GroupAccount, ...]) -> dict[str, Any]:
    """Return the account as plain values; a rate without limit is null."""
    return {"name": lab, "tolerance": TOLERANCE, "groups": [_plain(group) for group in groups]}


def _plain(group: GroupAccount) -> dict[str, Any]:
    values = asdict(group)
    for name, direction in (("up", group.up), ("down", group.down)):
        values[name]["agrees"] = direction.agrees
        if direction.rate_bit_s == float("inf"):
            values[name]["rate_bit_s"] = None
    return values


def write_account(path: Path, values: dict[str, Any]) -> None:
    """Write the account as JSON, whole or not at all."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(values, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    partial.replace(path)
