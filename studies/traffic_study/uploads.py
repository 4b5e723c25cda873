"""What one drive uploads: its reports through the vehicle's own sender to the cloud, every byte booked."""

import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, cast

import numpy as np

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
from gnd.schemas.keys import change_key
from gnd.schemas.packed import PackedGaussians, PackedReport, decode_upload
from gnd.schemas.report_states import ReportStates
from gnd.vehicle_agent.outbox import Outbox
from gnd.vehicle_agent.packing import askable, is_measured
from gnd.vehicle_agent.sending import SenderThread
from studies.simulation.base_map import BaseMap
from studies.simulation.result import VehicleResult
from studies.traffic_study.cloud import Cloud, Message
from studies.traffic_study.errors import TrafficError
from studies.traffic_study.reference import PACKET_BYTES, PACKET_SHOTS

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


def upload(result: VehicleResult, held: BaseMap, cloud: Cloud) -> DriveUpload:
    """Send everything that a drive has to say.

    Args:
        result: of the drive.
        held: the map that the vehicle drove with.
        cloud: which answers.

    Raises:
        TrafficError: a report was not acknowledged.
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


def _send(result: VehicleResult, reports: list[ChangeReport], held: BaseMap, cloud: Cloud, path: Path) -> None:
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
            raise TrafficError(
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
            parts["head"] += len(message.request) - len(said.flags) - len(said.track)
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
