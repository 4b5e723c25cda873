"""Captures of packets (pcap): a Velodyne's, decoded by `velodyne-decoder` with the times of the packets, an Ouster's by
`ouster.capture`. Which it is is known by the lengths of the packets.

VLP-16, Puck Hi-Res, VLP-32C, HDL-32E and HDL-64E S2/S3 are known by their packets. The first and last turn are cut off
by the capture and are left out. Positions in a capture (GPRMC) have no height, so a place must be given. Packets of
other sensors are refused with what to do.
"""

import weakref
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.files import files_below
from gnd.vehicle_agent.importers.optional import library
from gnd.vehicle_agent.importers.ouster.capture import UdpStreams, metadata_named, open_ouster
from gnd.vehicle_agent.importers.ouster.packets import kinds_of_size
from gnd.vehicle_agent.importers.recording import NOMINAL, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.udp_packets import BoundedFile

EXTRA: Final = "import"
MAGICS: Final = (b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\x0a\x0d\x0d\x0a")
VELODYNE_BYTES: Final = 1206
POSITION_BYTES: Final = 512
FULL: Final = 0.8
"""A turn with less than this share of the usual points was cut off by the capture."""
_POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("offset", "<u4"), ("ring", "<u2")])
_ADVICE: Final = "replay it through the sensor's ROS 2 driver, then import the bag of its points"


def is_pcap(head: bytes) -> bool:
    """Whether a file that begins so is a capture."""
    return head.startswith(MAGICS)


def open_pcap(path: Path, anchor: RecordingAnchor | None, choices: Choices | None = None) -> Recording:
    """A capture; `anchor` says where on the Earth the first pose lies.

    A folder is the capture that lies in it.

    Raises:
        ImportDriveError: no packets of a sensor that is read, no metadata of an Ouster, or a damaged file.
        MissingExtra: velodyne-decoder is not installed.
    """
    path = _file(path)
    streams = UdpStreams.of(path)
    sizes = streams.by_size
    if not sizes:
        reason = streams.capture.damaged or f"no whole UDP packet, {streams.capture.incomplete} in part"
        raise ImportDriveError(f"{path}: no readable capture: {reason}")
    is_velodyne = VELODYNE_BYTES in sizes and (choices is None or metadata_named(choices) is None)
    if not is_velodyne:
        ouster = open_ouster(path, streams, anchor, choices)
        if ouster is not None:
            return ouster
        held = ", ".join(f"{n} of {size} bytes" for size, n in sizes.most_common(4))
        raise ImportDriveError(
            f"{path}: no packets of a Velodyne ({VELODYNE_BYTES} bytes) or an Ouster but {held}. {_ADVICE}"
        )
    return _open_velodyne(path, sizes, anchor, strict=choices is not None and choices.strict)


def _open_velodyne(path: Path, sizes: Mapping[int, int], anchor: RecordingAnchor | None, *, strict: bool) -> Recording:
    """The turns of a Velodyne; `sizes`: packets of each length."""
    store = _Turns(path, strict=strict)
    t_ns = np.array([begin for begin, _, _ in store.index], np.int64)
    cut_off = (f"{store.left_out} turns cut off by the capture: left out",) if store.left_out else ()
    others = tuple(
        Entry(f"{size} bytes", "UDP packets", n, "", "", _why_not(size))
        for size, n in sizes.items() if size != VELODYNE_BYTES
    )  # fmt: skip
    return Recording(
        name=path.stem,
        sensor_model=store.model,
        source=f"packets of {path.name}, decoded by velodyne-decoder",
        T_vehicle_lidar=np.eye(4),
        t_ns=t_ns,
        read=store.read,
        anchor=anchor or NOMINAL,
        mount="assumed",
        placed=anchor is not None,
        notes=(*store.notes, *cut_off),
        entries=(
            Entry(f"{VELODYNE_BYTES} bytes", "data packets", sizes[VELODYNE_BYTES], store.model, "scans"),
            *others,
        ),
    )


def _why_not(size: int) -> str:
    if size == POSITION_BYTES:
        return "positions without a height"
    return "an Ouster's: --sensor FILE.json with its metadata reads it instead" if kinds_of_size(size) else ""


def _file(path: Path) -> Path:
    """The capture itself.

    Raises:
        ImportDriveError: a folder with several.
    """
    if path.is_file():
        return path
    found = files_below(path, ".pcap", ".pcapng")
    if len(found) != 1:
        names = ", ".join(one.name for one in found[:4])
        raise ImportDriveError(f"{path}: {len(found)} captures ({names}): name one of them")
    return found[0]


class _Turns:
    """Turns of the sensor, decoded once into a file of their own: a capture can only be read from its beginning.

    A damaged capture gives the turns before the damage, with a note; none where `strict`.
    """

    def __init__(self, path: Path, *, strict: bool) -> None:
        self.index: list[tuple[int, int, int]] = []
        self.model, self.left_out, self.notes = "unknown", 0, tuple[str, ...]()
        self._file: IO[bytes] = TemporaryFile()  # noqa: SIM115  (closed when the recording is no longer used)
        weakref.finalize(self, self._file.close)
        self._decode(path, strict)
        usual = float(np.median([n for _, _, n in self.index])) if self.index else 0.0
        whole = [one for one in self.index if one[2] >= FULL * usual]
        self.left_out, self.index = len(self.index) - len(whole), whole

    def _decode(self, path: Path, strict: bool) -> None:
        decoder = library("velodyne_decoder", EXTRA)
        config = decoder.Config()
        try:
            with path.open("rb") as stream:
                for stamp, points in decoder.read_pcap(BoundedFile(stream), config, as_pcl_structs=True):
                    self._add(stamp.device if stamp.device > 1e8 else stamp.host, points)
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            if strict or not self.index:
                raise ImportDriveError(f"{path}: {reason}") from error
            self.notes = (f"damaged after {len(self.index)} turns, the rest is left out: {reason}",)
        self.model = str(config.model).rpartition(".")[2] if config.model is not None else "Velodyne"

    def _add(self, stamp_s: float, points: NDArray[Any]) -> None:
        if not len(points):
            return
        time_s = points["time"].astype(np.float64)
        out = np.zeros(len(points), _POINT)
        for name in ("x", "y", "z", "ring"):
            out[name] = points[name]
        out["offset"] = np.round((time_s - time_s.min()) * 1e9)
        begin_ns = round(stamp_s * 1e9) + round(float(time_s.min()) * 1e9)
        self.index.append((begin_ns, self._file.tell(), len(points)))
        self._file.write(out.tobytes())

    def read(self, number: int) -> RawScan:
        """Turn `number` of those that are whole."""
        begin_ns, at, n = self.index[number]
        self._file.seek(at)
        rows = np.frombuffer(self._file.read(n * _POINT.itemsize), _POINT)
        xyz = np.stack([rows["x"], rows["y"], rows["z"]], axis=1)
        return RawScan(begin_ns, np.ascontiguousarray(xyz), rows["offset"].copy(), rows["ring"].copy())
