"""What one drive uploads: its reports through the vehicle's sender to the cloud in this process, byte by byte."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Final, Self, cast

import numpy as np

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.merge import MergeParameters
from gnd.cloud_merger.states import answer
from gnd.cloud_merger.work import Worker
from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES
from gnd.fleet_sim.sensors import MODELS, SHORT_NAMES
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import decode_mask
from gnd.gnd_map.tile import Tile
from gnd.schemas.bitmap import encode_observed
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.drive import GnssFix, MotionSample
from gnd.schemas.drive_messages import fix_of, motion_message_of
from gnd.schemas.keys import change_key, change_keys, want_key
from gnd.schemas.packed import PackedGaussians, PackedReport, decode_upload
from gnd.schemas.report_states import ReportState, ReportStates
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import DEFAULT_CODEC, DEFAULT_LAYER, StoreConfig
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.link.sending import SenderThread
from gnd.vehicle_agent.report.packing import askable, is_measured
from studies.frame.errors import ReproduceError
from studies.simulation.base_map import BaseMap
from studies.simulation.result import VehicleResult

_OWNER: Final = "traffic-study"
_LEASE_S: Final = 3600.0
_AT_ONCE: Final = 64
_BETWEEN_NS: Final = 3600 * 1_000_000_000
"""The vehicles that are on the street at a time come an hour after those before them."""


@dataclass(frozen=True, slots=True)
class Message:
    """One request of a vehicle and its answer; or a notice, which has no request."""

    key: str
    request: bytes
    reply: bytes

    @property
    def is_notice(self) -> bool:
        """Whether the cloud began to speak."""
        return not self.request


class UploadCloud:
    """One merger and its store.

    Args:
        path: of the store; an older one there is removed.
        base: the map that it begins with.
        merge: how statements become changes.
        codec: the lattice of tiles that it makes anew, "float" for none; others stay on that of the base.
    """

    def __init__(self, path: Path, base: BaseMap, merge: MergeParameters, codec: str = DEFAULT_CODEC) -> None:
        for old in path.parent.glob(f"{path.name}*"):
            old.unlink()
        store = StoreConfig(merge_delay_s=0.0)
        config = ShardConfig(_OWNER, path, merge=merge, codec=codec, store=store)
        self._later_ns = 0
        self.store = SqliteStore(path, config.store, now_ns=self._now_ns)
        self.store.put_tiles(Tile(tile, 1, gaussians) for tile, gaussians in base.tiles.items())
        self._ingest = Ingest(self.store, _OWNER, now_ns=self._now_ns)
        self._expander = Expander(self.store, config, self._tell)
        self._worker = Worker(self.store, config)
        self._messages: list[Message] = []
        self._hearers: dict[str, Callable[[str, bytes], None]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.store.close()

    def request(self, key: str, payload: bytes, **_how: object) -> bytes:
        """Answer a vehicle as a merger does; in place of `fleet_bus.Bus.request`."""
        is_report = key.startswith(change_keys().removesuffix("**"))
        reply = self._ingest.answer(key, payload).encode() if is_report else answer(self.store, key, payload)
        self._messages.append(Message(key, payload, reply))
        while self._expander.work():
            pass
        return reply

    def subscribe(self, key: str, callback: Callable[[str, bytes], None], **_how: object) -> None:
        """Tell a vehicle what is wanted of it; in place of `fleet_bus.Bus.subscribe`."""
        self._hearers[key] = callback

    def _tell(self, vehicle: str, state: ReportState) -> None:
        key, notice = want_key(vehicle), ReportStates((state,)).encode()
        self._messages.append(Message(key, b"", notice))
        self._hearers[key](key, notice)

    def heard(self) -> list[Message]:
        """Return the messages since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def _now_ns(self) -> int:
        return time.time_ns() + self._later_ns

    def merge(self) -> int:
        """Merge everything that has been reported; return how many tiles got a new version.

        Raises:
            ReproduceError: a tile could not be merged, or a report was refused.
        """
        published = 0
        while claims := self.store.claim(_OWNER, _AT_ONCE, _LEASE_S):
            publications = self._worker.merge(claims)
            if len(publications) != len(claims):
                raise ReproduceError(f"{len(claims) - len(publications)} of {len(claims)} tiles could not be merged")
            published += sum(result.status == "published" for result in self.store.publish(publications))
        self._later_ns += _BETWEEN_NS
        bad = self.store.quarantined()
        if bad:
            raise ReproduceError(f"{len(bad)} reports were refused, the first: {bad[0].reason}")
        return published

    def map(self) -> BaseMap:
        """Return the newest version of every tile."""
        tiles = {tile.tile_id: tile for tile in self._heads()}
        return BaseMap({i: t.gaussians for i, t in tiles.items()}, {i: t.version for i, t in tiles.items()})

    def _heads(self) -> Iterator[Tile]:
        for entry in self.store.heads(DEFAULT_LAYER):
            stored = self.store.get(DEFAULT_LAYER, entry.tile)
            if stored is not None:
                yield stored.decode_gaussians()


