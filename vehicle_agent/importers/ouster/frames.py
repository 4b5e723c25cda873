"""Lidar packets of one sensor into frames: a turn each, in the order of time, with what is missing counted.

Frames are known by the frame number in their packets, never by the columns: packets may come late, twice or not at
all. The number begins again at 0 after 16 or 32 bits, and anywhere when the sensor is started anew.
"""

import weakref
from dataclasses import dataclass, replace
from tempfile import TemporaryFile
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.ouster.metadata import OusterMetadata
from gnd.vehicle_agent.importers.ouster.packets import VALID, packet_dtype, ranges_mm
from gnd.vehicle_agent.importers.ouster.points import PointTable

I64 = NDArray[np.int64]

FULL: Final = 0.8
"""The first and the last frame with less than this share of their columns were cut off by the capture."""
LATE: Final = 8
"""Packets of a frame so many numbers back came late; of one further back, from a sensor that was started anew."""
MOST_LOST: Final = 10_000
"""A longer step forward of the frame number is a new start as well."""
CLOCK_SET_NS: Final = 100_000_000 * 1_000_000_000
"""A clock before 1973 counts from when the sensor was switched on."""
TAI_AHEAD_S: Final = 37.0
"""International atomic time against UTC since 2017: a PTP clock that tells no UTC."""
NEAR_TAI_S: Final = 0.5
ODD_CLOCK_S: Final = 1.0
MAX_T_NS: Final = 1 << 62
"""Later times (2116) are none: differences of two would not fit into 64 bits."""
MAX_FRAME_NS: Final = 2_000_000_000
"""A turn takes 0.05 to 0.2 s; over a longer one the clock was set."""


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """Every valid column of a capture: packet and place in it, frame (counted on), measurement number, time."""

    packet: I64
    place: I64
    frame: I64
    measurement_id: I64
    t_ns: I64


