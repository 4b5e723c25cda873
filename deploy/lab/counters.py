"""The kernel's counts of a link: bytes and packets of its interfaces, drops of its queues, what TCP says of it."""

import json
import re
from dataclasses import dataclass
from typing import Any, Final, TextIO

from gnd.deploy.lab.groups import LabLink
from gnd.deploy.lab.namespaces import inside, run_tool

ETHERNET_BYTES: Final = 14
"""Header that a veth interface counts with each packet, and a TUN interface has not."""

_FIELD: Final = re.compile(r"\b(rtt|minrtt|bytes_sent|bytes_retrans):([0-9.]+)")


@dataclass(frozen=True, slots=True)
class InterfaceCounts:
    """What one vehicle's interface has passed, in IP bytes.

    Attributes:
        up_bytes: sent by the vehicle; counted behind the queue that limits the rate and before losses on the way.
        down_bytes: received by the vehicle; what was lost on the way is not among them.
        up_packets: packets sent.
        down_packets: packets received.
    """

    up_bytes: int
    down_bytes: int
    up_packets: int
    down_packets: int


@dataclass(frozen=True, slots=True)
class Drops:
    """Packets of one direction that the kernel dropped.

    Attributes:
        queue: because the queue before the rate limit was full (congestion).
        netem: on purpose; 0 where a relay carries the link.
    """

    queue: int
    netem: int


def read_counts(link: LabLink) -> InterfaceCounts:
    """Read the interface on the vehicle's side.

    Raises:
        LabError: the interface is gone.
    """
    words = ("ip", "-n", link.vehicle_namespace, "-s", "-j", "link", "show", "dev", link.vehicle_device)
    state = json.loads(run_tool(*words))[0]
    header = ETHERNET_BYTES if state["link_type"] == "ether" else 0
    up, down = state["stats64"]["tx"], state["stats64"]["rx"]
    return InterfaceCounts(
        up["bytes"] - header * up["packets"], down["bytes"] - header * down["packets"], up["packets"], down["packets"]
    )


def read_drops(namespace: str, device: str) -> Drops:
    """Read the queueing disciplines of an interface that sends."""
    stages = json.loads(run_tool("tc", "-n", namespace, "-s", "-j", "qdisc", "show", "dev", device))
    netem = sum(_drops(stages, "netem"))
    # tbf counts the drops of the netem below it among its own.
    return Drops(max(0, sum(_drops(stages, "tbf")) - netem), netem)


def _drops(stages: list[dict[str, Any]], kind: str) -> list[int]:
    return [int(stage["drops"]) for stage in stages if stage["kind"] == kind]


@dataclass(frozen=True, slots=True)
class TcpSample:
    """What the kernel says of one TCP connection at one moment.

    Attributes:
        local: own address and port.
        rtt_ms: smoothed round trip, ms.
        min_rtt_ms: shortest round trip of the last minutes, ms.
        sent_bytes: payload sent, repetitions included.
        resent_bytes: payload sent again.
    """

    local: str
    rtt_ms: float
    min_rtt_ms: float
    sent_bytes: int
    resent_bytes: int


def tcp_samples(namespace: str) -> list[TcpSample]:
    """Return the established connections of a namespace that have measured their round trip."""
    lines = run_tool("ss", "-N", namespace, "-tinHO", "state", "established").splitlines()
    return [sample for line in lines if (sample := parse_ss(line)) is not None]


def parse_ss(line: str) -> TcpSample | None:
    """Read one line of `ss -tinHO state established`; None where it has no round trip (yet)."""
    words = line.split()
    found = dict(_FIELD.findall(line))
    if len(words) < 4 or not {"rtt", "minrtt"} <= found.keys():
        return None
    sent, resent = int(found.get("bytes_sent", 0)), int(found.get("bytes_retrans", 0))
    return TcpSample(words[2], float(found["rtt"]), float(found["minrtt"]), sent, resent)


@dataclass(slots=True)
class DeviceReader:
    """Reads an interface's counters again and again without starting a process: /proc/net/dev, opened inside."""

    file: TextIO

    @classmethod
    def of(cls, namespace: str) -> "DeviceReader":
        """Open a namespace's interfaces; close `file` when done, or the namespace stays."""
        with inside(namespace):
            return cls(open("/proc/thread-self/net/dev", encoding="ascii"))  # noqa: PTH123  (kept open)

    def sent_and_received(self) -> dict[str, tuple[int, int]]:
        """Return by device the bytes sent and received so far, link headers included."""
        self.file.seek(0)
        lines = [line.split(":") for line in self.file.read().splitlines()[2:]]
        return {name.strip(): _sent_and_received(values) for name, values in lines}


def _sent_and_received(values: str) -> tuple[int, int]:
    words = values.split()
    return int(words[8]), int(words[0])