PACKET_BYTES: Final = 1206
PACKET_SHOTS: Final = 384
"""A data packet of a Velodyne VLP-16: 12 blocks of a flag, an azimuth and 32 ranges with reflectivities, a time stamp
and two factory bytes (VLP-16 user manual, 63-9243). Every shot is in it, with an echo or without."""
PARTS: Final = ("keys", "flags", "track", "head", "gaussians", "whole", "acks")
"""Where the bytes of an upload go: `head` is everything of a report in short beside flags and track; `whole` are
reports that had to be sent in one piece."""
_MOTION_HZ, _GNSS_HZ = 50, 10
_WAIT_S = 120.0


@dataclass(frozen=True, slots=True)
class DriveUpload:
    """What one drive came to.

    Attributes:
        vehicle: its name.
        km: way driven.
        messages: how many questions went up.
        parts: bytes by `PARTS`: payloads and keys up; `acks`, answers and notices, down.
        changed: voxels that it reports as new, modified or deleted; by class in `classes`.
        wanted: Gaussians that the cloud asked for.
        observed: voxels observed.
        tiles: tiles reported about.
        float_bytes: the same reports in floats and whole: protobuf, float32 columns, bitmap of what was observed.
        bitmap_bytes: the part of it that the bitmaps are.
        raw_bytes: all measurements of the drive.
        pcd_bytes: uploads of the point-cloud baseline by its codec; empty where it did not run.
    """

    vehicle: str
    km: float
    messages: int
    parts: Mapping[str, int]
    changed: int
    classes: Mapping[str, int]
    wanted: int
    observed: int
    tiles: int
    float_bytes: int
    bitmap_bytes: int
    raw_bytes: int
    pcd_bytes: Mapping[str, int]

    @property
    def bytes(self) -> int:
        """All payloads up and their keys; the answers, which come down, are told apart."""
        return sum(self.parts.values()) - self.parts["acks"]

    @property
    def wire_bytes(self) -> int:
        """The same with what the transport adds to a message (key, headers, acknowledgement)."""
        return self.bytes - self.parts["keys"] + self.messages * MESSAGE_OVERHEAD_BYTES


