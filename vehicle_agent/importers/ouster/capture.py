"""A capture of an Ouster's packets as a recording; its metadata are the JSON beside it, or named with --sensor."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.ouster.frames import OusterFrames
from gnd.vehicle_agent.importers.ouster.metadata import OusterMetadata, is_metadata, read_metadata
from gnd.vehicle_agent.importers.ouster.packets import is_lidar, kinds_of_size, serial_of
from gnd.vehicle_agent.importers.recording import NOMINAL, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.udp_packets import UdpCapture

IMU_BYTES: Final = 48
DAMAGED: Final = "the capture is damaged after {n} packets, the rest is left out: {why}"


@dataclass(frozen=True, slots=True, order=True)
class UdpStream:
    """Where packets come from, and the port that they go to."""

    source: str
    port: int

    def __str__(self) -> str:
        return f"{self.source} to port {self.port}"


@dataclass(slots=True)
class UdpStreams:
    """What a capture holds: packets of each length in each stream, and the serial numbers that they may say.

    firsts: the first packet of each stream and length.
    """

    capture: UdpCapture
    sizes: dict[UdpStream, Counter[int]] = field(default_factory=dict)
    firsts: dict[tuple[UdpStream, int], bytes] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path) -> "UdpStreams":
        """Read a capture once; what can be read before a damage counts."""
        found = cls(UdpCapture(path))
        for one in found.capture.packets():
            stream, size = UdpStream(one.source, one.port), len(one.payload)
            found.sizes.setdefault(stream, Counter())[size] += 1
            found.firsts.setdefault((stream, size), one.payload)
        return found

    @property
    def by_size(self) -> Counter[int]:
        """Packets of each length."""
        found = Counter[int]()
        for sizes in self.sizes.values():  # a sum would copy what it has for each of them
            found.update(sizes)
        return found

    def of_ouster(self, known: Sequence[OusterMetadata] = ()) -> list[tuple[UdpStream, int]]:
        """UdpStreams, with the length, that look like an Ouster's lidar packets: of a usual setting or of these."""
        found = []
        for (stream, size), payload in self.firsts.items():
            kinds = [profile for profile, _ in kinds_of_size(size)]
            kinds += [one.profile for one in known if one.packet_bytes == size]
            if any(is_lidar(profile, payload) for profile in kinds):
                found.append((stream, size))
        return found


def open_ouster(
    path: Path, streams: UdpStreams, anchor: RecordingAnchor | None, choices: Choices | None = None
) -> Recording | None:
    """The frames of one sensor; `anchor` says where on the Earth the first pose lies. None: no packets of an Ouster.

    Raises:
        ImportDriveError: no metadata, metadata that do not fit the packets, several sensors and none chosen, or a
            damaged capture with `strict`.
    """
    choices = choices or Choices()
    candidates = _candidates(path, choices)
    if not streams.of_ouster(candidates):
        if metadata_named(choices) is not None:
            raise ImportDriveError(f"{path}: {_why_none(streams, candidates)}")
        return None
    stream, metadata = _chosen(path, streams, candidates, choices.topic)
    frames, wrong = _frames(path, stream, metadata)
    if streams.capture.damaged and (choices.strict or len(frames.t_ns) < 2):
        raise ImportDriveError(f"{path}: damaged capture: {streams.capture.damaged}")
    notes = _notes(streams, frames, wrong)
    if (n := len(frames.t_ns)) < 2:
        raise ImportDriveError(
            f"{path}: {n} whole frame{'' if n == 1 else 's'} of {metadata.product}; a drive needs at least 2."
            f" {'; '.join(notes)}".rstrip(". ")
        )
    return Recording(
        name=path.stem,
        sensor_model=metadata.product,
        source=f"packets of {path.name} ({metadata.profile.name}), metadata of {metadata.path.name}",
        T_vehicle_lidar=np.eye(4),
        t_ns=frames.t_ns,
        read=frames.read,
        anchor=anchor or NOMINAL,
        mount="assumed",
        placed=anchor is not None,
        timed=frames.timed,
        notes=notes,
        entries=_entries(streams, stream, metadata),
    )


def _frames(path: Path, stream: UdpStream, metadata: OusterMetadata) -> tuple[OusterFrames, int]:
    """Frames of a stream, and how many of its packets of the right length are none of points."""
    frames, wrong = OusterFrames(metadata), 0
    for one in UdpCapture(path).packets():
        if (one.source, one.port) != (stream.source, stream.port) or len(one.payload) != metadata.packet_bytes:
            continue
        if is_lidar(metadata.profile, one.payload):
            frames.add(one.host_ns, one.payload)
        else:
            wrong += 1
    frames.finish()
    return frames, wrong


def _notes(streams: UdpStreams, frames: OusterFrames, wrong: int) -> tuple[str, ...]:
    notes = list(frames.notes)
    if frames.left_out:
        notes.append(f"{frames.left_out} frames cut off by the capture: left out")
    if wrong:
        notes.append(f"{wrong} packets of a lidar packet's length that are of another type: left out")
    if streams.capture.incomplete:
        notes.append(f"{streams.capture.incomplete} packets cut off or captured in part: left out")
    if streams.capture.damaged:
        notes.append(DAMAGED.format(n=sum(streams.by_size.values()), why=streams.capture.damaged))
    return tuple(notes)