class OusterFrames:
    """Frames of one sensor, from packets that were added in the order of the capture; `finish` before reading.

    Packets lie in a file of their own meanwhile: a capture can only be read from its beginning.

    t_ns: (N,) begin of each frame, UTC. timed: whether that is known. left_out: frames at the ends that the capture
    cut off. notes: what was missing, odd or put right.
    """

    def __init__(self, metadata: OusterMetadata) -> None:
        self.metadata = metadata
        self.t_ns = np.zeros(0, np.int64)
        self.timed = True
        self.left_out = 0
        self.notes: list[str] = []
        self._layout = packet_dtype(metadata.profile, metadata.n_beams, metadata.columns_per_packet)
        self._host_ns: list[int] = []
        self._table = PointTable.of(metadata)
        self._frames: list[I64] = []
        self._file: IO[bytes] = TemporaryFile()  # noqa: SIM115  (closed when the frames are no longer used)
        weakref.finalize(self, self._file.close)

    def add(self, host_ns: int, payload: bytes) -> None:
        """One lidar packet of the sensor's length."""
        self._host_ns.append(host_ns)
        self._file.write(payload)

    def finish(self) -> None:
        """Sort what was added into frames."""
        if not self._host_ns:
            return
        self._file.flush()
        self._packets = np.memmap(self._file, self._layout, mode="r")
        self._columns = self._in_utc(self._valid(self._frame_numbers()))
        frames = self._whole(self._split())
        self._count_missing(frames)
        self._frames = self._in_order(frames)
        self.t_ns = np.array([self._columns.t_ns[rows[0]] for rows in self._frames], np.int64)

    def read(self, number: int) -> RawScan:
        """Frame `number`: points in the sensor's axes, by time, the second returns after the first ones."""
        rows = self._frames[number]
        columns, begin_ns = self._columns, int(self.t_ns[number])
        pixels = self._packets["columns"]["pixels"][columns.packet[rows], columns.place[rows]]
        offset_ns = (columns.t_ns[rows] - begin_ns).astype(np.uint32)
        points, offsets, rings = [], [], []
        for range_mm in ranges_mm(self.metadata.profile, pixels):
            column, beam = np.nonzero(range_mm)
            xyz = self._table.points_m(columns.measurement_id[rows], range_mm)
            points.append(xyz[column, beam].astype(np.float32))
            offsets.append(offset_ns[column])
            rings.append(beam.astype(np.uint16))
        return RawScan(begin_ns, np.concatenate(points), np.concatenate(offsets), np.concatenate(rings))

    def _frame_numbers(self) -> I64:
        """(P,) frame of each packet, counted on over the end of its bits and over a new start of the sensor."""
        turn = 1 << self.metadata.profile.frame_bits
        raw = self._packets["frame_id"].astype(np.int64)
        step = (np.diff(raw) + turn // 2) % turn - turn // 2
        anew = (step < -LATE) | (step > MOST_LOST)
        step[anew] = LATE + 1  # late packets from before stay apart
        number = np.concatenate([[0], np.cumsum(step)])
        if anew.any():
            self.notes.append(f"the frame number starts anew {int(anew.sum())} times: the sensor was started again")
        lost = int(np.ptp(number)) + 1 - len(np.unique(number)) - LATE * int(anew.sum())
        if lost > 0:
            self.notes.append(f"{lost} frames of which no packet was captured")
        return number

    def _valid(self, frame: I64) -> _Columns:
        """Columns that the sensor measured: status, and a number that the metadata knows; each once."""
        columns = self._packets["columns"]
        number = columns["measurement_id"].astype(np.int64)
        measured, known = (columns["status"] & VALID) != 0, number < self.metadata.columns
        dated = columns["t_ns"] < MAX_T_NS
        if (undated := int((measured & ~dated).sum())) > 0:
            self.notes.append(f"{undated} columns with times after {MAX_T_NS} ns: left out")
        measured &= dated
        if (beyond := int((measured & ~known).sum())) > 0:
            self.notes.append(f"{beyond} columns beyond the {self.metadata.columns} of the metadata: left out")
        if (empty := int((~measured & np.isin(number, self.metadata.measured)).sum())) > 0:
            self.notes.append(f"{empty} columns that the sensor marks as not measured: without points")
        packet, place = np.nonzero(measured & known)
        key = frame[packet] * self.metadata.columns + number[packet, place]
        _, first = np.unique(key, return_index=True)
        if len(first) < len(key):
            self.notes.append(f"{len(key) - len(first)} columns captured twice: taken once")
        packet, place = packet[first], place[first]
        t_ns = columns["t_ns"][packet, place].astype(np.int64)
        return _Columns(packet, place, frame[packet], number[packet, place], t_ns)

    def _in_utc(self, columns: _Columns) -> _Columns:
        """Times as UTC: of the sensor's clock where it was set, else laid on that of the computer that captured."""
        t_ns, host_ns = columns.t_ns, np.array(self._host_ns, np.int64)[columns.packet]
        is_set = t_ns > CLOCK_SET_NS
        shift_ns = np.where(is_set, self._leap_shift(host_ns[is_set] - t_ns[is_set], host_ns[is_set]), 0)
        mode = self.metadata.timestamp_mode or "mode not said"
        if (unset := ~is_set & (host_ns > CLOCK_SET_NS)).any():
            shift_ns[~is_set] = int(np.min(host_ns[unset] - t_ns[unset]))
            self.notes.append(
                f"the sensor's clock was not set ({mode}): its times are laid on the clock of the computer that"
                " captured, by the packet with the least delay"
            )
        elif not is_set.all():
            self.timed = False
            self.notes.append(f"neither the sensor's clock ({mode}) nor the capture's was set")
        return replace(columns, t_ns=t_ns + shift_ns)

    def _leap_shift(self, host_minus_sensor_ns: I64, host_ns: I64) -> int:
        """What a clock that was set differs from UTC by, where it is atomic time, ns; any other difference is named."""
        known = host_ns > CLOCK_SET_NS
        if not known.any():
            return 0
        ahead_s = -1e-9 * float(np.min(host_minus_sensor_ns[known]))
        mode = self.metadata.timestamp_mode or "mode not said"
        if abs(ahead_s - TAI_AHEAD_S) < NEAR_TAI_S:
            self.notes.append(
                f"the sensor's clock ({mode}) is {ahead_s:.3f} s ahead of the capture's: atomic time, brought to UTC"
            )
            return -round(TAI_AHEAD_S * 1e9)
        if abs(ahead_s) > ODD_CLOCK_S:
            self.notes.append(
                f"warning: the sensor's clock ({mode}) is {ahead_s:+.3f} s from the capture's: the sensor's is taken"
            )
        return 0

    def _split(self) -> list[I64]:
        """Rows of each frame, by time."""
        if not len(self._columns.frame):
            return []
        ends = np.flatnonzero(np.diff(self._columns.frame)) + 1
        frames = np.split(np.arange(len(self._columns.frame)), ends)
        return [rows[np.argsort(self._columns.t_ns[rows], kind="stable")] for rows in frames]

    def _whole(self, frames: list[I64]) -> list[I64]:
        """Without the first and the last frame where the capture cut them off."""
        least, last = FULL * len(self.metadata.measured), len(frames) - 1
        kept = [rows for i, rows in enumerate(frames) if 0 < i < last or len(rows) >= least]
        self.left_out = len(frames) - len(kept)
        return kept

    def _count_missing(self, frames: list[I64]) -> None:
        """Columns that no packet brought, or that were not measured."""
        expected = len(self.metadata.measured)
        missing = np.array([max(expected - len(rows), 0) for rows in frames], np.int64)
        if missing.any():
            self.notes.append(
                f"{int(missing.sum())} of {expected * len(frames)} columns missing, in {int((missing > 0).sum())} of"
                f" {len(frames)} frames: the rest of these is kept"
            )

    def _in_order(self, frames: list[I64]) -> list[I64]:
        """Frames each later than the one before; those over which the clock stepped are named and left out."""
        kept: list[I64] = []
        odd: list[int] = []
        for i, rows in enumerate(frames):
            t_ns = self._columns.t_ns[rows]
            late = not kept or t_ns[0] > self._columns.t_ns[kept[-1][0]]
            if late and t_ns[-1] - t_ns[0] < MAX_FRAME_NS:
                kept.append(rows)
            else:
                odd.append(i)
        if odd:
            self.notes.append(
                f"warning: {len(odd)} frames in or after which the sensor's clock stepped (the first: frame {odd[0]}):"
                " left out"
            )
        return kept
