"""Programs that send too much: what `python -m studies flooder` measures against and the attack tests start."""

import itertools
import os
import random
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from gnd.deploy.chaos.street import ChaosStreet, read_street
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.sealing import Sealing
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import alive_key, batch_key, catalog_keys, state_key, tiles_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportQuestion
from gnd.schemas.tiles_batch import TilesRequest

FLOODER: Final = "flooder"
T0_MS: Final = 1_700_000_000_000
PATIENCE_MS: Final = 2_000
AGAIN_S: Final = 6.0
"""A busy cloud says 5 s (`WAITING_RETRY_S`)."""
Message = tuple[str, bytes]


def reports(street: ChaosStreet, *, name_each: bool, salt: str, name: str = FLOODER) -> Iterator[Message]:
    """Real reports without end, each under an id of its own; of one vehicle, or each of another."""
    kept = [street.said(1, name, n) for n in range(4)]
    for n in itertools.count():
        one = kept[n % len(kept)]
        report_id = deterministic_report_id(T0_MS + n, salt, str(n))
        vehicle = f"{salt}-{n}" if name_each else name
        yield one.key, replace(one.packed, report_id=report_id, vehicle=vehicle).encode()


def returning(street: ChaosStreet, salt: str) -> Iterator[Message]:
    """Reports each of which has another name, and comes once more when that name was told to: whoever obeys, with names
    without end.
    """
    sent: deque[tuple[float, Message]] = deque()
    for message in reports(street, name_each=True, salt=salt):
        sent.append((time.monotonic(), message))
        yield message
        if time.monotonic() - sent[0][0] >= AGAIN_S:
            yield sent.popleft()[1]


def nonsense(street: ChaosStreet, size: int) -> Iterator[Message]:
    """Bytes that are no report, each time others."""
    rng = random.Random(7)
    key = street.said(1, FLOODER, 0).key
    while True:
        yield key, rng.randbytes(size)


def questions(kind: str, tile: TileId) -> Iterator[Message]:
    """Questions without end: about tiles of a district, regions, catalogs, or states of reports."""
    batch = batch_key("ndt", tile.district), _all_tiles()
    region, catalogs = (tiles_key("ndt"), b""), (catalog_keys("ndt"), b"")
    ids = [deterministic_report_id(T0_MS + n, "question") for n in range(64)]
    state = state_key(FLOODER), ReportQuestion(tuple(ids)).encode()
    yield from itertools.repeat({"tiles": batch, "regions": region, "catalogs": catalogs, "states": state}[kind])


def _all_tiles() -> bytes:
    return TilesRequest(wanted=tuple((index, 0) for index in range(1024))).encode()


def messages(kind: str, tile: TileId, name: str = FLOODER) -> Iterator[Message]:
    """Those of a kind; `name`: of the vehicle, where each is not of another."""
    if kind in ("tiles", "regions", "catalogs", "states"):
        return questions(kind, tile)
    street, salt = read_street(), f"{os.getpid()}"
    if kind == "nonsense":
        return nonsense(street, 4096)
    if kind == "huge":
        return nonsense(street, 8_000_000)
    if kind == "oversize":
        return ((key, bytes(12_000_000)) for key, _ in nonsense(street, 1))
    if kind == "returning":
        return returning(street, salt)
    return reports(street, name_each=kind == "names", salt=salt, name=name)


def flood(kind: str, connect: str, hz: float, tile: int, gate: str = "", *, stop: threading.Event) -> None:
    """Send without waiting for answers and without obeying any, so many a second, while the file `gate` is there ("":
    always).
    """
    with open_bus(BusConfig(connect=(connect,)), name=FLOODER) as bus:
        session, sealing = bus.connection.session, bus.connection.sealing
        name = FLOODER if sealing is None else sealing.own.name
        source, due_s = messages(kind, TileId(tile), name), time.monotonic()
        while not stop.is_set():
            if gate and not Path(gate).exists():
                time.sleep(0.05)
                due_s = time.monotonic()
                continue
            key, payload = next(source)
            session.get(
                key,
                lambda _reply: None,
                payload=payload,
                attachment=None if sealing is None else _seal(sealing, key, payload),
                timeout=PATIENCE_MS / 1000,
            )
            due_s = max(due_s + 1.0 / hz, time.monotonic() - 1.0)
            time.sleep(max(0.0, due_s - time.monotonic()))


def _seal(sealing: Sealing, key: str, payload: bytes) -> bytes:
    """With the certificate each time: who does not hear answers does not know whether it is wanted."""
    return sealing.question(key, payload, count_wanted=False, with_chain=True).attachment


def ghosts(connect: str, names: tuple[str, ...], *, stop: threading.Event) -> None:
    """Hold tokens of shards that do not exist."""
    with open_bus(BusConfig(connect=(connect,)), name="ghosts") as bus:
        for name in names:
            bus.declare_alive(alive_key("merger", name))
        stop.wait()