def upload(result: VehicleResult, held: BaseMap, cloud: UploadCloud) -> DriveUpload:
    """Send everything that a drive has to say.

    Args:
        result: of the drive.
        held: the map that the vehicle drove with.
        cloud: which answers.

    Raises:
        ReproduceError: a report was not acknowledged.
    """
    reports = [ChangeReport.decode(body) for body in result.reports]
    with TemporaryDirectory() as folder:
        _send(result, reports, held, cloud, Path(folder) / "outbox.sqlite")
    messages = cloud.heard()
    changes = [change for report in reports for change in report.tiles]
    return DriveUpload(
        vehicle=result.vehicle,
        km=result.stats["way_m"] / 1e3,
        messages=sum(not message.is_notice for message in messages),
        parts=_parts(messages),
        changed=sum(len(change.changed) for change in changes),
        classes=_classes(changes),
        wanted=sum(_wanted(message, reports) for message in messages),
        observed=sum(len(change.observed) for change in changes),
        tiles=len(changes),
        float_bytes=sum(len(change_key(r.layer, r.district)) for r in reports) + sum(map(len, result.reports)),
        bitmap_bytes=sum(len(encode_observed(change.observed)[1]) for change in changes),
        raw_bytes=raw_bytes(result.sensor, result.stats["scans"]),
        pcd_bytes=dict(result.stats["pcd_bytes"]),
    )


def _send(result: VehicleResult, reports: list[ChangeReport], held: BaseMap, cloud: UploadCloud, path: Path) -> None:
    """The vehicle's outbox and its sender; the bus is a call."""
    outbox = Outbox(path)
    try:
        for report, body, packed in zip(reports, result.reports, result.packed, strict=True):
            bases = [_base(change, held) for change in report.tiles if change.base_sha and is_measured(change).any()]
            outbox.put(report.report_id, change_key(report.layer, report.district), body, packed, bases)
        sender = SenderThread(cast("Bus", cloud), outbox, result.vehicle)
        try:
            done = sender.drain(_WAIT_S, threading.Event())
        finally:
            sender.close()
        counts = outbox.counts()
        if not done or counts.acknowledged != len(reports):
            raise ReproduceError(
                f"{result.vehicle}: {counts.acknowledged} of {len(reports)} reports acknowledged: {sender.last_error}"
            )
    finally:
        outbox.close()


def _base(change: TileChange, held: BaseMap) -> Tile:
    return Tile(change.tile, change.base_version, held.tiles[change.tile])


def _parts(messages: list[Message]) -> dict[str, int]:
    parts: Counter[str] = Counter(dict.fromkeys(PARTS, 0))
    for message in messages:
        parts["acks"] += len(message.reply)
        if message.is_notice:
            parts["acks"] += len(message.key)
            continue
        parts["keys"] += len(message.key)
        said = decode_upload(message.request)
        if isinstance(said, PackedReport):
            parts["flags"] += len(said.flags)
            parts["track"] += len(said.track)
            parts["gaussians"] += len(said.measured)
            parts["head"] += len(message.request) - len(said.flags) - len(said.track) - len(said.measured)
        else:
            parts["gaussians" if isinstance(said, PackedGaussians) else "whole"] += len(message.request)
    return dict(parts)


def _wanted(message: Message, reports: list[ChangeReport]) -> int:
    """How many Gaussians a notice asks for."""
    if not message.is_notice:
        return 0
    by_id = {report.report_id: report for report in reports}
    told = [state for state in ReportStates.decode(message.reply).states if state.wanted]
    return sum(int(decode_mask(state.wanted, askable(by_id[state.report_id])).sum()) for state in told)


def _classes(changes: list[TileChange]) -> dict[str, int]:
    counts = np.bincount(np.concatenate([c.change_class for c in changes]), minlength=len(ChangeClass))
    return {c.name.lower(): int(counts[c]) for c in (ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)}


def raw_bytes(sensor: str, scans: int) -> int:
    """All measurements of a drive: LiDAR packets, speed and yaw rate, GNSS, as the conventional way uploads them."""
    model = MODELS[SHORT_NAMES[sensor]]
    packets = ceil(scans * model.columns * model.beams / PACKET_SHOTS)
    seconds = scans / model.rate_hz
    motion = motion_message_of(MotionSample(1, 9.0, 0.01)).ByteSize()
    fix = fix_of(GnssFix(1, 0.655, 2.217, 30.0, 2.5)).ByteSize()
    return packets * PACKET_BYTES + ceil(seconds * _MOTION_HZ) * motion + ceil(seconds * _GNSS_HZ) * fix