def _entries(streams: UdpStreams, chosen: UdpStream, metadata: OusterMetadata) -> tuple[Entry, ...]:
    """Every stream and length, what it is and what it is used for."""
    clock = metadata.timestamp_mode or "timestamp mode not said"
    detail = f"{metadata.product}, {metadata.profile.name}, {metadata.n_beams} beams, {clock}"
    entries = []
    for stream, sizes in sorted(streams.sizes.items()):
        for size, n in sorted(sizes.items()):
            if stream == chosen and size == metadata.packet_bytes:
                entries.append(Entry(str(stream), "lidar packets", n, detail, "scans"))
            elif size == IMU_BYTES and stream.source == chosen.source:
                why = "turn rates and accelerations; motion needs a speed as well"
                entries.append(Entry(str(stream), "IMU packets", n, "", "", why))
            elif stream == chosen:
                why = f"not of {metadata.packet_bytes} bytes, as the metadata say"
                entries.append(Entry(str(stream), f"packets of {size} bytes", n, "", "", why))
            else:
                why = f"another sensor: --topic {stream.source}:{stream.port}" if kinds_of_size(size) else "not known"
                entries.append(Entry(str(stream), f"packets of {size} bytes", n, "", "", why))
    entries.append(Entry(metadata.path.name, "metadata", 1, f"serial number {metadata.serial}", "sensor"))
    if metadata.extrinsic:
        entries.append(Entry("extrinsic", "pose of the sensor", 1, "", "", "of the metadata; --mount gives a mount"))
    return tuple(entries)


def metadata_named(choices: Choices) -> Path | None:
    """The JSON that --sensor names, where it is one."""
    given = Path(choices.sensor) if choices.sensor else None
    return given if given is not None and given.suffix.lower() == ".json" else None


def _candidates(path: Path, choices: Choices) -> list[OusterMetadata]:
    """Metadata that may be the capture's: the one that is named; of its name; all beside it."""
    named = metadata_named(choices)
    if named is not None:
        return [read_metadata(named)]
    own = [path.with_suffix(".json"), path.with_name(path.name + ".json")]
    if found := [one for one in own if is_metadata(one)]:
        return [read_metadata(found[0])]
    beside = [one for one in sorted(path.parent.glob("*.json")) if is_metadata(one)]
    of_name = [one for one in beside if one.stem.startswith(path.stem)]
    return [read_metadata(one) for one in of_name or beside]


def _chosen(
    path: Path, streams: UdpStreams, candidates: Sequence[OusterMetadata], wanted: str | None
) -> tuple[UdpStream, OusterMetadata]:
    """The stream that is imported, and its metadata.

    Raises:
        ImportDriveError: none, or several of which nobody chose one.
    """
    every = streams.of_ouster(candidates)
    held = [at for at in every if _is_wanted(at[0], streams.firsts[at], candidates, wanted)]
    if not held:
        have = ", ".join(f"{stream.source}:{stream.port}" for stream, _ in every)
        raise ImportDriveError(f"{path}: --topic {wanted}: no such sensor; it holds {have}")
    if not candidates:
        raise ImportDriveError(
            f"{path}: {_sizes_text(streams)} of an Ouster, but no metadata of its sensor: put the JSON that its driver"
            f" or ouster-cli wrote beside it as {path.stem}.json, or name it with --sensor FILE.json; from the sensor:"
            " http://SENSOR/api/v1/sensor/metadata"
        )
    fitting = [(stream, one) for stream, size in held for one in _fitting(streams, stream, size, candidates)]
    if not fitting:
        raise ImportDriveError(f"{path}: {_why_none(streams, candidates)}")
    if len(fitting) > 1:
        which = "; ".join(
            f"--topic {stream.source}:{stream.port} is {one.product} {one.serial or ''} by {one.path.name}"
            for stream, one in fitting
        )
        raise ImportDriveError(f"{path}: several sensors or metadata fit; choose one: {which}")
    return fitting[0]


def _is_wanted(stream: UdpStream, first: bytes, candidates: Sequence[OusterMetadata], wanted: str | None) -> bool:
    names = {stream.source, str(stream.port), f"{stream.source}:{stream.port}"}
    profiles = [profile for profile, _ in kinds_of_size(len(first))] + [one.profile for one in candidates]
    return wanted is None or wanted in names | {str(serial_of(profile, first)) for profile in profiles}


def _fitting(
    streams: UdpStreams, stream: UdpStream, size: int, candidates: Sequence[OusterMetadata]
) -> list[OusterMetadata]:
    """Metadata of this length of packets: of this serial number where packets say one, else rather of this port."""
    first = streams.firsts[stream, size]
    fitting = [one for one in candidates if one.packet_bytes == size and is_lidar(one.profile, first)]
    told = [one for one in fitting if serial_of(one.profile, first) and one.serial]
    if told:
        return [one for one in told if serial_of(one.profile, first) == one.serial]
    return [one for one in fitting if one.port_lidar == stream.port] or fitting


def _sizes_text(streams: UdpStreams) -> str:
    return ", ".join(f"{n} packets of {size} bytes" for size, n in streams.by_size.most_common(4))


def _why_none(streams: UdpStreams, candidates: Sequence[OusterMetadata]) -> str:
    """What the packets are, and what the metadata say."""
    said = "; ".join(
        f"{one.path.name} is of {one.product} {one.serial or ''}: {one.profile.name}, {one.n_beams} beams, packets of"
        f" {one.packet_bytes} bytes"
        for one in candidates
    )
    looks = []
    for stream, size in streams.of_ouster(candidates):
        kinds = kinds_of_size(size)
        serials = {serial_of(profile, streams.firsts[stream, size]) for profile, _ in kinds} - {0}
        names = " or ".join(f"{profile.name} with {beams} beams" for profile, beams in kinds)
        number = f", serial number {max(serials)}" if serials else ""
        looks.append(f"{stream}: {size} bytes ({names}{number})")
    held = "; ".join(looks) or _sizes_text(streams)
    return f"the metadata are of another sensor or setting: {said}; the capture holds {held}"
