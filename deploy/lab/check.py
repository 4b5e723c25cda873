"""`gnd lab check`: what each profile's link really does, measured by real transfers through it."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from gnd.deploy.errors import LabError
from gnd.deploy.lab.groups import LabLink
from gnd.deploy.lab.lab import Lab
from gnd.deploy.lab.probes import Bulk, Direction, Stream, bulk, flood, stream
from gnd.deploy.lab.run import relay_processes
from gnd.deploy.processes import Supervisor

READY_S: Final = 30.0
DIRECTIONS: Final[tuple[Direction, ...]] = ("down", "up")
_CONGESTION: Final = Path("/proc/sys/net/ipv4/tcp_congestion_control")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LinkMeasured:
    """One direction of one profile's link.

    Attributes:
        profile: its name.
        direction: "up" from the vehicle or "down" to it.
        wanted_bit_s: rate of the profile, bit/s.
        wanted_delay_ms: one-way delay of the profile, ms.
        wanted_jitter_ms: its jitter to either side, ms.
        wanted_loss: share of packets that it loses.
        rate_bit_s: IP bit/s that arrived of a flood of datagrams.
        stream: delay and loss of a thin stream of datagrams.
        tcp: what one TCP connection made of it.
    """

    profile: str
    direction: Direction
    wanted_bit_s: float
    wanted_delay_ms: float
    wanted_jitter_ms: float
    wanted_loss: float
    rate_bit_s: float
    stream: Stream
    tcp: Bulk


@contextmanager
def carried(lab: Lab) -> Iterator[None]:
    """Run the relays of a lab for the block; each link has passed a datagram before the block begins.

    Raises:
        LabError: a link passes nothing.
    """
    with TemporaryDirectory(prefix="gnd-lab-") as name:
        folder = Path(name)
        supervisor = Supervisor(folder, folder / "pids.json")
        for process in relay_processes(lab, folder / "relays"):
            supervisor.start(process)
        try:
            for link in lab.links:
                _wait_until_carried(link)
            yield
        finally:
            supervisor.stop()


def _wait_until_carried(link: LabLink) -> None:
    deadline_s = time.monotonic() + READY_S
    while True:
        try:
            stream(link, "up", seconds=0.01)
        except LabError:
            if time.monotonic() > deadline_s:
                raise
        else:
            return


def measure(link: LabLink, direction: Direction, seconds: float) -> LinkMeasured:
    """Measure one direction: a thin stream, a flood, a TCP connection, each for some seconds.

    Raises:
        LabError: the link passes nothing.
    """
    profile = link.profile
    return LinkMeasured(
        profile.name,
        direction,
        profile.rate_byte_s(direction) * 8,
        profile.delay_ms,
        profile.jitter_ms,
        profile.loss,
        stream=stream(link, direction, seconds),
        rate_bit_s=flood(link, direction, seconds),
        tcp=bulk(link, direction, seconds),
    )


def as_json(measured: list[LinkMeasured]) -> dict[str, Any]:
    """Return the measurements as plain values; a rate without limit is null."""
    return {"tcp_congestion_control": congestion_control(), "links": [_plain(one) for one in measured]}


def _plain(one: LinkMeasured) -> dict[str, Any]:
    values = asdict(one)
    values["stream"]["loss"] = one.stream.loss
    if one.wanted_bit_s == float("inf"):
        values["wanted_bit_s"] = None
    return values


def congestion_control() -> str:
    """Return how this machine's TCP finds its rate (cubic, bbr, ...): with loss, that decides what it reaches."""
    return _CONGESTION.read_text(encoding="ascii").strip() if _CONGESTION.exists() else "unknown"
