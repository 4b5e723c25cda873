"""What a vehicle says and hears on a known street, over a real router: by the counters of its connection."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from gnd.deploy.ports import claim_port
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.serving import Request
from gnd.schemas.district_list import HEAD_ONLY
from gnd.schemas.keys import list_key, list_keys

What = Literal["question", "report", "word", "telemetry", "head"]


@dataclass(frozen=True, slots=True)
class KilometreMessage:
    """A message of the vehicle, or a word to it, and what comes back.

    Attributes:
        what: a question about the map; a report; a word of the shard to the vehicle; a sample of telemetry; a question
            after the head of the list of districts.
        up: payload bytes from the vehicle.
        down: payload bytes to it, of an answer that says to what it is one.
        named: so many of these say to what it is one: they are left out where the seal shows that.
    """

    what: What
    up: int
    down: int
    named: int = 0


NAME_BYTES: Final = 28
"""Of the report's id in an ack."""
_ACK_BYTES: Final = 32
_TOLD_BYTES: Final = 22
"""What an ack tells of the report before."""
_REPORTS: Final = tuple(KilometreMessage("report", up, _ACK_BYTES + _TOLD_BYTES, NAME_BYTES) for up in (240, 263))
"""Those of the drive of decision 167 with their Gaussians, 51 and 62 bytes, packed as they are since decision 173."""
_TELEMETRY: Final = (KilometreMessage("telemetry", 62, 0), KilometreMessage("telemetry", 159, 0))
WORD: Final = KilometreMessage("word", 0, 28)
"""What a shard tells where a vehicle is not patient, or something is wanted of it: none in this kilometre."""
HEAD: Final = KilometreMessage("head", 1, 135)
"""By which a vehicle with an identity hears every six hours that its map is not frozen: none in this kilometre."""
_QUESTIONS: Final = tuple(KilometreMessage("question", up, down) for up, down in ((153, 77), (155, 52)))
"""At the start, and after 120 s; in a faster drive, instead of the second one, where the next district comes near."""
KILOMETRE: Final = (*_QUESTIONS, *_REPORTS, *_TELEMETRY)
"""Payload bytes as the ledger of `gnd reproduce steady-vehicle --length 1000 --pace 2 --secure --met` (seed 201) has
them, of a drive that took 182 s, without the report that its end makes; acks as they are without identities."""
KILOMETRE_APART: Final = (
    *(KilometreMessage("question", up, down) for up, down in ((87, 53), (89, 36), (42, 6))),
    *_REPORTS,
    *_TELEMETRY,
)
"""The same with a question a district, before decision 178."""
PAUSE_S: Final = 0.3
_ASKED: Final = "gnd/v1/tiles/ndt/13033/03021/21000"
_REPORTED: Final = "gnd/v1/change/ndt/13033/03021/21000"
_WORD: Final = "gnd/v1/want/vehicle-00"


@dataclass(frozen=True, slots=True)
class Wired:
    """A vehicle and the two parts of the cloud that it talks with, on one router."""

    vehicle: Bus
    shard: Bus

    def say(self, one: KilometreMessage) -> None:
        """One message, with what comes back; its packets have passed when this returns. It says how much that is.

        No keep-alives are among it: they are sent after 30 s of silence.
        """
        asked = one.down.to_bytes(2, "big") + one.named.to_bytes(2, "big") + bytes(max(one.up - 4, 0))
        if one.what == "question":
            self.vehicle.request(_ASKED, asked, kind="tile", timeout_s=20)
        elif one.what == "report":
            self.vehicle.request(_REPORTED, asked, kind="change", timeout_s=20)
        elif one.what == "word":
            self.shard.publish(_WORD, bytes(one.down), kind="ack")
        elif one.what == "head":
            self.vehicle.request_many(list_keys("ndt"), HEAD_ONLY, kind="catalog", timeout_s=20)
        else:
            self.vehicle.publish("gnd/v1/traffic/vehicle-00", bytes(one.up), kind="telemetry")
        time.sleep(PAUSE_S)

    def bytes_of(self, said: tuple[KilometreMessage, ...]) -> int:
        """IP bytes in both directions."""
        before = self.vehicle.wire()
        for one in said:
            self.say(one)
        after = self.vehicle.wire()
        return after.up + after.down - before.up - before.down


def _as_much_as_asked(request: Request) -> bytes:
    return bytes(
        int.from_bytes(request.payload[:2], "big") - int.from_bytes(request.payload[2:4], "big") * request.binds
    )


@contextmanager
def wired(endpoint: str, identities: Path | None) -> Iterator[Wired]:
    """Parts that serve and listen at a router; `identities`: their folders, None = they have none."""
    names = ("store", "merger-0", "vehicle-00")
    store, shard, vehicle = (
        BusConfig(connect=(endpoint,), link="4g", identity=None if identities is None else identities / name)
        for name in names
    )
    with open_bus(store) as tiles, open_bus(shard) as merger, open_bus(vehicle) as car:
        tiles.serve("gnd/v1/tiles/**", _as_much_as_asked, complete=True)
        tiles.serve("gnd/v1/catalog/**", lambda _: [(list_key("ndt", "main"), bytes(HEAD.down))], complete=True)
        merger.serve("gnd/v1/change/**", _as_much_as_asked, complete=True, kind="change")
        car.subscribe(_WORD, lambda _key, _payload: None, kind="ack")
        yield Wired(car, merger)


@contextmanager
def router(protocol: str, identities: Path) -> Iterator[tuple[int, int]]:
    """A router process: its port and its id."""
    port = claim_port(0)
    command = [sys.executable, "-m", "gnd.deploy.cli", "router", "--listen", f"{protocol}/127.0.0.1:{port}"]
    command += ["--identity", str(identities / "router")] if protocol == "tls" else []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - our own command
        try:
            assert process.stdout is not None
            process.stdout.readline()
            yield port, process.pid
        finally:
            process.terminate()


def kilometres(endpoint: str, identities: Path | None, rounds: int) -> dict[str, float]:
    """IP bytes of the messages of `KILOMETRE`: the first time on a connection, and again."""
    with wired(endpoint, identities) as parts:
        driven = np.array([parts.bytes_of(KILOMETRE) for _ in range(1 + rounds)])
    return {
        "first_kilometre_bytes": float(driven[0]),
        "kilometre_bytes_mean": float(driven[1:].mean()),
        "kilometre_bytes_max": float(driven[1:].max()),
    }
